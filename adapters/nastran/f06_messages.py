"""What Nastran's print, log and F04 files say of themselves: messages, licence, version, end.

A fatal message stands alone on its line, `*** USER FATAL MESSAGE 2025 (IFPDRV)` or
`^^^ USER FATAL ...` from a DMAP sequence, and goes on until a blank line. MYSTRAN writes
`*ERROR  1308: ...`. Echoed decks may quote such a line, but have a line count before it.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from itertools import pairwise

FATAL = re.compile(
    r"^[01+ ]?\s{0,12}(?:(?:\*{3}|\^{3})\s*(?:\w+ )?(?:USER|SYSTEM|NASTRAN|DMAP)?\s*FATAL\b"
    r"|\*ERROR\s+\d+\s*:|\^{3}\s.*\bFATAL\b)"
)
NEXT_MESSAGE = re.compile(r"^[01+ ]?\s{0,12}(?:\*{3} |\^{3} |\*ERROR|\*WARNING|\*INFORMATION)")
#: A message is a few lines; what goes on longer is a table that follows it.
LONGEST = 20

CARD = re.compile(
    r"\b(?:BULK DATA ENTRY|BULK DATA CARD|BULK DATA|ENTRY|ENTRIES|CARD|ELEMENT TYPE)\s*[=:]?\s+"
    r"(?:NAME\s+)?['\"]?([A-Z][A-Z0-9]{2,7})\b"
)
NAMES = (
    r"C(?:QUAD|TRIA|HEXA|PENTA|TETRA|PYRAM|BAR|BEAM|ROD|ELAS|BUSH|ONM|ONROD|TUBE|SHEAR|GAP|DAMP)\w*"
    r"|P(?:SHELL|SOLID|BAR|BEAM|ROD|COMP|ELAS|BUSH|TUBE|SHEAR|MASS)\w*|MAT\d{1,2}|GRID|RB(?:E\d|AR)"
    r"|SPC1?|MPC|EIGRL?|CORD\d[RCS]|DESVAR|DVPREL\d|DVMREL\d|DRESP\d|[AO]SET1?|SUPORT"
)
KNOWN_CARD = re.compile(rf"\b({NAMES})\b")
NUMBER = re.compile(
    r"\b(?:ID|EID|PID|MID|GID|SID|POINT|GRID|ELEMENT|PROPERTY|MATERIAL"
    rf"|{NAMES})(?:\s*ID)?\s*[=:#\s]\s*(\d+)\b"
)
#: Words that follow "entry" or "card" in sentences and are not names of cards.
NO_CARD = frozenset(
    "FOR WITH WAS WERE NOT AND THE HAS HAVE FIELD FIELDS IMAGE IS ARE THAT WHICH NAME IN ON OF "
    "MUST NUMBER COUNT DECK ENTRY CARD SECTION POSSIBLY REQUIRED MISSING".split()
)

VERSION = re.compile(
    r"MYSTRAN\s+Version\s+[\w.]+|Simcenter Nastran\s+[\w.]+|NX Nastran\s+[\w.]+"
    r"|MSC Nastran\s+V?\d[\w.]+|Version\s+[\d][\w.\-]+|VERSION\s+-?\s*[\d][\w.]+|[A-Z]+ VERSION\b"
)
END = re.compile(r"\* \* \* END OF JOB \* \* \*|>> MYSTRAN END\b")
BANNER_LINES = 400


@dataclass(frozen=True, slots=True)
class FatalMessage:
    """A fatal message: its text, and what it says of its place in the deck.

    card_image: the card it quotes; card: the name of the card it speaks of; number: the first
    number of a card, element, point or property it names. Empty or 0 where there is none.
    """

    text: str
    card_image: str
    card: str
    number: int


def fatal_message(lines: list[str]) -> FatalMessage:
    """What the lines of one message say."""
    texts = [line[1:].strip() if line[:1] in "01+" else line.strip() for line in lines]
    # The message's own number and subroutine are not a card.
    body = [re.sub(r"MESSAGE\s+\d+\s*(?:\(\w+\))?|^\*ERROR\s+\d+\s*:", "", texts[0]), *texts[1:]]
    sentence = " ".join(body)
    names = [name for name in CARD.findall(sentence) if name not in NO_CARD]
    names = names or KNOWN_CARD.findall(sentence)
    card = names[0] if names else ""
    number = (card and re.search(rf"\b{card}\s+(\d+)\b", sentence)) or NUMBER.search(sentence)
    return FatalMessage(
        text="\n".join(texts),
        card_image=_card_image(texts[1:], card),
        card=card,
        number=int(number.group(1)) if number else 0,
    )


def _card_image(lines: list[str], card: str) -> str:
    for line in lines:
        if card and re.match(rf"{card}\*?(?:,|\s+\d)", line):
            return line
    for before, line in pairwise(lines):
        if re.search(r"(?:card|entry) image|as follows", before, re.IGNORECASE):
            return line
    return ""
