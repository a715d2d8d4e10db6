"""100,000 mutations of the files that users hand over: how each reader ends, and whether any fails.

Kinds of files, their mutations and limits are those of tests/mutations.py. A fault is an exception
that is not modetune's, an empty message, a signal, more than 5 s of processor time or 500 MB of
memory. Files are read in separate processes, so that crashes are reported too, and those that cause
faults are kept. A journal has the finished pieces: an interrupted benchmark goes on, the next one
has other mutations.

    python -m benchmarks.mutations [--count 100000] [--seed 2] [--kinds campaign OP2] [--jobs 2]
"""

from __future__ import annotations

import argparse
import logging
import os
import resource
import shutil
import sys
import tempfile
import time
import warnings
from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from benchmarks.journal import FOLDER, Journal
from tests.mutations import KINDS, mutation, read_all

#: Mutations that one process reads.
SLICE = 100
#: No reading may ask for more room in memory than this, bytes.
MOST_ROOM = 8 << 30


def main() -> None:
    """Read mutations of every file type and print how reading ended."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--count", type=int, default=100_000, help="Of all kinds together.")
    parser.add_argument("--seed", type=int, help="Default: another one after each whole run.")
    parser.add_argument("--kinds", nargs="*", default=list(KINDS), choices=list(KINDS))
    parser.add_argument("--jobs", type=int, default=1, help="Processes that read in parallel.")
    parser.add_argument("--journal", type=Path, default=FOLDER / "mutations.jsonl")
    chosen = parser.parse_args()
    shares = {name: KINDS[name].share for name in chosen.kinds}
    counts = {
        name: round(chosen.count * share / sum(shares.values())) for name, share in shares.items()
    }
    journal = Journal(chosen.journal, {"counts": counts}, chosen.seed)
    faults = chosen.journal.parent / "faults"
    todo = [
        (f"{name} {first}", name, range(first, min(first + SLICE, counts[name])))
        for first in range(0, max(counts.values()), SLICE)
        for name in chosen.kinds
        if first < counts[name] and f"{name} {first}" not in journal.results
    ]
    _tell(f"seed {journal.seed}: {len(journal.results)} pieces done, {len(todo)} to go")
    with ThreadPoolExecutor(chosen.jobs) as pool:
        pieces = pool.map(lambda piece: (piece[0], _piece(journal.seed, *piece[1:], faults)), todo)
        for name, result in pieces:
            journal.add(name, result)
    journal.end()
    raise SystemExit(1 if _show(journal, chosen.kinds) else 0)


def _show(journal: Journal, kinds: list[str]) -> int:
    """Print how reading ended, a line a kind; return the number of faults."""
    total: Counter[str] = Counter()
    for name in kinds:
        pieces = [
            found for piece, found in journal.results.items() if piece.rpartition(" ")[0] == name
        ]
        ends = sum((Counter(found["ends"]) for found in pieces), Counter[str]())
        each_ms = 1e3 * sum(found["wall_s"] for found in pieces) / max(1, ends.total())
        _tell(f"{name:26} {each_ms:7.2f} ms  {dict(ends)}")
        total += ends
    _tell(f"{total.total()} readings, {total['fault']} faults")
    return total["fault"]


def _piece(seed: int, name: str, numbers: range, faults: Path) -> dict[str, object]:
    """Return how reading of some mutations ended; print each fault and keep its files."""
    ends: Counter[str] = Counter()
    todo, began = list(numbers), time.monotonic()
    while todo:
        receiving, sending = os.pipe()
        child = os.fork()
        if child == 0:
            try:
                os.close(receiving)
                _read(name, seed, todo, sending)
                os._exit(0)
            finally:
                os._exit(1)
        os.close(sending)
        with os.fdopen(receiving) as pipe:
            lines = pipe.read().splitlines()
        _, status = os.waitpid(child, 0)
        first, todo = todo[0], todo[len(lines) :]
        if todo and (code := os.waitstatus_to_exitcode(status)):
            lines.append(f"fault: ended with {code}")
            todo = todo[1:]
        for number, line in enumerate(lines, first):
            ends[line.partition(":")[0]] += 1
            if line.startswith("fault"):
                kept = faults / f"{name.replace(' ', '_')}-{seed}-{number}"
                kept.mkdir(parents=True, exist_ok=True)
                for file, data in mutation(KINDS[name], seed, number).items():
                    (kept / file).write_bytes(data)
                _tell(f"{name:26} {line}; kept in {kept}")
    return {"ends": dict(ends), "wall_s": time.monotonic() - began}


def _read(name: str, seed: int, numbers: list[int], sending: int) -> None:
    """Print one line for each reading; runs in a separate process."""
    logging.disable(logging.CRITICAL)
    warnings.simplefilter("error")  # as in the tests
    resource.setrlimit(resource.RLIMIT_AS, (MOST_ROOM, MOST_ROOM))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    os.nice(5)
    folder = Path(tempfile.mkdtemp(prefix="modetune-mutations-"))
    with os.fdopen(sending, "w", buffering=1) as out:
        for number in numbers:
            try:
                ends = read_all(KINDS[name], folder, seed, [number])
                line = next(iter(ends), "same")
                if line == "read" and not KINDS[name].believed:
                    line = "fault: believed"
            except BaseException as fault:  # a panic of a library's is not an Exception
                said = " ".join(str(fault).split())[:200]
                line = f"fault: {type(fault).__name__}: {said}"
            out.write(f"{line.replace('no sentence', 'fault: no sentence')}\n")
    shutil.rmtree(folder, ignore_errors=True)


def _tell(line: str) -> None:
    sys.stdout.write(f"{line}\n")
    sys.stdout.flush()


if __name__ == "__main__":
    main()
