"""Rigid elements, constraint equations and concentrated masses in the translation to CalculiX."""

from __future__ import annotations

import itertools
from pathlib import Path

import numpy as np
import pytest

from modetune.adapters.translation.translation import translate
from modetune.core.errors import ModelError
from tests.adapters.solved import needs_ccx
from tests.adapters.test_translation import (
    MAT1,
    PSHELL,
    RHO,
    E,
    Grid,
    assert_shapes_match,
    bulk_of,
    card,
    plate_cards,
    probe,
    read_bulk,
    recorded_hz,
    solve,
    strip,
)


@needs_ccx
@pytest.mark.parametrize(
    ("name", "high"),
    # As the bare plate (cquad4): consistent against lumped masses, most in the short waves.
    [("rbe2_conm2", 0.03), ("rbe3_conm2", 0.025)],
)
def test_masses_on_rigid_elements_move_as_with_mystran(
    name: str, high: float, shared_data: Path, tmp_path: Path
) -> None:
    solved = solve(read_bulk(probe(shared_data, name)), tmp_path, 12)
    ratio = solved.result.modes.frequencies_hz[6:] / recorded_hz(shared_data, name)[6:]
    assert solved.result.n_rigid == 6
    assert ratio.min() > 1.0
    assert ratio.max() < 1.0 + high
    assert_shapes_match(shared_data, name, solved.result)


@needs_ccx
def test_a_clamp_through_a_rigid_element_is_a_clamp(tmp_path: Path) -> None:
    grid = Grid()
    plate = plate_cards(10, 4, 1.0, 0.4, grid=grid)
    edge = [grid.at(0.0, y) for y in (0.0, 0.1, 0.2, 0.3, 0.4)]
    spc = card("SPC1", 1, 123456, *edge)
    rigid = ["GRID,900,,-.1,.2,.1", "SPC1,1,123456,900", card("RBE2", 901, 900, 123456, *edge)]
    frequencies = []
    for name, cards in (("direct", [spc]), ("rigid", rigid)):
        folder = tmp_path / name
        folder.mkdir()
        bulk = bulk_of([MAT1, "PSHELL,1,1,.01,1,,1", *plate, *cards], folder, ["SPC=1"])
        frequencies.append(solve(bulk, folder).result.modes.frequencies_hz)
    # Both clamp the same nodes, midside ones included; only rounding differs.
    assert frequencies[1] == pytest.approx(frequencies[0], rel=1e-4)


@needs_ccx
@pytest.mark.parametrize("kind", ["RBE2", "RBAR"])
@pytest.mark.parametrize("direction", ["in_plane", "above"])
def test_a_heavy_body_at_the_tip_of_a_strip_has_the_frequency_of_its_lever(
    kind: str, direction: str, tmp_path: Path
) -> None:
    length, width, thick, mass = 1.0, 0.05, 0.005, 100.0
    grid = Grid()
    plate = plate_cards(20, 2, length, width, grid=grid)
    root = [grid.at(0.0, y) for y in (0.0, 0.025, 0.05)]
    tip = grid.at(length, 0.025)
    arm = 0.2
    place = (length + arm, 0.025, 0.0) if direction == "in_plane" else (length, 0.025, arm)
    link = (
        card("RBE2", 901, tip, 123456, 900)
        if kind == "RBE2"
        else card("RBAR", 901, tip, 900, 123456)
    )
    cards = [
        MAT1,
        f"PSHELL,1,1,{thick},1,,1",
        *plate,
        card("SPC1", 1, 123456, *root),
        link,
        f"GRID,900,,{place[0]},{place[1]},{place[2]}",
        f"CONM2,902,900,,{mass}",
    ]
    solved = solve(bulk_of(cards, tmp_path, ["SPC=1"]), tmp_path, 4)
    # Massless cantilever with a point mass on a rigid arm a along it: flexibility
    # (L^3 / 3 + a L^2 + a^2 L) / E I; on an arm across it, the mass also moves along by a theta.
    ei = E * width * thick**3 / 12
    if direction == "in_plane":
        flexibility = (length**3 / 3 + arm * length**2 + arm**2 * length) / ei
    else:
        matrix = (
            np.array([[length**3 / 3, length**2 / 2 * arm], [length**2 / 2 * arm, length * arm**2]])
            / ei
        )
        flexibility = float(np.linalg.eigvalsh(matrix)[-1])
    exact = (1.0 / (flexibility * mass)) ** 0.5 / 2 / np.pi
    # The strip weighs 0.7 % of the mass; its clamped root and its width stiffen by about 1 %.
    assert solved.result.modes.frequencies_hz[0] == pytest.approx(exact, rel=0.015)


