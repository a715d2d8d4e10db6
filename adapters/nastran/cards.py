"""Bulk data as cards: fields in small, large and free format, and lines that continue others.

A card has a name and numbered fields. A line holds eight of them in columns of 8 (small field),
four in columns of 16 (large field, a `*` in the first field), or as many between commas (free
field). A line whose first field is blank or starts with `+` or `*` continues another: the one
before it, or the one whose last field carries the same tag. Columns 73-80 hold nothing else.
Where tags disagree or are missing on one side, the line before is continued, since many programs
write sequence numbers there.
"""

from __future__ import annotations

import re
from bisect import bisect_left
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

from modetune.adapters.deck_files import Line
from modetune.adapters.nastran.number import format_number
from modetune.core.errors import ModelError

NAME = re.compile(r"[A-Z][A-Z0-9_]{0,7}")
#: Characters free field keeps of a number: eight, or sixteen in a line with a `*`.
SMALL, LARGE = 8, 16
#: Columns of the fields of a fixed-format line end here; the tag follows.
TAG = 72


@dataclass(frozen=True, slots=True)
class CardField:
    """One field of a card as it stands in the deck.

    line: position in the deck's lines. start, stop: the columns of the line's text, blanks of the
    field included. width: 8, 16, or 0 in free field. text: without blanks round it.
    """

    line: int
    start: int
    stop: int
    width: int
    text: str


@dataclass(frozen=True, slots=True)
class NastranCard:
    """A card: its name in upper case, positions of its lines, and its fields.

    fields: the name first, then the data fields numbered over all lines (1-8, 9-16, ...), as the
    manuals and pyNastran's BDFCard count them; None where blank.
    """

    name: str
    lines: tuple[int, ...]
    fields: tuple[CardField | None, ...]

    def text(self, field: int) -> str:
        """A field's text in upper case, empty where it is blank."""
        found = self.fields[field] if field < len(self.fields) else None
        return found.text.upper() if found else ""


@dataclass(frozen=True, slots=True)
class CardRow:
    """One line of bulk data: a name or the tag it continues, its data, and the tag it leaves."""

    line: int
    head: CardField | None
    name: str
    tag: str
    data: tuple[CardField | None, ...]
    next_tag: str


def read_cards(lines: Sequence[Line], positions: Iterable[int]) -> tuple[NastranCard, ...]:
    """The cards that these lines of a deck form. Raises ModelError with file and line."""
    rows = [
        _row(lines[position], position)
        for position in positions
        if lines[position].text.partition("$")[0].strip()
    ]
    following = _following(rows, lines)
    reached, cards = 0, []
    for start, row in enumerate(rows):
        if not row.name:
            continue
        chain, place = [row], following.get(start)
        while place is not None:
            chain.append(rows[place])
            place = following.get(place)
        reached += len(chain)
        cards.append(_card(chain))
    if reached < len(rows):
        used = {line for card in cards for line in card.lines}
        lost = next(row for row in rows if row.line not in used)
        raise ModelError(f"{lines[lost.line].where}: this line continues no card")
    return tuple(cards)


def _card(chain: Sequence[CardRow]) -> NastranCard:
    fields = [chain[0].head, *(field for row in chain for field in row.data)]
    while fields[-1] is None:
        fields.pop()
    return NastranCard(chain[0].name, tuple(row.line for row in chain), tuple(fields))


def _following(rows: Sequence[CardRow], lines: Sequence[Line]) -> dict[int, int]:
    """Which row continues which, by index."""
    tags = {row.next_tag: place for place, row in enumerate(rows) if row.next_tag}
    following: dict[int, int] = {}
    for place, row in enumerate(rows):
        if row.name:
            continue
        before = place - 1
        if row.tag and (before < 0 or rows[before].next_tag != row.tag):
            before = tags.get(row.tag, before)
        where = lines[row.line].where
        if before < 0:
            raise ModelError(f"{where}: a continuation line before the first card")
        if before in following:
            other = lines[rows[following[before]].line].where
            raise ModelError(f"{where}: continues the same line as {other} (tag +{row.tag})")
        following[before] = place
    return following


