"""The modes in an OP2 file, and the records of any OUTPUT2 file.

An OP2 file is a row of Fortran records, each between two copies of its length in bytes. Records of
one word are marks. A table is its name (mark 2), a trailer of seven words, and numbered records,
each opened by the marks -k, 1 and a type (0 table, else matrix column) and followed by as many
pieces as its length needs, each under a mark with the piece's number of words. Mark 0 in place of
a piece ends the table; mark 0 in place of a name ends the file. Words have 4 or 8 bytes: the very
first record is one word, so its length shows which.

Only tables that are asked for are held in memory; of all others the lengths are walked.

Tables read, each record of results under an identification record (all positions 0-based words):

======  =========================================  ==========================================
table   identification                             data
======  =========================================  ==========================================
LAMA    -                                          mode, order, eigenvalue, radians, cycles,
                                                   generalised mass and stiffness
OUG*,   0 approach, 1 table, 3 subcase, 4 mode,    point, type and six components; word 0 of
OPHIG   5 eigenvalue, 8 format, 9 row length       a row is 10 times the number plus a device
ONRGY1  2 total energy, 5-6 element type           element, energy, percent, density
OGPWG   -                                          M0, S, masses with centres, I(S), I(Q), Q
======  =========================================  ==========================================

The word after the eigenvalue is cycles in one program and radians in another, so no frequency is
read: eigenvalues alone are. Shapes are in the file's own frame, the displacement coordinate
system (CD) of each point. Of several subcases the first that has modes is read.

Source: the DMAP data block descriptions of the programs' programmers' guides; checked against
files of MSC Nastran 2005, 2014 and 2018, Simcenter Nastran 2019 and MYSTRAN 17.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np

from modetune.adapters.nastran.results import (
    ElementEnergies,
    GridShape,
    NastranModes,
    energy_table,
    shape_matrix,
)
from modetune.adapters.regular_file import open_regular
from modetune.core.errors import SolverCrashed
from modetune.core.modes import Floats, Integers


@dataclass(frozen=True, slots=True)
class Record:
    """One record of a table: its pieces in the file's order, and the width of a word."""

    pieces: tuple[bytes, ...]
    word: int

    @property
    def content(self) -> bytes:
        return b"".join(self.pieces)

    def integers(self) -> Integers:
        """All words as integers, (n_words,)."""
        return np.frombuffer(self.content, dtype=f"<i{self.word}").astype(np.int64)

    def floats(self) -> Floats:
        """All words as numbers, (n_words,). Words that hold integers come out as nonsense."""
        with np.errstate(invalid="ignore"):  # an integer may look like a signalling NaN
            return np.frombuffer(self.content, dtype=f"<f{self.word}").astype(np.float64)

    def text(self, first: int, n_words: int) -> str:
        """The text in n_words words from the first (0-based), four characters a word."""
        chosen = self.content[first * self.word : (first + n_words) * self.word]
        words = [chosen[at : at + 4] for at in range(0, len(chosen), self.word)]
        return b"".join(words).decode("latin-1").strip()


@dataclass(frozen=True, slots=True)
class Op2Table:
    """A data block: its name, its seven trailer words, its records after the header."""

    name: str
    trailer: Integers
    records: tuple[Record, ...]


def read_tables(path: Path, wanted: Callable[[str], bool]) -> list[Op2Table]:
    """The tables whose names are wanted, in the file's order, the file walked to its end.

    Raises SolverCrashed, with what was found, for a file that is not a whole OP2 file of this
    machine's byte order.
    """
    try:
        with open_regular(path) as stream:
            return _Reader(stream, path.stat().st_size).tables(wanted)
    except (OSError, _NotWholeError) as error:
        raise SolverCrashed(f"{path} cannot be read as an OP2 file: {error}") from error


class _NotWholeError(Exception):
    """The records do not follow each other as they must."""


