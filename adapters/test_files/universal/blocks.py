"""The datasets of a universal file, cut out of its bytes.

    ____-1          start mark, four blanks before it
    ____58          the dataset's number; `58b` with binary values
    ...
    ____-1          end mark

pyuff looks for marks anywhere, also inside binary values and in a row that happens to end in -1,
and takes a file that is cut short for a shorter one; so they are found here, with their lines.
"""

from __future__ import annotations

import re
from contextlib import suppress
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

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
    """The datasets of a file in their order. Raises CampaignError where it is none or cut short."""
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
        raise CampaignError(
            f"test file {path} holds no dataset of a universal file: none starts with a line "
            "`    -1` and a line with its number"
        )
    return tuple(blocks)


def read_file(path: Path) -> bytes:
    """A test file's bytes. Raises CampaignError where it cannot be read or is empty."""
    with read_errors(f"test file {path}", CampaignError):
        data = read_regular(path)
    if not data.strip():
        raise CampaignError(f"test file {path} is empty")
    return data.removeprefix(b"\xef\xbb\xbf")  # what some editors put before UTF-8


def _block(
    path: Path, data: bytes, start: int, line: int, kind: int, binary: bool
) -> tuple[int, DatasetBlock]:
    """Where the file goes on after the dataset whose number stands at `start`, and the dataset."""
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
    """The text rows of a binary dataset, and where its values begin."""
    rows = []
    for _ in range(BINARY_ROWS):
        end = data.find(b"\n", start)
        if end < 0:
            break
        rows.append(data[start:end])
        start = end + 1
    return rows, start


def _values_end(data: bytes, first: int, rows: list[bytes]) -> int | None:
    """Where binary values end: after as many bytes as they need or claim, where a mark follows.

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
    """The whole numbers between these columns; 0 where none stands."""
    fields = [row[start:end].strip() for start, end in pairwise(columns)]
    return tuple(int(field) if field.isdigit() else 0 for field in fields)


def _text(row: bytes) -> str:
    """A row as text. Programs write ids and units in UTF-8 or Latin-1, without saying which."""
    try:
        return row.decode("utf-8").rstrip("\r")
    except UnicodeDecodeError:
        return row.decode("latin-1").rstrip("\r")


def _cut_short(path: Path, line: int, name: str) -> CampaignError:
    return CampaignError(
        f"{path}, line {line}: dataset {name} has no end mark (`    -1`): the file is cut short; "
        "copy or export it again"
    )
