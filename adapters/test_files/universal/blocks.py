"""The datasets of a universal file: cut out of its bytes, and normalised for pyuff.

    ____-1          start mark, four blanks before it
    ____58          the number of the dataset; `58b` with binary values
    ...
    ____-1          end mark

pyuff finds marks anywhere, even inside binary values and in a row that happens to end in -1, and
reads a truncated file as a shorter one. So the marks are found here, with their lines.

Normalisation changes no number. pyuff 2.5.8 splits headers at characters that are not line ends
(non-ASCII ones of one byte); knows no exponent letter D in datasets 15, 18, 55 and 58; reads blanks
at the end of a row as values (18, 58 in double precision); takes one row for one record where the
format continues it (nodes of large elements in 2412, more than six values a node in 55 and 2414);
reads the end of line before the end mark as binary values; and takes all numbers of an uneven
binary function for doubles, where abscissae have single precision.
"""

from __future__ import annotations

import re
from contextlib import suppress
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np

from modetune.adapters.regular_file import read_errors, read_regular
from modetune.core.errors import CampaignError

_MARK = re.compile(rb"^ {4}-1[ \t]*\r?(?:\n|\Z)", re.MULTILINE)
#: Marks with other blanks before them, and such a one with a dataset's number in the next line.
_ODD_START = re.compile(rb"^(?! {4}-1)[ \t]*-1[ \t]*\r?\n[ \t]*\d{2,4}[ \t]*\r?$", re.MULTILINE)
_ODD_MARK = re.compile(rb"^[ \t]*-1(?=[ \t]*\r?$)", re.MULTILINE)
#: The end of a binary dataset, which follows its last value at once or after a line break.
_BINARY_END = re.compile(rb"\r?\n? {4}-1[ \t]*\r?(?:\n|\Z)")
_KIND = re.compile(rb"[ \t]*(\d{1,6})(b?)(?:\s|\Z)", re.IGNORECASE)
#: Bytes of a value of dataset 58 by its ordinate type: real and complex, single and double.
WIDTHS = {2: 4, 4: 8, 5: 8, 6: 16}
#: Rows of a binary dataset before its values: its number, then what n_ascii_lines counts.
BINARY_ROWS = 12


@dataclass(frozen=True, slots=True)
class DatasetBlock:
    """One dataset: its number, the line of that number, its text rows and its binary values."""

    kind: int
    line: int
    rows: tuple[str, ...]
    binary: bytes | None = None

    @property
    def name(self) -> str:
        return f"{self.kind}b" if self.binary is not None else str(self.kind)


def read_blocks(path: Path) -> tuple[DatasetBlock, ...]:
    """Return the datasets of a file in their order.

    Raises CampaignError where it is none or cut short.
    """
    data = read_file(path)
    tried = [data]
    if b"58b" not in data and (tidied := _ODD_MARK.sub(b"    -1", data)) != data:
        tried.insert(0 if _ODD_START.search(data) else 1, tidied)
    for text in tried[:-1]:
        with suppress(CampaignError):
            return _blocks(path, text)
    return _blocks(path, tried[-1])


def _blocks(path: Path, data: bytes) -> tuple[DatasetBlock, ...]:
    blocks = []
    position, line = 0, 1
    while mark := _MARK.search(data, position):
        line += data.count(b"\n", position, mark.end())
        position = mark.end()
        kind = _KIND.match(data, position, position + 80)
        if kind is None:  # an end mark without a start: the next mark may be a start
            continue
        end, block = _block(path, data, position, line, int(kind[1]), bool(kind[2]))
        blocks.append(block)
        line += data.count(b"\n", position, end)
        position = end
    if not blocks:
        if b"\r" in data and b"\n" not in data:
            raise CampaignError(
                f"test file {path}, line 1: lines end with a carriage return (CR) alone; convert "
                "the file to LF or CRLF line ends (`mac2unix`)"
            )
        raise CampaignError(
            f"test file {path} holds no dataset of a universal file: none starts with a line "
            "`    -1` and a line with its number"
        )
    return tuple(blocks)


def read_file(path: Path) -> bytes:
    """Return a test file's bytes. Raises CampaignError where it cannot be read or is empty."""
    with read_errors(f"test file {path}", CampaignError):
        data = read_regular(path)
    if not data.strip():
        raise CampaignError(f"test file {path} is empty")
    return data.removeprefix(b"\xef\xbb\xbf")  # what some editors put before UTF-8


def _block(
    path: Path, data: bytes, start: int, line: int, kind: int, binary: bool
) -> tuple[int, DatasetBlock]:
    """Return the end of the dataset whose number is at `start`, and the dataset."""
    if not binary:
        mark = _MARK.search(data, start)
        if mark is None:
            raise _cut_short(path, line, str(kind))
        rows = data[start : mark.start()].split(b"\n")[:-1]
        return mark.end(), DatasetBlock(kind, line, tuple(map(_text, rows)))
    rows, first = _head(data, start)
    last = _values_end(data, first, rows)
    ending = _BINARY_END.match(data, last) if last is not None else None
    if last is None or ending is None:
        raise _cut_short(path, line, f"{kind}b")
    return ending.end(), DatasetBlock(kind, line, tuple(map(_text, rows)), data[first:last])


def _head(data: bytes, start: int) -> tuple[list[bytes], int]:
    """Return the text rows of a binary dataset, and where its values begin."""
    rows = []
    for _ in range(BINARY_ROWS):
        end = data.find(b"\n", start)
        if end < 0:
            break
        rows.append(data[start:end])
        start = end + 1
    return rows, start


