"""What is outside linear structural dynamics is told from a deck's cards and statements."""

from __future__ import annotations

from pathlib import Path

import pytest
from benchmarks.corpus import Row, counts
from benchmarks.outside import outside

GRID = "GRID,1,,0.,0.,0.\n"


@pytest.mark.parametrize(
    ("head", "bulk", "kind"),
    [
        ("", "CONM2,1,1,,1.\nMAT4,1,2.\n", ""),
        ("SUPER = ALL\nSUBCASE 1\n", "", ""),
        ("", "CHBDYG,5,,AREA4\n,1,2,3,4\n", "heat"),
        ("ANALYSIS = HEAT\n", "", "heat"),
        ("", "MAT10,5,1.,2.\n", "fluids"),
        ("", "CGAP,5,5,1,1\n", "contact, gaps"),
        ("SUPER = 2\n", "", "superelements"),
        ("", "BEGIN SUPER = 1\n", ""),
        ("", "BEGIN SUPER = 1\nSELOC,1,1\n", "superelements"),
        ("", "PROD,1,1,%AREA\n", "not whole"),
        ("", "INCLUDE 'gone.inc'\n", "not whole"),
    ],
)
def test_a_deck_is_told_by_its_cards(head: str, bulk: str, kind: str, tmp_path: Path) -> None:
    path = tmp_path / "model.bdf"
    path.write_text(f"SOL 103\nCEND\n{head}BEGIN BULK\n{GRID}{bulk}ENDDATA\n")
    assert outside(path) == kind


def test_decks_are_counted_by_what_is_outside() -> None:
    rows = [
        Row("a", "yes", "yes", "MYSTRAN has no RSPLINE", "10", "", ""),
        Row("b", "yes", "yes", "b: nothing in the model has mass, so", "the same", "", ""),
        Row("c", "yes", "yes", "MYSTRAN has no CBEND", "CBEND not translated", "", ""),
        Row("d", "yes", "yes", "MYSTRAN has no CHBDYG", "not translated", "", "heat"),
    ]
    said = counts(rows)
    assert "without mass 1" in said
    assert "nothing outside linear structural dynamics: 2, of which 1 run" in said
    assert "heat: 1, of which 0 run" in said
