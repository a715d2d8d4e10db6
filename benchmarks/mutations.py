"""Tens of thousands of corrupted inputs: how often each reader refuses, and whether any crashes.

File types, mutations and the definition of a fault are those of tests/mutations.py: an exception
that is not modetune's, an empty message, a signal, more than 20 s or 2 GB. Files are read in
separate processes, so that crashes are reported too. Inputs that cause faults are kept as files.

    python -m benchmarks.mutations [--count 1000] [--seed 2] [--kinds campaign OP2]
"""

from __future__ import annotations

import argparse
import logging
import os
import sys
import tempfile
import time
import warnings
from collections import Counter
from pathlib import Path

from tests.mutations import KINDS, mutated, peak_memory, read_all

#: Number of mutations that one process reads.
SLICE = 200


def main() -> None:
    """Mutate every file type and print how reading ended."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--count", type=int, default=1000, help="Of each kind.")
    parser.add_argument("--seed", type=int, default=2)
    parser.add_argument("--kinds", nargs="*", default=list(KINDS), choices=list(KINDS))
    chosen = parser.parse_args()
    total: Counter[str] = Counter()
    for name in chosen.kinds:
        started, count = time.monotonic(), round(KINDS[name].share * chosen.count)
        ends: Counter[str] = Counter()
        for first in range(0, count, SLICE):
            ends += _slice(name, chosen.seed, range(first, min(first + SLICE, count)))
        each_ms = 1e3 * (time.monotonic() - started) / max(1, count)
        sys.stdout.write(f"{name:26} {each_ms:6.2f} ms  {dict(ends)}\n")
        sys.stdout.flush()
        total += ends
    sys.stdout.write(f"{sum(total.values())} readings, {total['fault']} faults\n")
    raise SystemExit(1 if total["fault"] else 0)


def _slice(name: str, seed: int, numbers: range) -> Counter[str]:
    """Return how reading of some mutations ended; print each fault."""
    ends: Counter[str] = Counter()
    folder = Path(tempfile.mkdtemp(prefix="modetune-mutations-"))
    todo = list(numbers)
    while todo:
        told, tell = os.pipe()
        child = os.fork()
        if child == 0:
            os.close(told)
            _read(name, folder, seed, todo, tell)
        os.close(tell)
        with os.fdopen(told) as pipe:
            said = pipe.read().splitlines()
        _, status = os.waitpid(child, 0)
        for line in said:
            ends[line.partition(":")[0]] += 1
            if line.startswith("fault"):
                sys.stdout.write(f"{name:26} {line}\n")
        todo = todo[len(said) :]
        if todo and os.waitstatus_to_exitcode(status) != 0:
            kept = folder / f"fault-{seed}-{todo[0]}"
            kept.write_bytes(mutated_file(name, seed, todo[0]))
            code = os.waitstatus_to_exitcode(status)
            sys.stdout.write(f"{name:26} fault: ended with {code}, kept as {kept}\n")
            ends["fault"] += 1
            todo = todo[1:]
    return ends


def mutated_file(name: str, seed: int, number: int) -> bytes:
    """A mutation of a kind by its number."""
    import numpy as np

    return mutated(KINDS[name].good, np.random.default_rng([seed, number]))


def _read(name: str, folder: Path, seed: int, numbers: list[int], tell: int) -> None:
    """Print one line for each reading; runs in a separate process."""
    logging.disable(logging.CRITICAL)
    warnings.simplefilter("error")  # as in the tests
    os.nice(5)
    with os.fdopen(tell, "w", buffering=1) as out:
        for number in numbers:
            try:
                ends = read_all(KINDS[name], folder / "input", seed, [number])
                line = next(iter(ends), "same")
                if line == "read" and not KINDS[name].believed:
                    line = f"fault: believed mutation {number}"
            except BaseException as fault:  # a panic of a library's is not an Exception
                said = " ".join(str(fault).split())[:200]
                line = f"fault: {type(fault).__name__}: {said} {' '.join(fault.__notes__)}"
            out.write(f"{line.replace('no sentence', 'fault: no sentence')}\n")
    assert peak_memory()
    os._exit(0)


if __name__ == "__main__":
    main()
