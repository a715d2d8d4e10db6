"""Bulk data as cards: fields in small, large and free format, and lines that continue others.

A card has a name and numbered fields. A line holds eight of them in columns of 8 (small field),
four in columns of 16 (large field, a `*` in the first field), or as many between commas or blanks
(free field: a comma in the first ten columns, or one that ends a field). A line whose first field
is blank or starts with `+` or `*` continues another: the one before it, or the one whose last field
carries the same tag. Columns 73-80 hold nothing else. Where tags disagree or are missing on one
side, the line before is continued, since many programs write sequence numbers there. A line of `=`
repeats the card above it (`==` its remaining fields) with increments `*(2)`, and `=(9)` does so
nine times more.

What is no card is kept as one, under the name that it has in the deck or `+` for a line that
continues none, so that a deck has all its lines and who uses it can judge.

Numbers are written as `7.1+4`, `7.1D4` or `-.5`, with as many digits as a field holds.
"""

from __future__ import annotations

import math
import re
from bisect import bisect_left
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

from modetune.adapters.deck_files import Line
from modetune.core.errors import ModelError

NAME = re.compile(r"[A-Z][A-Z0-9_]{0,7}")
#: The name field of a line that repeats a card: once, or several times.
AGAIN = re.compile(r"=|=\(?(\d+)\)?")
#: A field of such a line that adds to the number above.
INCREMENT = re.compile(r"\*\(?([^()]+)\)?")
#: How a line begins that copies a card above it, or increments it.
COPIES = ("=", "*(")
#: The name of a line that continues no card.
LOST = "+"
#: A card is repeated at most so often: more is a slip that would fill the memory.
MOST_COPIES = 1_000_000
#: Fields of a line; Nastran reads ten, and scripts write some thousands.
MOST_FIELDS = 20_000
#: Characters free field keeps of a number: eight, or sixteen in a line with a `*`.
SMALL, LARGE = 8, 16
#: A comma in these columns makes a line free field; one further on is part of a field.
FREE = 10
#: What in a fixed field says that its line is in free field all the same.
NUMBER_AND_COMMA = re.compile(r"[+-]?\d+,")
#: Columns of the fields of a fixed-format line end here; the tag follows.
TAG = 72


class CardField(NamedTuple):
    """One field of a card, as written in the deck.

    line: position in the deck's lines. start, stop: the columns of the line's text, blanks of the
    field included. width: 8, 16, or 0 in free field. text: without blanks round it. lead: what must
    be written before it where the line ends earlier.
    """

    line: int
    start: int
    stop: int
    width: int
    text: str
    lead: str = ""


@dataclass(frozen=True, slots=True)
class NastranCard:
    """A card: its name in upper case, positions of its lines, and its fields.

    fields: the name first, then the data fields numbered over all lines (1-8, 9-16, ...), as the
    manuals and pyNastran's BDFCard count them; None where blank.
    """

    name: str
    lines: tuple[int, ...]
    fields: tuple[CardField | None, ...]

    def __hash__(self) -> int:
        """The hash of a few parts that differ between cards: that of all fields takes long."""
        return hash((self.name, self.lines, self.fields[1:3]))

    def text(self, field: int) -> str:
        """A field's text in upper case, empty where it is blank."""
        found = self.fields[field] if field < len(self.fields) else None
        return found.text.upper() if found else ""


class CardRow(NamedTuple):
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
    following = _following(rows)
    cards: list[NastranCard] = []
    used: set[int] = set()
    increments: dict[int, str] = {}
    for start in [*sorted(set(range(len(rows))) - set(following.values())), *range(len(rows))]:
        if start in used:
            continue
        chain = [start]
        while (place := following.get(chain[-1])) is not None and place not in used:
            chain.append(place)
            used.add(place)
        used.add(start)
        again = AGAIN.fullmatch(rows[start].name)
        if again is None or not cards:
            cards.append(_card([rows[place] for place in chain]))
            continue
        count = int(again.group(1) or 1)
        if len(cards) + count > MOST_COPIES:
            raise ModelError(f"{lines[rows[start].line].where}: {count} copies of a card")
        if again.group(1) is None:
            increments = _increments(rows[start])
        for _ in range(count):
            cards.append(_copy(cards[-1], rows[start], increments, lines))
    return tuple(sorted(cards, key=lambda card: card.lines[0]))


