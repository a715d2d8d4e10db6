"""The units that a Nastran deck states: PARAM,UNITSYS, or the header of a pre-processor.

Simcenter 3D writes `PARAM UNITSYS MN-MM`, force and length in either order, MN being a
millinewton, and a comment such as `UNITS: mm (milli-newton)`. Both name length and force; the
mass follows, because the units of a deck are consistent.
"""

from __future__ import annotations

import re

from modetune.adapters.nastran.deck import NastranDeck
from modetune.adapters.solver import StatedUnits

#: Metres in a unit of length, by its names in lower case.
LENGTHS = {
    **dict.fromkeys(("m", "meter", "metre", "meters", "metres"), 1.0),
    **dict.fromkeys(("mm", "millimeter", "millimetre"), 1e-3),
    **dict.fromkeys(("cm", "centimeter", "centimetre"), 1e-2),
    **dict.fromkeys(("in", "inch", "inches"), 0.0254),
    **dict.fromkeys(("ft", "foot", "feet"), 0.3048),
}
POUND = 4.4482216
#: Newtons in a unit of force, by its names in lower case.
FORCES = {
    **dict.fromkeys(("n", "newton", "newtons"), 1.0),
    **dict.fromkeys(("mn", "milli-newton", "millinewton"), 1e-3),
    **dict.fromkeys(("lb", "lbf", "pound", "pound f", "pound-force"), POUND),
    **dict.fromkeys(("dyn", "dyne"), 1e-5),
}
#: A header: length, then force in brackets.
HEADER = re.compile(r"\$.*\bunits?\s*:\s*([a-z]+)\s*\(\s*([a-z -]+?)\s*\)", re.IGNORECASE)


def stated_units(deck: NastranDeck) -> StatedUnits | None:
    """Return the units of PARAM,UNITSYS or else of a header, None where neither is understood."""
    for card in deck.named("PARAM"):
        if card.text(1).upper() != "UNITSYS":
            continue
        words = card.text(2).lower().split("-")
        for force, length in (words[:2], words[1::-1]) if len(words) > 1 else ():
            if force in FORCES and length in LENGTHS:
                text = f"{deck.where(card)}: PARAM,UNITSYS is {card.text(2)}"
                return StatedUnits(LENGTHS[length], FORCES[force], text)
    for line in deck.lines:
        found = HEADER.match(line.text.strip()) if "(" in line.text else None
        if found:
            length, force = (found[i].lower() for i in (1, 2))
            if length in LENGTHS and force in FORCES:
                text = f"{line.where}: the header has units {length} ({force})"
                return StatedUnits(LENGTHS[length], FORCES[force], text)
    return None
