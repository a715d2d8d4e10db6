"""Offsets, angles, non-structural mass, shear, damping of Nastran decks: read, edited, solved."""

from __future__ import annotations

import math
import os
import re
import shutil
from pathlib import Path

import numpy as np
import pytest
from pyNastran.bdf.bdf import BDF

from modetune.adapters.nastran.cards import CARDS
from modetune.adapters.nastran.deck import read_deck, write_edited
from modetune.adapters.nastran.dialect import MYSTRAN
from modetune.adapters.nastran.model import NastranModel, understand
from modetune.adapters.nastran.solver import mystran_solver
from modetune.adapters.solver import ModalAnalysis
from modetune.core.errors import ModelError
from modetune.core.parameters import (
    DAMPING,
    QUANTITIES,
    Parameter,
    ParameterSet,
    frequency_reach,
)
from modetune.core.updating.job_results import ModalResult
from tests.adapters.nastran.test_model import parameter
from tests.adapters.test_solver_contract import run

#: A card of every kind that has these numbers, in small, large and free field, with blanks that
#: stand for defaults inside of a line, at its end, behind a tab and before a comment.
DECK = """SOL 103
CEND
BEGIN BULK
EIGRL,1,,,3
GRID,1,,0.,0.,0.
GRID,2,,1.,0.,0.
GRID,3,,1.,1.,0.
GRID,4,,0.,1.,0.
MAT1    1       7.+4            .3      2.7-9                   .02
MAT1,2,2.1+5,,.3,7.8-9
MAT8,5,1.+5,1.+4,.3,5.+3,4.+3,3.+3,1.6-9
,,,,,,,,
,.03
CQUAD4,11,1,1,2,3,4,,.25
CTRIA3,12,2,1,2,3,,-.5
CQUAD4,13,3,1,2,3,4
CQUAD4,14,6,1,2,3,4
CQUAD4,15,7,1,2,3,4
PSHELL,1,1,1.5,1,,1,,4.-9
PSHELL,2,1,2.,1 $ a comment
PSHELL  3       1       2.      1               1       $ another
PSHELL  4       1       2.      1
PSHELL*                7               1              2.               1
*                                      1
PCOMP,6,-.15,3.-9,,,,.01
,5,.1,0.,,5,.1,45.
,5,.1,-30.
CBAR,21,21,1,2,0.,0.,1.
,,,.1,,.2,.3,,.4
CBAR,22,22,1,2,0.,0.,1.
CBAR,23,23,1,2,0.,0.,1.
CBEAM,24,24,1,2,0.,0.,1.
CBEAM,25,25,1,2,0.,0.,1.
CBEAM,26,26,1,2,0.,0.,1.
PBAR    21      2       10.     20.     30.     40.     5.-6
+
+                       6.
PBAR,23,2,10.,20.,30.,40.
,
,.8,.9
PBARL,22,2,,BAR
,3.,4.,7.-6
PBEAM,24,2,10.,20.,30.,2.,40.,1.-6
,,,,,,,,
,NO,.5,12.,22.,32.,3.,42.,2.-6
,YES,1.,14.,24.,34.,4.,44.,3.-6
,,,,,,,,
,.7
,,,,,.1,.2,.3,.4
PBEAM,25,2,10.,20.,30.,2.,40.
PBEAM,26,2,10.,20.,30.,2.,40.
,NO,1.,14.
,.5,.6
CROD,31,31,1,2
PROD,31,2,8.,9.,,8.-6
CONROD,32,1,2,2,6.,7.,,9.-6
CELAS1,41,41,1,1,2,1
CELAS1,42,42,1,1,2,1
PELAS,41,100.,.04,,42,200.,.05
CELAS2,43,300.,1,1,2,1,.06
CBUSH,44,44,1,2,,,,0
PBUSH,44,K,1.,2.,3.
,,B,9.,,8.
,,GE,.07
CDAMP2,45,12.,1,1,2,1
CONM2   51      1               2.      .1              .3
        1.      .5      2.      .6      .7      3.
ENDDATA
"""
#: What scales, and where pyNastran finds it: (property or element and attribute): value.
PLACES: list[tuple[Parameter, dict[str, float]]] = [
    (parameter("structural_damping", "material", "1"), {"materials[1].ge": 0.02}),
    (parameter("structural_damping", "material", "5"), {"materials[5].ge": 0.03}),
    (parameter("offset", "element", "11"), {"elements[11].zoffset": 0.25}),
    (parameter("offset", "element", "12"), {"elements[12].zoffset": -0.5}),
    (parameter("nonstructural_mass", "property", "1"), {"properties[1].nsm": 4e-9}),
    (parameter("bending_inertia_ratio", "property", "1"), {"properties[1].twelveIt3": 1.0}),
    (parameter("shear_thickness_ratio", "element", "11"), {"properties[1].tst": 0.833333}),
    (parameter("bending_inertia_ratio", "property", "2"), {"properties[2].twelveIt3": 1.0}),
    (parameter("shear_thickness_ratio", "property", "3"), {"properties[3].tst": 0.833333}),
    (parameter("bending_inertia_ratio", "property", "7"), {"properties[7].twelveIt3": 1.0}),
    (parameter("shear_thickness_ratio", "property", "7"), {"properties[7].tst": 0.833333}),
    (
        parameter("ply_angle", "property", "6"),
        {"properties[6].thetas[1]": 45.0, "properties[6].thetas[2]": -30.0},
    ),
    (parameter("ply_angle", "element", "14", item=3), {"properties[6].thetas[2]": -30.0}),
    (parameter("offset", "property", "6"), {"properties[6].z0": -0.15}),
    (parameter("nonstructural_mass", "property", "6"), {"properties[6].nsm": 3e-9}),
    (parameter("structural_damping", "property", "6"), {"properties[6].ge": 0.01}),
    (
        parameter("offset", "element", "21"),
        {"elements[21].wa[0]": 0.1, "elements[21].wa[2]": 0.2, "elements[21].wb[0]": 0.3,
         "elements[21].wb[2]": 0.4},
    ),
    (parameter("offset", "element", "21", item=4), {"elements[21].wb[0]": 0.3}),
    (parameter("nonstructural_mass", "property", "21"), {"properties[21].nsm": 5e-6}),
    (parameter("shear_factor", "property", "23"),
     {"properties[23].k1": 0.8, "properties[23].k2": 0.9}),
    (parameter("shear_factor", "property", "23", item=2), {"properties[23].k2": 0.9}),
    (parameter("inertia_12", "property", "21"), {"properties[21].i12": 6.0}),
    (parameter("nonstructural_mass", "property", "22"), {"properties[22].nsm": 7e-6}),
    (parameter("area", "property", "24", item=2), {"properties[24].A[1]": 12.0}),
    (parameter("inertia_2", "property", "24", item=3), {"properties[24].i2[2]": 34.0}),
    (parameter("inertia_1", "property", "24", item=1), {"properties[24].i1[0]": 20.0}),
    (
        parameter("inertia_12", "property", "24"),
        {"properties[24].i12[0]": 2.0, "properties[24].i12[1]": 3.0, "properties[24].i12[2]": 4.0},
    ),
    (
        parameter("nonstructural_mass", "property", "24"),
        {"properties[24].nsm[0]": 1e-6, "properties[24].nsm[1]": 2e-6,
         "properties[24].nsm[2]": 3e-6},
    ),
    (parameter("shear_factor", "property", "24"),
     {"properties[24].k1": 0.7, "properties[24].k2": 1.0}),
    (
        parameter("offset", "property", "24"),
        {"properties[24].n1a": 0.1, "properties[24].n2a": 0.2, "properties[24].n1b": 0.3,
         "properties[24].n2b": 0.4},
    ),
    (parameter("shear_factor", "property", "26"),
     {"properties[26].k1": 0.5, "properties[26].k2": 0.6}),
    (parameter("nonstructural_mass", "property", "31"), {"properties[31].nsm": 8e-6}),
    (parameter("nonstructural_mass", "element", "32"), {"elements[32].nsm": 9e-6}),
    (parameter("structural_damping", "property", "41"), {"properties[41].ge": 0.04}),
    (parameter("structural_damping", "property", "42"), {"properties[42].ge": 0.05}),
    (parameter("structural_damping", "element", "43"), {"elements[43].ge": 0.06}),
    (parameter("structural_damping", "property", "44"), {"properties[44].GEi[0]": 0.07}),
    (
        parameter("viscous_damping", "property", "44"),
        {"properties[44].Bi[0]": 9.0, "properties[44].Bi[2]": 8.0},
    ),
    (parameter("viscous_damping", "element", "45"), {"elements[45].b": 12.0}),
    (parameter("offset", "element", "51"), {"masses[51].X[0]": 0.1, "masses[51].X[2]": 0.3}),
    (parameter("offset", "element", "51", item=3), {"masses[51].X[2]": 0.3}),
    (
        parameter("rotary_inertia", "element", "51"),
        {"masses[51].I[0]": 1.0, "masses[51].I[1]": 0.5, "masses[51].I[2]": 2.0,
         "masses[51].I[3]": 0.6, "masses[51].I[4]": 0.7, "masses[51].I[5]": 3.0},
    ),
    (parameter("rotary_inertia", "element", "51", item=21), {"masses[51].I[1]": 0.5}),
]  # fmt: skip


