"""What Nastran cards mean: where parameters stand, what they scale, and why some cannot."""

from __future__ import annotations

import json
import math
import re
from pathlib import Path

import pytest

from modetune.adapters.nastran.deck import read_deck, write_edited
from modetune.adapters.nastran.model import NastranModel, understand
from modetune.core.errors import ModelError
from modetune.core.parameters import Parameter, Quantity, TargetKind
from tests.adapters.nastran.test_deck import REAL

#: Two of everything a parameter can stand on, in several formats.
DECK = """SOL 103
CEND
METHOD = 1
BEGIN BULK
PARAM,WTMASS,0.5
EIGRL,1,,,10
$ a square and its points
GRID,1,,0.,0.,0.
GRID,2,,1.,0.,0.
GRID,3,,1.,1.,0.
GRID,4,,0.,1.,0.
MAT1    1       7.+4    2.7+4           2.7-9
MAT1,2,2.1+5,,.3,7.8-9
MAT1,3,7.+4,2.7+4,.3
MAT2,4,1.,2.,0.,4.,0.,6.,1.-9
MAT8,5,1.+5,1.+4,.3,5.+3,4.+3,3.+3,1.6-9
MAT1,9,1.,,.3
CQUAD4,11,1,1,2,3,4
CQUAD4,12,1,1,2,3,4
CQUAD4,13,2,1,2,3,4
,,,2.,2.,2.,2.
CQUAD4,14,3,1,2,3,4
CQUAD4,15,4,1,2,3,4
CQUAD4,16,5,1,2,3,4
CQUAD4,17,6,1,2,3,4
PSHELL,1,1,1.5,1,,1
PSHELL,2,1,2.
PSHELL,3,2,1.,3
PSHELL,4,4,3.
PCOMP,5
,5,.1,0.,,5,.2,90.
PCOMP,6
,5,.1,0.,,5
CBAR,21,21,1,2,0.,0.,1.
CBAR,22,22,1,2,0.,0.,1.
CBAR,23,23,1,2,0.,0.,1.
CBEAM,24,24,1,2,0.,0.,1.
CBEAM,25,25,1,2,0.,0.,1.
PBAR    21      2       10.     20.     30.     40.
PBAR,22,2,1.,2.,3.,4.
,
,.8,.8
PBARL,23,2,,BAR
,3.,4.
PBEAM,24,2,10.,20.,30.,,40.
,,,,,,,,
,NO,.5,12.,22.,,,42.
,YES,1.,14.,,34.
PBEAML,25,2,,BAR
,3.,4.,,YES,.5,3.5,4.5,0.
,YES,1.,,5.5
CROD,31,31,1,2
CONROD,32,1,2,2,6.,7.
PROD,31,2,8.,9.
CELAS1,41,41,1,1,2,1
CELAS1,42,42,1,1,2,1
PELAS,41,100.,,,42,200.
CELAS2,43,300.,1,1,2,1
CBUSH,44,44,1,2,,,,0
CBUSH,45,45,1,2,,,,0
PBUSH,44,K,1.,2.,3.
PBUSH,45,B,9.
,,K,1.,0.
CONM2,51,1,,2.,,,,,
,.1,,.2,,,.3
ENDDATA
"""


def parameter(
    quantity: Quantity, by: TargetKind, *targets: str, item: int = 0, name: str = "p"
) -> Parameter:
    return Parameter(name, quantity, by, targets, 0.5, 2.0, 0.1, item=item)


def model_of(folder: Path, text: str) -> NastranModel:
    path = folder / "main.bdf"
    path.write_text(text)
    return understand(read_deck(path))


@pytest.fixture
def model(tmp_path: Path) -> NastranModel:
    return model_of(tmp_path, DECK)


def line_of(text: str) -> int:
    return DECK.splitlines().index(text) + 1


def symbols(model: NastranModel, wanted: Parameter) -> dict[str, float]:
    return {place.symbol: place.value for place in model.places(wanted)}


def test_the_summary_counts_nodes_elements_and_masses(model: NastranModel) -> None:
    summary = model.summary
    assert summary.node_ids == {1, 2, 3, 4}
    assert summary.components == {1, 2, 3, 4, 5, 6}
    assert summary.n_elements == len(re.findall(r"(?m)^C(?!END)", DECK))  # names of elements only
    assert model.objections == ()


