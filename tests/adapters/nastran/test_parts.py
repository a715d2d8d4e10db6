"""Decks of superelements (BEGIN SUPER) against decks of the same structures without any."""

from __future__ import annotations

import re
from collections.abc import Iterable
from pathlib import Path

import pytest

from modetune.adapters.nastran.deck import read_deck
from modetune.adapters.nastran.dialect import DIALECTS
from modetune.adapters.nastran.f06 import read_f06
from modetune.adapters.nastran.job import job_text
from modetune.adapters.nastran.model import understand
from modetune.adapters.nastran.solver import mystran_solver
from modetune.adapters.solver import ModalAnalysis
from modetune.core.errors import ModelError
from modetune.core.parameters import Parameter
from tests.adapters.solved import Binder, needs_mystran, on_both, result_of, solved

HEAD = "SOL 103\nCEND\nMETHOD = 1\nSPC = 1\nBEGIN BULK\nEIGRL,1,,,8\n"
#: Both decks have the same matrices in another order of points; ccx prints seven digits.
ROUNDING = 2e-6
STEEL = "MAT1,1,2.1+11,,.3,7800.\n"
Point = tuple[float, float, float]


def grids(points: Iterable[Point], first: int = 1, tail: str = "") -> str:
    return "".join(
        f"GRID,{number},,{x:.4f},{y:.4f},{z:.4f}{tail}\n"
        for number, (x, y, z) in enumerate(points, first)
    )


def plate(columns: range, thicknesses: list[float], first: int = 1) -> str:
    """Shells of 0.1 by 0.1, four rows of them, with points column by column; one PSHELL each."""
    points = [(0.1 * i, 0.1 * j, 0.0) for i in (*columns, columns.stop) for j in range(5)]
    lines = grids(points, first)
    for pid in sorted({thicknesses.index(t) + 1 for t in thicknesses}):
        lines += f"PSHELL,{pid},1,{thicknesses[pid - 1]},1,,1\n"
    for place, thickness in enumerate(thicknesses):
        for one in range(first + 5 * place, first + 5 * place + 4):
            nodes = f"{one},{one + 5},{one + 6},{one + 1}"
            lines += f"CQUAD4,{one},{thicknesses.index(thickness) + 1},{nodes}\n"
    return lines


#: A plate of two thicknesses, held at one edge, with a mass at a corner. All numbers of the parts
#: clash: points, elements, properties.
PLATE = (
    HEAD + STEEL + plate(range(9), [0.004] * 6 + [0.003] * 3)
    + "CONM2,999,50,,2.\nSPC1,1,123456,1,THRU,5\n",
    HEAD + "GRID,1,,.9,.4,0.\nCONM2,1,1,,2.\n"
    "BEGIN SUPER = 1\n" + STEEL + plate(range(6), [0.004] * 6) + "SPC1,1,123456,1,THRU,5\n"
    "BEGIN BULK SUPER=2\n" + STEEL + plate(range(6, 9), [0.003] * 3),
)  # fmt: skip

FREE = HEAD.replace("SPC = 1\n", "")
ALLOY = "MAT1,3,7.+10,,.33,2700.\nPBAR,3,3,4.-4,2.-8,3.-8,4.-8\n"
ROUND = "CORD2C,7,,0.,0.,0.,0.,0.,1.\n,1.,0.,0.\n"
ZIGZAG: list[Point] = [(0.5 * i + 0.5, 0.0, 0.2 * (i % 2)) for i in range(7)]
#: A body that hangs on one end, and another that the last three points carry.
HANGING = "GRID,21,,.4,0.,.1\nRBE2,32,1,123456,21\nCONM2,33,21,,2.\n,.1,,.1,,,.1\n"
CARRIED = "GRID,20,,3.1,.2,.3,,456\nRBE3,30,,20,123,1.,123,{},{}\n,{}\nCONM2,31,20,,3.\n"


def springs(first: int, stiffness: str, point: int) -> str:
    return "".join(f"CELAS2,{first + c},{stiffness},{point},{c}\n" for c in range(1, 7))


def bars(count: int, pid: str = "3") -> str:
    return "".join(f"CBAR,{n},{pid},{n},{n + 1}\n" for n in range(1, count + 1))


