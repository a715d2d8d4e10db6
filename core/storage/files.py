"""Files written whole or not at all, and what the system says of a place in words with a remedy."""

from __future__ import annotations

import errno
import io
import os
import re
import shutil
import socket
import stat
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from uuid import uuid4

from modetune.core.errors import StorageUnavailable
from modetune.core.machine import user_label

#: What the system says where a folder may not be written, or is a file.
REFUSED = (errno.EACCES, errno.EPERM, errno.EROFS, errno.ENOTDIR, errno.EEXIST, errno.EISDIR)
#: What it says of a disk or a share that does not work, and of a file larger than it takes.
BROKEN = (errno.EIO, errno.ESTALE, errno.EFBIG)
#: A folder whose content belongs to its group: set-group-ID, and the group may write.
SHARED = stat.S_ISGID | stat.S_IWGRP
#: A half-written file older than this many seconds is a leftover.
WRITTEN_S = 3600.0


@contextmanager
def writing(path: Path, remedy: str = "name another place") -> Iterator[Path]:
    """Yield a temporary path that replaces `path`, flushed to disk, if no error occurs.

    Raises StorageUnavailable on a full disk or without permission; `path` is then unchanged. A
    device or a pipe is written to directly.
    """
    with storage_errors(path, remedy):
        make_folder(path.parent)
        device = path.exists() and not path.is_file()
        folder = Path(tempfile.gettempdir()) if device else path.parent
        part = folder / f".{uuid4().hex}.part"
        part.touch(0o600 if device else 0o666, exist_ok=False)
        if not device:
            share(part)
        try:
            yield part
            with io.FileIO(part) as written:
                os.fsync(written.fileno())
            if device:
                with part.open("rb") as written, path.open("wb") as out:
                    shutil.copyfileobj(written, out)
                return
            part.replace(path)
        finally:
            part.unlink(missing_ok=True)


def is_shared(folder: Path) -> bool:
    """Return whether a folder belongs to a group: set-group-ID, and the group may write."""
    return folder.stat().st_mode & SHARED == SHARED


def share(path: Path) -> None:
    """Let the group of a shared folder read and write a new path in it, whatever the umask.

    Raises OSError.
    """
    if is_shared(path.parent):
        mode = stat.S_IMODE(path.stat().st_mode)
        path.chmod(mode | (SHARED | 0o070 if path.is_dir() else 0o060))


def make_folder(path: Path) -> None:
    """Create a folder and those above it, shared where the one above is. Raises OSError.

    It appears with its permissions, so another account is never refused in between.
    """
    if path.is_dir():
        return
    make_folder(path.parent)
    if not is_shared(path.parent):
        path.mkdir(exist_ok=True)
        return
    part = path.with_name(f".{uuid4().hex}.part")
    part.mkdir()
    share(part)
    try:
        part.rename(path)
    except OSError:
        part.rmdir()
        if not path.is_dir():  # else another process was first
            raise


def remove_parts(folder: Path) -> None:
    """Remove what killed processes have half written, in a folder and in the folders in it."""
    for part in (*folder.glob(".*.part"), *folder.glob("*/.*.part")):
        with suppress(OSError):
            if part.lstat().st_mtime < time.time() - WRITTEN_S:
                shutil.rmtree(part) if part.is_dir() else part.unlink()


def machine_user() -> str:
    """HOST-UID: names what is a machine's and a user's own where several share a folder."""
    host = re.sub(r"[^A-Za-z0-9_.-]", "-", socket.gethostname())
    return f"{host}-{user_label()}"


def check_writable(folder: Path, remedy: str) -> None:
    """Fail now rather than after an hour's solving. Raises StorageUnavailable."""
    with storage_errors(folder / "any", remedy):
        make_folder(folder)
        with tempfile.TemporaryFile(dir=folder):
            pass


@contextmanager
def storage_errors(path: Path, remedy: str = "name another place") -> Iterator[None]:
    """Turn what the operating system says of a folder into a sentence with a remedy."""
    try:
        yield
    except OSError as error:
        if error.errno in (errno.ENOSPC, errno.EDQUOT) or "space left" in str(error):
            raise StorageUnavailable(
                f"the disk that holds {path.parent} is full; nothing stored before was harmed; "
                "free some space and run the same command again: finished jobs are not repeated"
            ) from error
        if error.errno in (errno.ENOTDIR, errno.EEXIST) and (file := _file_in_the_way(path)):
            raise StorageUnavailable(
                f"{file} is a file, and a folder is needed there; move it, or {remedy}"
            ) from error
        if error.errno == errno.EISDIR and path.is_dir():
            raise StorageUnavailable(
                f"{path} is a folder, and a file is needed there; move it, or {remedy}"
            ) from error
        if error.errno in REFUSED:
            raise StorageUnavailable(
                f"{path.parent} cannot be written ({error.strerror}); give write permission, or "
                f"{remedy}"
            ) from error
        if error.errno in BROKEN or _is_of(error, path):
            raise StorageUnavailable(
                f"{path.parent} cannot be written ({error.strerror}); {remedy}"
            ) from error
        if error.errno is None:  # HDF5 reports a failed write without the system's number
            raise StorageUnavailable(f"{path} could not be written: {error}") from error
        raise


def _file_in_the_way(path: Path) -> Path | None:
    """Return the file in place of a folder above a path, or None."""
    for above in path.parents:
        with suppress(OSError):
            if above.exists():
                return None if above.is_dir() else above
    return None


def _is_of(error: OSError, path: Path) -> bool:
    """Return whether an error is about a path, a folder above it or a file next to it.

    Errors inside a job's folder concern the job: a file that is missing there remains a fault.
    """
    if not isinstance(error.filename, str | os.PathLike):
        return False
    spoken, path = Path(os.fspath(error.filename)).absolute(), path.absolute()
    return path.is_relative_to(spoken) or spoken.parent == path.parent