@needs_ccx
@pytest.mark.parametrize(
    "inertia",
    [
        ("2.E-2", "0.", "3.E-2", "0.", "0.", "2.5E-2"),
        ("2.E-2", "2.E-3", "3.E-2", "-1.E-3", "3.E-3", "2.5E-2"),
        # No body has a single moment; the card may.
        ("2.E-2", "0.", "0.", "0.", "0.", "0."),
    ],
)
def test_a_free_plate_with_an_offset_body_has_six_rigid_modes_and_its_inertia(
    inertia: tuple[str, ...], tmp_path: Path
) -> None:
    body = ",".join(["CONM2", "900", "13", "", "4.", "0.02", "-0.01", "0.05", ""])
    cards = [
        MAT1,
        "PSHELL,1,1,.01,1,,1",
        *plate_cards(4, 4, 0.4, 0.4),
        body + "\n," + ",".join(inertia),
    ]
    solved = solve(bulk_of(cards, tmp_path), tmp_path, 10)
    assert solved.result.n_rigid == 6
    assert solved.result.mass == pytest.approx(0.16 * 0.01 * RHO + 4.0, rel=1e-5)
    # Sum rule of the body's share: phi^T M phi = 1 for rigid modes gives its inertia back.
    expected = rigid_body_mass(solved.translation.mass)
    found = rigid_body_mass_of_modes(solved)
    assert found == pytest.approx(expected, rel=5e-3, abs=5e-3 * float(np.abs(expected).max()))


def rigid_body_mass(mass) -> np.ndarray:  # type: ignore[no-untyped-def,type-arg]
    """(6, 6) about the origin, from mass, centre and inertia."""
    x, y, z = mass.centre
    skew = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    about = mass.inertia - mass.mass * skew @ skew
    return np.block([[mass.mass * np.eye(3), -mass.mass * skew], [mass.mass * skew, about]])


def rigid_body_mass_of_modes(solved) -> np.ndarray:  # type: ignore[no-untyped-def,type-arg]
    """(6, 6): rigid modes R q with unit modal mass have q^T M q = 1, so M = inv(q q^T)."""
    nodes = solved.result.modes.nodes[::3]
    deck = read_nodes(solved.translation.text)
    rows = []
    for node in nodes:
        x, y, z = deck[int(node)]
        rows += [[1, 0, 0, 0, z, -y], [0, 1, 0, -z, 0, x], [0, 0, 1, y, -x, 0]]
    motion = np.array(rows, dtype=np.float64)
    q = np.linalg.lstsq(motion, solved.result.modes.mode_shapes[:, :6], rcond=None)[0]
    return np.linalg.inv(q @ q.T)


def read_nodes(text: str) -> dict[int, tuple[float, ...]]:
    block = text.split("*ELEMENT")[0].split("\n")[1:-1]
    rows = [row.split(",") for row in block]
    return {int(row[0]): tuple(map(float, row[1:])) for row in rows}


@needs_ccx
def test_an_interpolation_element_on_solids_moves_with_the_mean_of_its_points(
    tmp_path: Path,
) -> None:
    # The point of an RBE3 in the middle of four corners moves with their mean.
    grid = Grid()
    square = ((0.0, 0.0), (0.1, 0.0), (0.1, 0.1), (0.0, 0.1))
    layers = (0.0, 0.1, 0.2, 0.3)
    solids = [
        card("CHEXA", i, 1, *[grid.at(x, y, z) for z in pair for x, y in square])
        for i, pair in enumerate(itertools.pairwise(layers), start=1)
    ]
    top = [grid.at(x, y, layers[-1]) for x, y in square]
    cards = [
        MAT1, "PSOLID,1,1", *grid.cards, *solids, "GRID,900,,.05,.05,.4",
        card("RBE3", 901, "", 900, 123456, 1.0, 123, *top), "CONM2,902,900,,5.",
    ]  # fmt: skip
    solved = solve(bulk_of(cards, tmp_path), tmp_path, 8)
    assert solved.result.n_rigid == 6
    modes = solved.result.elastic
    at = {
        int(node): modes.mode_shapes[3 * i : 3 * i + 3] for i, node in enumerate(modes.nodes[::3])
    }
    mean = np.mean([at[node] for node in top], axis=0)
    assert at[900][2] == pytest.approx(mean[2], rel=1e-4, abs=1e-5)


