"""The cost of a large store: forecasts, explanations, lists; and the size of an entry.

N entries are made cheaply, by sealing one result again behind each head, as many campaigns would
leave them: 12 parameters, 4 decks. The queries are those of the commands: to a store without an
index, to one with it, and by reading every entry's head. Then the commands themselves run, each in
a separate process, including its imports.

    python -m benchmarks.store [--entries 100000] [--folder FOLDER]

FOLDER is kept, and used again where it has entries already; else a temporary one.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np

from modetune.core.modes import mode_set
from modetune.core.storage.keys import canonical_json, content_key
from modetune.core.storage.sealed_file import BLOCK, _block, read_head
from modetune.core.storage.store import TITLE, Entry, Store
from modetune.core.updating.job_results import ModalResult
from modetune.flows.jobs.job import JobNote
from modetune.flows.jobs.job_description import JobDescription, job_of_holding
from modetune.flows.jobs.store_index import EntryFilter, StoreIndex, query_index

PARAMETERS, DECKS = 12, ("wing_a", "wing_b", "wing_c", "wing_d")
#: As the commands ask: newest results before a start, and after an iteration.
NEWEST, NEWEST_LATER = 100, 20
#: Entries that an iteration leaves.
ITERATION = 10


def head_of(number: int, random: np.random.Generator) -> dict[str, object]:
    """Return the head of an entry with a unique number."""
    names = [f"E_{place}" for place in range(PARAMETERS)]
    values = tuple(zip(names, (1.0 + 0.01 * random.normal(size=PARAMETERS)).tolist(), strict=True))
    deck = DECKS[number % len(DECKS)]
    asked = canonical_json(
        {"deck": f"{number:064x}", "n_modes": 12, "nodes": list(range(1, 41)), "reader": 3,
         "solver": "calculix", "version": "2.20"}
    )  # fmt: skip
    note = JobNote("calculix", "2.20", deck, deck, "modal", values, 12, 40, "nodes", (), 1)
    return {"key": content_key(asked), "kind": "modal", "asked": asked, "note": note.text(),
            "solver": "calculix", "solver_version": "2.20", "wall_s": 1.5}  # fmt: skip


def fill(store: Store, numbers: range) -> None:
    """Put entries of these numbers into a store, not flushed to disk."""
    random = np.random.default_rng(numbers.start)
    frequencies = np.arange(1.0, 13.0)
    result = ModalResult(
        frequencies**2,
        mode_set(frequencies, random.normal(size=(6, 12)), np.arange(1, 7), np.ones(6)),
        (), np.zeros((0, 12)), np.ones(12), 1.0,
    )  # fmt: skip
    with tempfile.TemporaryDirectory() as folder:
        one = Store(Path(folder))
        one.put(Entry("0" * 64, result, "", "", 0.0), "{}")
        data = one.path("0" * 64).read_bytes()
    content = memoryview(data)[BLOCK:]  # a short head fills one block
    for number in numbers:
        head = head_of(number, random)
        path = store.path(str(head["key"]))
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(_block(TITLE, json.dumps(head), content) + content)


@contextmanager
def timed(what: str) -> Iterator[None]:
    started, before = time.perf_counter(), os.times()
    yield
    wall, after = time.perf_counter() - started, os.times()
    cpu = sum(after[:4]) - sum(before[:4])
    sys.stdout.write(f"{what:50}{1e3 * wall:12.1f}{1e3 * cpu:12.0f}" + "\n")
    sys.stdout.flush()


def ask(what: str, store: Store, question: Callable[[StoreIndex], object]) -> None:
    with timed(what):
        query_index(store, question)


def read_all(store: Store, job: JobDescription) -> None:
    """Read every entry's head, as without an index."""
    for path in store.entries():
        with path.open("rb") as file:
            json.loads(read_head(file, TITLE))


def questions(store: Store, count: int) -> None:
    """Ask what commands ask, without an index and with it."""
    shutil.rmtree(store.folder / "index", ignore_errors=True)
    holding = store.holding(str(head_of(0, np.random.default_rng(0))["key"]))
    assert holding is not None
    job = replace(job_of_holding(holding), key="f" * 64)
    with timed("every entry's head, read"):
        read_all(store, job)
    ask("forecast before a start, no index yet", store, lambda index: index.newest(NEWEST))
    ask("forecast before a start", store, lambda index: index.newest(NEWEST))
    for _ in range(3):
        fill(store, range(count, count + ITERATION))
        count += ITERATION
        ask("forecast after an iteration", store, lambda index: index.newest(NEWEST_LATER))
    ask("a list of all", store, lambda index: index.entries(EntryFilter()))
    with timed("a lookup, 1000 times"):
        for _ in range(1000):
            assert job.key not in store


def commands(store: Store) -> None:
    """Run the commands, each in a separate process; peak: of its memory."""
    key = next(store.entries()).name[:64]
    for command in (
        ["version"],
        ["store", "explain", key[:16], "--store", str(store.folder)],
        ["store", "list", "--store", str(store.folder)],
        ["store", "size", "--store", str(store.folder)],
        ["store", "prune", "--older", "1d", "--dry-run", "--store", str(store.folder)],
        ["store", "check", "--store", str(store.folder)],
    ):
        with timed(f"modetune {' '.join(command[:2])}"):
            subprocess.run(
                [sys.executable, "-m", "modetune", *command],
                check=True, stdout=subprocess.DEVNULL,
            )  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--entries", type=int, default=100_000)
    parser.add_argument("--folder", type=Path)
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        store = Store(given.folder or Path(temporary))
        count = sum(1 for _ in store.entries())
        with timed(f"{max(given.entries - count, 0)} entries made"):
            fill(store, range(count, given.entries))
        sys.stdout.write(f"{'milliseconds':50}{'wall':>12}{'processor':>12}" + "\n")
        questions(store, max(count, given.entries))
        commands(store)


if __name__ == "__main__":
    main()
