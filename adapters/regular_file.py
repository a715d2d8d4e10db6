"""Files as readers get them: regular ones only, and none that the machine's memory cannot hold.

A pipe would be waited for without end, and a device such as /dev/zero read without end. What is
wrong is an OSError with a sentence (`strerror`), as for a file that is not there.
"""

from __future__ import annotations

import errno
import os
import stat
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO

from modetune.core.machine import physical_memory

#: The share of the machine's memory that one file may take which is read as a whole: what is made
#: of a deck or a table takes some ten times as much as its text.
SHARE = 1 / 16
#: How files are opened: without waiting for a writer, and as bytes on Windows.
OPENED = sum(getattr(os, f"O_{name}", 0) for name in ("RDONLY", "NONBLOCK", "CLOEXEC", "BINARY"))
#: Bytes read at once beyond the size that a file states.
PIECE = 1 << 20


def open_regular(path: Path) -> BinaryIO:
    """Return a regular file opened for reading. Raises OSError, also where it is something else."""
    handle = os.open(path, OPENED)
    kind = os.fstat(handle).st_mode
    if not stat.S_ISREG(kind):
        os.close(handle)
        number = errno.EISDIR if stat.S_ISDIR(kind) else errno.EINVAL
        text = os.strerror(errno.EISDIR) if stat.S_ISDIR(kind) else "it is a pipe or a device"
        raise OSError(number, f"{text}, and a regular file is needed", str(path))
    return os.fdopen(handle, "rb")


@contextmanager
def read_errors(path: Path | str, kind: Callable[[str], Exception]) -> Iterator[None]:
    """Raise an error of this kind where a file cannot be read; path: its name in messages."""
    try:
        yield
    except OSError as error:
        raise kind(f"{path} cannot be read: {error.strerror or error}") from error


def is_file(path: Path) -> bool:
    """Return whether there is a file of a name that a user wrote: names may be too long for one."""
    try:
        return path.is_file()
    except OSError:
        return False


def read_regular(path: Path, most: int | None = None) -> bytes:
    """Read a whole regular file of at most `most` bytes, by default a share of the memory.

    Raises OSError.
    """
    most = largest() if most is None else most
    with open_regular(path) as file:
        size = os.fstat(file.fileno()).st_size
        pieces = [file.read(size + 1)] if size <= most else []
        while pieces and pieces[-1] and size <= most:  # it grew, or has no size (/proc)
            pieces.append(file.read(PIECE))
            size = sum(map(len, pieces))
        if size > most:
            raise OSError(
                errno.EFBIG,
                f"it has more than {most / 1e6:.0f} MB, more than can be read here",
                str(path),
            )
    return b"".join(filter(None, pieces))


def largest(share: float = SHARE) -> int:
    """Return bytes that are a share of the machine's memory."""
    return int(share * physical_memory())
