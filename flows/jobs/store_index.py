"""An index of a store's entries, so that listing or searching them does not open every file.

    STORE/index/HOST-UID.sqlite    one per machine and user: SQLite is unsafe on network disks

The index is only a cache; the entries themselves are authoritative. A folder of entries is listed
again if its change time differs or is too recent to be reliable; the head of an entry is read on
first use. If the index is missing, has another layout, is damaged, locked or read-only, it is
rebuilt, in memory if necessary, with the same answers.

Entries that differ only in parameter values share one row of the table `asked`.
"""

from __future__ import annotations

import json
import logging
import os
import re
import sqlite3
import time
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager, suppress
from dataclasses import asdict, dataclass, replace
from hashlib import sha256
from pathlib import Path
from typing import Any, Literal, TypeVar
from urllib.parse import quote

import numpy as np

from modetune.core.errors import StorageUnavailable
from modetune.core.storage.files import machine_user, make_folder
from modetune.core.storage.locks import FileLock
from modetune.core.storage.store import FORMAT, Store
from modetune.flows.jobs.job import JobNote
from modetune.flows.jobs.job_description import IN_NOTES, LONGEST, JobDescription, job_of_holding

logger = logging.getLogger(__name__)
A = TypeVar("A")

#: To be increased when the tables or their contents change.
LAYOUT = 2
TABLES = """
CREATE TABLE folders(name TEXT PRIMARY KEY, inode INTEGER, changed_ns INTEGER) WITHOUT ROWID;
CREATE TABLE asked(id INTEGER PRIMARY KEY, solver TEXT, kind TEXT, shared TEXT UNIQUE);
CREATE TABLE entries(key TEXT PRIMARY KEY, folder TEXT, inode INTEGER, size INTEGER,
    written_ns INTEGER, asked INTEGER, wall_s REAL, numbers BLOB) WITHOUT ROWID;
CREATE INDEX by_folder ON entries(folder);
CREATE INDEX by_time ON entries(written_ns);
CREATE INDEX by_asked ON entries(asked);
"""
#: `entries.asked` of an entry with an unreadable head; null before the head is read.
UNREADABLE = 0
#: A folder that changed more recently may change again within one tick of its clock.
SETTLED_NS = 2_000_000_000
#: Seconds to wait for another process before the index is built in memory.
PATIENCE_S = 0.5
#: Errors caused by damaged content.
DAMAGED = (sqlite3.Error, ValueError, TypeError, KeyError, OverflowError)
#: SQLite's integers are signed, those of a file system may be unsigned.
LARGEST = 2**63 - 1
ENDING = f".{FORMAT}.h5"
ENTRY = re.compile(rf"([0-9a-f]{{64}}){re.escape(ENDING)}")


CHOSEN = "WHERE written_ns <= ? AND size >= ?"
Order = Literal["written_ns DESC", "written_ns", "size DESC"]


@dataclass(frozen=True, slots=True)
class EntryFilter:
    """Selects entries written before a time (nanoseconds since 1970) with a minimum size."""

    before_ns: int = LARGEST
    larger: int = 0


@dataclass(frozen=True, slots=True)
class IndexedEntry:
    """An entry of the index; job is None if its head cannot be read."""

    key: str
    size: int
    written_s: float
    wall_s: float
    job: JobDescription | None


def query_index(store: Store, question: Callable[[StoreIndex], A]) -> A:
    """Return a question's answer from the index of a store; a broken index is no error."""
    path = store.folder / "index" / f"{machine_user()}.sqlite"
    with _locked(path) as ours:
        for _ in range(2 if ours else 0):
            try:
                return _answer(f"file:{quote(str(path))}?nolock=1", store, question)
            except DAMAGED as error:
                logger.info("rebuilding %s: %s", path, error)
                for old in (path, Path(f"{path}-journal")):
                    with suppress(OSError):
                        old.unlink()
    return _answer(":memory:", store, question)


@contextmanager
def _locked(path: Path) -> Iterator[bool]:
    """Lock the index on disk; yield whether that was possible."""
    lock, deadline = FileLock(path.with_suffix(".lock")), time.monotonic() + PATIENCE_S
    ours = False
    try:
        if path.parent.parent.is_dir():
            make_folder(path.parent)
            while not (ours := lock.take()) and time.monotonic() < deadline:
                time.sleep(0.01)
    except (OSError, StorageUnavailable) as error:
        logger.info("building the index in memory: %s", error)
    try:
        yield ours
    finally:
        lock.release()


