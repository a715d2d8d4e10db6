"""The files of a store: entries and other files, and which of them may be removed.

Leftovers are files of killed runs that no process will use again: half-written files, folders of
interrupted jobs, unlocked lock files, indexes of machines that have not used the store for a month.
A running job holds its key's lock, so its folder is never a leftover. A lock's file is removed by
its holder while it holds it: a process that waits for it sees that, and makes a new one. Each
campaign that uses the store removes interrupted jobs and locks of dead processes. Entries of
other formats belong to other versions of modetune and are removed only on request. A running
campaign may read any result again, so no result is removed while one runs.

Factorisations too large for memory use a folder of their own, with a lock of the same name:

    STORE/jobs/factors-NAME.part

It is removed with its matrix or when the process ends; after a kill, by the next campaign that uses
the store, at once.
"""

from __future__ import annotations

import os
import re
import shutil
import time
import uuid
import weakref
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Literal

from modetune.core.algebra.mumps import FactorFiles
from modetune.core.errors import StorageUnavailable
from modetune.core.storage.files import WRITTEN_S, machine_user, make_folder, storage_errors
from modetune.core.storage.locks import FileLock
from modetune.core.storage.store import FORMAT, Store
from modetune.flows.jobs.store_index import EntryFilter, query_index

FileKind = Literal[
    "result",
    "result of another format",
    "damaged result",
    "failed job",
    "kept job",
    "deck's text",
    "interrupted job",
    "half-written file",
    "lock",
    "index of another machine",
]
LEFTOVERS: tuple[FileKind, ...] = (
    "interrupted job", "half-written file", "lock", "index of another machine",
)  # fmt: skip
#: Interrupted jobs and unlocked locks older than this are removed when a campaign uses the store.
ABANDONED_S = 86400.0
#: An index that a machine has not used for so long is a leftover.
FORGOTTEN_S = 30 * 86400.0
#: Prefix of the lock that a running campaign holds.
CAMPAIGN = "campaign-"
#: Files that a running campaign may read.
READABLE: tuple[FileKind, ...] = ("result", "deck's text")


@dataclass(frozen=True, slots=True)
class StoreFile:
    """A file or folder of a store: total size in bytes, and its time in seconds since 1970."""

    what: FileKind
    path: Path
    size: int
    written_s: float

    @property
    def key(self) -> str:
        """The key it belongs to, "" without one."""
        start = self.path.name.partition(".")[0]
        return start if re.fullmatch("[0-9a-f]{64}", start) else ""


@contextmanager
def in_use(store: Store) -> Iterator[None]:
    """Protect the results of a store in this context. Raises StorageUnavailable.

    A store that can only be read holds no lock: who may remove results there has other means.
    """
    if store.is_read_only:
        yield
        return
    lock = FileLock(store.folder / "locks" / f"{CAMPAIGN}{uuid.uuid4().hex}")
    with lock.held(lambda: time.sleep(0.01)):
        try:
            yield
        finally:
            lock.remove()


def campaigns_running(store: Store) -> int:
    """Return the number of campaigns and studies that use a store."""
    found = {path.name.partition(".")[0] for path in _inside(store.folder / "locks")}
    return sum(name.startswith(CAMPAIGN) and not _idle(store, name) for name in found)


def results(store: Store, chosen: EntryFilter) -> Iterator[StoreFile]:
    """Yield the selected entries, the oldest first."""
    for key, size, written_s in query_index(store, lambda index: index.files(chosen)):
        yield StoreFile("result", store.path(key), size, written_s)


def other_files(store: Store, now_s: float) -> Iterator[StoreFile]:
    """Yield all files of a store other than entries of this format."""
    for folder in sorted(_inside(store.folder)):
        if re.fullmatch("[0-9a-f]{2}", folder.name):
            for path in _inside(folder):
                if path.name.startswith(".") and path.name.endswith(".part"):
                    yield from _file("half-written file", path, now_s - WRITTEN_S)
                elif re.fullmatch(r"[0-9a-f]{64}\..*h5", path.name) and not path.name.endswith(
                    f".{FORMAT}.h5"
                ):
                    yield from _file("result of another format", path)
    for path in _inside(store.folder / "damaged"):
        yield from _file("damaged result", path)
    for path in _inside(store.folder / "models"):
        yield from _file("deck's text", path)
    yield from _files_of_jobs(store)
    for path in _inside(store.folder / "index"):
        if not path.name.startswith(f"{machine_user()}."):
            yield from _file("index of another machine", path, now_s - FORGOTTEN_S)


def _files_of_jobs(store: Store) -> Iterator[StoreFile]:
    """Yield folders of jobs, without those of running ones, and locks."""
    for path in _inside(store.folder / "jobs"):
        if path.suffix == ".part":
            if _idle(store, path.stem):
                yield from _file("interrupted job", path)
        else:
            yield from _file("failed job" if path.suffix == ".failed" else "kept job", path)
    for path in _inside(store.folder / "locks"):
        yield from _file("lock", path)