def test_wave_speeds_count_the_mass_in_its_own_unit(model: NastranModel) -> None:
    # sqrt(E / (rho * WTMASS)); MAT1 1 has E 7e4 and no density but NU, MAT1 2 has both.
    assert model.wtmass == 0.5
    assert model.wave_speeds()["MAT1 2"] == pytest.approx(math.sqrt(2.1e5 / (7.8e-9 * 0.5)))
    assert "MAT1 3" not in model.wave_speeds()


def test_case_control_parameters_come_before_bulk_ones(tmp_path: Path) -> None:
    text = DECK.replace("METHOD = 1", "METHOD = 1\nparam,wtmass,2.59-3")
    assert model_of(tmp_path, text).wtmass == 2.59e-3


PLACES: list[tuple[Parameter, dict[str, float]]] = [
    (parameter("youngs_modulus", "material", "1"), {"E": 7e4, "G": 2.7e4}),
    (parameter("youngs_modulus", "material", "2"), {"E": 2.1e5}),
    # Zeros stay zero, whatever the factor.
    (
        parameter("youngs_modulus", "material", "4"),
        {"G11": 1.0, "G12": 2.0, "G22": 4.0, "G33": 6.0},
    ),
    (parameter("youngs_modulus", "material", "4", item=22), {"G22": 4.0}),
    (
        parameter("youngs_modulus", "material", "5"),
        {"E1": 1e5, "E2": 1e4, "G12": 5e3, "G1Z": 4e3, "G2Z": 3e3},
    ),
    (parameter("youngs_modulus", "material", "5", item=2), {"E2": 1e4}),
    (parameter("shear_modulus", "material", "1"), {"G": 2.7e4}),
    (parameter("shear_modulus", "material", "5", item=13), {"G1Z": 4e3}),
    (parameter("poissons_ratio", "material", "2"), {"NU": 0.3}),
    (parameter("poissons_ratio", "material", "5"), {"NU12": 0.3}),
    (parameter("density", "material", "4"), {"RHO": 1e-9}),
    (parameter("density", "material", "5"), {"RHO": 1.6e-9}),
    (parameter("thickness", "property", "1"), {"T": 1.5}),
    (parameter("thickness", "element", "11-12"), {"T": 1.5}),
    (parameter("thickness", "property", "5"), {"T1": 0.1, "T2": 0.2}),
    (parameter("thickness", "property", "5", item=2), {"T2": 0.2}),
    (parameter("area", "property", "21"), {"A": 10.0}),
    (parameter("inertia_1", "property", "21"), {"I1": 20.0}),
    (parameter("inertia_2", "element", "21"), {"I2": 30.0}),
    (parameter("torsion_constant", "property", "21"), {"J": 40.0}),
    (parameter("area", "property", "24"), {"A(A)": 10.0, "A(1)": 12.0, "A(B)": 14.0}),
    (parameter("inertia_1", "property", "24"), {"I1(A)": 20.0, "I1(1)": 22.0}),
    (parameter("inertia_2", "property", "24"), {"I2(A)": 30.0, "I2(B)": 34.0}),
    (parameter("torsion_constant", "property", "24"), {"J(A)": 40.0, "J(1)": 42.0}),
    (parameter("area", "property", "31"), {"A": 8.0}),
    (parameter("torsion_constant", "property", "31"), {"J": 9.0}),
    (parameter("area", "element", "32"), {"A": 6.0}),
    (parameter("torsion_constant", "element", "32"), {"J": 7.0}),
    (parameter("dimension", "property", "23", item=2), {"DIM2": 4.0}),
    (parameter("dimension", "property", "25", item=1), {"DIM1(A)": 3.0, "DIM1(1)": 3.5}),
    (
        parameter("dimension", "property", "25", item=2),
        {"DIM2(A)": 4.0, "DIM2(1)": 4.5, "DIM2(B)": 5.5},
    ),
    (parameter("spring_stiffness", "property", "41"), {"K1": 100.0}),
    (parameter("spring_stiffness", "property", "42"), {"K1": 200.0}),
    (parameter("spring_stiffness", "element", "43"), {"K": 300.0}),
    (parameter("spring_stiffness", "property", "44"), {"K1": 1.0, "K2": 2.0, "K3": 3.0}),
    (parameter("spring_stiffness", "property", "44", item=3), {"K3": 3.0}),
    (parameter("spring_stiffness", "property", "45"), {"K1": 1.0}),
    (parameter("mass", "element", "51"), {"M": 2.0, "I11": 0.1, "I22": 0.2, "I33": 0.3}),
]


