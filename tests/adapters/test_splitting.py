"""Parameters by property, element set and elements: shared cards are copied, nothing else moves."""

from __future__ import annotations

import os
import shutil
import threading
from collections.abc import Mapping
from difflib import unified_diff
from pathlib import Path

import numpy as np
import pytest

from modetune.adapters.calculix.solver import calculix_solver
from modetune.adapters.nastran.deck import read_deck
from modetune.adapters.nastran.model import understand
from modetune.adapters.nastran.solver import mystran_solver
from modetune.adapters.process import run_process
from modetune.adapters.solver import ModalAnalysis, Solver
from modetune.core.errors import ModelError
from modetune.core.modes import Floats
from modetune.core.parameters import Parameter, Quantity, TargetKind, ValueKind, counted_from
from modetune.core.updating.job_results import ModalResult

MYSTRAN = shutil.which(os.environ.get("MODETUNE_MYSTRAN", "mystran"))
needs_mystran = pytest.mark.skipif(MYSTRAN is None, reason="MYSTRAN is not here (tools/mystran.sh)")

#: A bracket of two plates of one material: the foot, held at x = 0, and the flange that stands on
#: it; a plate of the foot and one of the flange share no property.
BRACKET = """\
SOL 103
CEND
METHOD = 1
SPC = 1
BEGIN BULK
EIGRL,1,,,4
GRID,1,,0.,0.,0.
GRID,2,,.1,0.,0.
GRID,3,,.2,0.,0.
GRID,4,,.2,0.,.1
GRID,5,,.2,0.,.2
GRID,11,,0.,.1,0.
GRID,12,,.1,.1,0.
GRID,13,,.2,.1,0.
GRID,14,,.2,.1,.1
GRID,15,,.2,.1,.2
CQUAD4,1,10,1,2,12,11
CQUAD4,2,10,2,3,13,12
CQUAD4  3       20      3       4       14      13
CQUAD4  4       20      4       5       15      14
PSHELL,10,5,.004,5,,5
PSHELL  20      5       .004    5               5
MAT1    5       7.1+10          .33     2700.
SPC1,1,123456,1,11
ENDDATA
"""
#: A plane of shells in CalculiX with two element sets of one material.
STRIP = """\
*NODE
1, 0, 0, 0
2, .1, 0, 0
3, .2, 0, 0
4, .3, 0, 0
11, 0, .1, 0
12, .1, .1, 0
13, .2, .1, 0
14, .3, .1, 0
*ELEMENT, TYPE=S4, ELSET=ROOT
1, 1, 2, 12, 11
*ELEMENT, TYPE=S4, ELSET=OUTER
2, 2, 3, 13, 12
3, 3, 4, 14, 13
*MATERIAL, NAME=ALU
** rolled
*ELASTIC
7.1e10, .33
*DENSITY
2700.
** sections
*SHELL SECTION, ELSET=ROOT, MATERIAL=ALU
.004
*SHELL SECTION, ELSET=OUTER, MATERIAL=ALU
.004
*BOUNDARY
1, 1, 6
11, 1, 6
"""


def parameter(
    name: str,
    quantity: Quantity,
    by: TargetKind,
    *targets: str,
    values: ValueKind = "relative",
    box: tuple[float, float, float] = (0.5, 1.0, 2.0),
) -> Parameter:
    """box: lower bound, start and upper bound, as users give them."""
    origin, scale = counted_from(values, box[1], box[0], 0.2 * (box[2] - box[0]))
    low, start, high = ((value - origin) / scale for value in box)
    own = (name, quantity, by, targets, low, high, 0.1, start)
    return Parameter(*own, values=values, origin=origin, scale=scale)


def frequencies(solver: Solver, values: Mapping[str, float], folder: Path, n: int = 4) -> Floats:
    folder.mkdir()
    analysis = ModalAnalysis(n, (1,))
    solver.render(values, analysis).write(folder)
    finished = run_process(solver.program.command(1), folder, 60.0, threading.Event())
    result = solver.read(values, analysis, folder, finished.return_code)
    assert isinstance(result, ModalResult)
    return np.sqrt(result.eigenvalues) / 2 / np.pi


def changes(before: str, after: str) -> tuple[list[str], list[str]]:
    """Lines that went and lines that came."""
    found = list(unified_diff(before.splitlines(), after.splitlines(), lineterm="", n=0))[2:]
    return (
        [line[1:] for line in found if line.startswith("-")],
        [line[1:] for line in found if line.startswith("+")],
    )


def test_a_shared_material_is_copied_for_the_property_that_is_named(tmp_path: Path) -> None:
    (tmp_path / "bracket.dat").write_text(BRACKET)
    flange = parameter("E_flange", "youngs_modulus", "property", "20")
    model = understand(read_deck(tmp_path / "bracket.dat"), (flange,))
    out = model.write_updated({"E_flange": 1.1}, tmp_path / "out")
    gone, come = changes(BRACKET, out.read_text())
    assert gone == ["PSHELL  20      5       .004    5               5"]
    assert come == [
        "PSHELL  20      6       .004    6               6",
        "$ MAT1 6: MAT1 5 for PSHELL 20 (E_flange)",
        "MAT1*   6               78100000000.                    .33",
        "*       2700.",
    ]
    (said,) = model.splits()
    assert said.endswith("line 23: added MAT1 6: MAT1 5 for PSHELL 20 (E_flange)")
    assert model.energy_sets(flange) == ("P20",)


