"""The units that a CalculiX deck states in its heading or in a comment before its first node.

PrePoMax writes `Unit system: MM_TON_S_C` below *HEADING; people write `** Units: mm, t, s`. The
first two units count, a length and a mass or a force.
"""

from __future__ import annotations

import re

from modetune.adapters.calculix.deck import KeywordDeck
from modetune.adapters.solver import StatedUnits
from modetune.adapters.unit_names import units_of

HEADER = re.compile(
    r"(?!\*[^*]).*?\bunits?(?:\s+system)?\s*[:=]\s*([a-z]+)[\s,;/_-]+([a-z]+)\b", re.IGNORECASE
)
#: An underscore is a letter to regular expressions.
APART = str.maketrans("_", " ")


def stated_units(deck: KeywordDeck) -> StatedUnits | None:
    """Return the units of the first header that is understood, None where there is none."""
    nodes = deck.named("*NODE")
    for line in deck.lines[: nodes[0].lines.start if nodes else 0]:
        found = HEADER.match(line.text.strip().translate(APART))
        if found:
            one, other = found[1].lower(), found[2].lower()
            text = f"{line.where}: the header has units {one} and {other}"
            if units := units_of(one, other, text):
                return units
    return None