def _answer(place: str, store: Store, question: Callable[[StoreIndex], A]) -> A:
    with closing(sqlite3.connect(place, uri=True, isolation_level=None)) as database:
        database.execute("PRAGMA synchronous = OFF")  # after a power cut it is rebuilt
        index = StoreIndex(store, database)
        index.prepare()
        return question(index)


class StoreIndex:
    """The index of one store, up to date when it was opened."""

    def __init__(self, store: Store, database: sqlite3.Connection) -> None:
        self.store = store
        self._database = database
        self._numbers: dict[str, int] = {}

    def prepare(self) -> None:
        """Make the tables where they are missing, and list the folders that changed."""
        ask, version = self._database.execute, LAYOUT * 1000 + FORMAT
        ((found,),) = ask("PRAGMA user_version").fetchall()
        if found not in (0, version):
            raise sqlite3.DatabaseError("its layout is another")
        if not found:
            self._database.executescript(f"{TABLES} PRAGMA user_version = {version};")
        known = {name: (inode, changed) for name, inode, changed in ask("SELECT * FROM folders")}
        now_ns, folders = time.time_ns(), _folders(self.store.folder)
        with self._transaction():
            for name in known.keys() - folders.keys():
                ask("DELETE FROM entries WHERE folder = ?", (name,))
                ask("DELETE FROM folders WHERE name = ?", (name,))
            for name, status in folders.items():
                seen = (status.st_ino & LARGEST, status.st_ctime_ns)
                if known.get(name) != seen:
                    self._list(name)
                    settled = status.st_ctime_ns < now_ns - SETTLED_NS
                    row = (name, seen[0], seen[1] if settled else 0)
                    ask("INSERT OR REPLACE INTO folders VALUES (?, ?, ?)", row)

    def newest(self, count: int) -> list[IndexedEntry]:
        """Return the newest entries, at most `count`, without unreadable ones."""
        found = self.entries(EntryFilter(), count)
        return [entry for entry in found if entry.job is not None]

    def entries(
        self, chosen: EntryFilter, count: int = -1, order: Order = "written_ns DESC"
    ) -> list[IndexedEntry]:
        """Return at most `count` selected entries in an order; all if it is negative."""
        values = (chosen.before_ns, chosen.larger, count)
        keys = f"SELECT key FROM entries {CHOSEN} ORDER BY {order}, key LIMIT ?"
        self._read_heads(f"key IN ({keys})", values)
        shared: dict[int, JobDescription | None] = {UNREADABLE: None}
        found = []
        rows = self._database.execute(
            "SELECT key, size, written_ns, wall_s, asked, numbers FROM entries "
            f"{CHOSEN} ORDER BY {order}, key LIMIT ?",
            values,
        ).fetchall()
        for key, size, written_ns, wall_s, asked, numbers in rows:
            if asked not in shared:
                query = "SELECT shared FROM asked WHERE id = ?"
                ((text,),) = self._database.execute(query, (asked,)).fetchall()
                shared[asked] = _read_shared_part(text)
            job = shared[asked]
            if job is not None:
                job = replace(job, key=str(key), note=_with_values(job.note, numbers))
            found.append(IndexedEntry(str(key), int(size), written_ns / 1e9, float(wall_s), job))
        return found

    def files(self, chosen: EntryFilter) -> list[tuple[str, int, float]]:
        """Return key, size and time (seconds since 1970) of selected entries, oldest first."""
        rows = self._database.execute(
            f"SELECT key, size, written_ns FROM entries {CHOSEN} ORDER BY written_ns, key",
            (chosen.before_ns, chosen.larger),
        )
        return [(str(key), int(size), written_ns / 1e9) for key, size, written_ns in rows]

    def sums(self) -> list[tuple[JobDescription | None, int, int, float]]:
        """Return job, count, total size and total time of entries that differ only in values; the
        job is None for unreadable entries."""
        self._read_heads("TRUE", ())
        rows = self._database.execute(
            "SELECT shared, COUNT(*), SUM(size), SUM(wall_s) FROM entries "
            "LEFT JOIN asked ON asked.id = entries.asked GROUP BY entries.asked"
        ).fetchall()
        return [
            (_read_shared_part(shared) if shared else None, int(count), int(size), float(wall_s))
            for shared, count, size, wall_s in rows
        ]

    def _list(self, folder: str) -> None:
        """Update the list of entries in a folder."""
        ask = self._database.execute
        known = dict(ask("SELECT key, inode FROM entries WHERE folder = ?", (folder,)).fetchall())
        found: dict[str, tuple[int, ...]] = {}
        with suppress(OSError), os.scandir(self.store.folder / folder) as files:
            for file in files:
                name, inode = file.name, file.inode() & LARGEST
                if name.endswith(ENDING) and known.get(name[: -len(ENDING)]) == inode:
                    found[name[: -len(ENDING)]] = ()  # same inode, same file
                elif match := ENTRY.fullmatch(name):
                    with suppress(OSError):  # gone or not readable
                        status = file.stat()
                        found[match[1]] = (inode, status.st_size, status.st_mtime_ns)
        self._database.executemany(
            "DELETE FROM entries WHERE key = ?", [(key,) for key in known.keys() - found.keys()]
        )
        self._database.executemany(
            "INSERT OR REPLACE INTO entries VALUES (?, ?, ?, ?, ?, NULL, NULL, NULL)",
            [(key, folder, *status) for key, status in found.items() if status],
        )

    def _read_heads(self, chosen: str, values: tuple[int, ...]) -> None:
        """Read the heads of the selected entries that were not read before."""
        query = f"SELECT key FROM entries WHERE asked IS NULL AND {chosen}"
        keys = self._database.execute(query, values).fetchall()
        if not keys:
            return
        with self._transaction():
            for (key,) in keys:
                self._database.execute(
                    "UPDATE entries SET asked = ?, wall_s = ?, numbers = ? WHERE key = ?",
                    (*self._head(key), key),
                )

    def _head(self, key: str) -> tuple[int, float, bytes]:
        """Row of `asked`, time and values of an entry."""
        holding = self.store.holding(key)
        if holding is None:
            return UNREADABLE, 0.0, b""
        job = job_of_holding(holding)
        shared, ask = _shared_part(job), self._database.execute
        if shared not in self._numbers:
            row = (job.solver, job.kind, shared)
            ask("INSERT OR IGNORE INTO asked(solver, kind, shared) VALUES (?, ?, ?)", row)
            ((number,),) = ask("SELECT id FROM asked WHERE shared = ?", (shared,)).fetchall()
            self._numbers[shared] = number
        values = [value for _, value in job.note.values] if job.note else []
        numbers = np.array(values, dtype=np.float64).tobytes()
        return self._numbers[shared], holding.wall_s, numbers

    @contextmanager
    def _transaction(self) -> Iterator[None]:
        self._database.execute("BEGIN")
        yield
        self._database.execute("COMMIT")