@needs_mystran
def test_mystran_of_a_split_deck_equals_a_deck_split_by_hand(tmp_path: Path) -> None:
    (tmp_path / "bracket.dat").write_text(BRACKET)
    by_hand = (
        BRACKET.replace("CQUAD4  4       20", "CQUAD4  4       30")
        .replace("PSHELL  20      5       .004    5               5", "PSHELL,20,6,.004,6,,6")
        .replace("MAT1 ", "PSHELL,30,7,.005,7,,7\nMAT1,6,7.81+10,,.33,2700.\n"
                 "MAT1,7,7.81+10,,.33,3240.\nMAT1 ")
    )  # fmt: skip
    (tmp_path / "hand.dat").write_text(by_hand)
    parameters = (
        parameter("E", "youngs_modulus", "property", "20"),
        parameter("rho", "density", "element", "4"),
        parameter("t", "thickness", "element", "4"),
    )
    solver = mystran_solver(tmp_path / "bracket.dat", parameters)
    assert solver.deck.problems(parameters) == []
    values = {"E": 1.1, "rho": 1.2, "t": 1.25}
    ours = frequencies(solver, values, tmp_path / "ours")
    theirs = frequencies(mystran_solver(tmp_path / "hand.dat", ()), {}, tmp_path / "theirs")
    untouched = frequencies(solver, {}, tmp_path / "untouched")
    plain = mystran_solver(tmp_path / "bracket.dat", ())
    # Both decks say the same numbers; MYSTRAN prints seven digits.
    assert ours == pytest.approx(theirs, rel=1e-6)
    assert untouched == pytest.approx(frequencies(plain, {}, tmp_path / "plain"), rel=1e-6)
    assert abs(ours / untouched - 1.0).max() > 0.02


def test_calculix_of_a_split_deck_equals_a_deck_split_by_hand(tmp_path: Path) -> None:
    (tmp_path / "strip.inp").write_text(STRIP)
    by_hand = (
        STRIP.replace("*MATERIAL", "*MATERIAL, NAME=B\n*ELASTIC\n7.81e10, .33\n*DENSITY\n2700.\n"
                      "*MATERIAL, NAME=C\n*ELASTIC\n7.81e10, .33\n*DENSITY\n3240.\n*MATERIAL")
        .replace("*SHELL SECTION, ELSET=OUTER, MATERIAL=ALU\n.004",
                 "*ELSET, ELSET=TWO\n2\n*ELSET, ELSET=THREE\n3\n"
                 "*SHELL SECTION, ELSET=TWO, MATERIAL=B\n.004\n"
                 "*SHELL SECTION, ELSET=THREE, MATERIAL=C\n.004")
    )  # fmt: skip
    (tmp_path / "hand.inp").write_text(by_hand)
    parameters = (
        parameter("E", "youngs_modulus", "elset", "OUTER"),
        parameter("rho", "density", "element", "3-9"),
    )
    solver = calculix_solver(tmp_path / "strip.inp", parameters)
    assert solver.deck.problems(parameters) == []
    assert len(solver.deck.splits()) == 3
    ours = frequencies(solver, {"E": 1.1, "rho": 1.2}, tmp_path / "ours")
    theirs = frequencies(calculix_solver(tmp_path / "hand.inp", ()), {}, tmp_path / "theirs")
    assert ours == pytest.approx(theirs, rel=1e-6)
    written = solver.deck.write_updated({"E": 1.1, "rho": 1.2}, tmp_path / "out")
    again = frequencies(calculix_solver(written, ()), {}, tmp_path / "again")
    assert again == pytest.approx(theirs, rel=1e-6)
    gone, _ = changes(STRIP, written.read_text())
    assert gone == ["*SHELL SECTION, ELSET=OUTER, MATERIAL=ALU"]


def test_what_is_not_shared_is_not_copied(tmp_path: Path) -> None:
    (tmp_path / "bracket.dat").write_text(BRACKET)
    whole = parameter("E", "youngs_modulus", "property", "10", "20")
    model = understand(read_deck(tmp_path / "bracket.dat"), (whole,))
    assert model.splits() == ()
    assert [number.value for number in model.numbers(whole)] == [7.1e10]


def test_a_material_and_a_property_of_it_cannot_both_move(tmp_path: Path) -> None:
    (tmp_path / "bracket.dat").write_text(BRACKET)
    both = (
        parameter("all", "youngs_modulus", "material", "5"),
        parameter("flange", "youngs_modulus", "property", "20"),
    )
    model = understand(read_deck(tmp_path / "bracket.dat"), both)
    (said,) = model.problems(both)
    assert "both all and flange change this number" in said


