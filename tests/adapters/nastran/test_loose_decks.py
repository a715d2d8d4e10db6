"""Decks that are looser than MYSTRAN reads: its job has the modes of the strict deck."""

from __future__ import annotations

import logging
from pathlib import Path

import numpy as np
import pytest

import modetune
from modetune.core.errors import ModelError
from modetune.core.modes import Floats
from tests.adapters.solved import needs_mystran

#: A bar, a rod, a shell and masses on two supports; MPC 7 ties the rod's end to the bar.
STRICT = """SOL 103
CEND
SPC = 1
METHOD = 1
BEGIN BULK
EIGRL,1,,,4
GRID,1,,0.,0.,0.
GRID,2,,1.,0.,0.
GRID,3,,2.,0.,0.
GRID,4,,2.,1.,0.
GRID,5,,1.,1.,0.
GRID,6,,3.,0.,0.
CBAR,1,1,1,2,0.,0.,1.
CBAR,2,1,2,3,0.,0.,1.
CQUAD4,3,3,2,3,4,5
CROD,4,4,3,6
PBAR,1,1,2.,1.,1.,1.
PSHELL,3,1,2.,1,1.,1,,3.
PROD,4,1,1.,1.
MAT1,1,1000.,,0.,1.
CONM2,9,6,,3.
SPC,1,1,123456,0.
SPC1,1,23456,6
SPC1,2,3,5
MPC,7,5,1,1.,4,1,-1.
PARAM,WTMASS,2.
ENDDATA
"""


def frequencies(folder: Path, deck: str) -> Floats:
    (folder / "deck.bdf").write_text(deck)
    return modetune.modes(
        folder / "deck.bdf", solver="mystran", units="m-kg-s"
    ).modes.frequencies_hz


def changed(*pairs: tuple[str, str]) -> str:
    deck = STRICT
    for old, new in pairs:
        assert deck.count(old) == 1
        deck = deck.replace(old, new)
    return deck


@needs_mystran
@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("MAT1,1,1000.,,0.,1.", "MAT1,1,1000,,0,1"),
        ("PSHELL,3,1,2.,1,1.,1,,3.", "PSHELL,3,1,2,1,1,1,,3"),
        ("CBAR,2,1,2,3,0.,0.,1.", "CBAR,2,1,2,3,0,0.,1."),
        ("GRID,6,,3.,0.,0.", "GRID,6,,3,0,0"),
        ("CONM2,9,6,,3.", "CONM2,9,6,,3"),
        ("PBAR,1,1,2.,1.,1.,1.", "PBAR,1,1,2,1,1,1"),
        ("PROD,4,1,1.,1.", "PROD,4,1,1,1"),
        ("PARAM,WTMASS,2.", "PARAM,WTMASS,2"),
        ("CQUAD4,3,3,2,3,4,5", "CQUAD4,3,3,2,3,4,5,,0"),
        ("SPC = 1\n", "SPC = 1\nPARAM,K6ROT,100\n"),
    ],
)
def test_whole_numbers_in_real_fields_get_their_point(old: str, new: str, tmp_path: Path) -> None:
    strict = changed(("SPC = 1\n", "SPC = 1\nPARAM,K6ROT,100.\n")) if "K6ROT" in new else STRICT
    np.testing.assert_array_equal(
        frequencies(tmp_path, changed((old, new))), frequencies(tmp_path, strict)
    )


@needs_mystran
def test_the_same_grid_point_twice_is_one(tmp_path: Path) -> None:
    twice = changed(("GRID,6,,3.,0.,0.", "GRID,6,,3.,0.,0.\nGRID,6,,3.,0.,0."))
    np.testing.assert_array_equal(frequencies(tmp_path, twice), frequencies(tmp_path, STRICT))


@needs_mystran
def test_sums_of_sets_leave_out_those_that_the_deck_lacks(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    both = changed(("SPC1,2,3,5", "SPC1,1,3,5"), ("SPC = 1\n", "SPC = 1\nMPC = 7\n"))
    sums = changed(
        ("SPC = 1\n", "SPC = 30\nMPC = 8\n"),
        ("SPC1,2,3,5", "SPC1,2,3,5\nSPCADD,30,1,9,2\nMPCADD,8,12,7"),
    )
    with caplog.at_level(logging.WARNING):
        found = frequencies(tmp_path, sums)
    np.testing.assert_array_equal(found, frequencies(tmp_path, both))
    assert "sets of SPCADD 30: 9, which the deck does not have" in caplog.text
    assert "sets of MPCADD 8: 12, which the deck does not have" in caplog.text
    # A sum of nothing is like no selection.
    nothing = changed(("SPC = 1\n", "SPC = 1\nMPC = 8\n"), ("MPC,7", "MPCADD,8,12\nMPC,7"))
    np.testing.assert_array_equal(frequencies(tmp_path, nothing), frequencies(tmp_path, STRICT))


@needs_mystran
def test_a_compile_that_alters_nothing_is_passed_over(tmp_path: Path) -> None:
    plain = changed(("CEND\n", "COMPILE SEMODES SOUIN=MSCSOU NOLIST NOREF\nCEND\n"))
    np.testing.assert_array_equal(frequencies(tmp_path, plain), frequencies(tmp_path, STRICT))
    altered = changed(("CEND\n", "COMPILE SEMODES\nALTER 'READ'\nMATPRN KGG// $\nCEND\n"))
    with pytest.raises(ModelError, match="line 2: COMPILE changes the solution sequence"):
        frequencies(tmp_path, altered)