#: A zigzag of bars on springs, with output frames (CD) and defaults (GRDSET, BAROR). The parts are
#: joined by SECONCT under other numbers.
FRAME = (
    FREE + ALLOY + ROUND + grids(ZIGZAG, 1, ",7") + "BAROR,,,,,0.,1.,0.\n" + bars(6)
    + HANGING + CARRIED.format(5, 6, 7) + springs(40, "4.+5", 1) + springs(50, "3.+5", 7),
    FREE + ROUND + "GRID,500,,2.,0.,.2,7\n"
    "SEBULK,4,PRIMARY,,MANUAL\nSEBULK,9,,,MANUAL\n"
    "SECONCT,4,0,,,,,,\n,4,500\nSECONCT,9,4,1.-4,,,,,\n,1,4\n"
    "BEGIN SUPER=4\n" + ALLOY + ROUND + "GRDSET,,,,,,7\n" + grids(ZIGZAG[:4])
    + "BAROR,,3,,,0.,1.,0.\n" + bars(3, "")
    + HANGING.replace(".4,0.,.1", ".4,0.,.1,0") + springs(40, "4.+5", 1)
    + "BEGIN SUPER=9\n" + ALLOY.replace("2700.", "2700.0") + ROUND + grids(ZIGZAG[3:], 1, ",7")
    + "BAROR,,,,,0.,1.,0.\n" + bars(3) + CARRIED.format(2, 3, 4) + springs(50, "3.+5", 4),
)  # fmt: skip

CORNERS: list[Point] = [(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0)]


def brick(floor: float, height: float) -> list[Point]:
    return [(x, y, floor + dz) for dz in (0.0, height) for x, y, _ in CORNERS]


#: A tower of three bricks, each a part with points 1 to 8, on a spring with a scalar point.
TOWER = (
    FREE + STEEL + "PSOLID,1,1\n"
    + grids([(x, y, z) for z in (0.0, 1.0, 2.0, 3.5) for x, y, _ in CORNERS])
    + "".join(f"CHEXA,{n + 1},1,{','.join(str(4 * n + i) for i in range(1, 7))},\n"
              f",{4 * n + 7},{4 * n + 8}\n" for n in range(3))
    + "SPOINT,50\nCMASS2,60,900.,50,0\nCELAS2,61,2.+8,50,0,16,1\n",
    FREE
    + "".join(
        f"BEGIN SUPER={n}\n{STEEL}PSOLID,1,1\n{grids(brick(floor, height))}"
        "CHEXA,1,1,1,2,3,4,5,6,\n,7,8\n" + more
        for n, floor, height, more in (
            (1, 0.0, 1.0, ""),
            (2, 1.0, 1.0, ""),
            (3, 2.0, 1.5, "SPOINT,50\nCMASS2,60,900.,50,0\nCELAS2,61,2.+8,50,0,8,1\n"),
        )
    ),
)  # fmt: skip


@on_both
@pytest.mark.parametrize("decks", [PLATE, FRAME, TOWER], ids=["plate", "frame", "tower"])
def test_parts_have_the_modes_of_the_whole(
    decks: tuple[str, str], binder: Binder, tmp_path: Path
) -> None:
    found = []
    for name, text in zip(("whole", "parts"), decks, strict=True):
        (tmp_path / name).mkdir()
        found.append(solved(text, tmp_path / name, binder, 12).eigenvalues)
    least = 1e-6 * abs(found[0]).max()
    assert found[1] == pytest.approx(found[0], rel=ROUNDING, abs=least)


@needs_mystran
@pytest.mark.parametrize(
    "name",
    ["part_super_guyan/guyanSuper", "part_super_cb/cbSuper1Mode", "part_super_cb/cbSuper3Modes"],
)
def test_a_public_cantilever_in_parts_has_mscs_frequencies_of_the_whole(
    name: str, shared_data: Path, tmp_path: Path
) -> None:
    folder = shared_data / "nastran/cofe/superelements/gitControlTestDir/cantilever_bar"
    expected = read_f06(folder / "no_super/noreduction.f06").modes.eigenvalues
    solver = mystran_solver(folder / f"{name}.dat", ())
    found = result_of(solver, ModalAnalysis(10, (6,)), tmp_path / "job")
    # MSC prints seven digits.
    assert found.eigenvalues == pytest.approx(expected, rel=5e-7)


def test_a_parameter_edits_the_line_of_its_part(tmp_path: Path) -> None:
    path = tmp_path / "model.bdf"
    path.write_text(PLATE[1].replace("PSHELL,1,1,0.003,1,,1", "PSHELL,1,1,.003,1,,1 $ thin"))
    thin = Parameter("t", "thickness", "property", ("2001",), 0.5, 2.0, 0.1)
    model = understand(read_deck(path), (thin,))
    assert [number.value for number in model.numbers(thin)] == [0.003]
    updated = model.write_updated({"t": 1.5}, tmp_path / "updated").read_text()
    old, new = path.read_text().splitlines(), updated.splitlines()
    changed = [(a, b) for a, b in zip(old, new, strict=True) if a != b]
    assert changed == [("PSHELL,1,1,.003,1,,1 $ thin", "PSHELL,1,1,.0045,1,,1 $ thin")]
    # A design model would name numbers that the deck does not have.
    assert [path.name for path in (tmp_path / "updated").iterdir()] == ["model.bdf"]