def test_cards_of_an_include_are_copied_in_it(tmp_path: Path) -> None:
    head, _, tail = BRACKET.partition("MAT1 ")
    card, _, rest = tail.partition("\n")
    (tmp_path / "bracket.dat").write_text(head + "INCLUDE 'mat.dat'\n" + rest)
    (tmp_path / "mat.dat").write_bytes(f"MAT1 {card}\r\n$ end\r\n".encode())
    flange = parameter("E", "youngs_modulus", "element", "3", "4")
    model = understand(read_deck(tmp_path / "bracket.dat"), (flange,))
    model.write_updated({"E": 1.1}, tmp_path / "out")
    written = (tmp_path / "out" / "mat.dat").read_bytes().decode()
    assert written.count("\r\n") == written.count("\n") == 5
    assert written.endswith("$ end\r\n")
    again = understand(read_deck(tmp_path / "out" / "bracket.dat")).bulk
    assert again.properties[20].mid1_ref.e == pytest.approx(7.81e10)
    assert again.properties[10].mid1_ref.e == 7.1e10


def test_elements_without_a_material_are_refused_with_their_line(tmp_path: Path) -> None:
    (tmp_path / "a.dat").write_text(BRACKET.replace("SPC1", "CELAS2,9,100.,5,3\nSPC1"))
    spring = parameter("E", "youngs_modulus", "element", "9")
    model = understand(read_deck(tmp_path / "a.dat"), (spring,))
    with pytest.raises(ModelError, match=r"a\.dat, line 24: CELAS2 9 has no property"):
        model.numbers(spring)
    wrong = parameter("E", "youngs_modulus", "property", "11")
    with pytest.raises(ModelError, match=r"there are 10, 20"):
        model.numbers(wrong)


@needs_mystran
def test_a_spring_that_starts_from_nothing_is_absolute(tmp_path: Path) -> None:
    """A mass of 2 between a spring of 8e4 and one that the deck gives no stiffness."""
    deck = tmp_path / "mount.dat"
    others = "".join(  # MYSTRAN requires some more unknowns than modes
        f"GRID,{n},,0.,{n}.,0.,,23456\nCONM2,{n},{n},,1.\nCELAS2,1{n},{n}.+6,{n},1,2,1\n"
        for n in range(3, 9)
    )
    deck.write_text(
        "SOL 103\nCEND\nMETHOD = 1\nBEGIN BULK\nEIGRL,1,,,1\nGRID,1,,0.,0.,0.,,23456\n"
        "GRID,2,,1.,0.,0.,,123456\nCONM2,9,1,,2.\nCELAS2,1,8.+4,1,1,2,1\nCELAS2,2,0.,1,1,2,1\n"
        f"{others}ENDDATA\n"
    )
    box = (0.0, 0.0, 2e5)
    added = parameter("k", "spring_stiffness", "element", "2", values="absolute", box=box)
    solver = mystran_solver(deck, (added,))
    assert solver.deck.problems((added,)) == []
    assert added.shown(added.initial) == 0.0
    for k in (0.0, 1e5):
        value = added.counted(k)
        hz = frequencies(solver, {"k": value}, tmp_path / f"{k:g}", 1)
        assert hz == pytest.approx([np.sqrt((8e4 + k) / 2.0) / 2 / np.pi], rel=1e-5)
        assert solver.deck.written(added, value) == pytest.approx(value, abs=1e-7)
    assert solver.deck.is_linear(added)
    assert solver.deck.energy_sets(added) == ()  # not proportional to what it is counted by
    factor = parameter("k", "spring_stiffness", "element", "2")
    (said,) = solver.deck.problems((factor,))
    assert said == (
        f"parameter k: {deck}, line 10: CELAS2 2: K is zero, which no factor changes; give the "
        "parameter `values: absolute` or `additive`, with bounds and a deviation"
    )


def test_a_shear_modulus_keeps_its_ratio_to_an_absolute_youngs_modulus(tmp_path: Path) -> None:
    card = "MAT1    5       7.1+10          .33     2700."
    (tmp_path / "a.dat").write_text(BRACKET.replace(card, "MAT1,5,7.+10,2.8+10,,2700."))
    young = parameter(
        "E", "youngs_modulus", "material", "5", values="additive", box=(-2e10, 0.0, 2e10)
    )
    model = understand(read_deck(tmp_path / "a.dat"), (young,))
    bulk = model.bulk_at(model.changed({"E": young.counted(7e9)}))
    assert (bulk.materials[5].e, bulk.materials[5].g) == pytest.approx((7.7e10, 3.08e10), rel=1e-7)
    assert model.changed({"E": young.counted(0.0)}) == {}


def test_bounds_that_make_a_thickness_negative_name_the_line(tmp_path: Path) -> None:
    (tmp_path / "a.dat").write_text(BRACKET)
    thick = parameter(
        "t", "thickness", "property", "20", values="additive", box=(-0.005, 0.0, 0.002)
    )
    model = understand(read_deck(tmp_path / "a.dat"), (thick,))
    (said,) = model.problems((thick,))
    assert said == (
        f"parameter t: {tmp_path / 'a.dat'}, line 22: parameter t: thickness would be -0.001, it "
        "is above zero; correct its bounds"
    )
