"""The files of a store: entries, and what runs left beside them; what may be removed.

Leftovers are what runs that were killed left behind and nobody will use again: half-written files,
folders of jobs that nobody runs any more, files of locks (one that is held stays), indexes of
machines that did not come back. A job that is under way holds its key's lock, so its folder is
never a leftover. Entries of other formats belong to other versions of modetune, and are removed
only when that is asked. A campaign that runs may read any result again, however old: while one does
results stay.
"""

from __future__ import annotations

import os
import re
import shutil
import time
import uuid
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from modetune.core.errors import StorageUnavailable
from modetune.core.storage.files import machine_user, storage_errors
from modetune.core.storage.locks import FileLock
from modetune.core.storage.store import FORMAT, Store
from modetune.flows.jobs.store_index import Chosen, ask_index

What = Literal[
    "result",
    "result of another format",
    "damaged result",
    "failed job",
    "kept job",
    "deck's text",
    "job broken off",
    "half-written file",
    "lock",
    "index of another machine",
]
LEFTOVERS: tuple[What, ...] = (
    "job broken off", "half-written file", "lock", "index of another machine",
)  # fmt: skip
#: A file is written in less.
WRITTEN_S = 3600.0
#: A machine that did not ask for so long does so no more.
FORGOTTEN_S = 30 * 86400.0
#: How the lock begins that a campaign holds while it runs.
CAMPAIGN = "campaign-"
#: What a campaign that runs may read.
READ: tuple[What, ...] = ("result", "deck's text")


@dataclass(frozen=True, slots=True)
class StoreFile:
    """A file or folder of a store; written_s: since 1970; size: in bytes, of all that is in it."""

    what: What
    path: Path
    size: int
    written_s: float

    @property
    def key(self) -> str:
        """The key it belongs to; empty where it has none."""
        start = self.path.name.partition(".")[0]
        return start if re.fullmatch("[0-9a-f]{64}", start) else ""


@contextmanager
def in_use(store: Store) -> Iterator[None]:
    """Results of a store stay for as long as this lasts. Raises StorageUnavailable."""
    lock = FileLock(store.folder / "locks" / f"{CAMPAIGN}{uuid.uuid4().hex}")
    with lock.held(lambda: time.sleep(0.01)):
        try:
            yield
        finally:
            lock.remove()


def campaigns_running(store: Store) -> int:
    """How many campaigns and studies run with a store."""
    found = {path.name.partition(".")[0] for path in _inside(store.folder / "locks")}
    return sum(name.startswith(CAMPAIGN) and not _idle(store, name) for name in found)


def results(store: Store, chosen: Chosen) -> Iterator[StoreFile]:
    """The entries that were chosen, the oldest first."""
    for key, size, written_s in ask_index(store, lambda index: index.files(chosen)):
        yield StoreFile("result", store.path(key), size, written_s)


def beside(store: Store, now_s: float) -> Iterator[StoreFile]:
    """Everything else that a store has."""
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
    for path in _inside(store.folder / "jobs"):
        if path.suffix == ".part":
            if _idle(store, path.stem):
                yield from _file("job broken off", path)
        else:
            yield from _file("failed job" if path.suffix == ".failed" else "kept job", path)
    for path in _inside(store.folder / "locks"):
        yield from _file("lock", path)
    for path in _inside(store.folder / "index"):
        if not path.name.startswith(f"{machine_user()}."):
            yield from _file("index of another machine", path, now_s - FORGOTTEN_S)


def prunable(
    store: Store, now_s: float, older_s: float | None, larger: int | None, formats: bool
) -> list[StoreFile]:
    """What `remove` may be given: leftovers, and what is older and larger than was asked.

    formats: entries of other formats too. Of our own only with an age or a size, and while no
    campaign runs.
    """
    kept = READ if campaigns_running(store) else ()
    before_s = now_s - older_s if older_s is not None else now_s + 1e9
    filtered = older_s is not None or larger is not None
    found: list[StoreFile] = []
    if filtered and "result" not in kept:
        found += results(store, Chosen(int(before_s * 1e9), larger or 0))
    for item in beside(store, now_s):
        asked = formats if item.what == "result of another format" else filtered
        fits = item.written_s <= before_s and item.size >= (larger or 0)
        if item.what in LEFTOVERS or (asked and fits and item.what not in kept):
            found.append(item)
    return found


def files_of(store: Store, key: str) -> list[StoreFile]:
    """All that a store has of one job."""
    jobs, found = store.folder / "jobs", list(_file("result", store.path(key)))
    found += _file("job broken off", jobs / f"{key}.part")
    found += _file("failed job", jobs / f"{key}.failed")
    found += _file("kept job", jobs / key)
    return found + list(_file("damaged result", store.folder / "damaged" / store.path(key).name))


def remove(store: Store, items: Iterable[StoreFile]) -> list[StoreFile]:
    """Remove files; those that were written anew meanwhile, or are in use, stay.

    Those that were removed. Raises StorageUnavailable.
    """
    removed = []
    for item in items:
        with storage_errors(item.path, "ask its owner"):
            if item.what in ("lock", "job broken off"):
                gone = _remove_idle(store, item)
            else:
                gone = _written_s(item.path) == item.written_s and _remove(item.path)
        if gone:
            removed.append(item)
    return removed


def check(store: Store) -> tuple[int, list[Path]]:
    """Read every entry: how many are whole, and those that were damaged and set aside."""
    whole, damaged = 0, []
    for path in store.entries():
        if store.check(path.name.partition(".")[0]):
            whole += 1
        elif (store.folder / "damaged" / path.name).exists():  # else it is gone
            damaged.append(path)
    return whole, damaged


def _remove_idle(store: Store, item: StoreFile) -> bool:
    """Remove what belongs to a job unless it is under way by now."""
    with FileLock(store.folder / "locks" / item.path.name.partition(".")[0]) as lock:
        lock.path.parent.mkdir(exist_ok=True)
        if not lock.take():
            return False
        removed = item.what == "lock" or _remove(item.path)
        lock.remove()
        return removed


def _idle(store: Store, key: str) -> bool:
    """Whether nobody runs the job of a key."""
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


def _file(what: What, path: Path, before_s: float | None = None) -> Iterator[StoreFile]:
    """A file or folder, unless it was written after a time or is gone."""
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
