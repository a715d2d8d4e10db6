"""Which components of nodes cannot move, by decks of both solvers."""

from __future__ import annotations

from pathlib import Path

import pytest

from modetune.adapters.calculix.constraints import fixed_components
from modetune.adapters.calculix.deck import read_deck as read_calculix
from modetune.adapters.calculix.structure import understand as understand_calculix
from modetune.adapters.nastran.deck import read_deck
from modetune.adapters.nastran.model import understand
from tests.adapters.ccx_decks import bar
from tests.adapters.nastran.test_oddities import BULK, CASE

ALL = frozenset(range(1, 7))


def of_nastran(folder: Path, text: str) -> dict[int, frozenset[int]]:
    (folder / "deck.bdf").write_text(text)
    return dict(understand(read_deck(folder / "deck.bdf")).fixed())


@pytest.mark.parametrize(
    ("case", "cards", "expected"),
    [
        ("", "", {99: ALL}),
        ("SPC = 3", "SPC,3,4,12,,5,3\n", {4: frozenset((1, 2)), 5: frozenset({3})}),
        ("SPC = 8", "SPCADD,8,1,3\nSPC1,3,23,5,THRU,90\n",
         {99: ALL, **dict.fromkeys((5, 6), frozenset((2, 3)))}),
        ("SPC = 7", "", {}),
        ("", "GRID,50,,1.,1.,1.,,46\nCONM2,9,6,,2.\n", {99: ALL, 50: ALL}),
        ("", "GRID,50,,1.,1.,1.,,46\nRBE2,60,6,12,50\n", {99: ALL, 50: frozenset((4, 6))}),
        ("SPC = 1\nMPC = 2", "GRID,50,,1.,1.,1.\nMPC,2,50,1,1.,6,1,-1.\n", {99: ALL}),
        # A card that is not understood may have stiffness.
        ("", "GRID,50,,1.,1.,1.,,46\nCWELD,9,1,50,7\n", {99: ALL, 50: frozenset((4, 6))}),
    ],
)  # fmt: skip
def test_a_nastran_deck_says_what_cannot_move(
    case: str, cards: str, expected: dict[int, frozenset[int]], tmp_path: Path
) -> None:
    text = CASE.replace("SPC = 1", case or "SPC = 1") + BULK + cards
    assert of_nastran(tmp_path, text) == expected


@pytest.mark.parametrize(
    ("held", "expected"),
    [
        ("*BOUNDARY\n1,1,3\n2,3\n", {1: frozenset((1, 2, 3)), 2: frozenset({3})}),
        ("*BOUNDARY\n1,1\n*BOUNDARY\n1,2,3\n", {1: frozenset((1, 2, 3))}),
        # In turned axes only a node that is clamped is fixed along a global one.
        ("*NSET,NSET=T\n1,2\n*TRANSFORM,NSET=T\n1.,1.,0.,-1.,1.,0.\n*BOUNDARY\n1,1,3\n2,1\n",
         {1: frozenset((1, 2, 3))}),
        ("*STEP\n*BOUNDARY\n1,1\n*FREQUENCY\n2\n*END STEP\n*STEP\n*BOUNDARY,OP=NEW\n2,1\n"
         "*FREQUENCY\n2\n*END STEP\n", {2: frozenset({1})}),
    ],
)  # fmt: skip
def test_a_calculix_deck_says_what_cannot_move(
    held: str, expected: dict[int, frozenset[int]], tmp_path: Path
) -> None:
    path = tmp_path / "bar.inp"
    path.write_text(bar("C3D8I", held))
    assert fixed_components(understand_calculix(read_calculix(path))) == expected
