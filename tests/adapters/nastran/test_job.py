"""Jobs of Nastran decks: what stays of the user's, what is added, what is refused."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pyNastran.bdf.bdf import BDF

from modetune.adapters.nastran.bulk import read_bulk
from modetune.adapters.nastran.deck import NastranDeck, read_deck
from modetune.adapters.nastran.dialect import MSC, MYSTRAN, NX, Dialect
from modetune.adapters.nastran.job import COLUMNS, job_text, wrapped_set
from modetune.adapters.nastran.model import NastranModel, understand
from modetune.adapters.solver import (
    Analysis,
    MatrixAnalysis,
    ModalAnalysis,
    SensitivityAnalysis,
)
from modetune.core.errors import ModelError
from modetune.core.parameters import Parameter, Quantity, TargetKind
from tests.adapters.mystran_decks import frame

HEAD = "SOL 103\nCEND\nTITLE = TRUSS\nSPC = 1\nMETHOD = 10\nDISP = ALL\nBEGIN BULK\n"
#: Two rods and a spring in a row, a mass at each node.
BULK = """\
$ a truss
EIGRL         10               5
PARAM,POST,0
PARAM,WTMASS,.001
GRID           1              0.      0.      0.
GRID           2              1.      0.      0.
GRID           3              2.      0.      0.
SPC1           1  123456       1
MAT1           1  70000.              .3
MAT1*                  2         70000.0                              .3
*
CONROD,11,1,2,1,2.5   $ the first rod
CONROD,12,2,3,2,1.5
CELAS2        13    250.       1       1       3       1
CONM2         21       2            1.5
CONM2         22       3            2.5
"""
MODAL = ModalAnalysis(2, (1, 2, 3))


def parameter(
    name: str, quantity: Quantity, by: TargetKind, *targets: str, item: int = 0
) -> Parameter:
    return Parameter(name, quantity, by, targets, 0.5, 2.0, 0.1, item=item)


def model_of(folder: Path, text: str) -> NastranModel:
    path = folder / "truss.bdf"
    path.write_text(text)
    return understand(read_deck(path))


def job(
    folder: Path, text: str = HEAD + BULK, analysis: Analysis = MODAL, dialect: Dialect = MSC
) -> str:
    return job_text(model_of(folder, text), {}, analysis, dialect)


def parsed(text: str, folder: Path) -> BDF:
    """The job as pyNastran reads it; it raises for a card that is wrong."""
    path = folder / "parsed.bdf"
    path.write_text(text)
    model = BDF(debug=None)
    model.read_bdf(str(path), xref=False, punch=False)
    return model


def bulk_lines(text: str) -> list[str]:
    return text.split("BEGIN BULK\n")[1].splitlines()


def test_a_job_asks_for_the_modes_at_the_analysis_nodes_and_keeps_the_selections(
    tmp_path: Path,
) -> None:
    text = job(tmp_path)
    assert text.splitlines()[:9] == [
        "SOL 103",
        "CEND",
        "ECHO = NONE",
        "SPC = 1",
        "SET 1 = 1, 2, 3",
        "METHOD = 10",
        "DISPLACEMENT(PLOT) = 1",
        "BEGIN BULK",
        "PARAM,POST,-1",
    ]
    assert bulk_lines(text)[1:3] == ["PARAM,GRDPNT,0", "EIGRL,10,,,2,,,,MASS"]
    assert text.endswith("ENDDATA\n")


def test_the_users_request_for_modes_and_their_output_parameters_go_and_the_rest_stays(
    tmp_path: Path,
) -> None:
    lines = bulk_lines(job(tmp_path))
    assert not any(line.startswith("EIGRL ") or "POST,0" in line for line in lines)
    stays = [line.split("$")[0].rstrip() for line in BULK.splitlines()[3:]]
    assert lines[3:-1] == stays


@pytest.mark.parametrize("dialect", [MSC, NX, MYSTRAN], ids=lambda d: d.name)
def test_pynastran_reads_the_jobs_of_all_dialects(dialect: Dialect, tmp_path: Path) -> None:
    bdf = parsed(job(tmp_path, dialect=dialect), tmp_path)
    assert bdf.sol == 103
    assert bdf.methods[10].nd == 2
    assert bdf.methods[10].norm == "MASS"
    assert sorted(bdf.nodes)[:3] == [1, 2, 3]  # MYSTRAN gets spare ones beyond
    assert sorted(bdf.elements)[:3] == [11, 12, 13]


def test_a_deck_of_bulk_data_alone_becomes_a_whole_job(tmp_path: Path) -> None:
    bdf = parsed(job(tmp_path, BULK), tmp_path)
    assert bdf.sol == 103
    assert list(bdf.methods) == [1]
    assert bdf.case_control_deck.subcases[0].get_parameter("METHOD")[0] == 1


def test_strain_energies_are_asked_for_the_groups_elements_only(tmp_path: Path) -> None:
    analysis = ModalAnalysis(2, (1,), (("E", ("E11", "E12")), ("k", ("E13",))))
    text = job(tmp_path, analysis=analysis)
    assert "SET 2 = 11, 12, 13\n" in text
    assert "ESE(PLOT) = 2\n" in text
    assert "PARAM,TINY,0.\n" in text
    assert "ESE" not in job(tmp_path)


def test_a_set_of_many_nodes_stays_within_the_columns_of_case_control() -> None:
    members = list(range(99_990_000, 99_990_500))
    lines = wrapped_set(1, members)
    assert max(map(len, lines)) <= COLUMNS
    assert all(line.endswith(",") for line in lines[:-1])
    words = " ".join(lines).partition("=")[2].split(",")
    assert [int(word) for word in words] == members


def test_includes_are_merged_and_comments_do_not_show(tmp_path: Path) -> None:
    whole = job(tmp_path)
    cut = BULK.index("MAT1")
    (tmp_path / "deep").mkdir()
    (tmp_path / "deep" / "rest.bdf").write_text("$ the rest\n" + BULK[cut:])
    assert job(tmp_path, HEAD + BULK[:cut] + "INCLUDE 'deep/rest.bdf'\n") == whole


def test_system_cells_stay_and_what_a_job_cannot_carry_is_refused_all_at_once(
    tmp_path: Path,
) -> None:
    kept = "NASTRAN SYSTEM(151)=1,\n  BUFFSIZE=65537\nASSIGN OUTPUT2='x.op2',UNIT=12\n"
    text = job(tmp_path, kept + HEAD + BULK)
    assert text.startswith("NASTRAN SYSTEM(151)=1,\n  BUFFSIZE=65537\nSOL 103\n")
    bad = "ASSIGN INPUTT2='loads.op2',UNIT=13\n" + HEAD.replace(
        "CEND", "COMPILE SEMODES\nALTER 3\nCEND"
    )
    with pytest.raises(ModelError) as caught:
        job(tmp_path, bad + BULK, dialect=MYSTRAN)
    message = str(caught.value)
    assert f"{tmp_path / 'truss.bdf'}, line 1: the model takes data from another file" in message
    assert "line 3: COMPILE changes the solution sequence" in message
    with pytest.raises(ModelError, match="line 1: LINK changes the solution sequence"):
        job(tmp_path, "LINK 'x.exe'\n" + HEAD + BULK)


def test_nastran_itself_judges_a_set_that_is_not_there(tmp_path: Path) -> None:
    head = HEAD.replace("SPC = 1", "SPC = 1\nMPC = 7")
    assert job(tmp_path, head + BULK) == job(tmp_path).replace("SPC = 1", "SPC = 1\nMPC = 7")
    assert job(tmp_path, head + BULK, dialect=MYSTRAN) == job(tmp_path, dialect=MYSTRAN)


@pytest.mark.parametrize("first", ["COMPILE SEMODES SOUIN=MSCSOU", "MALTER 'MODES'"])
def test_a_nastran_job_carries_the_alters_of_the_deck_behind_its_own_solution(
    first: str, tmp_path: Path
) -> None:
    alters = f"{first} $ as written\nALTER 'READ.*KXX'(1,-1)\nMATPRN KGG// $\nENDALTER\n"
    before = job(tmp_path, alters + "TIME 10\n" + HEAD + BULK)
    behind = job(tmp_path, HEAD.replace("CEND\n", alters + "TIME 10\nCEND\n") + BULK)
    assert before == behind == job(tmp_path).replace("CEND\n", alters + "CEND\n")
    without_end = alters.replace("ENDALTER\n", "")
    text = job(tmp_path, HEAD.replace("CEND\n", without_end + "CEND\n") + BULK)
    assert text == job(tmp_path).replace("CEND\n", without_end + "CEND\n")


@pytest.mark.parametrize(
    ("case", "expected"),
    [
        ("SPC = 1\nSUBCASE 1\n METHOD = 10\n", ["SPC = 1"]),
        ("SUBCASE 1\n LOAD = 3\nSUBCASE 2\n SPC = 1\n METHOD = 10\n", ["SPC = 1"]),
        ("SPC = 7\nSUBCASE 1\n SPC = 1\n METHOD = 10\n", ["SPC = 1"]),
        ("SUBCASE 1\n SPC=1\n METHOD=10\nSUBCASE 2\n SPC=1\n METHOD=10\n", ["SPC = 1"]),
        ("SUBCASE 1\n SPC = 2\n LOAD = 1\nSUBCASE 2\n SPC = 3\n METHOD 10\n", ["SPC = 3"]),
        ("SPC 7\nMETHOD = 10\n", ["SPC = 7"]),
        # Loads, temperatures that load alone, and combinations make no other modes.
        ("SUBCASE 1\n METHOD=10\nSUBCASE 2\n METHOD=10\n TEMP(LOAD)=3\n PARAM,EST,1\n", []),
        ("METHOD=10\nSUBCASE 1\n SPC=4\nSUBCOM 2\n SUBSEQ=1.\n", ["SPC = 4"]),
        (
            "PARAM,WTMASS,.01\nPARAM,POST,0\nTEMP(INIT)=1\nTEMP(LOAD)=2\nMETHOD = 10\n",
            ["TEMP(INIT)=1", "TEMP(LOAD)=2"],
        ),
        ("METHOD = 10\nOUTPUT(XYPLOT)\nSPC = 3\n", []),
        ("SET 5 = 1,2,\n 3\nDISP = 5\nMETHOD(STRUCTURE) = 10\nMPC = 4\n", ["MPC = 4"]),
    ],
)
def test_selections_come_from_the_subcase_that_counts(
    case: str, expected: list[str], tmp_path: Path
) -> None:
    text = job(tmp_path, f"SOL 103\nCEND\n{case}BEGIN BULK\n{BULK}")
    lines = text.splitlines()
    assert lines[lines.index("ECHO = NONE") + 1 : lines.index("SET 1 = 1, 2, 3")] == expected
    assert "METHOD = 10" in lines


@pytest.mark.parametrize(
    ("case", "message"),
    [
        ("SUBCASE 1\n METHOD = 10\nSUBCASE 2\n METHOD = 11\n", "line 3: 2 of 2 subcases"),
        ("STATSUB = 1\nMETHOD = 10\n", "line 3: STATSUB asks for modes of a preloaded"),
        ("SUPER = 2\n", "line 3: SUPER asks for superelements"),
        ("METHOD = ALL\n", "line 3: METHOD requires the number of an EIGRL card"),
    ],
)
def test_case_control_that_means_no_single_modal_job_is_refused(
    case: str, message: str, tmp_path: Path
) -> None:
    with pytest.raises(ModelError, match=message):
        job(tmp_path, f"SOL 103\nCEND\n{case}BEGIN BULK\n{BULK}")


@pytest.mark.parametrize("whole", ["SUPER = ALL\n", "SEALL = ALL\n", "SUPER=0\n"])
def test_superelements_are_asked_of_a_model_that_is_or_becomes_one(
    whole: str, tmp_path: Path
) -> None:
    for parts in ("", "SESET,1,2\n", "GRID,99,,0.,0.,0.,,,1\n"):
        text = job(tmp_path, f"SOL 103\nCEND\n{whole}BEGIN BULK\n{BULK}{parts}")
        assert "SUPER" not in text
        assert "SESET" not in text
    with pytest.raises(ModelError, match="CSUPER makes an image"):
        job(tmp_path, f"SOL 103\nCEND\n{whole}BEGIN BULK\n{BULK}SESET,1,2\nCSUPER,2,1,3\n")


def test_a_database_of_its_own_name_is_no_input(tmp_path: Path) -> None:
    text = job(tmp_path, f"ASSIGN MASTER='x.MASTER'\nSOL 103\nCEND\nBEGIN BULK\n{BULK}")
    assert "MASTER" not in text


def test_mystran_gets_defaults_filled_in_and_nothing_that_it_would_pass_over(
    tmp_path: Path,
) -> None:
    deck = HEAD + "GRDSET,,,,,,,6\nAERO,,1.,1.,1.\nGRID,77,,0.,1.,2.\n" + BULK
    text = job(tmp_path, deck, dialect=MYSTRAN)
    assert "AERO" not in text
    assert "GRDSET" not in text
    assert f"GRID*   {77:<16}{'':16}{'0.':<16}1.\n*       {'2.':<16}{'':16}6\n" in text


def test_a_parameter_of_the_case_control_goes_before_one_of_the_bulk_data(tmp_path: Path) -> None:
    # MYSTRAN knows parameters in bulk data only.
    text = job(tmp_path, f"SOL 103\nCEND\nPARAM,WTMASS,.01\nMETHOD = 10\nBEGIN BULK\n{BULK}")
    assert text.count("WTMASS") == 1
    assert text.index("BEGIN BULK") < text.index("PARAM,WTMASS,.01\n")


def test_edited_numbers_stand_in_the_job_and_nothing_else_differs(tmp_path: Path) -> None:
    model = model_of(tmp_path, HEAD + BULK)
    changed = model.edit([(parameter("E", "youngs_modulus", "material", "2"), 1.1)])
    before = job_text(model, {}, MODAL, MSC).splitlines()
    after = job_text(model, changed, MODAL, MSC).splitlines()
    different = [new for old, new in zip(before, after, strict=True) if new != old]
    assert len(different) == 1
    # 1.1 * 70000 by hand; the field is 16 wide.
    assert parsed("\n".join(after), tmp_path).materials[2].e == 77_000.0


def test_matrices_and_mystran_sensitivities_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ModelError, match="matrices are not read"):
        job(tmp_path, analysis=MatrixAnalysis())
    with pytest.raises(ModelError, match="MYSTRAN gives no sensitivities"):
        job(tmp_path, analysis=SensitivityAnalysis(2, ()), dialect=MYSTRAN)


def test_mystran_gets_a_shift_and_two_points_in_its_solids(tmp_path: Path) -> None:
    solid = "CTETRA,50,5,1,2,3,4\nGRID,4,,0.,0.,1.\n"
    text = job(tmp_path, HEAD + BULK + solid + "PSOLID,5,1\n", dialect=MYSTRAN)
    assert "EIGRL,10,,,2,,,-1000.,MASS" in text
    assert "DISPLACEMENT(PLOT,PRINT) = 1" in text
    assert f"PSOLID* {5:<16}{1:<16}{'':16}2\n" in text
    own = BULK.replace("EIGRL         10               5", "EIGRL,10,,,5,,,-50.")
    assert "EIGRL,10,,,2,,,-50.,MASS" in job(tmp_path, HEAD + own, dialect=MYSTRAN)
    given = job(tmp_path, HEAD + BULK + solid + "PSOLID,5,1,,3\n", dialect=MYSTRAN)
    assert f"PSOLID* {5:<16}{1:<16}{'':16}3\n" in given


def test_an_edited_deck_is_read_once_for_all_cards_that_mystran_gets_otherwise(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    model = model_of(tmp_path, frame())  # an RBE3 and bodies in frames of their own
    changed = model.edit([(parameter("E", "youngs_modulus", "material", "2"), 1.1)])
    read: list[NastranDeck] = []

    def counted(deck: NastranDeck) -> Any:
        read.append(deck)
        return read_bulk(deck)

    monkeypatch.setattr("modetune.adapters.nastran.model.read_bulk", counted)
    assert "RBE3" in job_text(model, changed, MODAL, MYSTRAN)
    assert len(read) == 1


def test_cards_that_mystran_has_not_are_refused_all_at_once(tmp_path: Path) -> None:
    text = HEAD + BULK + "CMASS2,14,5.,1,1,2,1\nNSM1,3,PSHELL,1.,4\n"
    with pytest.raises(ModelError) as caught:
        job(tmp_path, text, dialect=MYSTRAN)
    assert "line 24: MYSTRAN has no CMASS2 between two points" in str(caught.value)
    assert "line 25: MYSTRAN has no NSM1" in str(caught.value)


# SOL 200

DESIGNED: Sequence[Parameter] = (
    parameter("E1", "youngs_modulus", "material", "1"),
    parameter("A", "area", "element", "11", "12"),
    parameter("m", "mass", "element", "21"),
    parameter("k", "spring_stiffness", "element", "13"),
    parameter("E2", "youngs_modulus", "material", "2"),
)


def design(
    folder: Path, nodes: tuple[int, ...] = (), dialect: Dialect = MSC, factor: float = 1.0
) -> str:
    model = model_of(folder, HEAD + BULK)
    analysis = SensitivityAnalysis(2, tuple(p.name for p in DESIGNED[:4]), nodes)
    changed = model.edit((item, factor) for item in DESIGNED)
    return job_text(replace(model, parameters=tuple(DESIGNED)), changed, analysis, dialect)


@pytest.mark.parametrize("dialect", [MSC, NX], ids=lambda d: d.name)
def test_a_sensitivity_job_asks_for_eigenvalues_by_relative_variables(
    dialect: Dialect, tmp_path: Path
) -> None:
    text = design(tmp_path, dialect=dialect)
    case = text.split("BEGIN BULK")[0].splitlines()
    assert case[0] == "SOL 200"
    assert case[3:] == [
        "SPC = 1",
        "DSAPRT(FORMATTED,EXPORT,END=SENS)",
        "SUBCASE 1",
        "ANALYSIS = MODES",
        "DESSUB = 1",
        "METHOD = 10",
    ]
    bdf = parsed(text, tmp_path)
    assert {number: card.xinit for number, card in bdf.desvars.items()} == dict.fromkeys(
        (1, 2, 3, 4), 1.0
    )
    assert [card.response_type for card in bdf.dresps.values()] == ["EIGN", "EIGN"]
    assert [card.atta for card in bdf.dresps.values()] == [1, 2]
    assert list(bdf.dconstrs) == [1]
    assert [constraint.dresp_id for constraint in bdf.dconstrs[1]] == [1, 2]


@pytest.mark.parametrize("factor", [1.0, 1.2345])
def test_each_relation_gives_the_number_that_the_jobs_deck_has(
    factor: float, tmp_path: Path
) -> None:
    bdf = parsed(design(tmp_path, factor=factor), tmp_path)
    material = bdf.dvmrels[1]
    assert (material.mat_type, material.mid, material.mp_name) == ("MAT1", 1, "E")
    assert (material.dvids, material.coeffs) == ([1], [bdf.materials[1].e])
    elements = {
        (card.element_type, card.eid, card.cp_name): (card.dvids, card.coeffs)
        for card in bdf.dvcrels.values()
    }
    assert elements == {
        ("CONROD", 11, "A"): ([2], [bdf.elements[11].A]),
        ("CONROD", 12, "A"): ([2], [bdf.elements[12].A]),
        ("CONM2", 21, "M"): ([3], [bdf.masses[21].mass]),
        ("CELAS2", 13, "K"): ([4], [bdf.elements[13].k]),
    }
    assert bdf.elements[13].k == pytest.approx(250.0 * factor, rel=1e-5)  # eight columns


def test_shapes_get_one_response_a_node_component_and_mode(tmp_path: Path) -> None:
    text = design(tmp_path, nodes=(3, 1))
    assert "DSAPRT(NOPRINT,EXPORT,END=SENS)" in text
    bdf = parsed(text, tmp_path)
    shapes = [card for card in bdf.dresps.values() if card.response_type == "DISP"]
    assert len(shapes) == 2 * 6 * 2
    assert {(card.atti[0], card.atta, card.attb) for card in shapes} == {
        (node, component, mode) for node in (1, 3) for component in range(1, 7) for mode in (1, 2)
    }
    constrained = {constraint.dresp_id for constraint in bdf.dconstrs[1]}
    assert constrained == set(bdf.dresps)


def test_the_users_own_design_cards_do_not_get_in_the_way(tmp_path: Path) -> None:
    own = "DESVAR,1,OLD,3.,1.,5.\nDRESP1,1,W,WEIGHT\nDOPTPRM,DESMAX,5\nDSCREEN,STRESS,.5\n"
    model = model_of(tmp_path, HEAD + BULK + own)
    analysis = SensitivityAnalysis(2, ("E1",))
    text = job_text(replace(model, parameters=tuple(DESIGNED)), {}, analysis, MSC)
    assert "OLD" not in text
    assert "DOPTPRM" not in text
    assert parsed(text, tmp_path).desvars[1].label == "P1"


def test_properties_of_all_kinds_are_related_as_pynastran_knows_them(tmp_path: Path) -> None:
    deck = """\
