"""Datasets put so that pyuff reads them right. Nothing here changes a number.

pyuff 2.5.8 splits headers at characters that are not line ends (non-ASCII ones of one byte); knows
no exponent letter D in datasets 15, 18, 55 and 58; reads blanks at the end of a row as values (18,
58 in double precision); takes one row for one record where the format continues it (nodes of large
elements in 2412, more than six values a node in 55 and 2414); reads the end of line before the end
mark as binary values; and takes all numbers of an uneven binary function for doubles, where
abscissae have single precision.
"""

from __future__ import annotations

import re
from dataclasses import dataclass

import numpy as np

from modetune.adapters.test_files.universal.blocks import WIDTHS, DatasetBlock, whole_numbers

_EXPONENT = re.compile(r"(?<=[0-9.])[dD](?=[+-]?\d)")
#: Rows before the values: dataset 55, 58 and 2414, counted from the dataset's number on.
HEADERS = {55: 9, 58: 12, 2414: 14}
#: The row from which on a text dataset holds nothing but numbers.
NUMBERS_FROM = {15: 1, 55: 6, 58: 12, 82: 3, 2411: 1, 2412: 1, 2414: 9}
#: Numbers with or without blanks between, as columns of fixed width have them; tried in one way
#: only, so that a long row takes no longer.
_NUMBERS = re.compile(
    r"(?:\s*+[+-]?+(?:\d++\.?+\d*+|\.\d++|nan|inf(?:inity)?+)(?:[eEdD][+-]?+\d++)?+)*+\s*+",
    re.IGNORECASE,
)
#: Elements with a third record, as pyuff takes them.
RODS = {11, 21, 22, 23, 24}
#: Rows that hold text for people.
_TEXTS = {55: range(1, 6), 58: range(1, 6), 2414: range(2, 9), 151: range(1, 8)}


def tidy(block: DatasetBlock) -> bytes:
    """A dataset with its marks, as pyuff reads it. Raises ValueError where its form is broken."""
    rows = [_ascii(row).rstrip() for row in block.rows]
    header = HEADERS.get(block.kind)
    if header is not None and len(rows) < header:
        raise ValueError(f"has {len(rows)} rows, of which the first {header} must be its header")
    texts = _TEXTS.get(block.kind, range(0))
    rows = [
        _EXPONENT.sub("E", row) if ("D" in row or "d" in row) and number not in texts else row
        for number, row in enumerate(rows)
    ]
    if block.kind == 55:
        rows[6:8] = [_in_columns(row) for row in rows[6:8]]
    if block.kind in (55, 2414):
        rows = _joined_values(rows, HEADERS[block.kind], block.kind)
    elif block.kind == 2412:
        rows = _joined_elements(rows)
    elif block.kind == 58 and block.binary is None:
        rows = rows[:12] + [row for row in rows[12:] if row]
    # a row that ends like a mark would end the dataset for pyuff
    rows = [row + " " if row.endswith("    -1") else row for row in rows]
    if block.kind in (15, 2411):  # joined by pyuff without anything between them
        rows[1:] = [" " + row for row in rows[1:] if row]
    values = b"" if block.binary is None else _doubles(block)
    if values:  # what is not told is IEEE 754
        rows[0] = f"{rows[0][:13]}{2:6d}{rows[0][19:]}"
    text = "\n".join(["    -1", *rows, ""]).encode("ascii")
    return text + values + b"    -1\n"


def bad_row(block: DatasetBlock) -> int | None:
    """The first row of a dataset's numbers that holds something else, nothing if none does."""
    first = NUMBERS_FROM.get(block.kind)
    if first is None or block.binary is not None:
        return None
    rows = enumerate(block.rows[first:], start=first)
    return next((number for number, row in rows if not _NUMBERS.fullmatch(row)), None)


@dataclass(frozen=True, slots=True)
class DataKind:
    """What datasets 55 and 2414 hold, by the format's numbers.

    analysis: 2 normal mode, 3 and 7 complex modes. form: 2, 3 vectors, 4, 5 tensors. quantity: 8
    displacement, 11 velocity, 12 acceleration, others no motion. count: values a node.
    """

    analysis: int
    form: int
    quantity: int
    is_complex: bool
    count: int


