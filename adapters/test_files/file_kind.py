"""The kind of a test file, by its first bytes and never by its name.

A name shows an intention, the content shows the file. A form that modetune reads has a `Format`;
any other file gets a description and a remedy.
"""

from __future__ import annotations

import re
import struct
import zipfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from modetune.adapters.regular_file import open_regular, read_errors
from modetune.core.errors import CampaignError
from modetune.core.measurement.measurement import Measurement
from modetune.core.measurement.time_histories import TimeHistories
from modetune.core.modes import ModeSet
from modetune.core.near_names import listed
from modetune.core.storage.sealed_file import title_of

Form = Literal[
    "universal", "table", "workbook", "hdf5", "mat", "op2", "f06", "punch", "frd", "nastran hdf5",
    "", "unknown",
]  # fmt: skip
#: What the axes of a coordinate system are in the matrices of a file that leaves it open.
Axes = Literal["rows", "columns", "auto"]
#: The form that a suffix promises: forms that are written, and what a damaged file was meant to be.
SUFFIXES: dict[str, Form] = {
    ".csv": "table",
    ".h5": "hdf5",
    ".hdf5": "hdf5",
    ".unv": "universal",
    ".uff": "universal",
    ".uf": "universal",
}
#: The title of modetune's own HDF5 (`hdf5.py`).
OWN_TITLE = "modetune test data"
#: Bytes that are examined: a print file has the echo of its deck before the first heading.
START = 1 << 16
HDF5_MARK = b"\x89HDF\r\n\x1a\n"
NUMBERS = "ask for the numbers as a universal file, CSV or an Excel workbook"

