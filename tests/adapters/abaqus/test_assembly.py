"""Assemblies in the keywords of Abaqus/CAE: flattened, solved, refused and edited."""

from __future__ import annotations

import difflib
import shutil
import threading
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from modetune.adapters.abaqus.flattening import FlatDeck, flatten, has_assembly
from modetune.adapters.abaqus.solver import assembly_solver
from modetune.adapters.calculix.deck import read_deck
from modetune.adapters.calculix.solver import calculix_solver
from modetune.adapters.process import run_process
from modetune.adapters.solver import ModalAnalysis, Solver
from modetune.core.errors import CampaignError, ModelError
from modetune.core.modes import Floats, mode_set
from modetune.core.parameters import Parameter
from modetune.core.updating.job_results import ModalResult
from modetune.flows.campaign.mapping import map_sensors
from modetune.flows.campaign.schema import SensorSection
from tests.adapters.abaqus.decks import (
    BAR,
    BEYOND,
    HEAD_INERTIA,
    HEAD_MASS,
    HIGH,
    SIDE,
    STEEL,
    STEP,
    THICK,
    WIDE,
    bracket,
    plate,
    tied_bars,
)

needs_ccx = pytest.mark.skipif(shutil.which("ccx") is None, reason="CalculiX (ccx) is not here")
E, RHO, NU = 210000.0, 7.85e-9, 0.3


def frequencies(solver: Solver, folder: Path, n_modes: int = 4) -> Floats:
    """Frequencies, Hz (n_modes,)."""
    folder.mkdir()
    nodes = tuple(sorted(solver.deck.summary.node_ids))[:1]
    analysis = ModalAnalysis(n_modes, nodes)
    solver.render({}, analysis).write(folder)
    finished = run_process(solver.program.command(1), folder, 120.0, threading.Event())
    result = solver.read({}, analysis, folder, finished.return_code)
    assert isinstance(result, ModalResult)
    return np.asarray(np.sqrt(np.maximum(result.eigenvalues, 0.0)) / (2.0 * np.pi))


def of_text(text: str, folder: Path, parameters: tuple[Parameter, ...] = ()) -> Solver:
    path = folder / "model.inp"
    path.write_text(text)
    return assembly_solver(read_deck(path), parameters)


def flat(text: str, folder: Path) -> FlatDeck:
    (folder / "model.inp").write_text(text)
    return flatten(read_deck(folder / "model.inp"))


def cantilever() -> Floats:
    """First bending about both axes of a bar of twice the length, of Euler and Bernoulli."""
    speeds = np.sqrt(E / RHO * np.array([HIGH, WIDE]) ** 2 / 12)
    return np.asarray(1.8751**2 / (2 * np.pi * (2 * BAR) ** 2) * speeds)


def head_on_bar() -> Floats:
    """First bending about both axes of a beam of one cubic element with a rigid head."""
    found, arm = [], np.array([[1.0, BEYOND], [0.0, 1.0]])
    for wide, high in ((WIDE, HIGH), (HIGH, WIDE)):
        bending, line = E * wide * high**3 / 12, RHO * wide * high * BAR / 420
        stiffness = bending / BAR**3 * np.array([[12, -6 * BAR], [-6 * BAR, 4 * BAR**2]])
        mass = line * np.array([[156, -22 * BAR], [-22 * BAR, 4 * BAR**2]])
        mass = mass + arm.T @ np.diag([HEAD_MASS, HEAD_INERTIA]) @ arm
        found.append(np.linalg.eigvals(np.linalg.solve(mass, stiffness)).min())
    return np.asarray(np.sqrt(np.array(found)) / (2 * np.pi))


def clamped_plate() -> Floats:
    """The first three of a clamped square (Leissa, Vibration of Plates, 1969, table 4.24)."""
    rigidity = E * THICK**3 / 12 / (1 - NU**2)
    factors = np.array([35.99, 73.41, 73.41])
    return np.asarray(factors / (2 * np.pi * SIDE**2) * np.sqrt(rigidity / RHO / THICK))


@needs_ccx
@pytest.mark.parametrize(
    ("case", "closed", "within"),
    [
        (tied_bars, cantilever, 0.01),  # a bar of 20 heights
        (bracket, head_on_bar, 0.015),  # a bar of 5 to 10 heights
        (plate, clamped_plate, 0.02),  # 20 linear elements along a side
    ],
)
def test_flattened_assemblies_have_the_frequencies_of_those_flattened_by_hand(
    case: Callable[[], tuple[str, str]],
    closed: Callable[[], Floats],
    within: float,
    tmp_path: Path,
) -> None:
    text, by_hand = case()
    ours = frequencies(of_text(text, tmp_path), tmp_path / "ours")
    (tmp_path / "hand.inp").write_text(by_hand)
    theirs = frequencies(calculix_solver(tmp_path / "hand.inp", ()), tmp_path / "theirs")
    assert ours == pytest.approx(theirs, rel=1e-9)
    expected = closed()
    assert ours[: expected.size] == pytest.approx(expected, rel=within)