def model_of(folder: Path, text: str = DECK) -> NastranModel:
    path = folder / "main.bdf"
    path.write_text(text)
    return understand(read_deck(path))


def numbers(path: Path) -> dict[str, float]:
    """All numbers that pyNastran, an independent reader, finds in a deck, by where it has them."""
    bdf = BDF(debug=None)
    bdf.read_bdf(path, xref=False)
    found: dict[str, float] = {}
    for family in ("materials", "properties", "elements", "masses"):
        for ident, card in getattr(bdf, family).items():
            for name, value in vars(card).items():
                if isinstance(value, float):
                    found[f"{family}[{ident}].{name}"] = value
                elif isinstance(value, list | np.ndarray) and not name.startswith("_"):
                    for place, item in enumerate(value):
                        if isinstance(item, float):
                            found[f"{family}[{ident}].{name}[{place}]"] = float(item)
    return found


def same(one: float, other: float) -> bool:
    return one == other or (math.isnan(one) and math.isnan(other))  # pyNastran has NaN for blanks


@pytest.mark.parametrize(("wanted", "expected"), PLACES, ids=lambda value: str(value)[:60])
def test_another_reader_finds_the_edited_number_and_no_other_change(
    tmp_path: Path, wanted: Parameter, expected: dict[str, float]
) -> None:
    model = model_of(tmp_path)
    before = numbers(tmp_path / "main.bdf")
    assert {name: before[name] for name in expected} == expected
    changed = model.edit([(wanted, 1.25)])
    after = numbers(write_edited(model.deck, changed, tmp_path / "out"))
    moved = {name: value for name, value in after.items() if not same(value, before[name])}
    assert moved == {
        name: pytest.approx(1.25 * value, rel=2e-6) for name, value in expected.items()
    }
    # One line a number at most, and only that number's columns in it.
    assert len(changed) <= len(expected)
    assert [place.value for place in model.places(wanted)] == list(expected.values())
    assert model.written(wanted, 1.25) == pytest.approx(1.25, rel=2e-6)


