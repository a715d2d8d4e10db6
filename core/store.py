"""The store: results of solver runs by content key, one HDF5 file each, shared by everybody.

    STORE/ab/abcdef....h5     a result, its checksum, what was asked and a note (JSON)
    STORE/damaged/            entries whose checksum did not hold, set aside
    STORE/locks/KEY           one lock a job under way; the kernel frees it when its holder dies

A file is written aside, flushed to disk and renamed, so an entry is whole or absent. Many
processes and machines may share the folder. Nothing is believed that its checksum denies: a
damaged entry is set aside with a warning and counts as absent.

The checksum is of the whole file and stands in its first block, which HDF5 leaves to its users.
It is looked at before HDF5 is: HDF5 hangs or crashes on some files with a wrong byte. For the same
reason HDF5 never touches the disk here: entries are made and read in memory.
"""

from __future__ import annotations

import errno
import fcntl
import hashlib
import io
import logging
import os
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import IO

import h5py

from modetune.core.errors import StorageUnavailable, StoreDamaged
from modetune.core.result_file import read_result, write_result
from modetune.core.results import Result

logger = logging.getLogger(__name__)

FORMAT = 2
#: The first block of an entry: a line that names the format, the checksum of all after the block.
BLOCK = 512
SEAL = b"modetune store entry 2\nsha256 "
#: What the system says where a folder may not be written, or is a file.
REFUSED = (errno.EACCES, errno.EPERM, errno.EROFS, errno.ENOTDIR, errno.EEXIST, errno.EISDIR)
#: What it says of a disk or a share that does not work, and of a file larger than it takes.
BROKEN = (errno.EIO, errno.ESTALE, errno.EFBIG)


@dataclass(frozen=True, slots=True)
class Entry:
    """A stored result with what it cost and who computed it."""

    key: str
    result: Result
    solver: str
    solver_version: str
    wall_s: float


@dataclass(frozen=True, slots=True)
class Store:
    """A folder of results by content key."""

    folder: Path

    def path(self, key: str) -> Path:
        return self.folder / key[:2] / f"{key}.h5"

    def __contains__(self, key: str) -> bool:
        path = self.path(key)
        with storage_errors(path):
            return path.is_file()

    def get(self, key: str) -> Entry | None:
        """The entry of this key, or nothing; a damaged one is set aside and counts as nothing.

        Raises StorageUnavailable where the folder may not be read.
        """
        path = self.path(key)
        try:
            with path.open("rb") as file:
                try:
                    return _read_entry(file.read(), path, key)
                except StoreDamaged as problem:
                    logger.warning("%s; set aside, it will be computed again", problem)
                    self._set_aside(path, os.fstat(file.fileno()).st_ino)
                    return None
        except FileNotFoundError:
            return None
        except PermissionError as error:
            raise StorageUnavailable(f"{path} may not be read; give read permission") from error
        except OSError as error:  # too many files, a stale handle, a bad disk: no word on the entry
            raise StorageUnavailable(f"{path} could not be read: {error}") from error

    def put(self, entry: Entry, asked: str, note: str = "") -> None:
        """Write an entry whole or not at all.

        asked: the canonical JSON behind the key; note: what people are told of it.
        Raises StorageUnavailable on a full disk or without permission.
        """
        image = io.BytesIO()
        with h5py.File(image, "w", userblock_size=BLOCK) as file:
            file.attrs.update(
                format=FORMAT,
                key=entry.key,
                asked=asked,
                solver=entry.solver,
                solver_version=entry.solver_version,
                wall_s=entry.wall_s,
                note=note,
            )
            write_result(file, entry.result)
        content = image.getbuffer()[BLOCK:]
        with writing(self.path(entry.key)) as part, part.open("wb") as written:
            written.write(_seal(content))
            written.write(content)

    def drop(self, key: str) -> None:
        """Remove the entry of this key, if there is one. Raises StorageUnavailable."""
        path = self.path(key)
        with storage_errors(path):
            path.unlink(missing_ok=True)

    @contextmanager
    def lock(self, key: str, waiting: Callable[[], None]) -> Iterator[None]:
        """Hold the job of this key; a second holder, of this or another process, waits.

        waiting: called over and over while another holds it; it sleeps a little, or raises.
        """
        path = self.folder / "locks" / key
        with storage_errors(path):
            path.parent.mkdir(parents=True, exist_ok=True)
            handle = path.open("w")
        with handle:
            while not locked(handle):
                waiting()
            yield

    def _set_aside(self, path: Path, inode: int) -> None:
        """Move a damaged file away, unless another process has put a good one there since."""
        with storage_errors(path):
            target = self.folder / "damaged" / path.name
            target.parent.mkdir(parents=True, exist_ok=True)
            with suppress(FileNotFoundError):  # another process found the same damage
                if path.stat().st_ino != inode:
                    return
                path.replace(target)
                if target.stat().st_ino != inode:  # written between two breaths: back with it
                    target.replace(path)