class _Reader:
    """Walks the records of an open file."""

    def __init__(self, stream: BinaryIO, size: int) -> None:
        self._stream = stream
        self._size = size
        self._at = 0
        self._word = self._word_width()

    def tables(self, wanted: Callable[[str], bool]) -> list[Op2Table]:
        self._skip_label()
        found = []
        while (mark := self._next_table()) != 0:
            if mark < 0:
                raise _NotWholeError(f"mark {mark} at byte {self._at} where a table's name belongs")
            name = Record((self._record(mark),), self._word).text(0, mark)
            keep = wanted(name)
            trailer, records = self._table(keep)
            if keep:
                found.append(Op2Table(name, trailer, records))
        return found

    def _next_table(self) -> int:
        if self._at == self._size:
            raise _NotWholeError(
                "it ends after a table but without its end mark, as a run leaves it that broke "
                "off (or that had PARAM,POST,-4: use -1)"
            )
        return self._mark()

    def _word_width(self) -> int:
        head = self._stream.read(4)
        self._stream.seek(0)
        if len(head) < 4:
            raise _NotWholeError(f"it has {len(head)} bytes")
        (length,) = struct.unpack("<i", head)
        if length in (4, 8):
            return int(length)
        if struct.unpack(">i", head)[0] in (4, 8):
            raise _NotWholeError(
                "its byte order is big-endian; write it on this kind of machine, or with "
                "FORM=LITTLEEND on its ASSIGN statement"
            )
        raise _NotWholeError(f"its first bytes are {head!r}, not the length of a one-word record")

    def _skip_label(self) -> None:
        """The date and the label before the first table; PARAM,POST,-2 and such leave them out."""
        start = self._at
        if self._mark() != 3:
            self._stream.seek(start)
            self._at = start
            return
        self._record(3)
        while (mark := self._mark()) > 0:
            self._record(mark)
        if mark != -1 or self._mark() != 0:
            raise _NotWholeError("its label does not end as a label does")

    def _table(self, keep: bool) -> tuple[Integers, tuple[Record, ...]]:
        while (mark := self._mark()) > 0:
            self._record(mark)  # MSC 2014 puts its version between name and trailer
        if mark != -1:
            raise _NotWholeError(f"mark {mark} at byte {self._at}, where -1 belongs")
        trailer = Record((self._record(self._mark()),), self._word).integers()
        records: list[Record] = []
        mark, number = self._mark(), 2
        while True:
            if mark != -number:
                raise _NotWholeError(f"mark {mark} at byte {self._at}, where -{number} belongs")
            self._expect(1)
            self._mark()  # 0 in a table, 1 in the column of a matrix
            pieces = []
            while (mark := self._mark()) > 0:
                pieces.append(self._record(mark, keep))
            if mark == 0 and not pieces:
                return trailer, tuple(records[1:])
            if keep:
                records.append(Record(tuple(pieces), self._word))
            number += 1

    def _expect(self, mark: int) -> None:
        found = self._mark()
        if found != mark:
            raise _NotWholeError(f"mark {found} at byte {self._at}, where {mark} belongs")

    def _mark(self) -> int:
        return int.from_bytes(self._block(self._word), "little", signed=True)

    def _record(self, n_words: int, keep: bool = True) -> bytes:
        """A record of n_words, or of one more: a matrix column's row number is not counted."""
        length = self._length()
        if length not in (n_words * self._word, n_words * self._word + self._word):
            raise _NotWholeError(
                f"a record of {length} bytes at byte {self._at}, announced as {n_words} words"
            )
        return self._body(length, keep)

    def _block(self, length: int) -> bytes:
        found = self._length()
        if found != length:
            raise _NotWholeError(
                f"a record of {found} bytes at byte {self._at}, where a mark belongs"
            )
        return self._body(length, True)

    def _length(self) -> int:
        (length,) = struct.unpack("<i", self._read(4))
        # An absurd length must not be asked of the memory.
        if not 0 <= length <= self._size - self._at - 4:
            raise _NotWholeError(
                f"it ends at byte {self._size}, within a record of {length} bytes at byte "
                f"{self._at}: it was cut short or is damaged"
            )
        return int(length)

    def _body(self, length: int, keep: bool) -> bytes:
        if keep:
            body = self._read(length)
        else:
            body = b""
            self._stream.seek(length, 1)
            self._at += length
        (again,) = struct.unpack("<i", self._read(4))
        if again != length:
            raise _NotWholeError(
                f"a record ends with the length {again} and began with {length}, at byte {self._at}"
            )
        return body

    def _read(self, length: int) -> bytes:
        data = self._stream.read(length)
        self._at += len(data)
        if len(data) < length:
            raise _NotWholeError(f"it ends at byte {self._at}, within a record or before its end")
        return data


