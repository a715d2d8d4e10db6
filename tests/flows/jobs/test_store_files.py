"""What may be removed from a store: by age and size, and what killed runs left."""

from __future__ import annotations

import os
import signal
import time
from pathlib import Path

import numpy as np
import pytest

from modetune.core.storage.locks import FileLock
from modetune.core.storage.store import Entry, Store
from modetune.core.updating.sensitivity import ModeDerivatives
from modetune.flows.jobs.store_files import (
    ABANDONED_S,
    campaigns_running,
    check,
    in_use,
    other_files,
    prunable,
    remove,
    remove_abandoned,
)
from tests.core.storage.test_locks import holding

DAY_S = 86400.0
NOW_S = 1.7e9
#: Sizes in thousands of numbers, ages in days.
ENTRIES = {"a": (1, 1), "b": (1, 40), "c": (50, 1), "d": (50, 40)}


def key_of(letter: str) -> str:
    return letter * 64


def aged(path: Path, days: float) -> None:
    os.utime(path, (NOW_S - days * DAY_S,) * 2)


@pytest.fixture
def store(tmp_path: Path) -> Store:
    made = Store(tmp_path / "store")
    for letter, (size, days) in ENTRIES.items():
        noise = np.random.default_rng(1).normal(size=(1000 * size, 1))
        result = ModeDerivatives(noise, np.zeros((0, 1, 1)))
        made.put(Entry(key_of(letter), result, "calculix", "2.20", 1.0), "{}")
        aged(made.path(key_of(letter)), days)
    return made


def names(store: Store, **asked: float) -> list[str]:
    days, larger = asked.get("days"), asked.get("larger")
    items = prunable(
        store,
        NOW_S,
        None if days is None else days * DAY_S,
        None if larger is None else int(larger),
        bool(asked.get("formats")),
    )
    return sorted(f"{item.what} {item.key[:1] or item.path.name}" for item in items)


@pytest.mark.parametrize(
    ("days", "larger", "expected"),
    [(None, None, ""), (30, None, "bd"), (None, 100_000, "cd"), (30, 100_000, "d"), (50, None, "")],
)
def test_results_go_by_age_and_size_and_by_both(
    store: Store, days: float | None, larger: float | None, expected: str
) -> None:
    asked = {"days": days, "larger": larger}
    given = {name: value for name, value in asked.items() if value is not None}
    assert names(store, **given) == [f"result {letter}" for letter in expected]


def test_what_is_removed_is_gone_and_the_rest_is_whole(store: Store) -> None:
    gone = remove(store, prunable(store, NOW_S, 30 * DAY_S, None, False))
    assert {item.key[0] for item in gone} == {"b", "d"}
    assert [key_of(letter) in store for letter in "abcd"] == [True, False, True, False]
    assert check(store) == (2, [])


def test_a_result_written_anew_meanwhile_stays(store: Store) -> None:
    items = prunable(store, NOW_S, 30 * DAY_S, None, False)
    entry = store.get(key_of("b"))
    assert entry is not None
    store.put(entry, "{}")
    assert [item.key[0] for item in remove(store, items)] == ["d"]
    assert key_of("b") in store


def leave(store: Store) -> None:
    """What runs may leave beside results."""
    for name in ("failed", "part"):
        folder = store.folder / "jobs" / f"{key_of('e')}.{name}"
        folder.mkdir(parents=True)
        (folder / "solver.log").write_text("x" * 500)
        aged(folder, 40)
    kept = store.folder / "jobs" / key_of("f")
    kept.mkdir()
    aged(kept, 40)
    for place in ("damaged", "models"):
        (store.folder / place).mkdir()
        file = store.folder / place / f"{key_of('f')}.3.h5"
        file.write_bytes(b"x")
        aged(file, 40)
    for name, days in ((".young.part", 0.0), (".old.part", 1.0)):
        (store.folder / "aa" / name).write_bytes(b"half")
        aged(store.folder / "aa" / name, days)
    other = store.folder / "aa" / f"{key_of('a')}.99.h5"
    other.write_bytes(b"of another version")
    aged(other, 40)


LEFT = ["half-written file .old.part", "interrupted job e"]