@pytest.mark.parametrize(
    ("wanted", "line"),
    [
        (parameter("bending_inertia_ratio", "property", "1"), "PSHELL,1,1,1.5,1,1.25,1,,4.-9"),
        (parameter("bending_inertia_ratio", "property", "2"), "PSHELL,2,1,2.,1,1.25 $ a comment"),
        (
            parameter("shear_thickness_ratio", "property", "3"),
            "PSHELL  3       1       2.      1               1       1.041666       $ another",
        ),
        (
            parameter("bending_inertia_ratio", "property", "7"),
            "*                   1.25               1",
        ),
        (
            parameter("shear_thickness_ratio", "property", "7"),
            "*                                      1      1.04166625",
        ),
        (parameter("shear_factor", "property", "24"), ",.875,1.25"),
    ],
)
def test_a_blank_that_stands_for_a_default_is_written_into_its_own_columns(
    tmp_path: Path, wanted: Parameter, line: str
) -> None:
    assert [text for text in model_of(tmp_path).edit([(wanted, 1.25)]).values()] == [line]


@pytest.mark.parametrize(
    ("row", "line"),
    [(",", ",.25,.5"), ("+", "+       .25     .5"), ("*", "*       .25             .5")],
)
def test_two_blanks_behind_one_line_are_written_in_their_order(
    tmp_path: Path, row: str, line: str
) -> None:
    model = model_of(tmp_path, DECK.replace("\n,.5,.6\n", f"\n{row}\n"))
    items = [(parameter("shear_factor", "property", "26", item=i), i / 4) for i in (2, 1)]
    (text,) = model.edit(items).values()
    assert text == line


REFUSED: list[tuple[Parameter, str]] = [
    (parameter("shear_factor", "property", "22"), "PBARL 22 has no shear_factor"),
    (parameter("shear_factor", "property", "21"), "PBAR 21 has I12, with which K1 and K2"),
    (parameter("shear_factor", "property", "25"), "in a line that the card does not have"),
    (parameter("inertia_1", "property", "26", item=1), "end B of PBEAM 26 is blank"),
    (parameter("area", "property", "24", item=4), "no item 4 of area; it has 1, 2, 3"),
    (parameter("shear_thickness_ratio", "property", "2"), "PSHELL 2 has no MID3, without which"),
    (parameter("bending_inertia_ratio", "property", "4"), "no element uses PSHELL 4"),
    (parameter("nonstructural_mass", "property", "2"), "NSM is blank"),
    (parameter("ply_angle", "property", "6", item=1), "THETA1 is zero, which no factor changes"),
    (parameter("structural_damping", "material", "2"), "GE is blank"),
    (
        parameter("offset", "element", "13"),
        "ZOFFS is blank, so there is no offset; write it out (0. for none, and give the parameter "
        "`values: absolute` or `additive`",
    ),
    (parameter("offset", "element", "43"), "CELAS2 43 has no property"),
    (parameter("rotary_inertia", "element", "11"), "no such element 11"),
]