@needs_ccx
def test_an_equation_ties_what_it_names(tmp_path: Path) -> None:
    grid = Grid()
    plate = plate_cards(10, 1, 1.0, 0.1, grid=grid)
    ends = [grid.at(0.0, 0.0), grid.at(1.0, 0.0)]
    mpc = card("MPC", 1, ends[0], 3, 1.0, ends[1], 3, -1.0)
    bulk = bulk_of([MAT1, "PSHELL,1,1,.01,1,,1", *plate, mpc], tmp_path, ["MPC=1"])
    solved = solve(bulk, tmp_path, 8)
    shapes = solved.result.modes.mode_shapes
    rows = [3 * (node - 1) + 2 for node in ends]
    # The equation ties the means of the faces, ccx prints the middle: they differ by the change of
    # thickness, which matters where the plate bends in its plane.
    assert shapes[rows[0]] == pytest.approx(shapes[rows[1]], abs=2e-4 * np.abs(shapes).max())


def test_rigid_elements_that_cannot_be_are_refused_with_reasons(tmp_path: Path) -> None:
    cards = [
        MAT1,
        PSHELL,
        *strip(),
        "GRID,900,,.5,.5,.5",
        "GRID,901,,.5,.5,.6",
        "RBAR,910,900,901,123,45",
        "RBE3,911,,900,123456,1.,123,1,2",
        "RBE2,912,1,123456,2",
        "RBE2,913,3,123456,2",
    ]
    with pytest.raises(ModelError) as caught:
        translate(bulk_of(cards, tmp_path), "rigid.bdf")
    said = str(caught.value)
    assert "RBAR 910" in said
    assert "RBE3 911: its points do not determine all rotations of point 900" in said
    assert "RBE2 913" in said
    assert "RBE2 912 determine" in said


@needs_ccx
def test_an_independent_point_of_solids_turns_with_what_follows_it(tmp_path: Path) -> None:
    # A stack of bricks: two corners follow a third one, whose body turns about two axes with them;
    # about the line through all three nothing would hold it, and a mass there stays with the line.
    grid = Grid()
    square = ((0.0, 0.0), (0.1, 0.0), (0.1, 0.1), (0.0, 0.1))
    solids = [
        card("CHEXA", i + 1, 1, *[grid.at(x, y, 0.1 * z) for z in (i, i + 1) for x, y in square])
        for i in range(4)
    ]
    line = [grid.at(0.0, 0.0, z) for z in (0.4, 0.3, 0.2)]
    cards = [
        MAT1, "PSOLID,1,1", *grid.cards, *solids, "GRID,900,,-.1,0.,.4",
        card("RBE2", 901, line[0], 123, *line[1:], 900), "CONM2,902,900,,.5",
    ]  # fmt: skip
    solved = solve(bulk_of(cards, tmp_path), tmp_path, 10)
    # The rotation about the line is fixed, as AUTOSPC does: the offset mass then hinders the
    # rigid rotation about z a little, and one of the six rigid modes is no longer one of zero.
    assert solved.result.eigenvalues[7] > 1e3
    assert np.abs(solved.result.eigenvalues[:5]).max() < 1.0


def test_shells_without_area_are_refused(tmp_path: Path) -> None:
    cards = [
        MAT1,
        PSHELL,
        *strip(),
        "GRID,900,,.5,.5,.5",
        "GRID,901,,.5,.5,.6",
        "GRID,902,,.5,.5,.7",
        "GRID,903,,.5,.5,.5",
        "CTRIA3,910,1,900,901,902",
        "CQUAD4,911,1,900,903,901,902",
    ]
    with pytest.raises(ModelError) as caught:
        translate(bulk_of(cards, tmp_path), "flat.bdf")
    said = str(caught.value)
    assert "CTRIA3 910: its corners span no area" in said
    assert "CQUAD4 911: its corners span no area" in said