@pytest.mark.parametrize(("wanted", "found"), PLACES, ids=lambda value: str(value)[:60])
def test_a_parameter_stands_at_the_numbers_of_its_cards(
    model: NastranModel, wanted: Parameter, found: dict[str, float]
) -> None:
    # The numbers are those of DECK; the names are Nastran's own in DVxREL1 cards.
    assert symbols(model, wanted) == found


REFUSED: list[tuple[Parameter, str]] = [
    (parameter("youngs_modulus", "elset", "WING"), "no element sets: name a property or elements"),
    (parameter("matrix_factor", "part", "wing"), "no matrix parts"),
    (parameter("youngs_modulus", "material", "20"), "did you mean 2?"),
    (parameter("youngs_modulus", "material", "9"), "no element uses material 9"),
    (parameter("youngs_modulus", "material", "1", item=1), "leave the item out"),
    (parameter("shear_modulus", "material", "2"), "it follows from E and NU"),
    (parameter("poissons_ratio", "material", "1"), "it follows from E and G"),
    (parameter("poissons_ratio", "material", "3"), "bars take G and ignore NU"),
    (parameter("shear_modulus", "material", "4"), "MAT2 4 has no shear_modulus"),
    (parameter("youngs_modulus", "material", "4", item=13), "G13 is zero, which no factor"),
    (parameter("youngs_modulus", "material", "5", item=12), "no item 12 of youngs_modulus; it has"),
    (parameter("thickness", "property", "2"), "CQUAD4 13 gives its own thickness"),
    (parameter("thickness", "property", "6"), "ply 2 of PCOMP 6 has a blank thickness"),
    (parameter("thickness", "property", "5", item=3), "no item 3 of thickness; it has 1, 2"),
    (parameter("thickness", "element", "11"), "PSHELL 1 is used by 1 other elements too"),
    (parameter("thickness", "element", "900-910"), "no such element in 900-910"),
    (parameter("thickness", "property", "21"), "PBAR 21 has no thickness"),
    (parameter("thickness", "element", "32"), "CONROD 32 has no property"),
    (parameter("area", "property", "23"), "gives dimensions: update `dimension`"),
    (parameter("dimension", "property", "23"), "give the parameter an item"),
    (parameter("dimension", "property", "23", item=3), "no item 3 of dimension; it has 1, 2"),
    (parameter("spring_stiffness", "property", "44", item=4), "no item 4"),
    (parameter("mass", "element", "11"), "did you mean 51?"),
    (parameter("density", "material", "3"), "RHO is blank"),
    (parameter("area", "property", "21", "21"), "named twice"),
]


@pytest.mark.parametrize(("wanted", "reason"), REFUSED, ids=lambda value: str(value)[:60])
def test_what_cannot_be_updated_is_refused_with_its_reason(
    model: NastranModel, wanted: Parameter, reason: str
) -> None:
    if reason == "did you mean 51?":
        reason = "no such element 11 (there are 51)"  # 11 is not a mass, and 51 not near to it
    with pytest.raises(ModelError, match=re.escape(reason)):
        model.places(wanted)


def test_a_refusal_names_the_line_of_the_card(model: NastranModel) -> None:
    line = line_of("PSHELL,1,1,1.5,1,,1")
    with pytest.raises(ModelError, match=rf"main\.bdf, line {line}: PSHELL 1 is used"):
        model.places(parameter("thickness", "element", "12"))


def test_an_edit_scales_every_place_and_nothing_else(model: NastranModel, tmp_path: Path) -> None:
    wanted = [(known, 1.25) for known, _ in PLACES]
    for one, factor in wanted:
        changed = model.edit([(one, factor)])
        before, after = DECK.splitlines(), list(DECK.splitlines())
        for position, text in changed.items():
            after[position] = text
        again = understand(read_deck(write_edited(model.deck, changed, tmp_path / "out")))
        assert symbols(again, one) == {
            symbol: pytest.approx(1.25 * value, rel=1e-6)  # seven digits of eight columns
            for symbol, value in symbols(model, one).items()
        }
        places = {position for place in model.places(one) for position in place.card.lines}
        assert set(changed) <= places
        assert (tmp_path / "out" / "main.bdf").read_text().splitlines() == after
        assert len(before) == len(after)


def test_a_factor_of_one_changes_nothing(model: NastranModel) -> None:
    assert model.edit([(known, 1.0) for known, _ in PLACES]) == {}
    assert model.bulk_at({}) is model.bulk


