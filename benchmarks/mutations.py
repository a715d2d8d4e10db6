"""Spoilt input by the ten thousand: how often each reader refuses, and whether any breaks.

The kinds, the mutations and what counts as broken are those of tests/test_mutations.py. It ends
with the first traceback or hang, and keeps the file that brought it about.

    python -m benchmarks.mutations [--count 10000] [--seed 2] [--kinds campaign OP2]
"""

from __future__ import annotations

import argparse
import logging
import sys
import tempfile
import time
import warnings
from pathlib import Path

from tests.test_mutations import KINDS, read_all


def main() -> None:
    """Mutate every kind and tell how the readings ended."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--count", type=int, default=10_000)
    parser.add_argument("--seed", type=int, default=2)
    parser.add_argument("--kinds", nargs="*", default=list(KINDS), choices=list(KINDS))
    parser.add_argument("--go-on", action="store_true", help="Tell faults and go on.")
    chosen = parser.parse_args()
    logging.disable(logging.CRITICAL)
    warnings.simplefilter("error")  # as in the tests
    broken = 0
    for name in chosen.kinds:
        folder = Path(tempfile.mkdtemp(prefix="modetune-mutations-"))
        started = time.monotonic()
        try:
            ends = dict(read_all(KINDS[name], folder / "input", chosen.seed, chosen.count))
        except BaseException as fault:  # a panic of a library's is not an Exception
            if not chosen.go_on or isinstance(fault, KeyboardInterrupt):
                raise
            broken += 1
            sys.stdout.write(f"{name:26} {type(fault).__name__}: {fault} {fault.__notes__}\n")
            continue
        each_ms = 1e3 * (time.monotonic() - started) / chosen.count
        sys.stdout.write(f"{name:26} {each_ms:6.2f} ms  {ends}\n")
        sys.stdout.flush()
    raise SystemExit(1 if broken else 0)


if __name__ == "__main__":
    main()
