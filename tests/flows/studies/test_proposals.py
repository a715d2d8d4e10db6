"""Changes that a model lacks: found from tests of solvers' own runs of the changed decks."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml
from benchmarks.proposals import campaign_of, searching
from benchmarks.zoo.__main__ import truth_of
from benchmarks.zoo.matrix_models import chain
from benchmarks.zoo.structure import Structure

import modetune
from modetune.adapters.solver import Addition
from modetune.adapters.test_files.modes_csv import write_modes_csv
from modetune.configs.cases import write_case
from modetune.configs.measuring import noisy, signed
from modetune.core.modes import ModeSet
from modetune.flows.campaign.campaign import Campaign
from modetune.flows.studies.localise.apply import applied
from modetune.flows.studies.localise.changes import ModelChange
from modetune.flows.studies.localise.proposals import ChangeSearch, Proposal
from tests.command_line import run_command

needs_ccx = pytest.mark.skipif(shutil.which("ccx") is None, reason="CalculiX (ccx) is not here")
needs_mystran = pytest.mark.skipif(
    shutil.which("mystran") is None, reason="MYSTRAN is not here (tools/mystran.sh)"
)
#: Noise that the campaigns of these tests state.
FREQUENCY, SHAPE = 0.002, 0.05
#: An estimate of the change's size within so many of its standard errors.
SURE = 4.0


@contextmanager
def searched(
    structure: Structure, real: Structure, truth: dict[str, float], folder: Path, noise: int = 1
) -> Iterator[ChangeSearch]:
    """A search on a structure whose test is of another one; noise: seed, 0 for none."""
    (folder / "true").mkdir(parents=True)
    modes, _ = truth_of(real, truth, folder / "true")
    if noise:
        modes = noisy(modes, FREQUENCY, SHAPE, noise)
    campaign = campaign_of(structure, modes, folder / "campaign")
    with searching(campaign, np.array([truth[n] for n in campaign.parameters.names])) as (it, _):
        yield it


def soft_root(stiffness: float) -> str:
    """Springs along x at the root of `block`."""
    text = "*ELEMENT, TYPE=SPRING1, ELSET=SOFT\n"
    text += "".join(f"{1000 + n}, {n}\n" for n in range(1, 5))
    return text + f"*SPRING, ELSET=SOFT\n1\n{stiffness}\n"


def boom(more: str = "", held: str = "123456") -> Structure:
    """A cantilever of bars, on MYSTRAN. held: components of its root; more: cards."""
    text = "SOL 103\nCEND\nMETHOD = 1\nSPC = 1\nBEGIN BULK\nEIGRL,1,,,12\nPARAM,COUPMASS,1\n"
    text += "".join(f"GRID,{n + 1},,{120.0 * n},0.,0.\n" for n in range(11))
    for n in range(10):
        text += f"CBAR,{n + 1},{1 + n // 5},{n + 1},{n + 2},0.,0.,1.\n"
    for number in (1, 2):
        text += f"PBAR,{number},{number},300.,9000.,16000.,20000.\n"
        text += f"MAT1,{number},70000.,,.33,2.7-9\n"
    return Structure(
        "boom", f"{text}SPC1,1,{held},1\n{more}ENDDATA\n",
        tuple({"name": f"E{n}", "quantity": "youngs_modulus", "material": n} for n in (1, 2)),
        tuple(range(2, 12)), 6, solver="mystran",
    )  # fmt: skip


def block(held: tuple[int, int], more: str = "") -> Structure:
    """A cantilever of solids in two materials. held: directions at its root; more: cards."""
    nx, ny, nz = 6, 1, 1
    number = {
        (i, j, k): 1 + i * (ny + 1) * (nz + 1) + j * (nz + 1) + k
        for i in range(nx + 1)
        for j in range(ny + 1)
        for k in range(nz + 1)
    }
    text = "*NODE, NSET=NALL\n" + "".join(
        f"{n}, {25.0 * i}, {40.0 * j}, {9.0 * k}\n" for (i, j, k), n in number.items()
    )
    corners = [(0, 0), (1, 0), (1, 1), (0, 1)]
    for name, columns in (("ROOT", range(3)), ("TIP", range(3, nx))):
        text += f"*ELEMENT, TYPE=C3D8I, ELSET={name}\n"
        for i in columns:
            for j in range(ny):
                own = [number[i + a, j + b, c] for c in (0, 1) for a, b in corners]
                text += f"{1 + i * ny + j}, {', '.join(map(str, own))}\n"
        text += f"*MATERIAL, NAME={name}\n*ELASTIC\n70000., 0.33\n*DENSITY\n2.7e-9\n"
        text += f"*SOLID SECTION, ELSET={name}, MATERIAL={name}\n"
    root = [n for (i, _, _), n in number.items() if i == 0]
    text += more + "*BOUNDARY\n" + "".join(f"{n}, {held[0]}, {held[1]}\n" for n in root)
    sensors = tuple(number[i, j, 1] for i in range(1, 7) for j in (0, 1))
    parameters = tuple(
        {"name": f"E_{name}", "quantity": "youngs_modulus", "material": name}
        for name in ("ROOT", "TIP")
    )
    return Structure("block", text, parameters, sensors, 6)


@needs_ccx
def test_a_clamp_that_yields_is_found_with_its_stiffness(tmp_path: Path) -> None:
    truth = {"E_ROOT": 1.1, "E_TIP": 0.95}
    with searched(
        block((1, 3)), block((2, 3), soft_root(20000.0)), truth, tmp_path, noise=3
    ) as search:
        found = search.ranked()
    best = next(item for item in found.found if item.change.label.endswith("x yields"))
    # Whether it yields across too cannot be seen where it hardly moves across.
    assert found.proposed
    assert {item.change.kind for item in found.found[:2]} == {"yielding support"}
    assert abs(np.log(best.amplitudes[0] / 20000.0)) < SURE * best.errors[0]
    assert best.theta == pytest.approx([1.1, 0.95], abs=0.05)
    # Chi-square with as many degrees of freedom: 5 standard deviations.
    assert best.misfit < found.freedom + 5.0 * np.sqrt(2.0 * found.freedom)
    assert found.misfit > 100.0 * found.freedom


@needs_ccx
def test_a_part_whose_modulus_is_not_updated_is_found_with_its_factor(tmp_path: Path) -> None:
    known = block((1, 3))
    truth = {"E_ROOT": 1.1, "E_TIP": 0.7}
    own = replace(known, parameters=known.parameters[:1])
    with searched(own, known, truth, tmp_path) as search:
        best = search.ranked().found[0]
    assert best.change.quantity is not None
    assert (best.change.quantity.quantity, best.change.quantity.targets) == (
        "youngs_modulus",
        ("TIP",),
    )
    assert abs(np.log(best.amplitudes[0] / 0.7)) < SURE * best.errors[0]


@needs_ccx
def test_nothing_is_proposed_where_nothing_lacks(tmp_path: Path) -> None:
    known = block((1, 3))
    with searched(known, known, {"E_ROOT": 1.1, "E_TIP": 0.95}, tmp_path) as search:
        found = search.ranked()
    assert not found.proposed
    assert found.nothing > 0.5


@needs_mystran
def test_a_spring_on_a_rotation_is_found_on_mystran(tmp_path: Path) -> None:
    held = boom("CELAS2,900,5.E6,7,5\n")
    with searched(boom(), held, {"E1": 1.05, "E2": 0.9}, tmp_path) as search:
        found = search.ranked()
    best = found.found[0]
    assert best.change.label == "rotational spring to ground at node 7, about y"
    assert abs(np.log(best.amplitudes[0] / 5e6)) < SURE * best.errors[0]


def test_a_mass_is_found_in_a_model_of_matrices(tmp_path: Path) -> None:
    known = chain(np.random.default_rng(3))
    assert isinstance(known.deck, dict)
    mass = np.array(known.deck["mass"], dtype=np.float64)
    place = len(mass) // 2
    lacking = 0.4 * mass[place, place]
    mass[place, place] += lacking
    truth = {item["name"]: 1.1 for item in known.parameters}
    real = replace(known, deck={**known.deck, "mass": mass})
    with searched(known, real, truth, tmp_path, noise=0) as search:
        best = search.ranked().found[0]
    assert best.change.label == f"point mass at node {place + 1}"
    # Without noise, and unreduced: the rounding of the search's end.
    assert best.amplitudes[0] == pytest.approx(lacking, rel=1e-3)
    assert best.misfit < 1e-3


def test_configurations_are_searched_together(tmp_path: Path) -> None:
    """A mass that both states of a structure lack, each with the modes of three sensors alone."""
    known = chain(np.random.default_rng(3))
    assert isinstance(known.deck, dict)
    mass = np.array(known.deck["mass"], dtype=np.float64)
    place, own = len(mass) // 2, [item["name"] for item in known.parameters]
    lacking, configurations = 0.1 * mass[place, place], []
    for name, fuel in (("empty", 0.0), ("full", 0.8)):
        loaded = mass.copy()
        loaded[-1, -1] += fuel
        deck = {**known.deck, "mass": loaded}
        real = loaded.copy()
        real[place, place] += lacking
        (tmp_path / name).mkdir()
        modes, _ = truth_of(
            replace(known, deck={**deck, "mass": real}), dict.fromkeys(own, 1.1), tmp_path / name
        )
        measured = noisy(modes, FREQUENCY, SHAPE, len(name))
        few = np.isin(measured.nodes, known.sensors[:: 2 if fuel else 3])
        test = {
            "frequencies_hz": measured.frequencies_hz,
            "mode_shapes": measured.mode_shapes[few],
            "dofs": [f"{node}.x" for node in measured.nodes[few].tolist()],
        }
        configurations.append({"name": name, "model": deck, "test": test})
    given = {
        "name": "two", "configurations": configurations,
        "parameters": [{**item, "bounds": [0.4, 2.5]} for item in known.parameters],
        "residuals": {
            "frequency_deviation": FREQUENCY, "shape_weight": 1.0, "shape_deviation": SHAPE,
        },
        "run": {"parallel": 1}, "store": str(tmp_path / "store"),
    }  # fmt: skip
    campaign = modetune.load(given, folder=tmp_path)
    with searching(campaign, np.full(len(own), 1.1)) as (search, runs):
        together = search.ranked()
    best = together.found[0]
    assert runs == 2  # the matrices of each state
    assert best.change.label == f"point mass at node {place + 1}"
    assert abs(np.log(best.amplitudes[0] / lacking)) < SURE * best.errors[0]
    # The second test adds what it measures: the sum of what each alone leaves unexplained.
    assert len(search.cases) == 2
    assert together.freedom == sum(c.known.residual.n_independent for c in search.cases) - len(own)


@needs_ccx
def test_a_support_becomes_springs_in_a_calculix_deck(tmp_path: Path) -> None:
    """As in the deck that has these springs from the start."""
    given = _loaded(block((1, 3)), tmp_path / "given")
    added = Addition("support", (1, 2, 3, 4), 1, (20000.0,))
    cards = given.case.solver.deck.with_cards(added)
    assert cards.numbers == (
        ("spring_stiffness", "elset", ("MODETUNE_ADDED_1_SUPPORT_1",), 20000.0),
    )
    soft = _loaded(replace(block((1, 3)), deck=cards.text), tmp_path / "soft")
    by_hand = _loaded(block((2, 3), soft_root(20000.0)), tmp_path / "hand")
    expected = modetune.modes(by_hand).elastic.frequencies_hz
    # Printed with seven digits, in another order of equations.
    assert modetune.modes(soft).elastic.frequencies_hz == pytest.approx(expected, rel=1e-6)
    with pytest.raises(modetune.ModetuneError, match="no \\*BOUNDARY holds"):
        given.case.solver.deck.with_cards(replace(added, nodes=(9,)))


def test_only_configurations_with_a_support_get_springs(tmp_path: Path) -> None:
    """A clamped and a free state, both measured; the clamp yields."""
    clamped = block((1, 3))
    decks = {"clamped": clamped.deck, "free": str(clamped.deck).partition("*BOUNDARY")[0]}
    (tmp_path / "modes.csv").write_text("mode,frequency_hz,5.x,9.x\n1,100.0,1.0,0.5\n")
    for name, text in decks.items():
        (tmp_path / f"{name}.inp").write_text(str(text))
    given = {
        "name": "two",
        "configurations": [
            {
                "name": name,
                "model": {"deck": f"{name}.inp", "units": "mm-t-s"},
                "test": {"modes": "modes.csv"},
            }
            for name in decks
        ],
        "parameters": [{**item, "bounds": [0.4, 2.5]} for item in clamped.parameters],
    }
    (tmp_path / "two.yaml").write_text(yaml.safe_dump(given))
    change = ModelChange(
        "yielding support", "", (1, 2, 3, 4), 1, ((), ()), np.zeros(1), np.ones(1), constrained=True
    )
    best = Proposal(change, np.array([2e4]), np.zeros(1), np.ones(2), 0.0, 1.0, 1.0, 1.0, ())
    made = applied(modetune.load(tmp_path / "two.yaml"), best, tmp_path / "soft.yaml")
    assert [file.name for file in made.decks] == ["soft_clamped.inp"]
    after = yaml.safe_load((tmp_path / "soft.yaml").read_text())
    used = [item["model"]["deck"] for item in after["configurations"]]
    assert used == ["soft_clamped.inp", "free.inp"]
    assert after["parameters"][-1]["elset"] == "MODETUNE_ADDED_1_SUPPORT_1"
    nowhere = replace(best, change=replace(change, nodes=(27, 28)))
    with pytest.raises(modetune.ModetuneError, match="no deck of"):
        applied(modetune.load(tmp_path / "two.yaml"), nowhere, tmp_path / "other.yaml")


@needs_mystran
@pytest.mark.parametrize("solver", ["mystran", "calculix"])
def test_a_support_becomes_springs_in_a_nastran_deck(tmp_path: Path, solver: str) -> None:
    given = _loaded(replace(boom(), solver=solver), tmp_path / "given")
    cards = given.case.solver.deck.with_cards(Addition("support", (1,), 5, (5e6,)))
    assert "$ SPC1,1,123456,1\n" in cards.text
    soft = _loaded(replace(boom(), deck=cards.text, solver=solver), tmp_path / "soft")
    by_hand = replace(boom("CELAS2,900,5.E6,1,5\n", held="12346"), solver=solver)
    expected = modetune.modes(_loaded(by_hand, tmp_path / "hand")).elastic.frequencies_hz
    stiff = modetune.modes(given).elastic.frequencies_hz
    # The same cards but for their form: what either program prints.
    assert modetune.modes(soft).elastic.frequencies_hz == pytest.approx(expected, rel=1e-6)
    assert abs(stiff[0] / expected[0] - 1.0) > 0.1


@needs_ccx
def test_a_clamp_that_yields_in_rotation_is_found_in_a_translated_deck(tmp_path: Path) -> None:
    """CalculiX has rotations of a Nastran deck at nodes of their own."""
    held = replace(boom("CELAS2,900,5.E6,1,5\n", held="12346"), solver="calculix")
    known = replace(boom(), solver="calculix")
    with searched(known, held, {"E1": 1.05, "E2": 0.9}, tmp_path) as search:
        best = search.ranked().found[0]
    assert best.change.label == "support at node 1, about y yields"
    assert abs(np.log(best.amplitudes[0] / 5e6)) < SURE * best.errors[0]


def linked(stiffness: float = 0.0) -> Structure:
    """The block on a rigid body that the ground holds, tied along x by springs of a stiffness.

    Without one, the body holds the block's root wholly.
    """
    free = str(block((1, 3)).deck).partition("*BOUNDARY")[0]
    body = "*NODE\n900, 0., 20., 4.5\n901, 0., 20., 4.5\n*NSET, NSET=ROOT\n1, 2, 3, 4\n"
    if stiffness:
        body = body.replace("*NSET", "*NODE, NSET=PLATE\n911, 0., 0., 0.\n912, 0., 0., 9.\n"
                            "913, 0., 40., 0.\n914, 0., 40., 9.\n*NSET")  # fmt: skip
        body += "*RIGID BODY, NSET=PLATE, REF NODE=900, ROT NODE=901\n"
        body += "*ELEMENT, TYPE=SPRING2, ELSET=SOFT\n"
        body += "".join(f"{1000 + n}, {910 + n}, {n}\n" for n in range(1, 5))
        body += f"*SPRING, ELSET=SOFT\n1, 1\n{stiffness}\n"
        for axis in (2, 3):
            body += "*EQUATION\n" + "".join(
                f"2\n{n}, {axis}, 1., {910 + n}, {axis}, -1.\n" for n in range(1, 5)
            )
    else:
        body += "*RIGID BODY, NSET=ROOT, REF NODE=900, ROT NODE=901\n"
    held = "*BOUNDARY\n900, 1, 3\n901, 1, 3\n"
    return replace(block((1, 3)), deck=free + body + held)


def tied(stiffness: float = 0.0) -> Structure:
    """A cantilever of two halves of solids, tied; or joined by springs along x of a stiffness."""
    number = {
        (half, i, j, k): 1 + 100 * half + 4 * i + 2 * j + k
        for half in (0, 1) for i in range(4) for j in (0, 1) for k in (0, 1)
    }  # fmt: skip
    text = "*NODE, NSET=NALL\n" + "".join(
        f"{n}, {25.0 * (i + 3 * half)}, {40.0 * j}, {9.0 * k}\n"
        for (half, i, j, k), n in number.items()
    )
    corners = [(0, 0), (1, 0), (1, 1), (0, 1)]
    for half, name in enumerate(("ROOT", "TIP")):
        text += f"*ELEMENT, TYPE=C3D8I, ELSET={name}\n"
        for i in range(3):
            own = [number[half, i + a, b, c] for c in (0, 1) for a, b in corners]
            text += f"{1 + i + 10 * half}, {', '.join(map(str, own))}\n"
        text += f"*MATERIAL, NAME={name}\n*ELASTIC\n70000., 0.33\n*DENSITY\n2.7e-9\n"
        text += f"*SOLID SECTION, ELSET={name}, MATERIAL={name}\n"
    ends = [(number[0, 3, j, k], number[1, 0, j, k]) for j in (0, 1) for k in (0, 1)]
    if stiffness:
        text += "*ELEMENT, TYPE=SPRING2, ELSET=SOFT\n"
        text += "".join(f"{900 + n}, {a}, {b}\n" for n, (a, b) in enumerate(ends))
        text += f"*SPRING, ELSET=SOFT\n1, 1\n{stiffness}\n"
        for axis in (2, 3):
            text += "".join(f"*EQUATION\n2\n{b}, {axis}, 1., {a}, {axis}, -1.\n" for a, b in ends)
    else:
        text += "*SURFACE, NAME=END\n3, S4\n*SURFACE, NAME=START\n11, S6\n"
        text += "*TIE, NAME=JOINT, POSITION TOLERANCE=1.\nSTART, END\n"
    held = [number[0, 0, j, k] for j in (0, 1) for k in (0, 1)]
    text += "*BOUNDARY\n" + "".join(f"{n}, 1, 3\n" for n in held)
    places = ((0, 1), (0, 2), (0, 3), (1, 1), (1, 2), (1, 3))
    sensors = tuple(number[half, i, j, 1] for half, i in places for j in (0, 1))
    parameters = tuple(
        {"name": f"E_{name}", "quantity": "youngs_modulus", "material": name}
        for name in ("ROOT", "TIP")
    )
    return Structure("tied", text, parameters, sensors, 6)


@needs_ccx
def test_a_tie_that_yields_is_found_with_its_stiffness(tmp_path: Path) -> None:
    truth = {"E_ROOT": 1.05, "E_TIP": 0.95}
    with searched(tied(), tied(50000.0), truth, tmp_path, noise=3) as search:
        best = search.ranked().found[0]
    assert best.change.label == "tie of 4 nodes (101 to 104), x yields"
    assert abs(np.log(best.amplitudes[0] / 50000.0)) < SURE * best.errors[0]
    assert best.theta == pytest.approx([1.05, 0.95], abs=0.05)


@needs_ccx
def test_a_tie_becomes_a_joint(tmp_path: Path) -> None:
    """As in the deck that has the joint from the start."""
    given = _loaded(tied(), tmp_path / "given")
    added = Addition("link", (101, 102, 103, 104), 1, (50000.0,))
    cards = given.case.solver.deck.with_cards(added)
    assert "** *TIE, NAME=JOINT" in cards.text
    soft = _loaded(replace(tied(), deck=cards.text), tmp_path / "soft")
    expected = modetune.modes(_loaded(tied(50000.0), tmp_path / "hand")).elastic.frequencies_hz
    # Printed with seven digits, in another order of equations.
    assert modetune.modes(soft).elastic.frequencies_hz == pytest.approx(expected, rel=1e-6)


@needs_ccx
def test_a_rigid_body_becomes_a_joint_in_a_calculix_deck(tmp_path: Path) -> None:
    """As in the deck that has the joint from the start."""
    given = _loaded(linked(), tmp_path / "given")
    added = Addition("link", (1, 2, 3, 4), 1, (20000.0,))
    cards = given.case.solver.deck.with_cards(added)
    assert cards.numbers == (("spring_stiffness", "elset", ("MODETUNE_ADDED_1_LINK_1",), 20000.0),)
    soft = _loaded(replace(linked(), deck=cards.text), tmp_path / "soft")
    expected = modetune.modes(_loaded(linked(20000.0), tmp_path / "hand")).elastic.frequencies_hz
    assert modetune.modes(soft).elastic.frequencies_hz == pytest.approx(expected, rel=1e-6)
    assert abs(modetune.modes(given).elastic.frequencies_hz[0] / expected[0] - 1.0) > 0.1
    stiff = given.case.solver.deck.with_cards(replace(added, values=(1e12,))).text
    tied = _loaded(replace(linked(), deck=stiff), tmp_path / "stiff")
    assert modetune.modes(tied).elastic.frequencies_hz == pytest.approx(
        modetune.modes(given).elastic.frequencies_hz, rel=1e-5
    )
    with pytest.raises(modetune.ModetuneError, match="exactly its nodes"):
        given.case.solver.deck.with_cards(replace(added, nodes=(1, 2)))


@needs_ccx
def test_a_body_that_yields_is_found_with_its_stiffness(tmp_path: Path) -> None:
    truth = {"E_ROOT": 1.1, "E_TIP": 0.95}
    with searched(linked(), linked(20000.0), truth, tmp_path, noise=3) as search:
        found = search.ranked()
    best = next(item for item in found.found if item.change.label.endswith("x yields"))
    assert found.proposed
    assert "yielding link" in {item.change.kind for item in found.found[:2]}
    assert abs(np.log(best.amplitudes[0] / 20000.0)) < SURE * best.errors[0]


def elbow(joint: float = 0.0) -> Structure:
    """The boom with a rigid element at its middle, which turns about y by a spring of a stiffness.

    Without one, the element is rigid.
    """
    text = str(boom().deck).replace("CBAR,6,2,6,7,", "CBAR,6,2,60,7,")
    more = "GRID,60,,600.,0.,0.\n"
    if joint:
        more += f"RBE2,800,6,12346,60\nCELAS2,900,{joint:g},6,5,60,5\n"
    else:
        more += "RBE2,800,6,123456,60\n"
    return replace(boom(), deck=text.replace("ENDDATA", f"{more}ENDDATA"))


@needs_mystran
def test_a_rigid_element_becomes_a_joint_in_a_nastran_deck(tmp_path: Path) -> None:
    given = _loaded(elbow(), tmp_path / "given")
    cards = given.case.solver.deck.with_cards(Addition("link", (60,), 5, (4e6,)))
    assert "$ RBE2,800,6,123456,60\n" in cards.text
    soft = _loaded(replace(elbow(), deck=cards.text), tmp_path / "soft")
    expected = modetune.modes(_loaded(elbow(4e6), tmp_path / "hand")).elastic.frequencies_hz
    assert modetune.modes(soft).elastic.frequencies_hz == pytest.approx(expected, rel=1e-6)
    assert abs(modetune.modes(given).elastic.frequencies_hz[0] / expected[0] - 1.0) > 0.02


#: An inertia of 2 t mm^2 about each axis at the boom's tip.
TIP = "CONM2,900,11,0,0.,0.,0.,0.,,+A\n+A,2.,0.,2.,0.,0.,2.\n"


@needs_mystran
def test_an_inertia_is_found_though_bars_turn_without_mass(tmp_path: Path) -> None:
    """MYSTRAN also refuses the boom without its support, which then is not released."""
    with searched(boom(), boom(TIP), {"E1": 1.05, "E2": 0.9}, tmp_path) as search:
        best = search.ranked().found[0]
    assert best.change.label == "inertia at node 11"
    assert abs(np.log(best.amplitudes[0] / 2.0)) < SURE * best.errors[0]


@needs_mystran
def test_an_inertia_becomes_an_element_of_a_nastran_deck(tmp_path: Path) -> None:
    given = _loaded(boom(), tmp_path / "given")
    cards = given.case.solver.deck.with_cards(Addition("inertia", (11,), 0, (2.0,)))
    assert cards.numbers[0][:2] == ("rotary_inertia", "element")
    heavy = _loaded(replace(boom(), deck=cards.text), tmp_path / "heavy")
    expected = modetune.modes(_loaded(boom(TIP), tmp_path / "hand")).elastic.frequencies_hz
    assert modetune.modes(heavy).elastic.frequencies_hz == pytest.approx(expected, rel=1e-6)
    assert abs(modetune.modes(given).elastic.frequencies_hz[2] / expected[2] - 1.0) > 0.05


def _loaded(structure: Structure, folder: Path) -> Campaign:
    """A campaign of a structure, whose test is of no importance."""
    n = structure.n_modes
    nodes = np.array(structure.sensors)
    asked = ModeSet(
        np.arange(1.0, n + 1.0), np.ones((nodes.size, n)), nodes, np.full(nodes.size, 1),
        np.zeros(0), "unknown",
    )  # fmt: skip
    return campaign_of(structure, asked, folder)


@pytest.fixture(scope="module")
def mast(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The mast's campaign, and a test of a mast with 0.4 kg more at node 518."""
    folder = tmp_path_factory.mktemp("mast")
    write_case("mast", folder)
    head, step, rest = (folder / "mast.inp").read_text().partition("*STEP")
    lacking = "*ELEMENT, TYPE=MASS, ELSET=CABLE\n999999, 518\n*MASS, ELSET=CABLE\n4.0e-4\n"
    (folder / "real.inp").write_text(head + lacking + step + rest)
    given = yaml.safe_load((folder / "mast.yaml").read_text())
    del given["residuals"]["static"], given["residuals"]["mass_properties"]
    given["residuals"] |= {"shape_deviation": 0.03, "frequency_deviation": FREQUENCY}
    given["model"]["deck"] = "real.inp"
    (folder / "real.yaml").write_text(yaml.safe_dump(given))
    given |= {"model": given["model"] | {"deck": "mast.inp"}, "test": {"modes": "lab.csv"}}
    (folder / "mast.yaml").write_text("# ours\n" + yaml.safe_dump(given, sort_keys=False))
    real = modetune.load(folder / "real.yaml")
    truth = {"E_mast": 1.1, "rho_head": 1.0, "k_side": 0.8, "k_up": 1.2}
    seen = real.case.sensors.observe(modetune.modes(real, truth).elastic)
    modes = noisy(signed(seen.select(range(len(real.test.numbers)))), FREQUENCY, 0.03, 5)
    write_modes_csv(folder / "lab.csv", range(1, modes.n_modes + 1), modes)
    return folder