def _values_end(data: bytes, first: int, rows: list[bytes]) -> int | None:
    """Return the end of binary values: after the bytes that they need or claim, before a mark.

    pyuff itself claims 8 bytes a complex value, other programs the bytes of a padded record; the
    number and type of the values (record 7) are tried as well, then the first mark before a start.
    """
    claimed = whole_numbers(rows[0], (19, 31, 43))[1] if rows else 0
    sizes = [claimed]
    if len(rows) == BINARY_ROWS:
        kind, count, even = whole_numbers(rows[7], (0, 10, 20, 30))
        width = WIDTHS.get(kind, 0)
        sizes += [count * width] if even else [count * (width + 4), count * (width + 8)]
    for size in sizes:
        last = first + size
        if 0 < size <= len(data) - first and _BINARY_END.match(data, last):
            return last
    if max(sizes) > len(data) - first:
        return None
    found = re.compile(rb"\r?\n? {4}-1[ \t]*\r?(?:\n {4}-1[ \t]*\r?\n|\n?\Z)").search(data, first)
    return found.start() if found else None


def whole_numbers(row: bytes, columns: tuple[int, ...]) -> tuple[int, ...]:
    """Return the whole numbers between these columns; 0 where there is none."""
    fields = [row[start:end].strip() for start, end in pairwise(columns)]
    return tuple(int(field) if field.isdigit() else 0 for field in fields)


def _text(row: bytes) -> str:
    """Return a row as text. Programs write UTF-8 or Latin-1 without naming it."""
    try:
        return row.decode("utf-8").rstrip("\r")
    except UnicodeDecodeError:
        return row.decode("latin-1").rstrip("\r")


def _cut_short(path: Path, line: int, name: str) -> CampaignError:
    return CampaignError(
        f"{path}, line {line}: dataset {name} has no end mark (`    -1`): the file is cut short; "
        "copy or export it again"
    )


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
    """Return a dataset with its marks, as pyuff reads it.

    Raises ValueError where its form is broken.
    """
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
    if values:  # an unnamed number format is IEEE 754
        rows[0] = f"{rows[0][:13]}{2:6d}{rows[0][19:]}"
    text = "\n".join(["    -1", *rows, ""]).encode("ascii")
    return text + values + b"    -1\n"


def bad_row(block: DatasetBlock) -> int | None:
    """Return the first row of a dataset's numbers that is not made of numbers, None if all are."""
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
    """Return the declared content of a dataset 55 or 2414."""
    row = _in_columns(_ascii(row))
    fields = [int(row[start : start + 10].strip() or 0) for start in range(0, 60, 10)]
    return DataKind(fields[1], fields[2], fields[3], fields[4] in (5, 6), fields[5])


def _in_columns(row: str) -> str:
    """Return a row of whole numbers in columns of ten, which blanks or tabs may separate."""
    if all(len(row[start : start + 10].split()) < 2 for start in range(0, len(row), 10)):
        return row
    return "".join(f"{field:>10}" for field in row.split())


def node_rows(rows: list[str], header: int, kind: int) -> list[tuple[str, list[str]]]:
    """Return the row of each node and the rows of its values.

    Raises ValueError where one is missing.
    """
    text = data_kind(rows[6 if kind == 55 else 9])
    count = text.count * (2 if text.is_complex else 1)
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
    """Return each node's values in one row; none where modetune reads them itself."""
    if kind == 2414 and int(rows[3]) != 1:
        raise ValueError("holds data on elements or at points, not at nodes")
    joined = rows[:header]
    text = data_kind(rows[6 if kind == 55 else 9])
    if kind == 55 and text.count == 6 and text.is_complex:  # pyuff reads three complex values only
        joined[6] = rows[6][:40] + f"{2:10d}{3:10d}"
        return joined
    for node, values in node_rows(rows, header, kind):
        joined += [node, "".join(values)]
    return joined


def _joined_elements(rows: list[str]) -> list[str]:
    """Return each element's node numbers in one row. Raises ValueError where some are missing."""
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
    """Return a row with one character of ASCII for each.

    A raised 2 of a unit stays a 2, micro a u.
    """
    if row.isascii() and row.isprintable():
        return row
    text = row.translate(_PLAIN).encode("ascii", "replace").decode()
    return re.sub(r"[\x00-\x1f\x7f]", " ", text)


def _doubles(block: DatasetBlock) -> bytes:
    """Return values of a binary function; those of an uneven one all in double precision."""
    assert block.binary is not None
    row = block.rows[7]
    kind, count, even = (int(row[start : start + 10]) for start in (0, 10, 20))
    order, form = whole_numbers(block.rows[0].encode(), (7, 13, 19))
    if form not in (0, 2):  # unnamed: what every machine has had since
        raise ValueError("holds binary numbers that are not those of IEEE 754")
    if order not in (1, 2):
        raise ValueError(f"does not state the order of its bytes (1 or 2, it has {order})")
    width = WIDTHS.get(kind)
    if width is None:
        raise ValueError(f"has ordinates of the unknown type {kind}")
    if even or len(block.binary) != count * (width + 4) or kind not in (4, 6):
        return block.binary
    mark = "<" if order == 1 else ">"
    mixed = np.dtype([("x", f"{mark}f4"), ("y", f"{mark}f8", (width // 8,))])
    values = np.frombuffer(block.binary, mixed)
    return np.column_stack([values["x"], values["y"]]).astype(f"{mark}f8").tobytes()