def test_materials_of_parts_are_edited_one_by_one_or_together(tmp_path: Path) -> None:
    path = tmp_path / "model.bdf"
    path.write_text(TOWER[1])
    modulus = Parameter("E", "youngs_modulus", "material", ("1", "3001"), 0.5, 2.0, 0.1)
    model = understand(read_deck(path), (modulus,))
    updated = model.write_updated({"E": 2.0}, tmp_path / "updated").read_text()
    assert updated.count("MAT1,1,4.2+11,,.3,7800.") == 2
    changed = model.edited({"E": 2.0}).changed
    text = job_text(model, changed, ModalAnalysis(2, (1,)), DIALECTS["msc"])
    found = re.findall(r"^MAT1\* +(\d+) +(\S+)", text, re.MULTILINE)
    assert found == [("1", "4.2+11"), ("2001", "2.1+11"), ("3001", "4.2+11")]


def job_of(text: str, folder: Path) -> str:
    (folder / "model.bdf").write_text(text)
    model = understand(read_deck(folder / "model.bdf"), ())
    return job_text(model, {}, ModalAnalysis(2, (1,)), DIALECTS["msc"])


def test_the_job_of_nastran_is_of_one_model(tmp_path: Path) -> None:
    text = job_of(PLATE[1], tmp_path)
    assert "SUPER" not in text
    ids = re.findall(r"^GRID\* +(\d+)", text, re.MULTILINE)
    assert len(ids) == len(set(ids)) == 50


@pytest.mark.parametrize("wanted", ["SUPER = 99\n SET 99 = 0", "SUPER = ALL", "SUPER = 0", ""])
def test_the_subcase_of_the_residual_structure_counts(wanted: str, tmp_path: Path) -> None:
    head = (
        "SOL 103\nCEND\nSPC = 1\nSUBCASE 1\n SUPER = 1,1\n METHOD = 5\n"
        f"SUBCASE 2\n METHOD = 1\n {wanted}\nBEGIN BULK\n"
    )
    text = PLATE[1].replace(HEAD, head + "EIGRL,1,,,8\n")
    assert "METHOD = 1\n" in job_of(text, tmp_path)
    other = text.replace("SUPER = 1,1\n", "SUPER = 1,1\n SPC = 2\n")
    with pytest.raises(ModelError, match=r"line 4: .* other SPC or MPC sets"):
        job_of(other, tmp_path)


def test_points_of_superelements_without_parts_are_one_model(tmp_path: Path) -> None:
    whole = HEAD + "GRID,1,,0.,0.,0.\nGRID,2,,1.,0.,0.,,,{}\nCONM2,1,2,,1.\nCELAS2,3,5.,1,1,2,1\n"
    more = "SESET,2,1\nSEQSET1,2,0,9\n"
    plain, divided = (
        job_of(text, tmp_path) for text in (whole.format(""), whole.format("2") + more)
    )
    without = [re.sub(r"[ *,]+", " ", line) for line in (plain, divided)]
    assert "SESET" not in divided
    assert without[0].split() == without[1].split()


TWO = "GRID,1,,0.,0.,0.\nGRID,2,,1.,0.,0.\nCONM2,1,2,,1.\nCELAS2,3,5.,1,1,2,1\n"