def data_kind(row: str) -> DataKind:
    """What a dataset 55 or 2414 says that it holds."""
    row = _in_columns(_ascii(row))
    fields = [int(row[start : start + 10].strip() or 0) for start in range(0, 60, 10)]
    return DataKind(fields[1], fields[2], fields[3], fields[4] in (5, 6), fields[5])


def _in_columns(row: str) -> str:
    """A row of whole numbers in columns of ten, where blanks or tabs stand between them instead."""
    if all(len(row[start : start + 10].split()) < 2 for start in range(0, len(row), 10)):
        return row
    return "".join(f"{field:>10}" for field in row.split())


def node_rows(rows: list[str], header: int, kind: int) -> list[tuple[str, list[str]]]:
    """The row of each node and the rows of its values. Raises ValueError where one is missing."""
    said = data_kind(rows[6 if kind == 55 else 9])
    count = said.count * (2 if said.is_complex else 1)
    per_node = -(-count // 6)
    if per_node < 1:
        raise ValueError("has no values at its nodes")
    body = [row for row in rows[header:] if row]
    if len(body) % (per_node + 1):
        raise ValueError(f"does not have {count} values at each of its nodes")
    return [
        (body[first], body[first + 1 : first + 1 + per_node])
        for first in range(0, len(body), per_node + 1)
    ]


def _joined_values(rows: list[str], header: int, kind: int) -> list[str]:
    """Each node's values in one row; none where modetune reads them itself."""
    if kind == 2414 and int(rows[3]) != 1:
        raise ValueError("holds data on elements or at points, not at nodes")
    joined = rows[:header]
    said = data_kind(rows[6 if kind == 55 else 9])
    if kind == 55 and said.count == 6 and said.is_complex:  # pyuff reads three complex values only
        joined[6] = rows[6][:40] + f"{2:10d}{3:10d}"
        return joined
    for node, values in node_rows(rows, header, kind):
        joined += [node, "".join(values)]
    return joined


def _joined_elements(rows: list[str]) -> list[str]:
    """Each element's node numbers in one row. Raises ValueError where some are missing."""
    joined, body, place = rows[:1], [row for row in rows[1:] if row], 0
    while place < len(body):
        fields = body[place].split()
        if len(fields) < 6:
            raise ValueError(f"has an element of {len(fields)} numbers where 6 must be")
        records = 2 if int(fields[1]) in RODS else 1
        last = place + records + max(1, -(-int(fields[5]) // 8))
        nodes = " ".join(body[place + records : last])
        if len(nodes.split()) != int(fields[5]):
            raise ValueError(
                f"has {len(nodes.split())} of {fields[5]} nodes of element {fields[0]}"
            )
        joined += [*body[place : place + records], " " + nodes]
        place = last
    return joined


_PLAIN = str.maketrans("\N{SUPERSCRIPT TWO}\N{MICRO SIGN}\N{GREEK SMALL LETTER MU}", "2uu")


def _ascii(row: str) -> str:
    """A row with one character of ASCII for each; a raised 2 of a unit stays a 2, micro a u."""
    if row.isascii() and row.isprintable():
        return row
    text = row.translate(_PLAIN).encode("ascii", "replace").decode()
    return re.sub(r"[\x00-\x1f\x7f]", " ", text)


def _doubles(block: DatasetBlock) -> bytes:
    """Values of a binary function; those of an uneven one all in double precision."""
    assert block.binary is not None
    row = block.rows[7]
    kind, count, even = (int(row[start : start + 10]) for start in (0, 10, 20))
    order, form = whole_numbers(block.rows[0].encode(), (7, 13, 19))
    if form not in (0, 2):  # not told: what every machine has had since
        raise ValueError("holds binary numbers that are not those of IEEE 754")
    if order not in (1, 2):
        raise ValueError(f"does not tell the order of its bytes (1 or 2, it has {order})")
    width = WIDTHS.get(kind)
    if width is None:
        raise ValueError(f"has ordinates of the unknown type {kind}")
    if even or len(block.binary) != count * (width + 4) or kind not in (4, 6):
        return block.binary
    mark = "<" if order == 1 else ">"
    mixed = np.dtype([("x", f"{mark}f4"), ("y", f"{mark}f8", (width // 8,))])
    values = np.frombuffer(block.binary, mixed)
    return np.column_stack([values["x"], values["y"]]).astype(f"{mark}f8").tobytes()
