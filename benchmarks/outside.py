"""Recognition of decks outside linear structural dynamics, by cards and statements."""

from __future__ import annotations

import re
from pathlib import Path

from modetune.adapters.nastran.case_control import read_case_control
from modetune.adapters.nastran.deck import NastranDeck, read_deck
from modetune.core.errors import ModelError

#: Fields of mechanics and ways of modelling, by cards that belong to nothing else.
CARDS = {
    "heat": "CHBDYE CHBDYG CHBDYP PHBDY CONV CONVM PCONV RADM RADBC RADSET RADCAV RADLST RADMTX "
    "QVOL VIEW VIEW3D",
    "fluids": "MAT10 CHACAB CHACBR PACABS PACBAR PACINF CACINF3 CACINF4 CAABSF PAABSF CFLUID2 "
    "CFLUID3 CFLUID4 CSLOT3 CSLOT4 AXIF AXSLOT RINGFL GRIDF GRIDS",
    "axisymmetry, plane strain": "CTRIAX CTRIAX6 CQUADX CQUADX4 CQUADX8 CTRAX3 CTRAX6 CCONEAX "
    "AXIC RINGAX CPLSTN3 CPLSTN4 CPLSTN6 CPLSTN8 CPLSTS3 CPLSTS4 CPLSTS6 CPLSTS8",
    "contact, gaps": "BCTABLE BCTABL1 BCBODY BCBODY1 BCTSET BCONECT BCONP BCSURF BLSEG BGSET CGAP",
    "large strain": "MATHP MATHE MATG PLPLANE PLSOLID",
    "superelements": "CSUPER SEBULK SESET SELOC SECONCT SETREE",
    "damage": "MATDMG",
    "mesh generators": "EGRID GRIDG CGEN SPCG",
}
#: The same by statements of the executive and case control.
STATEMENTS = {
    "heat": r"SOL\s+(153|159)\b|ANALYSIS\s*=\s*HEAT",
    "contact, gaps": r"(BGSET|BCSET|BCONTACT)\s*=",
    "p-elements": r"ADAPT\s*=",
    "nonlinear buckling": r"PARAM[\s,]+BUCKLE[\s,]+2",
    "DMAP": r"(COMPILE|ALTER|MALTER)\b",
}
#: A name in the place of a number, which another program fills in.
BLANK_TO_FILL = re.compile(r"%[A-Z]\w*", re.IGNORECASE)


def outside(path: Path) -> str:
    """The first reason why a deck is no model of linear structural dynamics; empty for none."""
    try:
        deck = read_deck(path)
    except ModelError as error:
        return "superelements" if "superelements" in str(error) else "not whole"
    try:
        read_case_control(deck)
    except ModelError as error:
        if "superelements" in str(error):
            return "superelements"
    names = {card.name for card in deck.cards}
    for kind, cards in CARDS.items():
        if names.intersection(cards.split()):
            return kind
    for kind, pattern in STATEMENTS.items():
        if any(re.match(rf"\s*({pattern})", text, re.IGNORECASE) for text in _statements(deck)):
            return kind
    return "not whole" if _unfinished(deck) else ""


def _statements(deck: NastranDeck) -> list[str]:
    return [deck.lines[place].text for place in (*deck.executive, *deck.case_control)]


def _unfinished(deck: NastranDeck) -> bool:
    """Whether numbers are to be filled in."""
    return any(field and BLANK_TO_FILL.match(field.text) for c in deck.cards for field in c.fields)