@pytest.mark.parametrize(
    ("residual", "part", "said"),
    [
        ("SELOC,1,1,2,3,4,5,6\n", TWO, "line 7: superelements: SELOC moves a part"),
        ("SEMPLN,1,PLANE,1,2,3\n", TWO, "SEMPLN mirrors or moves"),
        ("CSUPER,1,0,1\n", TWO, "CSUPER makes an image"),
        ("RELEASE,1,1,1\n", TWO, "RELEASE frees"),
        ("SEBULK,1,MIRROR,2\n", TWO, "SEBULK of type MIRROR"),
        ("SEBULK,1,EXTERNAL\n", TWO, "SEBULK of type EXTERNAL .*K2GG"),
        ("", TWO + "EXTRN,1,123456\n", "EXTRN belongs to .*K2GG"),
        ("", TWO + "CGAP,5,5,1,1\n", "CGAP in part 1 cannot be joined"),
        ("", TWO + "PARAM,WTMASS,.1\n", "WTMASS of part 1 is not that"),
        ("", TWO.replace("GRID,2,,1.,0.,0.", "GRID,2,,0.,0.,0."), "at the place of several points"),
        ("", TWO.replace("GRID,1,,0.,0.,0.", "GRID,1,,0.,0.,0.,,3"), "other supports"),
        ("", "CORD2R,1,,0.,0.,0.,0.,1.,0.\n,1.,0.,0.\n"
         + TWO.replace("GRID,1,,0.,0.,0.", "GRID,1,,0.,0.,0.,1"), "other axes"),
        ("SECONCT,1,0,,,,,,\n,2,1\n", TWO, "not at the place of the point"),
        ("SECONCT,1,0,,,,,,\n,2,THRU,4,1,THRU,3\n", TWO, "SECONCT is read as pairs"),
        ("", TWO.replace("0.,0.,0.", "0.,0.,4."), "part 1 is joined to no other part"),
        ("", TWO.replace("1,2,,1.", "1,9,,1."), "CONM2 1 names point 9, which part 1 does not"),
        ("", TWO + "BEGIN SUPER = 1\n" + TWO, "superelements: BEGIN SUPER = 1 is none of"),
    ],
)  # fmt: skip
def test_what_is_not_exactly_one_model_is_refused_by_name(
    residual: str, part: str, said: str, tmp_path: Path
) -> None:
    own = "GRID,1,,0.,0.,0.\nCELAS2,1,7.,1,1,1,2\n"
    with pytest.raises(ModelError, match=said):
        job_of(f"{HEAD}{residual}{own}BEGIN SUPER = 1\n{part}", tmp_path)


@pytest.mark.parametrize(
    ("card", "expected"),
    [
        ("CQUAD8,1,1,1,2,1,2,1,2\n,1,2,.1,.1,.1,.1,1",
         "CQUAD8 2001 2001 2001 2002 2001 2002 2001 2002 2001 2002 .1 .1 .1 .1 2001"),
        ("PCOMP,1,-.1,,,,,,SYM\n,1,.1,0.,YES,1,.2,45.,YES",
         "PCOMP 2001 -.1 SYM 2001 .1 0. YES 2001 .2 45. YES"),
        ("PSHELL,1,1,.1,1,,1\n,-.1,.1,1", "PSHELL 2001 2001 .1 2001 2001 -.1 .1 2001"),
        ("CBUSH,1,1,1,2,,,,1", "CBUSH 2001 2001 2001 2002 2001"),
        ("CELAS1,1,1,1,1,2,2", "CELAS1 2001 2001 2001 1 2002 2"),
        ("CDAMP2,1,5.,1,1,2,2", "CDAMP2 2001 5. 2001 1 2002 2"),
        ("CBEAM,1,1,1,2,1", "CBEAM 2001 2001 2001 2002 2001"),
        ("CONROD,1,1,2,1,5.", "CONROD 2001 2001 2002 2001 5."),
        ("MPC,1,1,1,1.,2,2,-1.\n,,1,3,1.", "MPC 1 2001 1 1. 2002 2 -1. 2001 3 1."),
        ("RBE3,1,,1,123,1.,123,2,1\n,2,.5,12,2,UM,1,2", "RBE3 2001 2001 123 1. 123 2002 2001 "
         "2002 .5 12 2002 UM 2001 2"),
    ],
)  # fmt: skip
def test_all_numbers_of_clashing_cards_are_moved(card: str, expected: str, tmp_path: Path) -> None:
    # Points 1 and 2, system, property, material and element 1 are others in the main section.
    others = (
        "GRID,1,,0.,0.,0.\nGRID,2,,1.,0.,0.\nCORD2R,1,,0.,0.,0.,0.,0.,1.\n,1.,0.,0.\n"
        "PSHELL,1,1,.5\nMAT1,1,1.+5,,.3\nCELAS2,1,7.,1,1,2,1\nGRID,3,,9.,9.,9.\n"
    )
    own = "GRID,1,,0.,0.,5.\nGRID,2,,1.,0.,5.\nGRID,4,,9.,9.,9.\n"
    own += "CORD2R,1,,0.,0.,1.,0.,0.,5.\n,1.,0.,0.\n"
    own += "" if card.startswith("P") else "PROD,1,1,2.\n"
    own += "MAT1,1,2.+5,,.3\n"
    path = tmp_path / "model.bdf"
    path.write_text(f"{HEAD}{others}BEGIN SUPER = 2\n{own}{card}\n")
    read = read_deck(path)
    found = [" ".join(filter(None, map(item.text, range(len(item.fields))))) for item in read.cards]
    assert expected in found