@needs_ccx
def test_from_a_verdict_to_a_proposal_to_a_new_deck_to_a_verdict(mast: Path) -> None:
    before = (mast / "mast.inp").read_text()
    first = run_command(mast, "update", "mast.yaml", "--json")
    assert json.loads(first.stdout)["model_form"]["suspected"] is True
    given = ["localise", "mast.yaml", "--record", "runs/mast"]
    done = run_command(mast, *given, "--apply", "1", "--out", "heavier.yaml", "--json")
    assert done.returncode == 0, done.stderr
    told = json.loads(done.stdout)
    best = told["proposals"]["changes"][0]
    assert (best["kind"], best["nodes"]) == ("point mass", [518])
    assert best["probability"] > 0.99
    assert told["proposals"]["proposed"] is True
    assert abs(np.log(best["values"][0] / 4e-4)) < SURE * best["relative_errors"][0]
    # Only our cards are new, and only name, deck and parameter of the campaign.
    after = (mast / "heavier_mast.inp").read_text()
    added = [line for line in after.splitlines() if line not in before.splitlines()]
    assert after.replace("\n".join(added) + "\n", "") == before
    assert added[0] == "** added by modetune localise"
    lines = (mast / "heavier.yaml").read_text().splitlines()
    assert lines[0] == "# ours"
    changed = set(lines) ^ set((mast / "mast.yaml").read_text().splitlines())
    assert len(changed) == 5  # two names, two decks, one parameter
    then = run_command(mast, "update", "heavier.yaml", "--json")
    result = json.loads(then.stdout)
    assert result["model_form"]["suspected"] is False
    assert result["trust"]["verdict"] == "trusted"
    found = {item["name"]: item for item in result["parameters"]}
    for name, factor in {"E_mast": 1.1, "rho_head": 1.0, "k_side": 0.8, "k_up": 1.2}.items():
        apart = found[name]["updated"] - factor
        assert abs(apart) < SURE * found[name]["standard_error"]


@needs_ccx
@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--apply", "1"], "--apply and --out go together"),
        (["--apply", "1", "--no-changes", "--out", "x.yaml"], "--no-changes leaves out"),
        (["--apply", "1", "--out", "mast.yaml"], "exists already"),
        (["--apply", "1", "--out", "elsewhere/x.yaml"], "in the folder of"),
    ],
)
def test_what_cannot_be_applied_is_refused(mast: Path, options: list[str], said: str) -> None:
    done = run_command(mast, "localise", "mast.yaml", *options)
    assert (done.returncode, said in done.stderr) == (2, True), done.stderr