@pytest.mark.parametrize(("wanted", "reason"), REFUSED, ids=lambda value: str(value)[:60])
def test_what_has_no_number_or_no_effect_is_refused(
    tmp_path: Path, wanted: Parameter, reason: str
) -> None:
    with pytest.raises(ModelError, match=re.escape(reason)):
        model_of(tmp_path).edit([(wanted, 1.25)])


def test_what_nothing_acts_in_series_with_is_linear_and_the_rest_claims_nothing(
    tmp_path: Path,
) -> None:
    model = model_of(tmp_path)
    linear = {wanted.quantity for wanted, _ in PLACES if model.is_linear(wanted)}
    assert linear == {
        "rotary_inertia", "nonstructural_mass", "structural_damping", "viscous_damping",
    }  # fmt: skip
    assert not any(model.energy_sets(wanted) for wanted, _ in PLACES)


def test_the_reach_of_frequencies_is_not_bounded_by_an_angle_or_an_offset() -> None:
    masses = parameter("nonstructural_mass", "property", "1")
    assert frequency_reach(ParameterSet((masses,)), np.ones(1)) == pytest.approx(
        (0.5**0.5, 2.0**0.5)  # masses between half and twice, stiffness as it is
    )
    for wanted in (parameter("ply_angle", "property", "6"), parameter("offset", "element", "11")):
        assert frequency_reach(ParameterSet((masses, wanted)), np.ones(2)) == (0.0, np.inf)


# MYSTRAN, where it is

HEAD = "SOL 103\nCEND\nSPC = 1\nMETHOD = 1\nBEGIN BULK\nEIGRL,1,,,4\n"


def strip(rows: int, length: float, width: float, section: str) -> str:
    """A clamped strip of shells along x, two across; bending out of its plane and torsion alone."""
    text, across = HEAD, 3
    for i in range(rows + 1):
        for j in range(across):
            node = across * i + j + 1
            fixed = "123456" if i == 0 else "12"
            text += (
                f"GRID,{node},,{length * i / rows!r},{width * j / 2!r},0.\nSPC1,1,{fixed},{node}\n"
            )
    for i in range(rows):
        for j in range(across - 1):
            a = across * i + j + 1
            text += f"CQUAD4,{100 + 2 * i + j},7,{a},{a + across},{a + across + 1},{a + 1}\n"
    return text + section + "ENDDATA\n"


def beam(section: str, elements: int = 8) -> str:
    """A clamped bar of length 1 along x, and a body at its tip."""
    text = HEAD
    for i in range(elements + 1):
        text += f"GRID,{i + 1},,{i / elements!r},0.,0.\n"
        if i:
            text += f"CBAR,{i},7,{i},{i + 1},0.,1.,0.\n"
    return text + "SPC1,1,123456,1\n" + section.format(tip=elements + 1) + "ENDDATA\n"