def read_changed(
    cards: Sequence[NastranCard],
    lines: Sequence[Line],
    changed: Mapping[int, str],
    positions: range,
) -> tuple[NastranCard, ...] | None:
    """The cards of a deck of which some lines change; only cards in these lines are read again.

    cards, lines: before the change. positions: of the bulk data. None if all must be read again:
    where cards copy others, or where a line changes its name or the lines that it continues.
    """
    texts = {place: text for place, text in changed.items() if place in positions}
    if any("\n" in text for text in texts.values()) or has_copies(lines, positions):
        return None
    rows = {}
    for place, text in texts.items():
        before, after = _row(lines[place], place), _row(lines[place]._replace(text=text), place)
        links = (before.name, before.tag, before.next_tag)
        if links != (after.name, after.tag, after.next_tag):
            return None
        if not text.partition("$")[0].strip() or not lines[place].text.partition("$")[0].strip():
            return None
        rows[place] = after
    return tuple(
        card
        if rows.keys().isdisjoint(card.lines)
        else _card([rows.get(place) or _row(lines[place], place) for place in card.lines])
        for card in cards
    )


def has_copies(lines: Sequence[Line], positions: Iterable[int]) -> bool:
    """Whether lines at these positions repeat cards above them."""
    return any(lines[position].text.lstrip().startswith(COPIES) for position in positions)


def _card(chain: Sequence[CardRow]) -> NastranCard:
    fields = [chain[0].head, *(field for row in chain for field in row.data)]
    while fields and fields[-1] is None:
        fields.pop()
    return NastranCard(chain[0].name or LOST, tuple(row.line for row in chain), tuple(fields))


def _increments(row: CardRow) -> dict[int, str]:
    """What a line adds to fields of the card above, by their number."""
    found = ((number, field and INCREMENT.fullmatch(field.text)) for number, field in _data(row))
    return {number: match.group(1) for number, match in found if match}


def _data(row: CardRow) -> list[tuple[int, CardField | None]]:
    return list(enumerate(row.data, 1))


def _copy(
    above: NastranCard, row: CardRow, increments: Mapping[int, str], lines: Sequence[Line]
) -> NastranCard:
    """The card above once more: changed as its line says, or by the last line's increments."""
    here = CardField(row.line, 0, 0, 0, above.name)
    fields: list[CardField | None] = [here]
    written = dict(_data(row)) if row.name == "=" else {}
    rest = next((number for number, field in written.items() if field and field.text == "=="), 9)
    for number in range(1, max(len(above.fields), 9)):
        field = written.get(number)
        old = above.fields[number] if number < len(above.fields) else None
        copied = not written or number >= rest or (field is not None and field.text == "=")
        if number in increments and number < rest:
            try:
                text = _sum(old.text if old else "0", increments[number])
            except ValueError as error:
                raise ModelError(f"{lines[row.line].where}: {error}") from None
            fields.append(here._replace(text=text))
        elif copied:
            fields.append(old and here._replace(text=old.text))
        else:
            fields.append(field)
    while fields[-1] is None:
        fields.pop()
    return NastranCard(above.name, (row.line,), tuple(fields))


def _sum(text: str, increment: str) -> str:
    if text.lstrip("+-").isdecimal() and increment.lstrip("+-").isdecimal():
        return str(int(text) + int(increment))
    return format_number(read_number(text) + read_number(increment), LARGE)


def _following(rows: Sequence[CardRow]) -> dict[int, int]:
    """Which row continues which, by index."""
    tags = {row.next_tag: place for place, row in enumerate(rows) if row.next_tag}
    # First the lines whose tag the line above has: the same tags may occur in many places.
    following = {
        place - 1: place
        for place, row in enumerate(rows)
        if place and row.tag and not row.name and rows[place - 1].next_tag == row.tag
    }
    done = set(following.values())
    for place, row in enumerate(rows):
        if row.name or place in done:
            continue
        before = tags.get(row.tag, place - 1) if row.tag else place - 1
        if before in following:  # a tag that occurs twice
            before = place - 1
        if before >= 0 and before not in following:
            following[before] = place
    return following


def _row(line: Line, position: int) -> CardRow:
    """Split one line into its fields. Raises ModelError."""
    data = line.text.partition("$")[0].rstrip()
    if "," not in data and "\t" not in data:
        row = _fixed_row(data, position)
        if row is not None:
            return row
    free = _is_free(data)
    if (count := data.count(",")) > MOST_FIELDS:
        raise ModelError(f"{line.where}: {count:,} fields in one line, more than Nastran reads")
    first, *spans = _free_spans(data) if free else _fixed_spans(data)
    head = data[first[0] : first[1]].strip().upper()
    large = head.startswith("*") or head.endswith("*")
    count, width = (4, LARGE) if large else (8, SMALL)
    texts = [data[start:stop].strip() for start, stop in spans]
    if any(texts[count + 1 :]):  # free field alone can have more, all of them data
        count = len(texts)
    fields = tuple(
        CardField(position, start, stop, 0 if free else width, text) if text else None
        for (start, stop), text in zip(spans[:count], texts, strict=False)
    )
    fields += (None,) * (count - len(fields))
    tag = texts[count].upper() if len(texts) > count else ""
    name = "" if head[:1] in ("", "+", "*") else head.rstrip("*").rstrip()
    return CardRow(
        position,
        CardField(position, *first, 0 if free else SMALL, head) if name else None,
        name,
        "" if name else _tag(head),
        fields,
        _tag(tag),
    )