GRID,1
GRID,2,,1.
GRID,3,,1.,1.
GRID,4,,0.,1.
MAT1,1,7.+4,,.3,2.7-9
PSHELL,1,1,2.5,1
CQUAD4,1,1,1,2,3,4
PBAR,2,1,10.,20.,30.,40.
CBAR,2,2,1,2,0.,0.,1.
PBARL,3,1,,BAR
,4.,5.
CBAR,3,3,2,3,0.,0.,1.
PELAS,4,100.
CELAS1,4,4,1,1,2,1
PBUSH,5,K,10.,20.
CBUSH,5,5,1,2,,,,0
PCOMP,6
,1,.5,0.,,1,.6,90.
CQUAD4,6,6,1,2,3,4
"""
    parameters = (
        parameter("t", "thickness", "property", "1"),
        parameter("I", "inertia_1", "property", "2"),
        parameter("d", "dimension", "property", "3", item=2),
        parameter("k", "spring_stiffness", "property", "4"),
        parameter("kb", "spring_stiffness", "property", "5", item=2),
        parameter("t2", "thickness", "property", "6", item=2),
    )
    model = model_of(tmp_path, deck)
    analysis = SensitivityAnalysis(3, tuple(p.name for p in parameters))
    text = job_text(replace(model, parameters=parameters), {}, analysis, MSC)
    path = tmp_path / "parsed.bdf"
    path.write_text(text)
    bdf = BDF(debug=None)
    bdf.read_bdf(str(path), xref=True, punch=False)
    found = {
        (card.prop_type, card.pid, card.pname_fid): card.coeffs for card in bdf.dvprels.values()
    }
    assert found == {
        ("PSHELL", 1, "T"): [2.5],
        ("PBAR", 2, "I1"): [20.0],
        ("PBARL", 3, "DIM2"): [5.0],
        ("PELAS", 4, "K1"): [100.0],
        ("PBUSH", 5, "K2"): [20.0],
        ("PCOMP", 6, "T2"): [0.6],
    }
    assert np.all([card.dvids for card in bdf.dvprels.values()] == np.arange(1, 7)[:, None])


def test_bulk_data_alone_holds_by_its_only_constraint_set(tmp_path: Path) -> None:
    assert "SPC = 1\n" in job(tmp_path, BULK)
    summed = BULK + "SPC1,2,123456,3\nSPCADD,9,1,2\n"
    assert "SPC = 9\n" in job(tmp_path, summed)
    assert "SPC = " not in job(tmp_path, HEAD.replace("SPC = 1\n", "") + BULK)  # as it says


def test_bulk_data_alone_with_several_constraint_sets_is_ambiguous(tmp_path: Path) -> None:
    with pytest.raises(ModelError, match="no case control, and SPC sets 1, 2 are both there"):
        job(tmp_path, BULK + "SPC1,2,123456,3\n")


@pytest.mark.parametrize(
    ("card", "message"),
    [  # what MYSTRAN 18 was seen to get wrong without a word
        ("CELAS1,40,9,2,1\n", "CELAS1: its value is not there .PELAS 9"),
        ("RBAR,40,2,3,1234,23\n", "RBAR is led by all six components"),
        ("GRID,9,,3.,0.,0.\nRBE3,40,,9,123456,1.,123456,1,2\n", "RBE3 wrong whose independent"),
        ("MAT1,3,7.+4,,.3,2.7-9\nMAT1,4,1.+4,,.3,1.-10\nPCOMP,6\n,3,1.,0.,,4,1.,0.\n"
         "CTRIA3,50,6,1,2,3\n",
         "plies of several densities"),
        ("GRID,9,,1.,1.,0.\nPSHELL,5,1,.1\nCQUAD4,50,5,1,2,3,9\n,,1,1.,1.,1.,1.\n", "TFLAG 1"),
    ],
)  # fmt: skip
def test_what_mystran_takes_for_something_else_is_refused_with_its_line(
    card: str, message: str, tmp_path: Path
) -> None:
    with pytest.raises(ModelError, match=rf"truss\.bdf, line \d+: .*{message}"):
        job(tmp_path, HEAD + BULK + card, dialect=MYSTRAN)
    assert job(tmp_path, HEAD + BULK + card, dialect=MSC)


def test_cards_without_effect_on_modes_are_no_obstacle_for_mystran(tmp_path: Path) -> None:
    loads = "FORCE,1,1,,1.,1.,0.,0.\nDESVAR,1,X,1.\nTABDMP1,5\n,0.,.01,ENDT\n"
    assert "EIGRL" in job(tmp_path, HEAD + BULK + loads, dialect=MYSTRAN)


@pytest.mark.parametrize(
    ("stations", "found"),
    [
        # One section over the length: DVPREL1 names both ends, as public decks do.
        ("PBEAM,7,1,10.,20.,30.,,40.", {"I1(A)": 20.0, "I1(B)": 20.0}),
        ("PBEAM,7,1,10.,20.,30.,,40.\n,,,,,,,,\n,NO,1.,5.,8.,9.", {"I1(A)": 20.0, "I1(B)": 8.0}),
        ("PBEAM,7,1,10.,20.,30.,,40.\n,,,,,,,,\n,NO,1.", {"I1(A)": 20.0, "I1(B)": 20.0}),
        # A blank station lies between the ends: 20 + (8 - 20) / 4.
        (
            "PBEAM,7,1,10.,20.,30.,,40.\n,NO,.25\n,NO,1.,5.,8.,9.",
            {"I1(A)": 20.0, "I1(1)": 17.0, "I1(B)": 8.0},
        ),
    ],
)
def test_a_beams_numbers_are_related_at_all_stations(
    stations: str, found: dict[str, float], tmp_path: Path
) -> None:
    deck = f"GRID,1\nGRID,2,,1.\nMAT1,1,7.+4,,.3,2.7-9\n{stations}\nCBEAM,7,7,1,2,0.,0.,1.\n"
    inertia = parameter("I", "inertia_1", "property", "7")
    model = replace(model_of(tmp_path, deck), parameters=(inertia,))
    text = job_text(model, model.edit([(inertia, 1.5)]), SensitivityAnalysis(1, ("I",)), MSC)
    bdf = parsed(text, tmp_path)
    assert {card.pname_fid: card.coeffs for card in bdf.dvprels.values()} == {
        name: [pytest.approx(1.5 * value)] for name, value in found.items()
    }
    assert {card.dvids[0] for card in bdf.dvprels.values()} == {1}


def test_a_dimension_of_one_section_over_the_length_is_related_at_both_ends(
    tmp_path: Path,
) -> None:
    deck = (
        "GRID,1\nGRID,2,,1.\nMAT1,1,7.+4,,.3,2.7-9\nPBEAML,7,1,,BAR\n,4.,5.\n"
        "CBEAM,7,7,1,2,0.,0.,1.\n"
    )
    width = parameter("w", "dimension", "property", "7", item=1)
    model = replace(model_of(tmp_path, deck), parameters=(width,))
    bdf = parsed(job_text(model, {}, SensitivityAnalysis(1, ("w",)), MSC), tmp_path)
    assert {card.pname_fid: card.coeffs for card in bdf.dvprels.values()} == {
        "DIM1(A)": [4.0],
        "DIM1(B)": [4.0],
    }


def case_of(text: str) -> list[str]:
    """Case control of a deck, squeezed, in capitals."""
    body = text.upper().split("CEND", 1)[1].split("BEGIN", 1)[0]
    lines = ("".join(line.split("$", 1)[0].split()) for line in body.splitlines())
    return [line for line in lines if line]


def test_the_request_stands_as_in_the_public_deck_that_msc_ran(
    shared_data: Path, tmp_path: Path
) -> None:
    """MSC Nastran 2018 wrote DSCM2 for this deck; its only objective is a WEIGHT."""
    public = shared_data / "nastran" / "pn_goland_sol200_dscm2" / "goland_final_test.bdf"
    skin = parameter("t", "thickness", "property", "9")
    model = replace(understand(read_deck(public)), parameters=(skin,))
    analysis = SensitivityAnalysis(1, ("t",), (int(model.deck.named("GRID")[0].text(1)),))
    ours = case_of(job_text(model, {}, analysis, MSC))
    theirs = case_of(public.read_text(encoding="latin-1"))
    asked = [line for line in theirs if line.startswith("DSAPRT")]
    assert asked == [line for line in ours if line.startswith("DSAPRT")]
    above, below = theirs[: theirs.index("SUBCASE1")], theirs[theirs.index("SUBCASE1") :]
    at = ours.index("SUBCASE1")
    assert asked[0] in ours[:at]
    assert asked[0] in above
    assert not any(line.startswith("DESOBJ") for line in ours)
    assert [line.partition("=")[0] for line in ours[at:]] == [
        line.partition("=")[0] for line in below
    ]


def test_a_sensitivity_job_of_one_spring_is_this_text(tmp_path: Path) -> None:
    deck = "GRID,1\nGRID,2,,1.\nCELAS2,3,250.,1,1,2,1\nCONM2,4,2,,1.5\nSPC1,1,123456,1\n"
    spring = parameter("k", "spring_stiffness", "element", "3")
    model = replace(model_of(tmp_path, deck), parameters=(spring,))
    assert (
        job_text(model, {}, SensitivityAnalysis(1, ("k",)), MSC)
        == """\
SOL 200
CEND
ECHO = NONE
SPC = 1
DSAPRT(FORMATTED,EXPORT,END=SENS)
SUBCASE 1
ANALYSIS = MODES
DESSUB = 1
METHOD = 1
BEGIN BULK
PARAM,POST,-1
PARAM,GRDPNT,0
PARAM,POSTEXT,YES
EIGRL,1,,,1,,,,MASS
DESVAR,1,P1,1.,.5,2.
DVCREL1*               1          CELAS2               3               K
*
*                      1            250.
DRESP1,1,L1,EIGN,,,1
DCONSTR,1,1
DSCREEN,EIGN,-1.+10,9999999
GRID,1
GRID,2,,1.
CELAS2,3,250.,1,1,2,1
CONM2,4,2,,1.5
SPC1,1,123456,1
ENDDATA
"""
    )
