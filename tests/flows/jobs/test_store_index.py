"""The index of a store: the answers of the entries themselves, whatever became of the index."""

from __future__ import annotations

import errno
import json
import os
import shutil
import signal
import sqlite3
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from modetune.core.storage.files import machine_user
from modetune.core.storage.keys import Json, canonical_json, content_key
from modetune.core.storage.locks import FileLock
from modetune.core.storage.store import Entry, Store
from modetune.core.updating.sensitivity import ModeDerivatives
from modetune.flows.jobs import store_index
from modetune.flows.jobs.job import JobNote
from modetune.flows.jobs.job_description import job_of_holding
from modetune.flows.jobs.store_index import EntryFilter, IndexedEntry, StoreIndex, query_index
from modetune.flows.updating.update import update_campaign
from tests.core.storage.test_locks import without_flock
from tests.core.storage.test_store import holdings

RESULT = ModeDerivatives(np.ones((2, 3)), np.zeros((0, 2, 3)))
COUNT = 40


def put(store: Store, random: np.random.Generator) -> str:
    """Put an entry of one of a few models, analyses and sets of values; its key."""
    names = "abc"[: random.integers(4)]
    values = tuple((name, float(random.integers(8, 12)) / 10) for name in names)
    kind, deck = str(random.choice(["modal", "matrices"])), str(random.choice(["wing", "fin"]))
    n_modes, version = int(random.choice([6, 8])), str(random.choice(["2.20", "2.21"]))
    solver = str(random.choice(["calculix", "nastran"]))
    asked: dict[str, Json] = {
        "deck": f"{random.integers(1 << 62):x}", "n_modes": n_modes, "reader": 3, "solver": solver,
        "groups": list(range(int(random.choice([2, 60])))), "analysis": {"kind": kind},
        "version": version,
    }  # fmt: skip
    note = JobNote(solver, version, deck, deck, kind, values, n_modes, 5, "nodes", (), 1).text()
    if random.uniform() < 0.2:  # as what is computed from results
        asked, note, solver, version = {"jobs": asked["deck"], "kind": kind}, "", "modetune", ""
    text = canonical_json(asked)
    key = content_key(text)
    store.put(Entry(key, RESULT, solver, version, float(random.integers(100))), text, note)
    return key


@pytest.fixture
def store(tmp_path: Path) -> Store:
    random = np.random.default_rng(3)
    made = Store(tmp_path / "store")
    for _ in range(COUNT):
        put(made, random)
    return made


def index_file(store: Store) -> Path:
    return store.folder / "index" / f"{machine_user()}.sqlite"


def everything(store: Store) -> list[IndexedEntry]:
    return query_index(store, lambda index: index.entries(EntryFilter(), order="written_ns"))


def told(entries: list[IndexedEntry]) -> set[tuple[object, ...]]:
    return {
        (entry.key, entry.size, entry.wall_s, entry.job and entry.job.note) for entry in entries
    }


def test_entries_are_what_stands_before_them(store: Store) -> None:
    expected = {
        (item.key, store.path(item.key).stat().st_size, item.wall_s, job_of_holding(item).note)
        for item in holdings(store)
    }
    assert told(everything(store)) == expected
    assert index_file(store).is_file()
    assert told(everything(store)) == expected  # and from the file


def test_the_newest_come_first(store: Store) -> None:
    for place, holding in enumerate(holdings(store)):
        os.utime(store.path(holding.key), (1e9 + place, 1e9 + place))
    shutil.rmtree(store.folder / "index", ignore_errors=True)
    expected = [holding.key for holding in holdings(store)][-5:][::-1]
    found = query_index(store, lambda index: index.newest(5))
    assert [entry.key for entry in found] == expected
    assert [entry.written_s for entry in found] == [1e9 + COUNT - 1 - place for place in range(5)]


def test_no_entry_is_opened_twice(store: Store, monkeypatch: pytest.MonkeyPatch) -> None:
    everything(store)
    opened: list[str] = []
    honest = Store.holding

    def counted(self: Store, key: str) -> Any:
        opened.append(key)
        return honest(self, key)

    monkeypatch.setattr(Store, "holding", counted)
    everything(store)
    query_index(store, lambda index: (index.newest(5), index.sums()))
    assert opened == []
    key = put(store, np.random.default_rng(99))
    assert key in {entry.key for entry in everything(store)}
    assert opened == [key]


def test_what_is_new_replaced_or_gone_is_seen_at_once(store: Store) -> None:
    before = {entry.key for entry in everything(store)}
    new = put(store, np.random.default_rng(99))
    gone, replaced = sorted(before)[:2]
    store.drop(gone)
    entry, holding = store.get(replaced), store.holding(replaced)
    assert entry is not None
    assert holding is not None
    store.put(
        Entry(replaced, entry.result, entry.solver, entry.solver_version, 777.0),
        holding.asked,
        holding.note,
    )
    after = {entry.key: entry.wall_s for entry in everything(store)}
    assert after.keys() == {*before, new} - {gone}
    assert after[replaced] == 777.0
    shutil.rmtree(store.folder / new[:2])
    assert new not in {entry.key for entry in everything(store)}