def test_without_an_age_only_what_killed_runs_left_goes(store: Store) -> None:
    leave(store)
    assert names(store) == LEFT
    remove(store, prunable(store, NOW_S, None, None, False))
    assert names(store) == []
    found = {item.what for item in other_files(store, NOW_S)}
    assert found == {
        "failed job", "kept job", "damaged result", "deck's text", "result of another format",
    }  # fmt: skip
    assert (store.folder / "aa" / ".young.part").exists()  # somebody may be writing it


def test_other_formats_go_only_when_that_is_asked(store: Store) -> None:
    leave(store)
    beside_results = ["damaged result f", "deck's text f", "failed job e", "kept job f"]
    assert names(store, days=30) == sorted([*LEFT, *beside_results, "result b", "result d"])
    assert "result of another format a" in names(store, days=30, formats=True)
    assert "result of another format a" not in names(store, days=50, formats=True)
    assert names(store, formats=True) == sorted([*LEFT, "result of another format a"])


def test_a_job_that_is_under_way_is_left_alone(store: Store) -> None:
    leave(store)
    (store.folder / "locks").mkdir()
    lock = store.folder / "locks" / key_of("e")
    holder = holding(lock, 0)
    assert names(store) == ["half-written file .old.part", "lock e"]
    gone = remove(store, prunable(store, NOW_S, None, None, False))
    assert [item.what for item in gone] == ["half-written file"]
    holder.send_signal(signal.SIGKILL)
    holder.communicate()
    assert names(store) == ["interrupted job e", "lock e"]
    remove(store, prunable(store, NOW_S, None, None, False))
    assert names(store) == []
    assert not lock.exists()
    with FileLock(lock) as again:
        assert again.take()


def test_a_campaign_removes_what_dead_processes_left_a_day_ago(store: Store) -> None:
    """An old folder of a running job, and leftovers of today, stay."""
    letters = {"e": ABANDONED_S, "f": ABANDONED_S, "a": 0.0}
    for letter, age_s in letters.items():
        for path in (store.folder / "jobs" / f"{key_of(letter)}.part",
                     store.folder / "locks" / key_of(letter)):  # fmt: skip
            path.parent.mkdir(exist_ok=True)
            path.touch()
            os.utime(path, (time.time() - age_s - 60.0,) * 2)
    with FileLock(store.folder / "locks" / key_of("f")) as lock:
        assert lock.take()
        os.utime(lock.path, (time.time() - 2.0 * ABANDONED_S,) * 2)
        remove_abandoned(store)
        left = {path.name for name in ("jobs", "locks") for path in (store.folder / name).iterdir()}
        assert left == {key_of("f"), f"{key_of('f')}.part", key_of("a"), f"{key_of('a')}.part"}


def test_the_check_finds_every_damage_and_sets_it_aside(store: Store) -> None:
    random = np.random.default_rng(2)
    for letter in "bd":
        path = store.path(key_of(letter))
        data = bytearray(path.read_bytes())
        data[int(random.integers(len(data)))] ^= 1
        path.write_bytes(data)
    store.path(key_of("c")).replace(store.path("c" * 63 + "d"))  # under another key
    whole, damaged = check(store)
    assert whole == 1
    assert {path.name[:64] for path in damaged} == {key_of("b"), key_of("d"), "c" * 63 + "d"}
    assert {path.name for path in (store.folder / "damaged").iterdir()} == {
        path.name for path in damaged
    }
    assert check(store) == (1, [])


def test_results_stay_while_a_campaign_runs(store: Store) -> None:
    (store.folder / "damaged").mkdir(exist_ok=True)
    damaged = store.folder / "damaged" / f"{key_of('e')}.1.h5"
    damaged.write_bytes(b"damaged")
    aged(damaged, 40)
    with in_use(store), in_use(store):
        assert campaigns_running(store) == 2
        assert names(store, days=0)[0] == "damaged result e"  # nobody reads it again
        assert not any(name.startswith("result") for name in names(store, days=0))
        gone = remove(store, prunable(store, NOW_S, 0.0, None, False))
        assert {item.what for item in gone} == {"damaged result"}  # the locks are held
        assert campaigns_running(store) == 2
    assert campaigns_running(store) == 0
    assert not list((store.folder / "locks").iterdir())
    assert sum(name.startswith("result") for name in names(store, days=0)) == len(ENTRIES)
