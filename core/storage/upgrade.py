"""Files of earlier formats, rewritten to the newest one: records, past runs, entries of a store.

Each file is read with its checksum verified, changed in memory, written under another name,
flushed, verified and renamed. So a file is the old one or the new one at any time, whatever is
killed, and a second call continues. A file that cannot be read stays as it is. A record is replaced
while the lock of its run folder is held, an entry while that of its key is; a run that holds it
comes first.
"""

from __future__ import annotations

import os
import re
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from modetune.core.errors import CampaignError, CampaignRunning, StoreDamaged, StoreError
from modetune.core.storage.files import writing
from modetune.core.storage.locks import FileLock
from modetune.core.storage.sealed_file import LONGEST_TITLE, RecordFile, holds, title_of
from modetune.core.storage.store import ENTRY, FORMAT, KIND_OF_FILE, Store

#: The outcome for a file: rewritten (or to be), of the newest format already, left as it is.
State = Literal["upgraded", "newest", "left"]
#: The lock that an update holds in its run folder.
RUN_LOCK = ".lock"
#: How many folders above a record its run folder may be: history/RUN/campaign.h5.
DEPTH = 3
#: Seconds that a lock is waited for: another upgrade holds it for milliseconds.
PATIENCE_S = 1.0


@dataclass(frozen=True, slots=True)
class SealedFile:
    """A file of modetune's, by its first line.

    noun: what it is of; format: the number in its title. state, reason: what was done, and why not
    more.
    """

    path: Path
    noun: str
    format: int
    state: State
    reason: str = ""


def sealed_files(folders: Iterable[Path]) -> Iterator[Path]:
    """Yield the HDF5 files in folders and below, without those that a store has set aside.

    Raises CampaignError for a folder that is not there.
    """
    for folder in folders:
        if folder.is_file():
            yield folder
            continue
        if not folder.is_dir():
            raise CampaignError(f"{folder} is not there; name a folder, a campaign or a file")
        for place, folders_inside, names in os.walk(folder):
            folders_inside[:] = sorted(name for name in folders_inside if name != "damaged")
            yield from (Path(place) / name for name in sorted(names) if name.endswith(".h5"))


def upgrade_file(
    path: Path, kinds: Sequence[RecordFile[Any]], dry_run: bool = False
) -> SealedFile | None:
    """Rewrite a file of an earlier format; None for one that is not modetune's.

    kinds: of records. dry_run: read and verify it, and write nothing.
    """
    if (entry := ENTRY.fullmatch(path.name)) and int(entry["format"]) == FORMAT:
        return SealedFile(path, "store entry", FORMAT, "newest")
    try:
        title = _title(path)
    except FileNotFoundError:  # another process upgraded or removed it
        return None
    except OSError as error:
        return SealedFile(path, "file", 0, "left", f"{path} cannot be read: {error.strerror}")
    found = re.fullmatch(r"modetune (.+) (\d+)", title)
    if found is None:
        return None
    noun, number = found[1], int(found[2])
    kind = next((kind for kind in kinds if title.startswith(kind.title)), None)
    try:
        if title.startswith(KIND_OF_FILE):
            _upgrade_entry(path, number, dry_run)
        elif kind is None:
            raise CampaignError(f"{path} is a {noun}, which this version of modetune does not know")
        elif number == kind.format:
            return SealedFile(path, noun, number, "newest")
        else:
            _upgrade_record(path.resolve() if path.is_symlink() else path, kind, dry_run)
    except FileNotFoundError:
        return None
    except CampaignRunning as problem:
        if not path.exists() or _title(path) != title:  # so has another process
            return None
        return SealedFile(path, noun, number, "left", str(problem))
    except (CampaignError, StoreError) as problem:
        return SealedFile(path, noun, number, "left", str(problem))
    return SealedFile(path, noun, number, "upgraded")


def _title(path: Path) -> str:
    with path.open("rb") as file:
        return title_of(file.read(LONGEST_TITLE))


def _upgrade_record(path: Path, kind: RecordFile[Any], dry_run: bool) -> None:
    """Rewrite a record. Raises CampaignError, StoreDamaged, StorageUnavailable."""
    before = path.stat()
    data = kind.sealed(kind.read(path))
    if dry_run:
        return
    folder = _run_folder(path)
    lock = FileLock(folder / RUN_LOCK)
    new = not lock.path.exists()
    with ExitStack() as held, writing(path, "ask its owner") as part:
        part.write_bytes(data)
        os.utime(part, ns=(before.st_atime_ns, before.st_mtime_ns))
        if not holds(part.read_bytes(), kind.newest):
            raise StoreDamaged(f"{path} was written and is damaged; check the disk")
        held.enter_context(lock.held(_waiting(f"a run is in progress in {folder}")))
        if new:
            held.callback(lock.remove)  # after the record is replaced, before the lock is free
        now = path.stat()
        if (now.st_ino, now.st_mtime_ns) != (before.st_ino, before.st_mtime_ns):
            raise CampaignRunning(f"{path} has been rewritten by another process; try again")


def _run_folder(path: Path) -> Path:
    """Return the folder whose lock an update of a record holds."""
    above = path.parents[:DEPTH]
    return next((folder for folder in above if (folder / RUN_LOCK).exists()), path.parent)


def _upgrade_entry(path: Path, number: int, dry_run: bool) -> None:
    """Rewrite an entry of a store. Raises FileNotFoundError, CampaignError, StoreError."""
    name, store = ENTRY.fullmatch(path.name), Store(path.parent.parent)
    if name is None or store.path(name["key"], number).name != path.name:
        raise CampaignError(f"{path} is a store entry under another name; its key is its name")
    key = name["key"]
    store.read_earlier(key, number)
    if not dry_run:
        lock = FileLock(store.folder / "locks" / key)
        with lock.held(_waiting(f"a run computes the result of {path}")):
            try:
                store.upgrade(key, number)
            finally:
                lock.remove()


def _waiting(reason: str) -> Callable[[], None]:
    """Return what waits for a lock, and raises CampaignRunning where that takes too long."""
    deadline = time.monotonic() + PATIENCE_S

    def wait() -> None:
        if time.monotonic() > deadline:
            raise CampaignRunning(f"{reason}; upgrade after its end")
        time.sleep(0.02)

    return wait
