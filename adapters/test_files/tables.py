"""Tables as people and spreadsheets write them: CSV of any dialect, and Excel workbooks.

Text is UTF-8, UTF-16 with its mark, or Latin-1 (Windows' form of it); columns are separated by
`;`, tabs, commas or, where there are none of them, blanks; decimal marks are points or commas, one
of them in a table. Rows that are empty or begin with `#` are skipped. Headings may be words with a
unit: `Frequency [Hz]`, `Damping (%)`, `x [mm]`.
"""

from __future__ import annotations

import csv
import math
import re
import warnings
import zipfile
import zlib
from dataclasses import dataclass
from pathlib import Path

from modetune.adapters.regular_file import largest, open_regular, read_errors, read_regular
from modetune.core.errors import CampaignError

SEPARATORS = (";", "\t", ",")
_NUMBER = re.compile(r"[+-]?(?:[0-9]+[.,]?[0-9]*|[.,][0-9]+)(?:[eEdD][+-]?[0-9]+)?")
_HEADING = re.compile(r"(.*?)[\s:]*(?:[\[(]([^\])]*)[\])]|(?:/|\bin\b)\s*(\S+))?[\s:]*")

#: No measured value is larger, and its square is finite.
LARGEST = 1e150
#: Characters of a heading that may have a meaning; a long text takes the pattern minutes.
LONGEST_HEADING = 200
#: Cells of a workbook, which take 4 us and 80 bytes each; a text is read ten times as fast.
MOST_CELLS = 3_000_000
#: Sheets of numbers unpack to five to thirty times their size, repeated cells to a thousand times;
#: small ones do no harm.
MOST_PACKED, SMALL = 100, 10_000_000
SIZES = ("file_size", "compress_size")
#: Headings by their meaning.
MEANINGS = {
    word: meaning
    for meaning, words in {
        "mode": "mode|mode number|mode no|mode nr|mode #|no|nr|#",
        "frequency_hz": "frequency_hz|frequency|frequency hz|freq|natural frequency|"
        "eigenfrequency|resonance frequency|frequenz|eigenfrequenz",
        "damping_ratio": "damping_ratio|damping ratio|damping|modal damping|viscous damping|zeta|"
        "dämpfung|dämpfungsgrad",
        "frequency_deviation": "frequency_deviation|frequency deviation",
        "shape_deviation": "shape_deviation|shape deviation",
        "node": "node|node number|node id|point|point number|point id|id|knoten|punkt",
        "metres": "metres",
        **{name: name for name in "x y z xx xy xz yx yy yz zx zy zz".split()},
    }.items()
    for word in words.split("|")
}
#: Factors of values by their units.
UNITS = {
    "frequency_hz": {"": 1.0, "hz": 1.0, "khz": 1e3, "rad/s": 0.5 / math.pi},
    **{
        name: {"": 1.0, "-": 1.0, "1": 1.0, "%": 0.01, "percent": 0.01, "% critical": 0.01}
        for name in ("damping_ratio", "frequency_deviation", "shape_deviation")
    },
    "x": {"m": 1.0, "cm": 1e-2, "mm": 1e-3, "in": 0.0254, "inch": 0.0254, "ft": 0.3048},
}


@dataclass(frozen=True, slots=True)
class TableRow:
    """where: file and line, or workbook, sheet and row; fields: stripped, the first a name."""

    where: str
    fields: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class FileTable:
    """name: of the file, and of the sheet where there are sheets."""

    name: str
    rows: tuple[TableRow, ...]

    @property
    def start(self) -> str:
        """Where the table begins, for messages."""
        return self.rows[0].where if self.rows else f"{self.name}, line 1"

    @property
    def first(self) -> str:
        """What its first heading means."""
        return heading(self.rows[0].fields[0])[0] if self.rows else ""


def read_tables(path: Path) -> list[FileTable]:
    """Return the one table of a text, or the table of each sheet. Raises CampaignError."""
    with read_errors(f"test file {path}", CampaignError):
        with open_regular(path) as file:
            zipped = file.read(4) == b"PK\x03\x04"
        tables = _sheets(path) if zipped else [_text_table(path, read_regular(path))]
    for table in tables:
        _check_marks(table)
    return tables


def heading(text: str) -> tuple[str, str]:
    """Return the meaning of a heading, or its plain words, and its unit in lower case."""
    plain = " ".join(text.split()).casefold()
    if plain in MEANINGS or len(plain) > LONGEST_HEADING:
        return MEANINGS.get(plain, plain), ""
    found = _HEADING.fullmatch(plain)
    assert found is not None  # the pattern takes anything
    words = re.sub(r"[\s_.]+", " ", found[1]).strip()
    return MEANINGS.get(words, words), (found[2] or found[3] or "").strip().replace("µ", "u")


def factor(where: str, meaning: str, unit: str, problems: list[str]) -> float:
    """Return the factor of values with such a heading; an unknown unit adds a problem."""
    known = UNITS[meaning]
    if unit not in known:
        there = ", ".join(name for name in known if name)
        problems.append(f"{where}: `{meaning}` has the unit {unit!r}; known are {there}")
    return known.get(unit, math.nan)


def number(text: str) -> float:
    """Return a number with a decimal point or comma; NaN where it is none, or beyond LARGEST."""
    if _NUMBER.fullmatch(text) is None:
        return math.nan
    value = float(text.replace(",", ".").replace("d", "e").replace("D", "e"))
    return value if abs(value) < LARGEST else math.nan