#: A sandwich, a laminate and a bar with a body: what scales, its field now and as edited by hand.
SANDWICH = strip(
    8,
    0.8,
    0.1,
    "MAT1,1,7.+10,,.3,2700.\nMAT1,2,2.+8,,.3,80.\nPSHELL,7,1,.001,1,50.,2,.9,1.5\n",
)
LAMINATE = strip(
    8,
    0.5,
    0.05,
    "MAT8,1,1.3+11,9.+9,.3,5.+9,5.+9,4.+9,1600.\n"
    "PCOMP,7,,.4,,,,,\n,1,.0005,20.,,1,.0005,-35.\n,1,.0005,20.\n",
)
BAR = beam(
    "MAT1,1,2.1+11,,.3,7800.\nPBAR,7,1,4.-4,3.-8,2.-8,4.-8,.6\n,\n,.8,.7,.5-8\n"
    "CONM2,99,{tip},,1.2,.02,.01,.03,,\n,.004,.0005,.003,.0002,.0001,.005\n"
)
SOLVED: dict[str, tuple[str, Parameter, float, str, str]] = {
    "12I/T3": (
        SANDWICH, parameter("bending_inertia_ratio", "property", "7"), 1.3, ",50.,", ",65.,"),
    "TS/T": (SANDWICH, parameter("shear_thickness_ratio", "property", "7"), 0.5, ",.9,", ",.45,"),
    "NSM of shells": (
        SANDWICH, parameter("nonstructural_mass", "property", "7"), 2.0, ",1.5\n", ",3.\n"),
    "angle": (LAMINATE, parameter("ply_angle", "property", "7", item=2), 0.4, ",-35.", ",-14."),
    "NSM of a laminate": (
        LAMINATE, parameter("nonstructural_mass", "property", "7"), 2.0, ",,.4,", ",,.8,"),
    "I12": (BAR, parameter("inertia_12", "property", "7"), 1.6, ",.5-8\n", ",.8-8\n"),
    "K2": (  # which MYSTRAN leaves out beside I12
        BAR.replace(",.5-8\n", "\n"), parameter("shear_factor", "property", "7", item=2), 0.05,
        ",.7\n", ",.035\n"),
    "NSM of a bar": (BAR, parameter("nonstructural_mass", "property", "7"), 3.0, ",.6\n", ",1.8\n"),
    "offset of a body": (
        BAR, parameter("offset", "element", "99"), 2.0, ",.02,.01,.03,", ",.04,.02,.06,"),
    "inertia of a body": (
        BAR, parameter("rotary_inertia", "element", "99", item=33), 2.0, ",.005\n", ",.01\n"),
}  # fmt: skip


def modes(
    folder: Path, text: str, wanted: Parameter | None = None, value: float = 1.0
) -> ModalResult:
    program = os.environ.get(MYSTRAN.variable, MYSTRAN.program)
    if shutil.which(program) is None:
        pytest.skip(f"no {program} here; {MYSTRAN.variable} names one")
    path = folder / "deck.bdf"
    path.write_text(text)
    solver = mystran_solver(path, () if wanted is None else (wanted,))
    node = max(solver.deck.summary.node_ids)
    result = run(solver, {} if wanted is None else {"p": value}, ModalAnalysis(4, (node,)), folder)
    assert isinstance(result, ModalResult)
    return result


@pytest.mark.parametrize("name", SOLVED)
def test_mystran_solves_the_edited_deck_as_one_edited_by_hand(tmp_path: Path, name: str) -> None:
    text, wanted, value, old, new = SOLVED[name]
    assert text.count(old) == 1
    nominal = modes(tmp_path, text).eigenvalues
    by_hand = modes(tmp_path, text.replace(old, new)).eigenvalues
    edited = modes(tmp_path, text, wanted, value).eigenvalues
    assert np.abs(by_hand / nominal - 1.0).max() > 1e-3  # the number acts
    # Frequencies are half of this; the same numbers, in other columns.
    np.testing.assert_allclose(edited, by_hand, rtol=1e-6)


def test_mystran_bends_and_weighs_as_closed_forms_say(tmp_path: Path) -> None:
    # Without MID3 a strip bends without shear: f goes with the root of 12I/T**3 and of 1/mass.
    thin = SANDWICH.replace(",50.,2,.9,1.5", ",50.,,,1.5")
    bends = parameter("bending_inertia_ratio", "property", "7")
    weighs = parameter("nonstructural_mass", "property", "7")
    nominal = modes(tmp_path, thin).eigenvalues
    # 1e-5: printed membrane stiffness couples nowhere here, eigenvalues carry seven digits.
    np.testing.assert_allclose(
        modes(tmp_path, thin, bends, 1.21).eigenvalues / nominal, 1.21, rtol=1e-5
    )
    mass = 2700.0 * 0.001 + 1.5  # of a square metre
    lighter = modes(tmp_path, thin, weighs, 0.2).eigenvalues
    np.testing.assert_allclose(lighter / nominal, mass / (mass - 0.8 * 1.5), rtol=1e-5)
    assert math.isclose(mass, 4.2)


@pytest.mark.parametrize("name", CARDS)
def test_a_card_has_quantities_that_parameters_name_by_its_owner(name: str) -> None:
    row = CARDS[name]
    by = "element" if row.owner == "mass" else row.owner
    assert all(by in QUANTITIES[quantity].targets for quantity in row.numbers)
    assert {quantity for quantity, law in row.numbers.items() if not law.moves} <= DAMPING


def test_springs_without_a_property_have_no_damping(tmp_path: Path) -> None:
    deck = tmp_path / "springs.bdf"
    deck.write_text("BEGIN BULK\nCELAS4,1,900.,1,2\nCMASS4,2,1.,1\nENDDATA\n")
    assert "the deck has no damping" in understand(read_deck(deck)).undamped()
