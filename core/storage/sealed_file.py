"""Sealed files: HDF5 after a first block with its checksum, and records in them.

    TITLE              what the file is, and the number of its format
    sha256 DIGEST      of the next line and of all after the block
    HEAD               a line of JSON where the kind of file has one, else empty
    (line ends)        up to the block's end at 512, 1024, 2048, ... bytes
    HDF5               the content; HDF5 leaves the block to its users, so that other programs open
                       the whole file

HDF5 hangs or crashes on some files with a wrong byte, so the seal is checked before HDF5 sees the
content. For the same reason HDF5 never touches the disk here: files are made and read in memory.

A record is one dataclass in a sealed file, written by the codec. A record of another format is
refused with a sentence that says what to do, unless its kind knows how to bring it up to date.
"""

from __future__ import annotations

import hashlib
import io
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, Generic, TypeVar

import h5py

from modetune.core.errors import CampaignError, StoreDamaged
from modetune.core.storage.codec import read_value, write_value
from modetune.core.storage.files import writing

R = TypeVar("R")

#: The least length of the block; HDF5 takes it and its doubles.
BLOCK = 512
#: The longest line that is taken for a title, and for a head.
LONGEST_TITLE, LONGEST_HEAD = 100, 1 << 26
#: The first bytes of HDF5 without a seal.
HDF5 = b"\x89HDF"


def sealed(title: str, fill: Callable[[h5py.File], None], head: str = "") -> memoryview:
    """The bytes of a file whose content `fill` writes."""
    size = _block_size(title, head)
    image = io.BytesIO()
    with h5py.File(image, "w", userblock_size=size, libver="v110") as file:
        fill(file)
    data = image.getbuffer()
    data[:size] = _block(title, head, data[size:])
    return data


def title_of(data: bytes) -> str:
    """The first line of a file; empty where that is not a title."""
    line = data[:LONGEST_TITLE].partition(b"\n")[0]
    return line.decode("ascii", "replace") if line.isascii() else ""


def holds(data: bytes, title: str) -> bool:
    """Whether a file of this title is, bit for bit, what was written."""
    start = len(title) + len("\nsha256 \n") + 64
    end = data.find(b"\n", start, start + LONGEST_HEAD)
    line = data[start:end] if end >= 0 else b"\xff"
    if not line.isascii():
        return False
    head = line.decode("ascii")
    size = _block_size(title, head)
    return data[:size] == _block(title, head, memoryview(data)[size:])


def read_head(file: IO[bytes], title: str) -> str:
    """The head of a file, unchecked: of a damaged one it is any text, empty where it has none."""
    if file.read(len(title) + 1) != f"{title}\n".encode():
        return ""
    file.readline(LONGEST_TITLE)
    return file.readline(LONGEST_HEAD).decode("ascii", "replace").rstrip("\n")


@contextmanager
def content(data: bytes, mode: str = "r") -> Iterator[h5py.File]:
    """The HDF5 content of a file whose seal holds. Raises StoreDamaged where that is not HDF5.

    mode: "r+" for a copy that may be changed.
    """
    try:
        file = h5py.File(io.BytesIO(data), mode)
    except (OSError, RuntimeError, ValueError) as error:
        raise StoreDamaged(f"what is sealed is not HDF5: {error}") from error
    with file:
        yield file


@dataclass(frozen=True, slots=True)
class RecordFile(Generic[R]):
    """A kind of record: what it is of, its usual file name, and the number of its format.

    The number grows whenever the layout of its dataclasses changes. earlier: by the number of an
    earlier format, a function that changes the content of such a file into the next one's. remedy:
    what to do with a file that cannot be read; by default to run what the record is of again.
    """

    kind: type[R]
    noun: str
    file: str
    format: int
    earlier: Mapping[int, Callable[[h5py.File], None]] = field(default_factory=dict)
    remedy: str = ""

    @property
    def again(self) -> str:
        return self.remedy or f"run the {self.noun} again"

    @property
    def title(self) -> str:
        return f"modetune {self.noun} record "

    @property
    def newest(self) -> str:
        """The title of files that are written."""
        return f"{self.title}{self.format}"

    def sealed(self, record: R) -> memoryview:
        """Return the bytes of a record's file."""
        return sealed(self.newest, lambda file: write_value(file, record))

    def write(self, path: Path, record: R) -> None:
        """Write a record whole or not at all. Raises StorageUnavailable."""
        data = self.sealed(record)
        with writing(path) as part:
            part.write_bytes(data)

    def read(self, path: Path) -> R:
        """The record as it was written. Raises StoreDamaged where the file is not what it was,
        CampaignError where it is not such a record, or of another format.
        """
        what = f"a record of a {self.noun} (the {self.file} in a run folder)"
        if not path.is_file():
            raise CampaignError(f"{path} is not there; a record is the {self.file} in a run folder")
        try:
            data = path.read_bytes()
        except OSError as error:
            raise CampaignError(f"{path} cannot be read: {error.strerror}") from error
        title = title_of(data)
        if data.startswith(HDF5):
            raise CampaignError(
                f"{path} is not {what} of this version: it is HDF5 without a seal, as earlier "
                f"versions of modetune and other programs write it; {self.again}"
            )
        if not title.startswith(self.title):
            raise CampaignError(f"{path} is not {what}, or its beginning is damaged")
        number = title.removeprefix(self.title)
        found = int(number) if number.isdecimal() else 0
        upgrades = [self.earlier.get(n) for n in range(found, self.format)]
        if found > self.format or None in upgrades:
            first = min((self.format, *self.earlier))
            formats = f"{first} to {self.format}" if self.earlier else str(self.format)
            when = "the later" if found > self.format else "the earlier"
            raise CampaignError(
                f"{path} is a {title.removeprefix('modetune ')}, and this version of modetune "
                f"reads format {formats}; use {when} version that wrote it, or {self.again}"
            )
        if not holds(data, title):
            stored = "" if self.remedy else ", for which the store has what was solved"
            raise StoreDamaged(
                f"the checksum of {path} does not hold: the record was damaged or cut short; copy "
                f"it again, or {self.again}{stored}"
            )
        try:
            with content(data, "r+" if upgrades else "r") as file:
                for upgrade in filter(None, upgrades):
                    upgrade(file)
                return read_value(file, self.kind)
        except StoreDamaged as problem:
            raise StoreDamaged(f"{path} is not {what}: {problem}") from problem


def _block_size(title: str, head: str) -> int:
    size = BLOCK
    while size < len(title) + len(head) + len("\nsha256 \n\n") + 64:
        size *= 2
    return size


def _block(title: str, head: str, content: memoryview) -> bytes:
    digest = hashlib.sha256(head.encode("ascii"))
    digest.update(content)
    return f"{title}\nsha256 {digest.hexdigest()}\n{head}".encode("ascii").ljust(
        _block_size(title, head), b"\n"
    )