def locked(handle: IO[str]) -> bool:
    """Take the lock of an open file for this handle alone, unless another has it."""
    with storage_errors(Path(handle.name)):
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            return False
    return True


@contextmanager
def writing(path: Path, remedy: str = "name another place") -> Iterator[Path]:
    """A temporary path beside `path` that takes its place, flushed to disk, when all went well.

    Raises StorageUnavailable on a full disk or without permission; what stood at `path` before
    then still stands there.
    """
    with storage_errors(path, remedy):
        path.parent.mkdir(parents=True, exist_ok=True)
        handle, name = tempfile.mkstemp(dir=path.parent, prefix=".", suffix=".part")
        os.close(handle)
        part = Path(name)
        try:
            yield part
            with part.open("rb") as written:
                os.fsync(written.fileno())
            part.chmod(0o666 & ~_umask())  # mkstemp's files are for their owner only
            part.replace(path)
        finally:
            part.unlink(missing_ok=True)


def check_writable(folder: Path, remedy: str) -> None:
    """Fail now rather than after an hour's solving. Raises StorageUnavailable."""
    with storage_errors(folder / "any", remedy):
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            pass


def _umask() -> int:
    """The process's file mode mask, as the kernel tells it without changing it."""
    try:
        status = Path("/proc/self/status").read_text()
    except OSError:
        return 0o022
    return int(status.partition("Umask:")[2].split(None, 1)[0], 8)


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
    """The file that stands where a folder above a path should be, or nothing."""
    for above in path.parents:
        with suppress(OSError):
            if above.exists():
                return None if above.is_dir() else above
    return None


def _is_of(error: OSError, path: Path) -> bool:
    """Whether an error speaks of a path, a folder above it or a file beside it.

    What goes on inside a job's folder is the job's own: a file that is missing there stays a fault.
    """
    if not isinstance(error.filename, str | os.PathLike):
        return False
    spoken, path = Path(os.fspath(error.filename)).absolute(), path.absolute()
    return path.is_relative_to(spoken) or spoken.parent == path.parent


def _seal(content: memoryview) -> bytes:
    """The first block of an entry whose file goes on with this content."""
    return (SEAL + hashlib.sha256(content).hexdigest().encode()).ljust(BLOCK, b"\n")


def _read_entry(data: bytes, path: Path, key: str) -> Entry:
    """The entry that a file's bytes are. Raises StoreDamaged."""
    if data[:BLOCK] != _seal(memoryview(data)[BLOCK:]):
        raise StoreDamaged(f"the checksum of {path} does not hold")
    try:
        with h5py.File(io.BytesIO(data), "r") as file:
            if file.attrs["key"] != key:
                raise StoreDamaged(f"{path} is the entry of another key")
            return Entry(
                key=key,
                result=read_result(file),
                solver=str(file.attrs["solver"]),
                solver_version=str(file.attrs["solver_version"]),
                wall_s=float(file.attrs["wall_s"]),
            )
    except (OSError, KeyError, RuntimeError, ValueError, TypeError) as error:
        raise StoreDamaged(f"{path} is not a readable store entry ({error})") from error