@needs_ccx
def test_of_several_steps_the_chosen_or_the_last_one_gives_the_modes(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """Supports of a frequency step, a perturbation, are of this step alone."""
    clamped, _ = tied_bars()
    model, _, _ = clamped.partition("** STEP: Modes")
    free = model + STEP.format(boundary="")
    path = tmp_path / "both.inp"
    path.write_text(clamped + STEP.format(boundary=""))
    for number, alone in ((1, clamped), (2, free), (0, free)):
        folder = tmp_path / str(number)
        folder.mkdir()
        ours = assembly_solver(read_deck(path, number), ())
        found = frequencies(ours, folder / "ours", 8)
        expected = frequencies(of_text(alone, folder), folder / "alone", 8)
        assert found == pytest.approx(expected, rel=1e-9, abs=1e-9)
    (said,) = [text for text in caplog.messages if "the modes are those of" in text]
    assert "step 2, the last with *FREQUENCY" in said


def test_an_instance_is_moved_then_turned_about_the_axis_through_two_points(tmp_path: Path) -> None:
    found = flat(
        box("  1., 0., 0.\n  1., 0., 0., 1., 0., 1., 90."), tmp_path
    )  # (1, 0, 0) moved to (2, 0, 0), turned by 90 degrees about z through (1, 0, 0): (1, 1, 0)
    numbers = {name: number for number, name in found.labels.items()}
    rows = [
        line.text for line in found.deck.lines if line.text.startswith(f"{numbers['BOX-1.2']},")
    ]
    assert [float(x) for x in rows[0].split(",")[1:]] == pytest.approx([1.0, 1.0, 0.0], abs=1e-12)


def test_nodes_sets_and_instances_keep_their_names(tmp_path: Path) -> None:
    found = flat(tied_bars()[0], tmp_path)
    assert found.labels[1] == "BAR-1.1"
    assert found.labels[1001] == "BAR-2.1"
    names = {card.option("ELSET") for card in found.deck.named("*ELSET")}
    assert {"BAR-1.WHOLE", "BAR-2.WHOLE", "_TIP_S4", "_START_S6"} <= names


@needs_ccx
def test_a_shell_edge_in_a_coupling_turns_with_its_point(tmp_path: Path) -> None:
    """A strip with a head beyond its edge is the beam with a head, not a hinge."""
    nodes = [f"{10 * i + j}, {5.0 * i}, {10.0 * j}, 0." for i in range(21) for j in (0, 1)]
    corners = [(10 * i, 10 * i + 10, 10 * i + 11, 10 * i + 1) for i in range(20)]
    rows = [f"{i + 1}, {', '.join(map(str, c))}" for i, c in enumerate(corners)]
    text = f"""\
*Part, name=Strip
*Node
{chr(10).join(f"{int(n.split(',')[0]) + 1},{n.split(',', 1)[1]}" for n in nodes)}
*Element, type=S4R, elset=Skin
{chr(10).join(shifted(row) for row in rows)}
*Nset, nset=Root
1, 2
*Nset, nset=End
201, 202
*Shell Section, elset=Skin, material=Steel
1.,
*End Part
*Assembly, name=Assembly
*Instance, name=Strip-1, part=Strip
*End Instance
*Node
1, {100.0 + BEYOND}, 5., 0.
*Nset, nset=Point
1
*Element, type=MASS, elset=Head
1, 1
*Mass, elset=Head
{HEAD_MASS}
*Surface, type=NODE, name=Edge
Strip-1.End, 1.
*Coupling, constraint name=Joint, ref node=Point, surface=Edge
*Kinematic
*End Assembly
{STEEL.replace("0.3", "0.")}*Boundary
Strip-1.Root, ENCASTRE
"""
    first = frequencies(of_text(text, tmp_path), tmp_path / "job", 1)[0]
    bending = E * 10.0 / 12
    stiffness = bending / BAR**3 * np.array([[12, -6 * BAR], [-6 * BAR, 4 * BAR**2]])
    arm = np.array([[1.0, BEYOND], [0.0, 1.0]])
    flexibility = (arm @ np.linalg.solve(stiffness, arm.T))[0, 0]
    expected = 1.0 / (2 * np.pi * np.sqrt(flexibility * (HEAD_MASS + 0.24 * RHO * 1000.0)))
    assert first == pytest.approx(expected, rel=0.01)  # the beam's own mass is 0.4 % of the head's


def shifted(row: str) -> str:
    number, *nodes = map(int, row.split(","))
    return ", ".join(map(str, [number, *(node + 1 for node in nodes)]))


@needs_ccx
def test_an_updated_deck_changes_the_authors_value_lines_alone(tmp_path: Path) -> None:
    text = bracket()[0].replace("\n", "\r\n")
    (tmp_path / "model.inp").write_bytes(text.encode())
    parameters = (
        Parameter("E", "youngs_modulus", "material", ("Steel",), 0.5, 2.0, 0.2),
        Parameter("m", "mass", "elset", ("_PickedSet7_Inertia-1_MASS_",), 0.5, 2.0, 0.2),
    )
    deck = assembly_solver(read_deck(tmp_path / "model.inp"), parameters).deck
    written = deck.write_updated({"E": 0.5, "m": 1.5}, tmp_path / "updated").read_bytes()
    changes = [
        line
        for line in difflib.ndiff(text.splitlines(), written.decode().splitlines())
        if line[0] in "+-"
    ]
    assert changes == ["- 0.002,", "+ 0.003,", "- 210000., 0.3", "+ 105000.0, 0.3"]
    assert written.count(b"\r\n") == text.count("\r\n") == written.count(b"\n")


def test_sections_of_one_part_are_moved_together_or_refused(tmp_path: Path) -> None:
    text = plate()[0]
    both = of_text(text, tmp_path).deck.targets()
    names = [target.names for target in both if target.by == "elset"]
    assert names == [("LEFT.SKIN", "RIGHT.SKIN")]
    one = Parameter("t", "thickness", "elset", ("LEFT.SKIN",), 0.5, 2.0, 0.2)
    (reason,) = of_text(text, tmp_path, (one,)).deck.problems((one,))
    assert "LEFT.SKIN, RIGHT.SKIN: name all of them" in reason
    all_of = Parameter("t", "thickness", "elset", names[0], 0.5, 2.0, 0.2)
    deck = of_text(text, tmp_path, (all_of,)).deck
    assert not deck.problems((all_of,))
    assert deck.deck_value(all_of) == THICK


def test_a_flat_deck_with_named_supports_is_one_too(tmp_path: Path) -> None:
    (tmp_path / "a.inp").write_text("*NODE\n1,0.,0.,0.\n*BOUNDARY\n1, encastre\n")
    assert has_assembly(read_deck(tmp_path / "a.inp"))
    (tmp_path / "a.inp").write_text("*NODE\n1,0.,0.,0.\n*BOUNDARY\n1, 1, 3\n")
    assert not has_assembly(read_deck(tmp_path / "a.inp"))


def box(moved: str = "  0., 0., 0.", more: str = "", of_part: str = "", end: str = "") -> str:
    """One brick as a part with an instance, and further lines in the assembly and the part."""
    return f"""\
*Part, name=Box
*Node
1, 0., 0., 0.
2, 1., 0., 0.
3, 1., 1., 0.
4, 0., 1., 0.
5, 0., 0., 1.
6, 1., 0., 1.
7, 1., 1., 1.
8, 0., 1., 1.
*Element, type=C3D8I, elset=All
1, 1, 2, 3, 4, 5, 6, 7, 8
*Solid Section, elset=All, material=Steel
,
{of_part}*End Part
*Assembly, name=Assembly
*Instance, name=Box-1, part=Box
{moved}
*End Instance
*Nset, nset=Root, instance=Box-1
1, 2, 3, 4
{more}*End Assembly
{STEEL}*Boundary
Root, ENCASTRE
{end}"""


@pytest.mark.parametrize(
    ("changes", "line", "said"),
    [
        ({"more": "*Element, type=CONN3D2, elset=Wire\n1, Box-1.1, Box-1.7\n"}, 22, "CONN3D2"),
        ({"more": "*Nset, nset=A, instance=Box-9\n1\n"}, 22, "BOX-9"),
        ({"more": "*Nset, nset=A, instance=Box-1\n99\n"}, 23, "no node 99 of instance BOX-1"),
        ({"more": "*Embedded Element, host elset=Box-1.All\n"}, 22, "*EMBEDDEDELEMENT"),
        ({"more": "*Coupling, constraint name=C, ref node=Root, surface=S\n"}, 22, "ROOT has 4"),
        ({"of_part": "*Distribution, name=Angles\n"}, 15, "*DISTRIBUTION ANGLES of part BOX"),
        ({"moved": "  0., 0., 0.\n  1., 1., 1., 1., 1., 1., 90."}, 19, "the axis of BOX-1"),
        ({"moved": "  0., zero, 0."}, 18, "numbers expected"),
        ({"end": "*Step, nlgeom=YES\n*Static\n*End Step\n*Step\n*Frequency\n3\n*End Step\n"}, 33,
         "NLGEOM"),
        ({"end": "*Boundary\nRoot, NOWARP\n"}, 34, "NOWARP"),
        ({"end": "*Initial Conditions, type=STRESS\n"}, 33, "*INITIALCONDITIONS STRESS"),
    ],
)  # fmt: skip
def test_what_cannot_be_expressed_is_refused_with_file_line_and_name(
    changes: dict[str, str], line: int, said: str, tmp_path: Path
) -> None:
    with pytest.raises(ModelError) as refused:
        flat(box(**changes), tmp_path)
    assert f"model.inp, line {line}: " in str(refused.value)
    assert said in str(refused.value)


@pytest.mark.parametrize(
    ("lines", "said"),
    [
        ("*Elastic, type=LAMINA\n1., 1., .3, 1., 1., 1.\n", "TYPE=LAMINA"),
        ("*Hyperelastic\n1., 1.\n", "*HYPERELASTIC of material STEEL"),
    ],
)
def test_materials_without_counterpart_are_refused_by_name(
    lines: str, said: str, tmp_path: Path
) -> None:
    text = box().replace("*Elastic\n210000., 0.3\n", lines)
    with pytest.raises(ModelError, match=r"model\.inp, line 29") as refused:
        flat(text, tmp_path)
    assert said in str(refused.value)


def test_a_node_of_an_instance_is_a_landmark_by_its_name(tmp_path: Path) -> None:
    mesh = of_text(box(more="*Node\n1, 5., 0., 0.\n"), tmp_path).deck.mesh()
    assert mesh.names[2] == "BOX-1.2"
    shapes = mode_set(np.array([10.0]), np.ones((2, 1)), np.array([7, 9]), np.array([3, 3]))
    sensors = SensorSection(by="number", match={7: "Box-1.6", 9: 8})
    found = map_sensors(shapes, None, mesh, sensors, 1e-3)
    assert [(row.model_node, row.node_name) for row in found.table] == [
        (6, "BOX-1.6"),
        (8, "BOX-1.8"),
    ]
    wrong = SensorSection(by="number", match={7: "Box-1.66"})
    with pytest.raises(CampaignError, match=r"Box-1\.66, which is not there"):
        map_sensors(shapes, None, mesh, wrong, 1e-3)


@pytest.mark.parametrize(
    "joint",
    [
        "*Coupling, constraint name=C, ref node=Point, surface=Face\n*Kinematic\n",
        "*Coupling, constraint name=C, ref node=Point, surface=Face\n*Distributing\n",
        "*Kinematic Coupling, ref node=Point\nTop, 1, 3\n",
        "*Rigid Body, ref node=Point, pin nset=Top\n",
        "*MPC\nBEAM, Top, Point\n",
    ],
)
def test_rigid_motions_meet_the_equations_of_every_joint(joint: str, tmp_path: Path) -> None:
    """A joint that resists no rigid motion of the whole is built with the right arms and signs."""
    more = (
        "*Node\n1, 3., -1., 2.\n*Nset, nset=Point\n1\n*Nset, nset=Top, instance=Box-1\n5, 6, 7, 8\n"
        f"*Surface, type=ELEMENT, name=Face\nBox-1.All, S2\n{joint}"
    )
    found = flat(box("  1., 2., 3.\n  1., 0., 0., 2., 1., 3., 40.", more), tmp_path)
    places = {
        int(fields[0]): np.array(fields[1:4], dtype=float)
        for card in found.deck.named("*NODE")
        for fields in map(found.deck.fields, card.data)
    }
    point = next(number for number, name in found.labels.items() if name == "ASSEMBLY.1")
    (turn,) = places.keys() - found.labels.keys()  # the node made for the rotation of the point
    random = np.random.default_rng(3)
    shift, angles = random.normal(size=3), random.normal(size=3)
    moved = {node: shift + np.cross(angles, place) for node, place in places.items()}
    moved[turn] = angles
    cards = found.deck.named("*EQUATION")
    named = set()
    for card in cards:
        words = [word for line in card.data[1:] for word in found.deck.fields(line)]
        terms = [words[at : at + 3] for at in range(0, len(words), 3)]
        assert len(terms) == int(found.deck.fields(card.data[0])[0])
        named |= {int(node) for node, _, _ in terms}
        rest = sum(float(factor) * moved[int(node)][int(c) - 1] for node, c, factor in terms)
        assert rest == pytest.approx(0.0, abs=1e-9)  # factors have 12 digits
    assert len(cards) in (6, 12)
    assert {point, turn} <= named