def test_the_edited_model_is_what_pynastran_reads_of_the_edited_lines(model: NastranModel) -> None:
    changed = model.edit(
        [
            (parameter("youngs_modulus", "material", "2"), 1.1),
            (parameter("area", "property", "24"), 2.0),
        ]
    )
    bulk = model.bulk_at(changed)
    assert bulk.materials[2].e == pytest.approx(2.31e5)
    assert bulk.properties[24].A.tolist() == [20.0, 24.0, 28.0]
    assert model.bulk.materials[2].e == 2.1e5  # the model itself stays


def test_two_numbers_of_one_line_change_together(model: NastranModel) -> None:
    pair = (
        (parameter("area", "property", "21"), 1.1),
        (parameter("inertia_2", "element", "21"), 0.9),
    )
    (text,) = model.edit(pair).values()
    assert text == "PBAR    21      2       11.     20.     27.     40."


ENERGY: list[tuple[Parameter, tuple[str, ...]]] = [
    (parameter("youngs_modulus", "material", "1"), ("P1", "P2")),
    (parameter("youngs_modulus", "material", "2"), ()),  # PSHELL 3 bends with material 3
    (
        parameter("youngs_modulus", "material", "2", "3"),
        ("P3", "P21", "P22", "P23", "P24", "P25", "P31", "E32"),
    ),
    (parameter("youngs_modulus", "material", "4"), ("P4",)),
    (parameter("youngs_modulus", "material", "4", item=11), ()),
    (parameter("youngs_modulus", "material", "5"), ("P5", "P6")),
    (parameter("density", "material", "1"), ()),
    (parameter("torsion_constant", "property", "31"), ()),
    (parameter("spring_stiffness", "property", "41"), ("P41",)),
    (parameter("spring_stiffness", "element", "42"), ("P42",)),
    (parameter("spring_stiffness", "element", "43"), ("E43",)),
    (parameter("spring_stiffness", "property", "44"), ("P44",)),
    (parameter("spring_stiffness", "property", "44", item=1), ()),
    (parameter("spring_stiffness", "property", "45", item=1), ("P45",)),  # its only stiffness
]


@pytest.mark.parametrize(("wanted", "sets"), ENERGY, ids=lambda value: str(value)[:60])
def test_energy_sets_hold_what_the_parameter_alone_makes_stiff(
    model: NastranModel, wanted: Parameter, sets: tuple[str, ...]
) -> None:
    assert model.energy_sets(wanted) == sets


def test_energy_sets_have_their_elements(model: NastranModel) -> None:
    assert model.set_elements("P1") == {11, 12}
    assert model.set_elements("E32") == {32}


@pytest.mark.parametrize(
    ("wanted", "linear"),
    [
        (parameter("youngs_modulus", "material", "1"), True),
        (parameter("youngs_modulus", "material", "2"), False),  # shares PSHELL 3
        (parameter("youngs_modulus", "material", "5", item=1), False),  # E1 and E2 are coupled
        (parameter("poissons_ratio", "material", "2"), False),
        (parameter("density", "material", "1"), True),
        (parameter("thickness", "property", "1"), False),
        (parameter("dimension", "property", "23", item=1), False),
        (parameter("inertia_1", "property", "21"), True),
        (parameter("inertia_1", "property", "22"), False),  # K1 and K2: shear in series
        (parameter("inertia_1", "property", "24"), False),  # a PBEAM shears unless told not to
        (parameter("torsion_constant", "property", "24"), True),
        (parameter("area", "element", "32"), True),
        (parameter("spring_stiffness", "property", "41"), True),
        (parameter("mass", "element", "51"), True),
    ],
)
def test_linear_is_only_what_nothing_acts_in_series_with(
    model: NastranModel, wanted: Parameter, linear: bool
) -> None:
    assert model.is_linear(wanted) is linear