def _folders(store: Path) -> dict[str, os.stat_result]:
    found = {}
    with suppress(OSError), os.scandir(store) as items:
        for item in items:
            if re.fullmatch("[0-9a-f]{2}", item.name):
                with suppress(OSError):
                    found[item.name] = item.stat()
    return found


def _shared_part(job: JobDescription) -> str:
    """What entries that differ only in values have in common, as JSON."""
    note = None
    if job.note is not None:
        note = {name: value for name, value in asdict(job.note).items() if name != "values"}
    return json.dumps(
        {
            "solver": job.solver,
            "version": job.solver_version,
            "kind": job.kind,
            "asked": [
                (name, _short(value))
                for name, value in job.asked
                if note is None or name not in IN_NOTES or name == "solver"
            ],
            "note": note,
            "names": [name for name, _ in job.note.values] if job.note else [],
        },
        sort_keys=True,
    )


def _read_shared_part(text: str) -> JobDescription:
    shared: Any = json.loads(text)
    note = None
    if shared["note"] is not None:
        columns = tuple(shared["note"].pop("columns"))
        values = tuple((name, 1.0) for name in shared["names"])
        note = JobNote(**shared["note"], columns=columns, values=values)
    asked = tuple((str(name), str(value)) for name, value in shared["asked"])
    return JobDescription("", shared["solver"], shared["version"], shared["kind"], asked, note)


def _with_values(note: JobNote | None, numbers: bytes) -> JobNote | None:
    if note is None:
        return None
    names, values = (name for name, _ in note.values), np.frombuffer(numbers).tolist()
    return replace(note, values=tuple(zip(names, values, strict=True)))


def _short(value: str) -> str:
    """A part of a key, or the digest of a long one."""
    return value if len(value) <= LONGEST else f"sha256 {sha256(value.encode()).hexdigest()}"
