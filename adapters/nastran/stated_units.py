"""The units that a Nastran deck states: PARAM,UNITSYS, or the header of a pre-processor.

Simcenter 3D writes `PARAM UNITSYS MN-MM`, force and length in either order, MN being a
millinewton, and a comment such as `UNITS: mm (milli-newton)`. Both name length and force; the
mass follows, because the units of a deck are consistent.
"""

from __future__ import annotations

import re

from modetune.adapters.nastran.deck import NastranDeck
from modetune.adapters.solver import StatedUnits
from modetune.adapters.unit_names import units_of

#: A header: length, then force in brackets.
HEADER = re.compile(r"\$.*\bunits?\s*:\s*([a-z]+)\s*\(\s*([a-z -]+?)\s*\)", re.IGNORECASE)


def stated_units(deck: NastranDeck) -> StatedUnits | None:
    """Return the units of PARAM,UNITSYS or else of a header, None where neither is understood."""
    for card in deck.named("PARAM"):
        if card.text(1).upper() != "UNITSYS":
            continue
        words = card.text(2).lower().split("-")
        text = f"{deck.where(card)}: PARAM,UNITSYS is {card.text(2)}"
        if len(words) > 1 and (units := units_of(words[0], words[1], text)):
            return units
    for line in deck.lines:
        found = HEADER.match(line.text.strip()) if "(" in line.text else None
        if found:
            length, force = (found[i].lower() for i in (1, 2))
            text = f"{line.where}: the header has units {length} ({force})"
            if units := units_of(length, force, text):
                return units
    return None