BAD: list[tuple[str, int, str]] = [
    ("MAT1,1,x\n", 2, "E = 'X'"),
    ("CQUAD4,1,1,1\n", 2, "CQUAD4"),
    ("PCOMP,1\nCTRIA3,9,1,1,1,1\n", 2, "PCOMP"),
    ("CONM2,1,7,,1.\n", 2, "CONM2 1"),
    ("GRID,2,,0.,0.,0.\nCROD,1,5,1,2\n", 3, "CROD 1"),
    ("GRID,2,,0.,0.,0.\nGRID,2,,1.,0.,0.\n", 2, "line 3: GRID 2 is there more than once"),
    ("CORD2R,2\n", 2, "the three points lie in one line"),
    ("CROD,5,1,1,1\nCBAR,5,1,1,1,1.,0.,0.\n", 2, "line 3: CBAR 5 is there more than once"),
    ("MAT1,1,2.,,.3\nMAT1,1,3.,,.3\n", 2, "line 3: MAT1 1 is there more than once"),
    ("GRID,2,7,0.,0.,0.\n", 2, "coordinate system 7 is not there"),
    ("PSHELL,1,7,.1\nCTRIA3,9,1,1,1,1\n", 2, "PSHELL 1"),
    ("PBUSH,1,K,1.,RIGID\nCBUSH,9,1,1\n", 2, "= 'RIGID' (field #4)"),
]


@pytest.mark.parametrize(("text", "line", "reason"), BAD)
def test_bad_cards_name_file_and_line(
    tmp_path: Path, text: str, line: int, reason: str, capfd: pytest.CaptureFixture[str]
) -> None:
    expected = rf"(?s)main\.bdf, line {line}\b.*{re.escape(reason)}"
    model = model_of(tmp_path, f"GRID,1,,0.,0.,0.\n{text}")
    with pytest.raises(ModelError, match=expected):
        model.check()
    assert capfd.readouterr() == ("", "")  # standard output is for the summary alone


def test_all_bad_cards_are_told_at_once(tmp_path: Path) -> None:
    model = model_of(tmp_path, "GRID,x\nMAT1,1,x\n")
    with pytest.raises(ModelError) as caught:
        model.check()
    assert [line.split(":")[0][-6:] for line in str(caught.value).splitlines()] == [
        "line 1",
        "line 2",
    ]


