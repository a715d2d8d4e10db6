"""An index of a store: what stands before its entries, so that nobody opens all of them for it.

    STORE/index/HOST-UID.sqlite    one a machine and user: SQLite does not hold over network disks

It is a cache and never the truth: whether the store has a key, and what an entry is, the entry
itself says. A folder of entries is listed again when its change time is another than it was, or was
too new to tell; an entry's head is read when it is first asked for. An index that is missing, of
another layout, damaged, in use by another process or not ours to write is made anew, in memory
where it cannot be on disk, and gives the same answers.

Entries that differ in parameter values alone share what was asked (`asked`), and have their values
as numbers: a hundred thousand are compared with a job in a fraction of a second.
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
from modetune.core.modes import Floats, Integers
from modetune.core.storage.files import machine_user
from modetune.core.storage.locks import FileLock
from modetune.core.storage.store import FORMAT, Store
from modetune.flows.jobs.explain import SAID_BY_NOTES, SHOWN, AskedJob, asked_of, told_differences
from modetune.flows.jobs.job import JobNote

logger = logging.getLogger(__name__)
A = TypeVar("A")

#: Grows whenever the tables or what is in them changes.
LAYOUT = 1
TABLES = """
CREATE TABLE folders(name TEXT PRIMARY KEY, inode INTEGER, changed_ns INTEGER) WITHOUT ROWID;
CREATE TABLE asked(id INTEGER PRIMARY KEY, solver TEXT, kind TEXT, told TEXT UNIQUE);
CREATE TABLE entries(key TEXT PRIMARY KEY, folder TEXT, inode INTEGER, size INTEGER,
    written_ns INTEGER, asked INTEGER, wall_s REAL, numbers BLOB) WITHOUT ROWID;
CREATE INDEX by_folder ON entries(folder);
CREATE INDEX by_time ON entries(written_ns);
CREATE INDEX by_asked ON entries(asked);
"""
#: `entries.asked` where the head was not read yet is null, and where it cannot be read this.
UNREADABLE = 0
#: A folder that changed so short a time ago may change again within one tick of its clock.
SETTLED_NS = 2_000_000_000
#: How long another process is waited for before the index is made in memory.
PATIENCE_S = 0.5
#: What an index whose content was damaged leads to.
DAMAGED = (sqlite3.Error, ValueError, TypeError, KeyError, OverflowError)
#: SQLite's numbers have a sign; a file's need not.
LARGEST = 2**63 - 1
#: Keys of the nearest entries; more than one in case some are gone.
NEAREST = 5
ENDING = f".{FORMAT}.h5"
ENTRY = re.compile(rf"([0-9a-f]{{64}}){re.escape(ENDING)}")


CHOSEN = "WHERE written_ns <= ? AND size >= ?"
Order = Literal["written_ns DESC", "written_ns", "size DESC"]


@dataclass(frozen=True, slots=True)
class Chosen:
    """Entries written before a time (nanoseconds since 1970), and of at least so many bytes."""

    before_ns: int = LARGEST
    larger: int = 0


@dataclass(frozen=True, slots=True)
class IndexedEntry:
    """An entry as the index knows it; job: None where its head cannot be read."""

    key: str
    size: int
    written_s: float
    wall_s: float
    job: AskedJob | None


def ask_index(store: Store, question: Callable[[StoreIndex], A]) -> A:
    """What a store's index answers to a question; never fails for the index's own sake."""
    path = store.folder / "index" / f"{machine_user()}.sqlite"
    with _locked(path) as ours:
        for _ in range(2 if ours else 0):
            try:
                return _answer(f"file:{quote(str(path))}?nolock=1", store, question)
            except DAMAGED as error:
                logger.info("%s is made anew: %s", path, error)
                for old in (path, Path(f"{path}-journal")):
                    with suppress(OSError):
                        old.unlink()
    return _answer(":memory:", store, question)


@contextmanager
def _locked(path: Path) -> Iterator[bool]:
    """Whether the index on disk is this process's alone for now."""
    lock, deadline = FileLock(path.with_suffix(".lock")), time.monotonic() + PATIENCE_S
    ours = False
    try:
        if path.parent.parent.is_dir():
            path.parent.mkdir(exist_ok=True)
            while not (ours := lock.take()) and time.monotonic() < deadline:
                time.sleep(0.01)
    except (OSError, StorageUnavailable) as error:
        logger.info("the index is made in memory: %s", error)
    try:
        yield ours
    finally:
        lock.release()


def _answer(place: str, store: Store, question: Callable[[StoreIndex], A]) -> A:
    with closing(sqlite3.connect(place, uri=True, isolation_level=None)) as database:
        database.execute("PRAGMA synchronous = OFF")  # what a power cut spoils is made anew
        index = StoreIndex(store, database)
        index.prepare()
        return question(index)