#: Frames: OUG and OPHIG are in the points' own, the B tables in the basic frame (not read).
EIGENVECTORS = ("OUGV1", "OUG1", "OUGV1PAT", "OUGV2", "OUG2", "OPHIG", "OUGPF1")
EIGENVALUES = ("LAMA", "LAMAS")
STRAIN_ENERGIES = ("ONRGY1", "ONRGY")
MASS_PROPERTIES = ("OGPWG", "OGPWGM")
REAL_MODES = 2
GRID_TYPES = (1, 2)  # grid points and scalar points; harmonic and extra points are not nodes


def read_op2(path: Path) -> NastranModes:
    """Read the modes of an OP2 file.

    Raises SolverCrashed where the file is not whole, holds no real modes, or holds them sorted by
    point (SORT2) or complex.
    """
    names = EIGENVECTORS + EIGENVALUES + STRAIN_ENERGIES + MASS_PROPERTIES
    tables = read_tables(path, lambda name: name in names)
    try:
        return _modes(tables)
    except (ValueError, IndexError, OverflowError) as error:
        raise SolverCrashed(f"{path} holds no modes that can be used: {error}") from error


def _modes(tables: list[Op2Table]) -> NastranModes:
    shapes = _shapes([table for table in tables if table.name in EIGENVECTORS])
    lama = next((table for table in tables if table.name in EIGENVALUES), None)
    rows = np.zeros((0, 7)) if lama is None else _lama(lama)
    if not shapes and not len(rows):
        raise ValueError("it has neither a table of eigenvalues (LAMA) nor of real eigenvectors")
    numbers = [shape.mode for shape in shapes] or rows[:, 0].astype(np.int64).tolist()
    if not len(rows) and numbers != list(range(1, len(numbers) + 1)):
        raise ValueError(f"its modes are numbered {numbers}: some are lost, or were not asked for")
    own = {shape.mode: shape.eigenvalue for shape in shapes}
    listed = {int(row[0]): row for row in rows}
    _agree(own, listed)
    eigenvalues = np.array([listed[n][2] if n in listed else own[n] for n in numbers])
    if not np.isfinite(eigenvalues).all():
        raise ValueError("an eigenvalue is not a finite number")
    nodes, components, mode_shapes = shape_matrix(shapes, len(numbers))
    energies = _energies([table for table in tables if table.name in STRAIN_ENERGIES])
    elements, strain_energies, totals = energy_table(energies, numbers)
    return NastranModes(
        eigenvalues=eigenvalues,
        mode_numbers=np.arange(1, len(numbers) + 1),
        nodes=nodes,
        components=components,
        mode_shapes=mode_shapes,
        generalized_mass=np.array([listed[n][5] if n in listed else np.nan for n in numbers]),
        elements=elements,
        strain_energies=strain_energies,
        total_strain_energy=totals,
        mass=_mass(tables),
    )


def _agree(own: dict[int, float], listed: dict[int, Floats]) -> None:
    """Both places of an eigenvalue hold the same number; single precision has seven digits."""
    largest = max((abs(row[2]) for row in listed.values()), default=0.0)
    for mode, eigenvalue in own.items():
        if mode in listed and not np.isclose(
            listed[mode][2], eigenvalue, rtol=1e-5, atol=1e-9 * largest
        ):
            raise ValueError(
                f"mode {mode} has the eigenvalue {listed[mode][2]:g} in LAMA and {eigenvalue:g} "
                "with its eigenvector"
            )


def _lama(table: Op2Table) -> Floats:
    """Rows of the table of real eigenvalues, (n_modes, 7)."""
    if len(table.records) != 2:
        raise ValueError(f"its table {table.name} has {len(table.records)} records, not 2")
    record = table.records[1]
    rows = record.floats()
    if rows.size % 7 or not rows.size:
        raise ValueError(f"its table {table.name} has {rows.size} words, 7 belong to a mode")
    rows = rows.reshape(-1, 7)
    rows[:, 0] = record.integers().reshape(-1, 7)[:, 0]
    stiffness = rows[:, 2] * rows[:, 5]
    # Single precision; one program writes radians in the place of another's cycles.
    radians = np.abs(rows[:, 3:5]).max(axis=1)
    if not (
        np.allclose(radians**2, np.abs(rows[:, 2]), rtol=1e-4, atol=1e-30)
        and np.allclose(rows[:, 6], stiffness, rtol=1e-4, atol=1e-30)
    ):
        raise ValueError(
            f"its table {table.name} has eigenvalues that its frequencies or generalised "
            "stiffnesses contradict"
        )
    if not np.array_equal(rows[:, 0], np.arange(1, len(rows) + 1)):
        raise ValueError(f"its table {table.name} does not number the modes 1 to {len(rows)}")
    return rows