def test_cards_of_other_programs_are_kept_and_listed(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    model = model_of(tmp_path, "GRID,1,,0.,0.,0.\nWONDER,1,2.,3\nEIGR,1,FEER,,,4\n")
    assert [card.name for card in model.deck.cards] == ["GRID", "WONDER", "EIGR"]
    assert model.objections == ()
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize("case", REAL)
def test_real_decks_are_understood(shared_data: Path, case: str) -> None:
    folder = shared_data / "nastran" / case
    expected = json.loads((folder / "expected.json").read_text())
    (path,) = (folder / name for name in expected["files"] if name.endswith((".bdf", ".dat")))
    model = understand(read_deck(path))
    assert len(model.summary.node_ids) == expected["ngrid"]


def test_every_element_of_the_probes_can_be_made_stiffer(shared_data: Path) -> None:
    folder = shared_data / "nastran" / "mystran_probes"
    cases = json.loads((folder / "expected.json").read_text())["cases"]
    for name, case in cases.items():
        model = understand(read_deck(folder / f"{name}.dat"))
        assert len(model.summary.node_ids) == case["ngrid"]
        for number in model.bulk.materials:
            wanted = parameter("youngs_modulus", "material", str(number))
            assert model.energy_sets(wanted), (name, number)
            assert model.is_linear(wanted)


def test_the_aircraft_has_its_shells_and_masses(shared_data: Path) -> None:
    model = understand(read_deck(shared_data / "garteur" / "mystran" / "gart.dat"))
    # 322 GRID, 230 CQUAD4, 3 CONM2: README of the data.
    assert (len(model.summary.node_ids), model.summary.n_elements) == (322, 233)


def test_a_written_value_is_what_the_columns_hold(tmp_path: Path) -> None:
    # 1.111-10 times 1.005 is 1.116555-10; eight columns hold 1.117-10.
    path = tmp_path / "bar.bdf"
    path.write_text(
        "GRID,1,,0.,0.,0.\nGRID,2,,1.,0.,0.\nMAT1,1,7.+10,,.3,2700.\n"
        "PBAR           1       1    1.-51.111-101.111-101.111-10\nCBAR,1,1,1,2,0.,1.,0.\n"
    )
    model = understand(read_deck(path))
    inertia = Parameter("I1", "inertia_1", "property", ("1",), 0.5, 2.0, 0.1)
    assert model.written(inertia, 1.005) == pytest.approx(1.117 / 1.111, rel=1e-12)
    assert model.written(inertia, 1.0) == 1.0
    changed = model.edit([(inertia, 1.005)])
    written = model.bulk_at(changed).properties[1].i1
    assert written == pytest.approx(model.written(inertia, 1.005) * 1.111e-10, rel=1e-12)


def test_a_mat8_without_transverse_shear_moduli_has_none(tmp_path: Path) -> None:
    path = tmp_path / "ply.bdf"
    path.write_text("MAT8,1,140.+9,10.+9,.3,5.+9,,,1600.\nMAT8,2,1.,1.,.3,1.,4.,5.\n")
    materials = understand(read_deck(path)).bulk.materials
    assert (materials[1].g1z, materials[1].g2z) == (0.0, 0.0)
    assert (materials[2].g1z, materials[2].g2z) == (4.0, 5.0)


def test_a_parameter_tells_what_is_wrong_with_its_card(tmp_path: Path) -> None:
    text = "GRID,1,,0.,0.,0.\nGRID,2,,1.,0.,0.\nCROD,1,1,1,2\nPROD,1,1,%A\nMAT1,1,7.,,.3\n"
    model = model_of(tmp_path, text)
    with pytest.raises(ModelError, match=r"no element uses PROD 1\n.*line 4: PROD: A = '%A'"):
        model.places(parameter("area", "property", "1"))


def test_blank_fields_are_filled_by_the_defaults_of_the_deck(tmp_path: Path) -> None:
    model = model_of(
        tmp_path,
        "CORD2R,9,,0.,0.,0.,0.,0.,1.\n,0.,1.,0.\nGRDSET,,9,,,,9,456\nBAROR,,4,,,0.,0.,1.\n"
        "GRID,1,,1.,0.,0.\nGRID,2,0,1.,0.,0.,0,3\nCBAR,7,,1,2\n"
        "PBAR,4,1,1.,1.,1.\nMAT1,1,7.,,.3\n",
    )
    one, two = model.bulk.nodes[1], model.bulk.nodes[2]
    assert (one.Cp(), one.Cd(), str(one.ps)) == (9, 9, "456")
    assert (two.Cp(), two.Cd(), str(two.ps)) == (0, 0, "3")
    assert model.bulk.elements[7].pid == 4
    assert list(model.bulk.elements[7].x) == [0.0, 0.0, 1.0]


def test_elements_between_scalar_points_make_them(tmp_path: Path) -> None:
    model = model_of(tmp_path, "GRID,1,,0.,0.,0.\nCELAS4,7,100.,11,12\nCMASS4,8,2.,12\n")
    assert set(model.bulk.spoints) == {11, 12}
    assert model.objections == ()


ROD = "GRID,1,,0.,0.,0.\nGRID,2,,1.,0.,0.\nCROD,1,1,1,2\nPROD,1,1,1.\nMAT1,1,7.+4,,.3,2.7-9\n"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("PARAM,CK1,2.\n", r"line 1: PARAM,CK1,2\. changes normal modes"),
        ("MDLPRM,OFFDEF,NOMASS\n", r"line 1: MDLPRM,OFFDEF,NOMASS"),
        ("", "nothing in the model has mass.*give its materials a density"),
    ],
)
def test_what_other_solvers_would_lose_is_refused_with_a_remedy(
    text: str, message: str, tmp_path: Path
) -> None:
    bulk = text + (ROD if text else ROD.replace(",2.7-9", ""))
    with pytest.raises(ModelError, match=message):
        model_of(tmp_path, bulk).check()


def test_a_material_follows_a_temperature_only_where_one_is_selected(tmp_path: Path) -> None:
    bulk = ROD + "MATT1,1,5\nTEMPD,3,80.\n"
    for case, taken in (("TEMP(LOAD) = 3\n", True), ("", True), ("TEMP(INIT) = 3\n", False)):
        model = model_of(tmp_path, f"SOL 103\nCEND\n{case}BEGIN BULK\n{bulk}")
        if taken:
            model.check()
            continue
        with pytest.raises(ModelError, match=r"line 10: MATT1 makes .*`TEMP\(INIT\) = 3` selects"):
            model.check()


def test_what_changes_no_modes_is_left_out_and_told_once(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    # A property of heat that nothing uses, output, an added pole of a control system.
    bulk = ROD + "PHBDY,7,.1\nPBAR,8,99,1.\nPARAM,NASPDV,1\nPARAM,CK1,1.\nEPOINT,90\nTF,3,90,,1.\n"
    model_of(tmp_path, bulk).check()
    (said,) = [record.getMessage() for record in caplog.records]
    assert said.endswith("left out of jobs on this solver: 1 EPOINT, 1 TF, PARAM CK1, PARAM NASPDV")