class StoreIndex:
    """The index of one store, up to date when it was opened."""

    def __init__(self, store: Store, database: sqlite3.Connection) -> None:
        self.store = store
        self._database = database
        self._alike: dict[int, tuple[list[str], Integers, Floats]] = {}
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
        """So many of the newest entries, without those whose heads cannot be read."""
        found = self.entries(Chosen(), count)
        return [entry for entry in found if entry.job is not None]

    def entries(
        self, chosen: Chosen, count: int = -1, order: Order = "written_ns DESC"
    ) -> list[IndexedEntry]:
        """So many of the chosen entries in an order; below zero: all of them."""
        values = (chosen.before_ns, chosen.larger, count)
        keys = f"SELECT key FROM entries {CHOSEN} ORDER BY {order}, key LIMIT ?"
        self._read_heads(f"key IN ({keys})", values)
        told: dict[int, AskedJob | None] = {UNREADABLE: None}
        found = []
        rows = self._database.execute(
            "SELECT key, size, written_ns, wall_s, asked, numbers FROM entries "
            f"{CHOSEN} ORDER BY {order}, key LIMIT ?",
            values,
        ).fetchall()
        for key, size, written_ns, wall_s, asked, numbers in rows:
            if asked not in told:
                query = "SELECT told FROM asked WHERE id = ?"
                ((text,),) = self._database.execute(query, (asked,)).fetchall()
                told[asked] = _read_told(text)
            job = told[asked]
            if job is not None:
                job = replace(job, key=str(key), note=_with_values(job.note, numbers))
            found.append(IndexedEntry(str(key), int(size), written_ns / 1e9, float(wall_s), job))
        return found

    def files(self, chosen: Chosen) -> list[tuple[str, int, float]]:
        """Keys, sizes and times (seconds since 1970) of the chosen entries, the oldest first."""
        rows = self._database.execute(
            f"SELECT key, size, written_ns FROM entries {CHOSEN} ORDER BY written_ns, key",
            (chosen.before_ns, chosen.larger),
        )
        return [(str(key), int(size), written_ns / 1e9) for key, size, written_ns in rows]

    def sums(self) -> list[tuple[AskedJob | None, int, int, float]]:
        """What entries that differ in values alone have in common; how many they are, their size
        and what they took. None: heads that cannot be read."""
        self._read_heads("TRUE", ())
        rows = self._database.execute(
            "SELECT told, COUNT(*), SUM(size), SUM(wall_s) FROM entries "
            "LEFT JOIN asked ON asked.id = entries.asked GROUP BY entries.asked"
        ).fetchall()
        return [
            (_read_told(told) if told else None, int(count), int(size), float(wall_s))
            for told, count, size, wall_s in rows
        ]

    def nearest(self, job: AskedJob) -> list[str]:
        """Keys of the entries nearest to a job, the nearest first.

        Nearest are those of the same solver and kind of analysis, then those with the fewest
        differences, then those whose values are closest.
        """
        self._read_heads("TRUE", ())
        ask = self._database.execute
        kinds = ask(
            "SELECT id, solver, kind, told FROM asked WHERE EXISTS "
            "(SELECT 1 FROM entries WHERE asked = id AND key <> ?)",
            (job.key,),
        ).fetchall()
        classes = [(solver != job.solver, kind != job.kind) for _, solver, kind, _ in kinds]
        alike = []
        for place, (number, *_, told) in enumerate(kinds):
            if classes[place] == min(classes):
                alike.append((_differing(job, _read_told(told)), number, json.loads(told)))
        best: list[tuple[int, float, int, str]] = []
        for base, number, told in sorted(alike, key=lambda item: item[:2]):
            if len(best) == NEAREST and base > best[-1][0]:
                break
            names = told["names"] if told["note"] and job.note else None
            best = sorted([*best, *self._closest(job, base, number, names)])[:NEAREST]
        return [key for *_, key in best]

    def _closest(
        self, job: AskedJob, base: int, number: int, names: list[str] | None
    ) -> list[tuple[int, float, int, str]]:
        """Of entries that share what was asked: differences, distance, age and key of the best.

        names: of the values; None where either side's values are not known.
        """
        keys, written, values = self._sharing(number)
        count, distance = np.full(len(keys), base), np.full(len(keys), np.inf)
        if job.note is not None and names is not None:
            ours = dict(job.note.values)
            wanted = np.array([ours.get(name, 1.0) for name in names])
            absent = [value for name, value in ours.items() if name not in names]  # 1 there
            values = values.reshape(len(keys), len(names))
            count = count + (values != wanted).sum(axis=1) + sum(v != 1.0 for v in absent)
            distance = np.abs(values - wanted).sum(axis=1) + sum(abs(v - 1.0) for v in absent)
        # Jobs without a word of difference differ all the same: their keys do.
        count = np.maximum(count, 1)
        best = np.lexsort((-written, distance, count))[: NEAREST + 1]
        return [
            (int(count[row]), float(distance[row]), -int(written[row]), keys[row])
            for row in best
            if keys[row] != job.key
        ]

    def _sharing(self, asked: int) -> tuple[list[str], Integers, Floats]:
        """Keys, age and values of the entries that share what was asked."""
        if asked not in self._alike:
            query = "SELECT key, written_ns, numbers FROM entries WHERE asked = ?"
            rows = self._database.execute(query, (asked,)).fetchall()
            written = np.array([row[1] for row in rows], dtype=np.int64)
            values = np.frombuffer(b"".join(row[2] for row in rows))
            self._alike[asked] = [row[0] for row in rows], written, values
        return self._alike[asked]

    def _list(self, folder: str) -> None:
        """Take over which entries a folder has."""
        ask = self._database.execute
        known = dict(ask("SELECT key, inode FROM entries WHERE folder = ?", (folder,)).fetchall())
        found: dict[str, tuple[int, ...]] = {}
        with suppress(OSError), os.scandir(self.store.folder / folder) as files:
            for file in files:
                name, inode = file.name, file.inode() & LARGEST
                if name.endswith(ENDING) and known.get(name[: -len(ENDING)]) == inode:
                    found[name[: -len(ENDING)]] = ()  # the same file: a new one has its own number
                elif match := ENTRY.fullmatch(name):
                    with suppress(OSError):  # gone, or not ours to see
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
        """Read what stands before the chosen entries, where that was not done yet."""
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
        """What was asked, what it took, and the values, of an entry."""
        holding = self.store.holding(key)
        if holding is None:
            return UNREADABLE, 0.0, b""
        job = asked_of(holding)
        told, ask = _told(job), self._database.execute
        if told not in self._numbers:
            row = (job.solver, job.kind, told)
            ask("INSERT OR IGNORE INTO asked(solver, kind, told) VALUES (?, ?, ?)", row)
            ((number,),) = ask("SELECT id FROM asked WHERE told = ?", (told,)).fetchall()
            self._numbers[told] = number
        values = [value for _, value in job.note.values] if job.note else []
        numbers = np.array(values, dtype=np.float64).tobytes()
        return self._numbers[told], holding.wall_s, numbers

    @contextmanager
    def _transaction(self) -> Iterator[None]:
        self._database.execute("BEGIN")
        yield
        self._database.execute("COMMIT")