#: First bytes of files that nothing reads, what these files are, and the remedy.
BINARY: tuple[tuple[bytes, str, str], ...] = (
    (b"%PDF-", "a PDF document", NUMBERS),
    (b"\x89PNG", "a picture (PNG)", NUMBERS),
    (b"\xff\xd8\xff", "a picture (JPEG)", NUMBERS),
    (b"GIF8", "a picture (GIF)", NUMBERS),
    (b"\xd0\xcf\x11\xe0", "an Office file of before 2007, such as .xls", "save it as .xlsx or CSV"),
    (b"\x1f\x8b", "a file compressed by gzip", "unpack it"),
    (b"BZh", "a file compressed by bzip2", "unpack it"),
    (b"\xfd7zXZ", "a file compressed by xz", "unpack it"),
    (b"7z\xbc\xaf", "a 7z archive", "unpack it"),
    (b"Rar!", "a RAR archive", "unpack it"),
    (b"\x93NUMPY", "an array of NumPy (.npy)", NUMBERS),
    (b"SQLite format 3", "an SQLite database", NUMBERS),
    (b"\x80\x04\x95", "a pickle of Python, which may run anything", NUMBERS),
)
#: Lines near the start of a text, the first that matches: form, pattern, description, remedy.
TEXT: tuple[tuple[Form, str, str, str], ...] = (
    ("universal", r"^ {4}-1[ \t]*\r?\n {0,5}\d{1,5}b?\b|\A\s*-1[ \t]*\r?\n[ \t]*\d{2,4}b?[ \t\r]*$",
     "a universal file", ""),
    ("frd", r"\A {4}1[CU]", "a result file of CalculiX (.frd)", ""),
    ("punch", r"\A(?:\$[^\n]*\n){0,3}\$TITLE   =[^\n]{50,69} \d+[ \r]*$",
     "a punch file of Nastran", ""),
    ("", r"E I G E N V A L U E   (?:O U T P U T|N U M B E R)", "a print file of CalculiX (.dat)",
     "its shapes have no places; name the .frd of the same run"),
    ("f06", r"MYSTRAN Version|^(?![$#*]).{20,}(?:\b[A-Z] ){5}",
     "a print file of Nastran (.f06)", ""),
    ("", r"^(?:CEND|BEGIN\s+BULK|SOL\s+\w+|GRID\*?[\s,])", "a Nastran deck",
     "it is a model; `model.deck` of a campaign names it"),
    ("", r"^\*(?:NODE|ELEMENT|HEADING|INCLUDE|STEP|MATERIAL)\b", "a CalculiX deck",
     "it is a model; `model.deck` of a campaign names it"),
    ("", r"\A\s*<(?:!doctype html|html)", "a web page", NUMBERS),
    ("", r"\A\s*<\?xml", "an XML file", NUMBERS),
    ("", r"\A\{\\rtf", "a text with formats (RTF)", NUMBERS),
    ("", r"\A\s*[{\[]\s*[\"{\[\]}]", "a JSON file", NUMBERS),
    ("", r"^(?:model|test|parameters):", "a campaign file", "name the test's files"),
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class FileKind:
    """What a file is: its form, a description with an article, and a remedy if nothing reads it.

    form: empty for files that nothing reads, `unknown` where the bytes do not show it.
    """

    form: Form
    description: str
    remedy: str = ""


@dataclass(frozen=True, slots=True)
class Format:
    """What can be done with the files of a format; `measurements.FORMATS` has the list.

    read: read one file. read_together: read all files of a test that have this format as one, with
    the names of the datasets of each, and the number of functions in them. read_modes: read all
    modes of a model, rigid ones and rotations too. read_histories: read time histories, with notes.
    """

    read: Callable[[Path, FileKind], Measurement] | None = None
    read_together: (
        Callable[[Sequence[Path], Axes], tuple[Measurement, dict[Path, tuple[str, ...]], int]]
        | None
    ) = None
    read_modes: Callable[[Path, FileKind], ModeSet] | None = None
    read_histories: Callable[[Path, list[str]], list[TimeHistories]] | None = None
    write: Callable[[Path, Measurement], None] | None = None


def kind_of(path: Path) -> FileKind:
    """Return what a file is. Raises CampaignError where it cannot be opened."""
    with read_errors(f"test file {path}", CampaignError), open_regular(path) as file:
        start = file.read(START)
    if not start:
        return FileKind("", "an empty file", "copy or export it again")
    return _binary(path, start) or _text(start)


def _binary(path: Path, start: bytes) -> FileKind | None:
    if title_of(start) == OWN_TITLE:
        return FileKind("hdf5", "a test that modetune wrote as HDF5")
    if start.startswith(b"PK\x03\x04"):
        return _archive(path)
    if start.startswith(b"MATLAB 5.0 MAT-file"):
        return FileKind("mat", "a MATLAB file")
    if any(start[at : at + 8] == HDF5_MARK for at in (0, 512, 1024, 2048, 4096)):
        if start.startswith(b"MATLAB 7.3"):
            return FileKind("mat", "a MATLAB 7.3 file")
        return FileKind("nastran hdf5", "an HDF5 file")
    if _is_op2(start):
        return FileKind("op2", "a result file of Nastran (.op2)")
    if _is_mat_4(start):
        return FileKind("mat", "a MATLAB 4 file")
    for mark, description, remedy in BINARY:
        if start.startswith(mark):
            return FileKind("", description, remedy)
    return None


def _text(start: bytes) -> FileKind:
    marked = start.startswith((b"\xff\xfe", b"\xfe\xff"))
    binary = b"\0" in start and not marked  # of text, universal files alone may have such values
    text = start.decode("utf-16" if marked else "utf-8-sig", "replace")
    for form, pattern, description, remedy in TEXT[: 1 if binary else None]:
        if re.search(pattern, text, re.MULTILINE | (0 if form else re.IGNORECASE)):
            return FileKind(form, description, remedy)
    if binary:
        return FileKind("unknown", "a binary file of an unknown form", NUMBERS)
    return FileKind("table", "a table as text")


def _archive(path: Path) -> FileKind:
    """Return what a ZIP archive is: a workbook, a document, arrays or only an archive."""
    try:
        with zipfile.ZipFile(path) as archive:
            names = archive.namelist()
    except (zipfile.BadZipFile, ValueError, OSError, NotImplementedError):
        return FileKind("", "a ZIP archive or Office file that is cut short", "copy it again")
    if "xl/workbook.xml" in names:
        return FileKind("workbook", "an Excel workbook")
    if "xl/workbook.bin" in names:
        return FileKind("", "a binary Excel workbook (.xlsb)", "save it as .xlsx")
    for part, description in (("word/", "a Word document"), ("ppt/", "a PowerPoint presentation")):
        if any(name.startswith(part) for name in names):
            return FileKind("", description, NUMBERS)
    if "content.xml" in names:
        return FileKind("", "an OpenDocument file", "save it as .xlsx or CSV")
    members = listed(names, 4)
    if names and all(name.endswith(".npy") for name in names):
        return FileKind("", f"an archive of NumPy's arrays ({members})", NUMBERS)
    return FileKind("", f"a ZIP archive of {members or 'nothing'}", "unpack it")


def _is_op2(start: bytes) -> bool:
    """Return whether the first record is one word, a mark, in any byte order."""
    for order in "<>":
        (length,) = struct.unpack(f"{order}i", start[:4]) if len(start) >= 4 else (0,)
        if length in (4, 8) and start[4 + length : 8 + length] == start[:4]:
            return True
    return False


def _is_mat_4(start: bytes) -> bool:
    """Return whether the file starts with the five numbers and the name of a matrix."""
    if len(start) < 24:
        return False
    for order in "<>":
        kind, rows, columns, imaginary, length = struct.unpack(f"{order}5i", start[:20])
        digits = kind // 1000, kind // 100 % 10, kind // 10 % 10, kind % 10
        fits = 0 <= kind < 5000 and digits[1] == 0 and digits[2] <= 5 and digits[3] <= 2
        name = start[20 : 19 + length] if 2 <= length <= 64 else b""
        if (
            fits
            and rows >= 0
            and columns >= 0
            and imaginary in (0, 1)
            and re.fullmatch(rb"[A-Za-z]\w*", name)
        ):
            return True
    return False
