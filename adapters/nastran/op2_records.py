"""The records of an OUTPUT2 file, whatever they hold.

An OP2 file is a row of Fortran records, each between two copies of its length in bytes. Records of
one word are marks. A table is its name (mark 2), a trailer of seven words, and numbered records,
each opened by the marks -k, 1 and a type (0 table, else matrix column) and followed by as many
pieces as its length needs, each under a mark with the piece's number of words. Mark 0 in place of
a piece ends the table; mark 0 in place of a name ends the file. Words have 4 or 8 bytes: the very
first record is one word, so its length tells.

Only tables that are asked for are held in memory; of all others the lengths are walked.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np

from modetune.adapters.regular_file import open_regular
from modetune.core.errors import SolverCrashed
from modetune.core.modes import Floats, Integers


@dataclass(frozen=True, slots=True)
class Record:
    """One record of a table: its pieces, as they stand in the file, and the width of a word."""

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