def _fixed_row(data: str, position: int) -> CardRow | None:
    """A line in small or large field, of a large deck nearly all; None if a `*` is inside a name.

    data: without tabs, commas and comment.
    """
    end = len(data)
    head = data[:SMALL].strip().upper()
    large = "*" in head
    if large and not (head.startswith("*") or head.endswith("*")):
        return None
    width = LARGE if large else SMALL
    fields = []
    for start in range(SMALL, TAG, width):
        text = data[start : start + width].strip()
        place = CardField(position, start, min(start + width, end), width, text) if text else None
        fields.append(place)
    name = "" if head[:1] in ("", "+", "*") else head.rstrip("*").rstrip()
    return CardRow(
        position,
        CardField(position, 0, min(SMALL, end), SMALL, head) if name else None,
        name,
        "" if name else _tag(head),
        tuple(fields),
        _tag(data[TAG : TAG + SMALL].strip().upper()) if end > TAG else "",
    )


def _tag(text: str) -> str:
    """A continuation's tag; `+` and `*` only say in which format the line is."""
    return text[1:].strip() if text[:1] in ("+", "*") else text


def _is_free(data: str) -> bool:
    """Return whether a line is in free field; an equation's commas are within its text."""
    if "," in data[:FREE]:
        return True
    if "," not in data or data.startswith(" ") or data.upper().startswith("DEQATN"):
        return False
    texts = [data[start:stop].strip() for start, stop in _fixed_spans(data)[1:]]
    return any(NUMBER_AND_COMMA.fullmatch(text) for text in texts)


def _free_spans(data: str) -> list[tuple[int, int]]:
    """Return the fields between commas; blanks split them further, except within a name."""
    spans, start = [], 0
    for piece in data.split(","):
        whole = not start and len(piece) < FREE
        words = [] if whole else list(re.finditer(r"\S+", piece))
        edges = [start, *(start + word.start() for word in words[1:]), start + len(piece)]
        spans += list(pairwise(edges))
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


def blank_field(lines: Sequence[Line], card: NastranCard, number: int) -> CardField | None:
    """Return the place of a blank field of a card; None in a line that the card does not have."""
    first = 1
    for position in card.lines:
        count = len(_row(lines[position], position).data)
        if number < first + count:
            return _blank(lines[position].text.partition("$")[0].rstrip(), position, number - first)
        first += count
    return None


def _blank(data: str, position: int, place: int) -> CardField:
    """A blank field of a line, by its place among the data fields of that line."""
    end = len(data)
    if _is_free(data):
        _, *spans = _free_spans(data)
        if place < len(spans):
            return CardField(position, *spans[place], 0, "")
        return CardField(position, end, end, 0, "", "," * (place - len(spans) + 1))
    _, *spans = _fixed_spans(data)
    width = LARGE if "*" in data.expandtabs()[:SMALL] else SMALL
    lead = " " * (SMALL + place * width - len(data.expandtabs()))
    return CardField(position, *spans[place], width, "", lead)


def large_field(name: str, fields: Sequence[str]) -> str:
    """A card in large field: four data fields of 16 columns a line. Raises ModelError."""
    try:
        texts = [
            text if len(text) <= LARGE else format_number(read_number(text), LARGE)
            for text in fields
        ]
    except ValueError as error:
        raise ModelError(f"{name}: {str(error)[:100]}, and too long for a field") from error
    rows = [texts[start : start + 4] for start in range(0, len(texts), 4)] or [[]]
    if len(rows) % 2 and len(rows) > 1:
        rows.append([])  # MYSTRAN takes two lines for one, and breaks off where a ply has no second
    heads = [f"{name}*", *["*"] * (len(rows) - 1)]
    lines = [
        f"{head:<{SMALL}}" + "".join(f"{text:<{LARGE}}" for text in row)
        for head, row in zip(heads, rows, strict=True)
    ]
    return "\n".join(line.rstrip() for line in lines)


