"""Processes killed under campaigns: by matrices, by the solver, in studies, and deployed ones.

Campaigns, screenings and samplings are killed at random moments and run again
(`benchmarks/killed_campaigns`). Deployed ones go in rounds: each starts a worker and a run that is
under way, kills what the round is named for, starts another worker and waits: the run must be known
to have crashed within a minute, its slot be free, the next run that is due start, once, and come to
its end. Where the server alone is killed the run must go on and its end be known. What must hold of
rounds is in tests/flows/server/test_worker.py; the first that does not ends the benchmark.

    python -m benchmarks.kills [--matrices 100] [--solver 100] [--screening 50] [--sampling 50]
                               [--rounds 20] [--seed 1]
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from pathlib import Path

from benchmarks.killed_campaigns import KINDS, Field
from tests.flows.server.test_worker import (
    POSTER,
    RUN,
    SERVER,
    WORKER,
    Site,
    killed_round,
    killed_server_round,
)

#: What is killed at one blow, in turn.
BLOWS = {
    "worker and run": (WORKER, RUN),
    "machine, server elsewhere": (WORKER, RUN, POSTER),
    "machine with its server": (WORKER, RUN, POSTER, *SERVER),
    "server": (),
}


#: Kills of each kind unless told.
COUNTS = {"matrices": 100, "solver": 100, "screening": 50, "sampling": 50}


def main() -> None:
    """Kill, and tell what came of it; ends with code 1 where something is not as it must be."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    for kind in KINDS:
        parser.add_argument(f"--{kind}", type=int, default=COUNTS[kind])
    parser.add_argument("--rounds", type=int, default=20)
    parser.add_argument("--seed", type=int, default=1)
    chosen = parser.parse_args()
    good = True
    with tempfile.TemporaryDirectory(prefix="modetune-kills-") as folder:
        for number, kind in enumerate(KINDS):
            count = getattr(chosen, kind)
            if count:
                good &= killed(kind, count, Path(folder) / kind, chosen.seed + number)
        if chosen.rounds:
            rounds(chosen.rounds, Path(folder) / "site")
    sys.exit(0 if good else 1)


def killed(kind: str, count: int, folder: Path, seed: int) -> bool:
    """Kill campaigns of a kind so many times; whether all was as it must be."""
    began = time.monotonic()
    folder.mkdir()
    found = Field(folder, seed).kill(kind, count)
    blows = ", ".join(f"{name} {times}" for name, times in sorted(found.blows.items()))
    differ = ", ".join(sorted(set(found.differ))) or "none"
    _tell(
        f"{kind:10}{found.blows.total():4d} kills ({blows}) of {found.campaigns} runs: jobs "
        f"repeated {found.repeated}, orphans {found.orphans}, datasets that differ: {differ}; "
        f"{time.monotonic() - began:.0f} s"
    )
    return found.good


def rounds(count: int, folder: Path) -> None:
    """Rounds of deployed campaigns, a line each. Raises AssertionError."""
    folder.mkdir()
    site = Site(folder)
    try:
        for number in range(count):
            name = list(BLOWS)[number % len(BLOWS)]
            began = time.monotonic()
            if BLOWS[name]:
                known_s = killed_round(site, *BLOWS[name])
            else:
                killed_server_round(site)
                known_s = time.monotonic() - began
            _tell(f"{number + 1:3d}  {name:26}  known after {known_s:5.1f} s")
    finally:
        site.kill(WORKER, RUN, POSTER, *SERVER)


def _tell(line: str) -> None:
    sys.stdout.write(f"{line}\n")
    sys.stdout.flush()


if __name__ == "__main__":
    main()