def _results(tables: list[Op2Table]) -> Iterator[tuple[Op2Table, Record, Record]]:
    """Identification and data records in pairs."""
    for table in tables:
        if len(table.records) % 2:
            raise ValueError(f"its table {table.name} has a record without its data")
        for first in range(0, len(table.records), 2):
            if len(table.records[first].content) < 20 * table.records[first].word:
                raise ValueError(f"its table {table.name} has a short identification record")
            yield table, table.records[first], table.records[first + 1]


def _shapes(tables: list[Op2Table]) -> list[GridShape]:
    """One shape for each mode of the first subcase that has modes."""
    found: dict[int, GridShape] = {}
    wanted: tuple[str, int] | None = None
    for table, head, data in _results(tables):
        words = head.integers()
        if int(words[0]) // 10 != REAL_MODES:
            if int(words[0]) // 10 == 9:
                raise ValueError("its modes are complex; real normal modes (SOL 103) are needed")
            continue
        _check_layout(table.name, words)
        # Several outputs of one subcase (print and plot frames) repeat the modes.
        place = (table.name, int(words[3]))
        wanted = wanted or place
        if place == wanted:
            shape = _shape(table.name, head, data)
            if shape.mode in found:
                raise ValueError(f"mode {shape.mode} occurs twice in its table {table.name}")
            found[shape.mode] = shape
    return list(found.values())


def _check_layout(name: str, words: Integers) -> None:
    if int(words[1]) >= 1000:
        raise ValueError(
            f"its table {name} is sorted by point (SORT2), not by mode: ask for it with SORT1"
        )
    if words[8] not in (0, 1) or words[9] != 8:
        raise ValueError(
            f"its table {name} has rows of {words[9]} words and format {words[8]}: complex "
            "numbers, or none of eigenvectors"
        )


def _shape(name: str, head: Record, data: Record) -> GridShape:
    numbers, values = data.integers(), data.floats()
    if numbers.size % 8 or not numbers.size:
        raise ValueError(f"its table {name} has {numbers.size} words, 8 belong to a point")
    numbers, values = numbers.reshape(-1, 8), values.reshape(-1, 8)
    points = np.isin(numbers[:, 1], GRID_TYPES)
    return GridShape(
        mode=int(head.integers()[4]),
        eigenvalue=float(head.floats()[5]),
        nodes=numbers[points, 0] // 10,
        scalar=numbers[points, 1] == 2,
        values=values[points, 2:],
    )


def _energies(tables: list[Op2Table]) -> list[ElementEnergies]:
    """Tables of element strain energies; kinetic energies (ONRGY2) look the same, by name only."""
    found = []
    subcase: int | None = None
    for table, head, data in _results(tables):
        words = head.integers()
        if int(words[0]) // 10 != REAL_MODES or int(words[1]) >= 1000 or words[9] != 4:
            continue
        subcase = int(words[3]) if subcase is None else subcase
        if int(words[3]) != subcase:
            continue
        numbers, values = data.integers(), data.floats()
        if numbers.size % 4:
            raise ValueError(f"its table {table.name} has {numbers.size} words, 4 belong to a row")
        elements = numbers.reshape(-1, 4)[:, 0] // 10
        real = elements < 100_000_000  # this number is the sum of an element type
        found.append(
            ElementEnergies(
                mode=int(words[4]),
                element_type=head.text(5, 2),
                total=float(head.floats()[2]),
                elements=elements[real],
                energies=values.reshape(-1, 4)[real, 1],
            )
        )
    return found


def _mass(tables: list[Op2Table]) -> float:
    table = next((table for table in tables if table.name in MASS_PROPERTIES), None)
    if table is None or len(table.records) < 2:
        return np.nan
    numbers = table.records[1].floats()
    if numbers.size < 78:
        raise ValueError(f"its table {table.name} has {numbers.size} words, not 78")
    # Behind two matrices: the mass along each axis and its centre.
    return float(numbers[45])
