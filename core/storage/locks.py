"""Locks of files: one holder at a time, over threads, processes and machines, freed when it dies.

Where the file system has `flock`, the kernel keeps the lock and frees it with its holder. Where it
refuses (NFS without a lock daemon, Lustre mounted without) or the system has none (Windows), a file
FILE.lease says who holds it: host, process, and when that was started. Its holder touches it
regularly; another process takes it over when the holder is gone or, on another machine, has not
touched it for a minute.
"""

from __future__ import annotations

import errno
import io
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING
from uuid import uuid4

from modetune.core.storage.files import is_shared, make_folder, share, storage_errors

try:
    import fcntl

    HAS_FLOCK = True
except ImportError:  # Windows
    HAS_FLOCK = False

if TYPE_CHECKING:
    from filelock import SoftFileLease

#: What the system says where a file system has no flock.
WITHOUT_FLOCK = (errno.ENOLCK, errno.ENOSYS, errno.EOPNOTSUPP)
#: How long another machine waits for a sign of life; the holder gives three in that time.
LEASE_S = 60.0


class FileLock:
    """The lock that belongs to a path, for one holder: not shared between threads."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._handle: io.FileIO | None = None
        self._lease: SoftFileLease | None = None

    def take(self) -> bool:
        """Take the lock unless another has it. Raises StorageUnavailable."""
        with storage_errors(self.path):
            try:
                handle = _opened(self.path)
            except FileNotFoundError:  # another process has just removed it
                return False
            if not HAS_FLOCK:
                handle.close()
                return self._take_lease()
            try:
                fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except OSError as error:
                handle.close()
                if isinstance(error, BlockingIOError):
                    return False
                if error.errno not in WITHOUT_FLOCK:
                    raise
                return self._take_lease()
            if _is_removed(handle):  # since it was opened: the file there now is another's
                handle.close()
                return False
        self._handle = handle
        return True

    def remove(self) -> None:
        """Remove the file of a lock that this one holds; others make a new one."""
        with storage_errors(self.path):
            self.path.unlink(missing_ok=True)

    def release(self) -> None:
        """Let the next one have it."""
        if self._handle is not None:
            self._handle.close()
        if self._lease is not None:
            self._lease.release()

    @contextmanager
    def held(self, waiting: Callable[[], None]) -> Iterator[None]:
        """Hold the lock; `waiting` is called over and over while another does: it sleeps a little,
        or raises. Raises StorageUnavailable."""
        while not self.take():
            waiting()
        with self:
            yield

    def __enter__(self) -> FileLock:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        at: TracebackType | None,
    ) -> None:
        self.release()

    def _take_lease(self) -> bool:
        from filelock import SoftFileLease, Timeout

        if self._lease is None:  # one for all tries: it notices a holder that stopped touching it
            self._lease = SoftFileLease(
                f"{self.path}.lease", lease_duration=LEASE_S, thread_local=False
            )
        for _ in range(2):  # the first try may do no more than clear a dead holder's file away
            try:
                self._lease.acquire(blocking=False)
            except Timeout:
                continue
            with suppress(OSError):
                share(Path(self._lease.lock_file))
            return True
        return False


def _opened(path: Path) -> io.FileIO:
    """Open a lock's file. Raises OSError.

    In a shared folder it appears with its permissions, so another account is never refused.
    """
    make_folder(path.parent)
    if not is_shared(path.parent):
        return io.FileIO(path, "w")
    if not path.exists():
        part = path.with_name(f"{path.name}.{uuid4().hex}")
        part.touch()
        share(part)
        try:
            os.link(part, path)
        except FileExistsError:
            pass
        except OSError:  # a file system without hard links
            path.touch()
        finally:
            part.unlink()
    return io.FileIO(path, "r+")


def _is_removed(handle: io.FileIO) -> bool:
    try:
        return os.fstat(handle.fileno()).st_nlink == 0
    except OSError:  # a share says so of a file that is gone
        return True