def prunable(
    store: Store, now_s: float, older_s: float | None, larger: int | None, formats: bool
) -> list[StoreFile]:
    """Return the files to prune: leftovers, and files older and larger than the given limits.

    formats includes entries of other formats. Entries of this format need an age or size limit, and
    stay while a campaign runs.
    """
    protected = READABLE if campaigns_running(store) else ()
    before_s = now_s - older_s if older_s is not None else now_s + 1e9
    filtered = older_s is not None or larger is not None
    found: list[StoreFile] = []
    if filtered and "result" not in protected:
        found += results(store, EntryFilter(int(before_s * 1e9), larger or 0))
    for item in other_files(store, now_s):
        wanted = formats if item.what == "result of another format" else filtered
        fits = item.written_s <= before_s and item.size >= (larger or 0)
        if item.what in LEFTOVERS or (wanted and fits and item.what not in protected):
            found.append(item)
    return found


def files_of(store: Store, key: str) -> list[StoreFile]:
    """Return all files of one job."""
    jobs, found = store.folder / "jobs", list(_file("result", store.path(key)))
    found += _file("interrupted job", jobs / f"{key}.part")
    found += _file("failed job", jobs / f"{key}.failed")
    found += _file("kept job", jobs / key)
    return found + list(_file("damaged result", store.folder / "damaged" / store.path(key).name))


def remove(store: Store, items: Iterable[StoreFile]) -> list[StoreFile]:
    """Remove files that were not rewritten since and are not in use; return them.

    Raises StorageUnavailable.
    """
    removed = []
    for item in items:
        with storage_errors(item.path, "ask its owner"):
            if item.what in ("lock", "interrupted job"):
                gone = _remove_idle(store, item)
            else:
                gone = _written_s(item.path) == item.written_s and _remove(item.path)
        if gone:
            removed.append(item)
    return removed


def check(store: Store) -> tuple[int, list[Path]]:
    """Read all entries; return the number of valid ones and the damaged ones, now set aside."""
    whole, damaged = 0, []
    for path in store.entries():
        if store.check(path.name.partition(".")[0]):
            whole += 1
        elif (store.folder / "damaged" / path.name).exists():  # else it is gone
            damaged.append(path)
    return whole, damaged


def _remove_idle(store: Store, item: StoreFile) -> bool:
    """Remove a file of a job unless the job is running by now."""
    with FileLock(store.folder / "locks" / item.path.name.partition(".")[0]) as lock:
        if not lock.take():
            return False
        removed = item.path.suffix == ".lease" or _remove(item.path)
        lock.remove()
        return removed


def _idle(store: Store, key: str) -> bool:
    """Whether no process runs the job of a key."""
    path = store.folder / "locks" / key
    if not path.exists() and not path.with_name(f"{key}.lease").exists():
        return True
    try:
        with FileLock(path) as lock:
            return lock.take()
    except StorageUnavailable:  # another user's
        return False


def _remove(path: Path) -> bool:
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)
    return True


def _written_s(path: Path) -> float | None:
    try:
        return path.lstat().st_mtime_ns / 1e9
    except OSError:
        return None


def _file(what: FileKind, path: Path, before_s: float | None = None) -> Iterator[StoreFile]:
    """Yield a file or folder unless it is newer than a time or gone."""
    with suppress(OSError):
        status = path.lstat()
        if before_s is None or status.st_mtime <= before_s:
            size = status.st_size if path.is_file() else sum(_sizes(path))
            yield StoreFile(what, path, size, status.st_mtime_ns / 1e9)


def _sizes(folder: Path) -> Iterator[int]:
    for place, _, names in os.walk(folder):
        for name in names:
            with suppress(OSError):
                yield (Path(place) / name).lstat().st_size


def _inside(folder: Path) -> list[Path]:
    try:
        with os.scandir(folder) as items:
            return [Path(item.path) for item in items]
    except OSError:
        return []


#: Prefix of folders for factors.
PREFIX = "factors-"


def factor_files(store: Store) -> FactorFiles:
    """Create a folder in a store for the factors of one matrix. Raises StorageUnavailable."""
    name = f"{PREFIX}{uuid.uuid4().hex}"
    folder, lock = store.folder / "jobs" / f"{name}.part", FileLock(store.folder / "locks" / name)
    with storage_errors(folder):
        lock.take()  # free, because the name is new
        make_folder(folder)
    files = FactorFiles(folder, partial(_remove_factors, folder, lock))
    weakref.finalize(files, files.remove)  # at the process's end too
    return files


def remove_abandoned(store: Store) -> None:
    """Remove factors of dead processes, and their interrupted jobs and locks after a day."""
    before_s = time.time() - ABANDONED_S
    for item in _files_of_jobs(store):
        old = item.path.name.startswith(PREFIX) or item.written_s < before_s
        if old and item.what in ("interrupted job", "lock"):
            with suppress(StorageUnavailable):  # another user's
                remove(store, [item])


def _remove_factors(folder: Path, lock: FileLock) -> None:
    shutil.rmtree(folder, ignore_errors=True)
    lock.path.unlink(missing_ok=True)
    lock.release()
