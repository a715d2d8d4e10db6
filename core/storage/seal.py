"""The seal of a file of our own: a first block with a checksum of all the rest.

    TITLE              what the file is, and the number of its format
    sha256 DIGEST      of the next line and of all after the block
    HEAD               a line of JSON where the kind of file has one, else empty
    (line ends)        up to the block's end at 512, 1024, 2048, ... bytes
    HDF5               the content; HDF5 leaves the block to its users, so that other programs open
                       the whole file

HDF5 hangs or crashes on some files with a wrong byte, so the seal is looked at before HDF5 is. For
the same reason HDF5 never touches the disk here: files are made and read in memory.
"""

from __future__ import annotations

import hashlib
import io
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import IO

import h5py

from modetune.core.errors import StoreDamaged

#: The least length of the block; HDF5 takes it and its doubles.
BLOCK = 512
#: The longest line that is taken for a title, and for a head.
LONGEST_TITLE, LONGEST_HEAD = 100, 1 << 26


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
def content(data: bytes) -> Iterator[h5py.File]:
    """The HDF5 content of a file whose seal holds. Raises StoreDamaged where that is not HDF5."""
    try:
        file = h5py.File(io.BytesIO(data), "r")
    except (OSError, RuntimeError, ValueError) as error:
        raise StoreDamaged(f"what is sealed is not HDF5: {error}") from error
    with file:
        yield file


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