def test_entries_that_cannot_be_read_are_listed_but_not_described(store: Store) -> None:
    bad = holdings(store)[0].key
    store.path(bad).write_bytes(b"no entry")
    (found,) = [entry for entry in everything(store) if entry.job is None]
    assert (found.key, found.size) == (bad, len(b"no entry"))
    keys = {entry.key for entry in query_index(store, lambda index: index.newest(COUNT))}
    assert len(keys) == COUNT - 1


def test_entries_of_other_formats_are_not_in_it(store: Store) -> None:
    expected = told(everything(store))
    for name in ("a" * 64 + ".h5", "a" * 64 + ".99.h5", ".x.part"):
        (store.folder / "aa").mkdir(exist_ok=True)
        (store.folder / "aa" / name).write_bytes(b"of another version")
    assert told(everything(store)) == expected


def test_an_index_that_is_damaged_changes_nothing_and_is_made_anew(store: Store) -> None:
    expected, random = told(everything(store)), np.random.default_rng(11)
    file = index_file(store)
    good = file.read_bytes()
    for _ in range(100):
        spoilt = bytearray(good)
        for place in random.integers(0, len(good), int(random.integers(1, 20))):
            spoilt[place] = random.integers(256)
        cut = int(random.integers(1, len(good))) if random.uniform() < 0.2 else len(good)
        file.write_bytes(spoilt[:cut])
        query_index(store, lambda index: (index.newest(5), index.sums()))
        everything(store)
    for junk in (b"", b"no database", good[: len(good) // 2]):
        file.write_bytes(junk)
        assert told(everything(store)) == expected


def test_an_index_of_another_layout_is_made_anew(
    store: Store, monkeypatch: pytest.MonkeyPatch
) -> None:
    expected = told(everything(store))
    monkeypatch.setattr(store_index, "LAYOUT", 77)
    assert told(everything(store)) == expected
    with sqlite3.connect(index_file(store)) as database:
        ((version,),) = database.execute("PRAGMA user_version").fetchall()
    assert version // 1000 == 77


@pytest.mark.parametrize("how", ["held", "a file", "no flock", "no locks at all"])
def test_an_index_that_cannot_be_used_changes_nothing(
    store: Store, monkeypatch: pytest.MonkeyPatch, how: str
) -> None:
    expected = told(everything(store))
    monkeypatch.setattr(store_index, "PATIENCE_S", 0.0)
    with FileLock(index_file(store).with_suffix(".lock")) as lock:
        if how == "held":
            assert lock.take()
        elif how == "a file":
            shutil.rmtree(store.folder / "index")
            (store.folder / "index").write_text("")
        elif how == "no flock":
            without_flock(monkeypatch, errno.ENOLCK)
        else:
            without_flock(monkeypatch, errno.EIO)
        assert told(everything(store)) == expected
        put(store, np.random.default_rng(99))
        assert len(everything(store)) == COUNT + 1


KILLED = """
import os, signal, sys
from pathlib import Path
from modetune.core.storage.store import Store
from modetune.flows.jobs.store_index import query_index
def spoil(index):
    ask = index._database.execute
    ask("PRAGMA cache_size = 1")
    ask("BEGIN")
    ask("UPDATE entries SET wall_s = -1, size = -1, numbers = zeroblob(5000)")
    os.kill(os.getpid(), signal.SIGKILL)
query_index(Store(Path(sys.argv[1])), spoil)
"""


def test_a_process_killed_while_it_writes_leaves_what_was_there(store: Store) -> None:
    expected = told(everything(store))
    before = index_file(store).read_bytes()
    ended = subprocess.run([sys.executable, "-c", KILLED, str(store.folder)], check=False)
    assert ended.returncode == -signal.SIGKILL
    assert index_file(store).read_bytes() != before  # half of it was on disk
    assert told(everything(store)) == expected


def test_a_store_that_is_not_there_is_not_made(tmp_path: Path) -> None:
    assert everything(Store(tmp_path / "none")) == []
    assert not (tmp_path / "none").exists()


def test_a_campaign_is_the_same_whatever_its_index_says(bench: Any, watcher: Any) -> None:
    """An index of lies: every entry moved to another key."""
    campaign = bench.campaign({"k1": 1.2, "k2": 0.8})
    first = update_campaign(campaign, bench.folder / "run", watcher, forecast=lambda _: None).record
    everything(campaign.store)

    def lie(index: StoreIndex) -> None:
        index._database.execute("UPDATE entries SET key = substr(key, 2) || '0', wall_s = 1e9")

    query_index(campaign.store, lie)
    runs = bench.runs()
    again = update_campaign(campaign, bench.folder / "run", watcher, forecast=lambda _: None).record
    assert bench.runs() == runs
    np.testing.assert_array_equal(again.updated, first.updated)
    assert json.dumps([item.modal_key for item in again.iterations]) == json.dumps(
        [item.modal_key for item in first.iterations]
    )