def _folders(store: Path) -> dict[str, os.stat_result]:
    """The folders of entries as they are now, by name."""
    found = {}
    with suppress(OSError), os.scandir(store) as items:
        for item in items:
            if re.fullmatch("[0-9a-f]{2}", item.name):
                with suppress(OSError):
                    found[item.name] = item.stat()
    return found


def _told(job: AskedJob) -> str:
    """What entries that differ in values alone have in common, as JSON."""
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
                if note is None or name not in SAID_BY_NOTES or name == "solver"
            ],
            "note": note,
            "names": [name for name, _ in job.note.values] if job.note else [],
        },
        sort_keys=True,
    )


def _read_told(text: str) -> AskedJob:
    told: Any = json.loads(text)
    note = None
    if told["note"] is not None:
        columns = tuple(told["note"].pop("columns"))
        values = tuple((name, 1.0) for name in told["names"])
        note = JobNote(**told["note"], columns=columns, values=values)
    asked = tuple((str(name), str(value)) for name, value in told["asked"])
    return AskedJob("", told["solver"], told["version"], told["kind"], asked, note)


def _with_values(note: JobNote | None, numbers: bytes) -> JobNote | None:
    if note is None:
        return None
    names, values = (name for name, _ in note.values), np.frombuffer(numbers).tolist()
    return replace(note, values=tuple(zip(names, values, strict=True)))


def _differing(job: AskedJob, other: AskedJob) -> int:
    """In how much two jobs differ besides parameter values."""
    if job.note is not None and other.note is not None:
        other = replace(other, note=replace(other.note, values=job.note.values))
    asked = tuple((name, _short(value)) for name, value in job.asked)
    return len(told_differences(replace(job, asked=asked), other))


def _short(value: str) -> str:
    """A part of a key, or what stands for a long one."""
    return value if len(value) <= SHOWN else f"sha256 {sha256(value.encode()).hexdigest()}"