def changed_texts(lines: Sequence[Line], values: Mapping[CardField, float | int]) -> dict[int, str]:
    """New texts of the lines in which these fields get new numbers; nothing else changes.

    A number keeps its field's format and place: 8 or 16 columns, at the left or the right as it
    stood. In free field it takes at most 8 characters, 16 in a line with a `*`, or as many as
    stood there before: what is longer is cut by some programs. Raises ModelError.
    """
    changed: dict[int, str] = {}
    for field in sorted(values, key=lambda field: (field.line, -field.start, len(field.lead))):
        line = lines[field.line]
        text = changed.get(field.line, line.text)
        old = text[field.start : field.stop]
        if line.text[field.start : field.stop].strip() != field.text:
            raise ModelError(
                f"{line.where}: the number {field.text} of a card that repeats the one above (=) "
                "cannot be changed by itself; write the card out"
            )
        try:
            new = (
                _free(line, field, old, values[field])
                if not field.width
                else _fixed(field, old, values[field])
            )
        except ValueError as error:
            raise ModelError(f"{line.where}: {error}") from None
        if field.lead:
            tail = text[field.start : len(text) + field.start - len(line.text)]
            gap = "" if field.width else field.lead[tail.count(",") :]
            new = tail.ljust(len(field.lead) if field.width else 0) + gap + new
            text = text[: field.start] + text[field.start + len(tail) :]
        changed[field.line] = text[: field.start] + new + text[field.stop :]
    return changed


def _number(value: float | int, width: int) -> str:
    """Return an integer or a real number in at most `width` characters. Raises ValueError."""
    if not isinstance(value, int):
        return format_number(value, width)
    if len(str(value)) > width:
        raise ValueError(f"{value} does not fit {width} characters")
    return str(value)


def _free(line: Line, field: CardField, old: str, value: float | int) -> str:
    large = "*" in line.text.partition(",")[0]
    width = LARGE if large else min(max(SMALL, len(field.text)), LARGE)
    blanks = len(old) - len(old.lstrip())
    return f"{old[:blanks]}{_number(value, width)}{old[len(old.rstrip()) :]}"


def _fixed(field: CardField, old: str, value: float | int) -> str:
    """The field's columns with another number; a field cut short by the line's end stays so."""
    number = _number(value, field.width)
    if not old and not field.lead:  # the line ends where the field begins
        return number.rjust(field.width)
    columns = old.expandtabs(SMALL)
    length = len(columns)
    lead = length - len(columns.lstrip())
    if lead and length == field.width and columns == columns.rstrip():
        return number.rjust(length)
    lead = min(lead, max(length, len(number)) - len(number))
    return f"{' ' * lead}{number}".ljust(length)


#: Digits with or without a point, then an exponent with or without its letter.
NUMBER = re.compile(r"([+-]?(?:\d+\.?\d*|\.\d+))(?:[ED]([+-]?\d+)|([+-]\d+))?", re.IGNORECASE)
#: Digits beyond which a double has no information.
DIGITS = 17


def read_number(text: str) -> float:
    """A number as Nastran reads it: 7.1E4, 7.1d4 and 7.1+4 are one. Raises ValueError."""
    found = NUMBER.fullmatch(text.strip())
    if found is None:
        raise ValueError(f"{text!r} is not a number")
    mantissa, lettered, bare = found.groups()
    value = float(f"{mantissa}e{lettered or bare or 0}")
    if not math.isfinite(value):
        raise ValueError(f"{text!r} is not finite")
    return value


def format_number(value: float, width: int) -> str:
    """The text of at most `width` characters that is nearest to a real number.

    It always has a decimal point, for Nastran takes a number without one for an integer. Eight
    characters hold four to seven digits (four in -1.234-10, seven in 1234567.): the same number
    always gives the same text, so what a job runs is what an updated deck says.
    Raises ValueError where the value is not finite or no text fits.
    """
    if not math.isfinite(value):
        raise ValueError(f"{value} is not a finite number")
    if value == 0.0:
        return "0."
    texts = [*_plain(value, width), *_with_exponent(value, width)]
    if not texts:
        raise ValueError(f"{value!r} does not fit {width} characters")
    # Of two that are equally near the first is taken, the one without an exponent.
    return min(texts, key=lambda text: abs(read_number(text) - value))


def _plain(value: float, width: int) -> list[str]:
    """The longest text without an exponent that fits, if any keeps a digit."""
    if not 1e-8 < abs(value) < 10.0**width:
        return []
    for decimals in range(DIGITS, -1, -1):
        whole, _, part = f"{value:.{decimals}f}".partition(".")
        whole = whole.replace("-0", "-") if whole.startswith("-0") else whole
        text = f"{'' if whole == '0' else whole}.{part.rstrip('0')}"
        if len(text) <= width and any(digit in text for digit in "123456789"):
            return [text]
    return []


def _with_exponent(value: float, width: int) -> list[str]:
    """The longest text with an exponent that fits, as 7.1+4."""
    for digits in range(DIGITS, 0, -1):
        mantissa, _, exponent = f"{value:.{digits - 1}e}".partition("e")
        mantissa = mantissa.rstrip("0") if "." in mantissa else f"{mantissa}."
        text = f"{mantissa}{int(exponent):+d}"
        if len(text) <= width:
            return [text] if _finite(text) else []
    return []


def _finite(text: str) -> bool:
    """Whether rounding has not carried the largest doubles past what a double holds."""
    try:
        read_number(text)
    except ValueError:
        return False
    return True
