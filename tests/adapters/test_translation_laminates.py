"""Laminates, sandwiches and shells of unlike membrane and bending in the translation to CalculiX.

Closed forms decide: classical laminate theory for thin strips, and for sandwiches the simply
supported plate with transverse shear, omega^2 = D k^4 / (m (1 + D k^2 / H)).
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from modetune.adapters.nastran.shell_laws import law_of
from tests.adapters.solved import needs_ccx
from tests.adapters.test_translation import (
    LENGTH,
    MAT1,
    MAT8,
    NU,
    RHO,
    THICK,
    WIDTH,
    E,
    Grid,
    Solved,
    bulk_of,
    card,
    plate_cards,
    solve,
    strip,
    strip_frequency,
)

#: Faces of 1 mm aluminium on 18 mm of honeycomb: E, G in Pa, densities in kg/m3.
FACE, CORE, CORE_G, CORE_RHO = 0.001, 0.018, 80e6, 50.0
HONEYCOMB = f"MAT8,2,1.E5,1.E5,.3,1.E5,{CORE_G},{CORE_G},{CORE_RHO}"
SANDWICH = f"PCOMP,1\n,1,{FACE},0.,YES,2,{CORE},0.,YES\n,1,{FACE},0.,YES"


def law(folder: Path, *cards: str):  # type: ignore[no-untyped-def]
    bulk = bulk_of([MAT1, MAT8.replace("MAT8,1", "MAT8,8"), *cards, *strip()], folder)
    return law_of(bulk.properties[1])


# ---- laws


def test_a_pshell_has_a_law_of_its_own_for_each_of_its_materials(tmp_path: Path) -> None:
    found = law(tmp_path, "PSHELL,1,1,.002,8,3.,1,.5,4.\n,,,1")
    q1 = E / (1 - NU**2) * np.array([[1, NU, 0], [NU, 1, 0], [0, 0, (1 - NU) / 2]])
    share = 1 - 0.3**2 * 10 / 70  # MAT8: E1, E2, nu12, G12 = 70, 10 GPa, 0.3, 5 GPa
    q8 = 1e9 * np.array(
        [[70 / share, 3 / share, 0], [3 / share, 10 / share, 0], [0, 0, 5]]
    )  # fmt: skip
    np.testing.assert_allclose(found.membrane, 0.002 * q1)
    np.testing.assert_allclose(found.bending, 3.0 * 0.002**3 / 12 * q8)
    np.testing.assert_allclose(found.coupling, 0.002**2 * q1)
    np.testing.assert_allclose(found.shear, 0.5 * 0.002 * E / 2 / (1 + NU) * np.eye(2))
    assert found.mass == pytest.approx(0.002 * RHO + 4.0)


def test_plies_are_stacked_from_the_bottom_up(tmp_path: Path) -> None:
    found = law(tmp_path, "MAT1,2,7.E9,,.3,900.", "PCOMP,1\n,1,.001,0.,YES,2,.003,0.,YES")
    # E dz and E z dz of 70 GPa from -2 to -1 mm and 7 GPa from -1 to 2 mm.
    plane = 1 / (1 - NU**2)
    assert found.membrane[0, 0] == pytest.approx((70e9 * 1e-3 + 7e9 * 3e-3) * plane)
    assert found.coupling[0, 0] == pytest.approx((70e9 * -1.5e-6 + 7e9 * 1.5e-6) * plane)
    assert found.bending[0, 0] == pytest.approx((70e9 * 7 / 3 + 7e9 * 3) * 1e-9 * plane)
    assert found.mass == pytest.approx(0.001 * RHO + 0.003 * 900.0)


def test_shear_stiffness_is_that_of_equilibrium(tmp_path: Path) -> None:
    plate = law(tmp_path, "PCOMP,1\n,1,.002,0.,YES,1,.002,45.,YES")
    homogeneous = 5 / 6 * 0.004 * E / 2 / (1 + NU)
    assert plate.shear == pytest.approx(homogeneous * np.eye(2), abs=1e-12 * homogeneous)
    sandwich = law(tmp_path, HONEYCOMB, SANDWICH)
    # Thin faces on a soft core: G (c + f)^2 / c; the faces' own bending and shear are 1 % of it.
    assert sandwich.shear[0, 0] == pytest.approx(CORE_G * (CORE + FACE) ** 2 / CORE, rel=0.01)
    blank = law(tmp_path, "MAT8,2,7.E10,7.E10,.3,5.E9,0.,0.,900.", "PCOMP,1\n,2,.002,0.")
    assert blank.shear[0, 0] > 10 * blank.membrane[2, 2]


# ---- closed forms


@needs_ccx
@pytest.mark.parametrize(
    ("cards", "modulus"),
    [
        ([f"PSHELL,1,1,{THICK},1,4.,1"], 4 * E),
        ([MAT8.replace("MAT8,1", "MAT8,8"), f"PSHELL,1,8,{THICK},1,.5,1"], 0.5 * E),
        (["MAT2,8,10.E9,2.E9,0.,20.E9,0.,5.E9", f"PSHELL,1,1,{THICK},8"], 10e9 - 2e9**2 / 20e9),
    ],
    ids=["12I/T3", "membrane_of_another", "mat2"],
)
def test_a_strip_bends_by_its_bending_material(
    cards: list[str], modulus: float, tmp_path: Path
) -> None:
    solved = solve(bulk_of([MAT1, *cards, *strip(",0.")], tmp_path), tmp_path)
    assert solved.frequencies_hz[0] == pytest.approx(strip_frequency(modulus), rel=0.005)


def supported(n: int, side: float, cards: list[str], folder: Path, kind: str = "CQUAD4") -> Solved:
    """A square plate on simple supports that hold the rotation along the edge too."""
    grid = Grid()
    plate = plate_cards(n, n, side, side, kind=kind, grid=grid)
    at = np.linspace(0.0, side, (2 * n if kind in ("CQUAD8", "CTRIA6") else n) + 1)
    along_x = [grid.at(x, y) for x in at for y in (0.0, side)]
    along_y = [grid.at(x, y) for y in at for x in (0.0, side)]
    holds = [
        card("SPC1", 1, 135, *along_x), card("SPC1", 1, 234, *along_y),
        card("SPC1", 1, 12, grid.at(side / 2, side / 2)),
        card("SPC1", 1, 1, grid.at(side / 2, 0.0)),
    ]  # fmt: skip
    return solve(bulk_of([*cards, *plate, *holds], folder, ["SPC=1"]), folder, 6)


@needs_ccx
@pytest.mark.parametrize("kind", ["CQUAD4", "CTRIA3", "CQUAD8", "CTRIA6", "CQUADR", "CTRIAR"])
def test_a_honeycomb_panel_has_the_frequency_of_a_sandwich(kind: str, tmp_path: Path) -> None:
    side, mass = 1.0, 2 * FACE * RHO + CORE * CORE_RHO
    solved = supported(6, side, [MAT1, HONEYCOMB, SANDWICH], tmp_path, kind)
    bending = E / (1 - NU**2) * ((CORE + 2 * FACE) ** 3 - CORE**3) / 12
    shear = CORE_G * (CORE + FACE) ** 2 / CORE
    k2 = 2 * (np.pi / side) ** 2
    exact = (bending * k2**2 / mass / (1 + bending * k2 / shear)) ** 0.5 / 2 / np.pi
    assert bending * k2 / shear > 0.05  # the core's shear matters
    # Six elements a half wave; triangles come from above.
    rel = 0.03 if "TRIA" in kind else 0.005
    assert solved.frequencies_hz[0] == pytest.approx(exact, rel=rel)


@needs_ccx
def test_the_same_sandwich_as_a_pshell_is_the_same_panel(tmp_path: Path) -> None:
    (tmp_path / "pshell").mkdir()
    mass, thick = 2 * FACE * RHO + CORE * CORE_RHO, 2 * FACE
    inertia = ((CORE + 2 * FACE) ** 3 - CORE**3) / thick**3
    tst = (CORE + FACE) ** 2 / CORE / thick
    core = f"MAT1,2,,{CORE_G},.3,0."
    section = f"PSHELL,1,1,{thick},1,{inertia:.6f},2,{tst:.6f},{mass - thick * RHO:.6f}"
    plies = supported(4, 1.0, [MAT1, HONEYCOMB, SANDWICH], tmp_path)
    plate = supported(4, 1.0, [MAT1, core, section], tmp_path / "pshell")
    # The plies' shear stiffness counts the faces' own bending, about a hundredth of a tenth.
    assert plate.frequencies_hz == pytest.approx(plies.frequencies_hz, rel=0.003)


# ---- what stands on laminates


@needs_ccx
@pytest.mark.parametrize("how", ["mass", "rigid_arm", "spring_end", "bar"])
def test_masses_springs_beams_and_rigid_arms_stand_on_a_laminate(how: str, tmp_path: Path) -> None:
    grid, body, n = Grid(), 200.0, 20
    plate = plate_cards(n, 2, LENGTH, WIDTH, ",0.", grid=grid)
    root = [grid.at(0.0, y) for y in (0.0, WIDTH / 2, WIDTH)]
    tip, arm, spring = grid.at(LENGTH, WIDTH / 2), 0.3, 2000.0
    far = f"GRID,900,,{LENGTH + arm},{WIDTH / 2},0."
    added = {
        "mass": [card("CONM2", 901, tip, "", body)],
        "rigid_arm": [far, card("RBE2", 902, tip, 123456, 900), card("CONM2", 901, 900, "", body)],
        "spring_end": [card("CONM2", 901, tip, "", body), card("CELAS2", 902, spring, tip, 3)],
        "bar": [
            far, card("CBAR", 902, 9, tip, 900, 0.0, 0.0, 1.0), "PBAR,9,9,1.,1.,1.,1.",
            "MAT1,9,70.E9,,.3", card("CONM2", 901, 900, "", body),
        ],
    }  # fmt: skip
    plies = "PCOMP,1,,,,,,,SYM\n,1,.00125,0.,YES,1,.00125,90.,YES"
    cards = [MAT8, plies, *plate, card("SPC1", 1, 123456, *root), *added[how]]
    solved = solve(bulk_of(cards, tmp_path, ["SPC=1"]), tmp_path, 2)
    # A massless cantilever of 62.5 GPa (test_fibres_point_where_the_cards_say).
    ei = 62.5e9 * WIDTH * THICK**3 / 12
    reach = arm if how in ("rigid_arm", "bar") else 0.0
    flexibility = (LENGTH**3 / 3 + reach * LENGTH**2 + reach**2 * LENGTH) / ei
    stiffness = 1 / flexibility + (spring if how == "spring_end" else 0.0)
    exact = (stiffness / body) ** 0.5 / 2 / np.pi
    # The strip weighs 0.1 % of the body; clamping its width at the root stiffens by 0.3 %.
    assert solved.frequencies_hz[0] == pytest.approx(exact, rel=0.006)


@needs_ccx
def test_a_free_unsymmetric_warped_laminate_has_six_rigid_modes(tmp_path: Path) -> None:
    grid = Grid()
    cards = [MAT8, "PCOMP,1,.001\n,1,.002,30.,YES,1,.001,-60.,YES"]
    elements = list[str]()
    for i in range(4):
        for j in range(3):
            ring = [(i, j), (i + 1, j), (i + 1, j + 1), (i, j + 1)]
            places = [(0.1 * a, 0.1 * b, 0.01 * a * b + 0.02 * a**2) for a, b in ring]
            elements.append(card("CQUAD4", len(elements) + 1, 1, *(grid.at(*p) for p in places)))
    solved = solve(bulk_of([*cards, *grid.cards, *elements, "CONM2,99,7,,1."], tmp_path), tmp_path)
    assert solved.result.n_rigid == 6
    lowest = solved.result.eigenvalues[6]
    assert np.abs(solved.result.eigenvalues[:6]).max() < 1e-6 * lowest  # rounding


# ---- no stiffness in some directions


@needs_ccx
def test_a_membrane_moves_in_its_plane_and_a_plate_without_one_across(tmp_path: Path) -> None:
    grid = Grid()
    plate = plate_cards(4, 4, 1.0, 1.0, grid=grid)
    root = card("SPC1", 1, 123456, *(grid.at(0.0, y) for y in (0.0, 0.25, 0.5, 0.75, 1.0)))
    found = {}
    for name, section in (("membrane", "1,.01"), ("bending", ",.01,1"), ("both", "1,.01,1")):
        folder = tmp_path / name
        folder.mkdir()
        bulk = bulk_of([MAT1, f"PSHELL,1,{section}", *plate, root], folder, ["SPC=1"])
        found[name] = solve(bulk, folder, 20).result.modes.frequencies_hz
    np.testing.assert_allclose(found["bending"][:4], found["both"][:4], rtol=1e-6)
    assert np.abs(found["both"] / found["membrane"][0] - 1.0).min() < 1e-6


@needs_ccx
def test_a_free_box_of_membranes_has_six_rigid_modes(tmp_path: Path) -> None:
    grid, elements = Grid(), list[str]()
    steps = [(i / 2, j / 2) for i in range(2) for j in range(2)]
    for u, v in steps:
        for axis in range(3):
            for w in (0.0, 1.0):
                ring = [(u, v), (u + 0.5, v), (u + 0.5, v + 0.5), (u, v + 0.5)]
                places = [tuple(np.roll((a, b, w), axis)) for a, b in ring]
                nodes = [grid.at(*place) for place in places]
                elements.append(card("CQUAD4", len(elements) + 1, 1, *nodes))
    solved = solve(bulk_of([MAT1, "PSHELL,1,1,.01", *grid.cards, *elements], tmp_path), tmp_path)
    assert solved.result.n_rigid == 6
    # No mode of single unsupported nodes below those of the box.
    assert solved.frequencies_hz[0] > 500.0


# ---- pyramids


@needs_ccx
def test_a_free_bar_of_pyramids_bends_as_timoshenko_says(tmp_path: Path) -> None:
    grid, elements, n, b, length = Grid(), list[str](), 10, 0.05, 0.5
    faces = ((0, 1, 2, 3), (4, 7, 6, 5), (0, 4, 5, 1), (1, 5, 6, 2), (2, 6, 7, 3), (3, 7, 4, 0))
    for i in range(n):
        ends = i * length / n, (i + 1) * length / n
        brick = [(ends[k], y, z) for z in (0.0, b) for k, y in ((0, 0.0), (1, 0.0), (1, b), (0, b))]
        apex = np.mean(brick, axis=0)
        for face in faces:
            ring = np.array([brick[k] for k in face])
            middles = [*(ring + np.roll(ring, -1, axis=0)) / 2, *(ring + apex) / 2]
            nodes = [grid.at(*place) for place in (*ring, apex, *middles)]
            elements.append(card("CPYRAM", len(elements) + 1, 1, *nodes))
    bulk = bulk_of([MAT1, "PSOLID,1,1", *grid.cards, *elements], tmp_path)
    solved = solve(bulk, tmp_path, 10)
    assert solved.result.mass == pytest.approx(RHO * length * b * b)
    # Euler and Bernoulli; shear and rotary inertia take 1.4 % at b / L = 0.1, the mesh gives some.
    slender = 4.7300407**2 / 2 / np.pi * (E * b**2 / 12 / RHO) ** 0.5 / length**2
    assert solved.frequencies_hz[0] == pytest.approx(slender, rel=0.015)