def row_values(row: TableRow, problems: list[str]) -> list[float]:
    """Return the numbers of a row after its name; a field that is none adds a problem."""
    values = [number(field) for field in row.fields[1:]]
    for field, value in zip(row.fields[1:], values, strict=True):
        if math.isnan(value):
            problems.append(f"{row.where}: `{row.fields[0]}` has {field!r} where a number must be")
    return values


def _text_table(path: Path, data: bytes) -> FileTable:
    rows: list[TableRow] = []
    separator, first = "", ""
    for count, line in enumerate(_decoded(path, data).splitlines(), start=1):
        if not line.strip(" \t,;") or line.lstrip().startswith("#"):
            continue
        where = f"{path}, line {count}"
        if not rows and re.fullmatch(r"sep=.", line.strip(), re.IGNORECASE):
            continue  # spreadsheets name the separator here, which other lines show
        if not rows:
            separator = next((mark for mark in SEPARATORS if mark in line), " ")
            first = where
        try:  # line by line, so that no quote can swallow the lines below it
            fields = [
                field.strip()
                for field in (
                    line.split()
                    if separator == " "
                    else next(csv.reader([line.lstrip(" ")], delimiter=separator))
                )
            ]
        except csv.Error as error:
            raise CampaignError(f"{where}: {error}") from error
        other = next((mark for mark in SEPARATORS if mark in line), separator)
        if len(fields) == 1 and other != separator:
            raise CampaignError(
                f"{where}: columns are separated by {other!r}, and by {separator!r} in {first}"
            )
        while len(fields) > 1 and not fields[-1]:  # what spreadsheets add to shorter rows
            fields.pop()
        rows.append(TableRow(where, tuple(fields)))
    return FileTable(str(path), tuple(rows))


def _decoded(path: Path, data: bytes) -> str:
    """Return a text in its encoding. Raises CampaignError where it is not a text."""
    if data.startswith((b"\xff\xfe", b"\xfe\xff")):
        try:
            return data.decode("utf-16")
        except UnicodeDecodeError as error:
            raise CampaignError(f"test file {path} is not a text file: {error}") from error
    found = re.search(rb"[\0-\x08\x0e-\x1b]", data)
    if found is not None:
        count = data.count(b"\n", 0, found.start()) + 1
        raise CampaignError(
            f"test file {path}, line {count}: not a text file: it has the byte "
            f"0x{found.group()[0]:02x}"
        )
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError:
        return data.decode("cp1252", "replace")


def _sheets(path: Path) -> list[FileTable]:
    """Return the sheets of a workbook that hold anything. Raises CampaignError, OSError."""
    from openpyxl import load_workbook
    from openpyxl.utils.exceptions import InvalidFileException

    try:
        with zipfile.ZipFile(path) as archive:
            parts = archive.infolist()
        size, packed = (sum(getattr(item, name) for item in parts) for name in SIZES)
        if size > largest() or size > max(SMALL, MOST_PACKED * packed):
            raise CampaignError(
                f"{path} unpacks from {packed / 1e6:.2g} to {size / 1e6:.0f} MB, more than "
                "measured values do; write them as CSV"
            )
        with open_regular(path) as file, warnings.catch_warnings():
            warnings.simplefilter("ignore")  # a book without styles has its numbers
            book = load_workbook(file, read_only=True, data_only=True)
            tables, room = [], MOST_CELLS
            for sheet in book.worksheets:
                tables.append(_sheet(f"{path}, sheet {sheet.title}", sheet, room))
                room -= sum(len(row.fields) for row in tables[-1].rows)
            return tables
    except (zipfile.BadZipFile, zlib.error, InvalidFileException, ValueError, LookupError,
            TypeError, AttributeError, SyntaxError, EOFError, RuntimeError) as error:  # fmt: skip
        raise CampaignError(f"{path} is not a whole Excel workbook: {error}") from error


def _sheet(name: str, sheet: object, room: int) -> FileTable:
    """Return a sheet of at most `room` cells. Raises CampaignError."""
    rows, cells_read = [], 0
    sheet.reset_dimensions()  # type: ignore[attr-defined]  # the declared size may be wrong
    for count, cells in enumerate(sheet.iter_rows(values_only=True), start=1):  # type: ignore[attr-defined]
        cells_read += 1 + len(cells)
        if cells_read > room:
            raise CampaignError(
                f"{name} has more than {MOST_CELLS / 1e6:.0f} million cells, more than a workbook "
                "is read for; write them as CSV, a universal file or MATLAB"
            )
        fields = [_cell(cell) for cell in cells]
        while fields and not fields[-1]:
            fields.pop()
        if any(fields) and not fields[0].startswith("#"):
            rows.append(TableRow(f"{name}, row {count}", tuple(fields)))
    return FileTable(name, tuple(rows))


def _cell(value: object) -> str:
    """Return a cell as a text: numbers as they are, dates and truth values as they look."""
    if isinstance(value, float) and value.is_integer() and abs(value) < 1e15:
        return str(int(value))
    return "" if value is None else str(value).strip()


def _check_marks(table: FileTable) -> None:
    """Refuse a table with decimal points and commas: 1,234 next to 5.6 may be a thousand."""
    found: dict[str, tuple[str, str]] = {}
    for row in table.rows[1:]:
        for field in row.fields[1:]:
            for mark in ",.":
                if mark in field and _NUMBER.fullmatch(field):
                    found.setdefault(mark, (row.where, field))
        if len(found) == 2:
            (here, one), (there, other) = found.values()
            raise CampaignError(
                f"{there}: {other!r}, and {one!r} in {here}: decimal commas and decimal points in "
                "one table; write one of them, and no marks between thousands"
            )