def _row(line: Line, position: int) -> CardRow:
    """Split one line into its fields. Raises ModelError."""
    data = line.text.partition("$")[0].rstrip()
    free = "," in data
    first, *spans = _free_spans(data) if free else _fixed_spans(data)
    head = data[first[0] : first[1]].strip().upper()
    large = head.startswith("*") or head.endswith("*")
    count, width = (4, LARGE) if large else (8, SMALL)
    texts = [data[start:stop].strip() for start, stop in spans]
    if any(texts[count + 1 :]):
        raise ModelError(f"{line.where}: more than {count} data fields in one line")
    fields = tuple(
        CardField(position, start, stop, 0 if free else width, text) if text else None
        for (start, stop), text in zip(spans[:count], texts, strict=False)
    )
    fields += (None,) * (count - len(fields))
    tag = texts[count].upper() if len(texts) > count else ""
    name = "" if head[:1] in ("", "+", "*") else head.rstrip("*").rstrip()
    if name and not NAME.fullmatch(name):
        raise ModelError(f"{line.where}: {name[:40]!r} is not the name of a card")
    return CardRow(
        position,
        CardField(position, *first, 0 if free else SMALL, head) if name else None,
        name,
        "" if name else _tag(head),
        fields,
        _tag(tag),
    )


def _tag(text: str) -> str:
    """A continuation's tag; `+` and `*` only say in which format the line is."""
    return text[1:].strip() if text[:1] in ("+", "*") else text


def _free_spans(data: str) -> list[tuple[int, int]]:
    spans, start = [], 0
    for piece in data.split(","):
        spans.append((start, start + len(piece)))
        start += len(piece) + 1
    return spans


def _fixed_spans(data: str) -> list[tuple[int, int]]:
    """Columns of the text that the fields of a fixed-format line take; tabs stop at every 8."""
    width = LARGE if "*" in data.expandtabs()[:SMALL] else SMALL
    edges = [0, *range(SMALL, TAG + 1, width), TAG + SMALL]
    if "\t" in data:
        columns, column = [], 0
        for character in data:
            columns.append(column)
            column += SMALL - column % SMALL if character == "\t" else 1
        edges = [bisect_left(columns, edge) for edge in edges]
    stops = [min(edge, len(data)) for edge in edges]
    return list(pairwise(stops))


def changed_texts(lines: Sequence[Line], values: Mapping[CardField, float]) -> dict[int, str]:
    """New texts of the lines in which these fields get new numbers; nothing else changes.

    A number keeps its field's format and place: 8 or 16 columns, at the left or the right as it
    stood. In free field it takes at most 8 characters, 16 in a line with a `*`, or as many as
    stood there before: what is longer is cut by some programs. Raises ModelError.
    """
    changed: dict[int, str] = {}
    for field in sorted(values, key=lambda field: (field.line, -field.start)):
        line = lines[field.line]
        text = changed.get(field.line, line.text)
        old = text[field.start : field.stop]
        try:
            new = (
                _free(line, field, old, values[field])
                if not field.width
                else _fixed(field, old, values[field])
            )
        except ValueError as error:
            raise ModelError(f"{line.where}: {error}") from None
        changed[field.line] = text[: field.start] + new + text[field.stop :]
    return changed


def _free(line: Line, field: CardField, old: str, value: float) -> str:
    large = "*" in line.text.partition(",")[0]
    width = LARGE if large else min(max(SMALL, len(field.text)), LARGE)
    blanks = len(old) - len(old.lstrip())
    return f"{old[:blanks]}{format_number(value, width)}{old[len(old.rstrip()) :]}"


def _fixed(field: CardField, old: str, value: float) -> str:
    """The field's columns with another number; a field cut short by the line's end stays so."""
    number = format_number(value, field.width)
    columns = old.expandtabs(SMALL)
    length = len(columns)
    lead = length - len(columns.lstrip())
    if lead and length == field.width and columns == columns.rstrip():
        return number.rjust(length)
    lead = min(lead, max(length, len(number)) - len(number))
    return f"{' ' * lead}{number}".ljust(length)
