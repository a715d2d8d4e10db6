"""Processes killed under campaigns: by matrices, by the solver, as flows, in studies, deployed.

Campaigns, screenings and samplings are killed at random moments and run again
(`benchmarks/killed_campaigns`). Deployed campaigns are killed in rounds. Each round starts a worker
and a run, kills the processes that the round is named after, starts another worker and waits.
Within a minute the run must be marked as crashed and its slot be free; the next run that is due
must start once and finish. If only the server is killed, the run itself must finish. The first
round that violates a condition ends the benchmark.

    python -m benchmarks.kills [--matrices 100] [--solver 100] [--flow 50] [--screening 50]
                               [--sampling 50] [--studies 45] [--rounds 20] [--seed 1]
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from pathlib import Path

from benchmarks.killed_campaigns import KINDS, Field
from tests.flows.server.site import ENDED, GOOD, RUN, SERVER, WORKER, Site, stop

#: Processes to kill together, in turn.
BLOWS = {
    "run": (RUN,),
    "machine, server elsewhere": (WORKER, RUN),
    "machine with its server": (WORKER, RUN, *SERVER),
    "server": SERVER,
}


#: Default number of kills of each type.
COUNTS = {
    "matrices": 100, "solver": 100, "flow": 50, "screening": 50, "sampling": 50, "studies": 45,
}  # fmt: skip


def main() -> None:
    """Kill campaigns and print the outcomes; exit with code 1 if a condition is violated."""
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
    """Kill campaigns of one type repeatedly; return whether all conditions held."""
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
            known_s = killed_round(site, *BLOWS[name])
            _tell(f"{number + 1:3d}  {name:26}  known after {known_s:5.1f} s")
    finally:
        site.resume()
        site.kill(WORKER, RUN, *SERVER)


def killed_round(site: Site, *kinds: bytes) -> float:
    """Kill processes under a deployed run; return the seconds until its end is known."""
    site.hang()
    worker = site.worker()
    run = site.due()
    site.wait(run, lambda run: run["state_type"] == "RUNNING")
    assert site.kill(*kinds)
    if WORKER in kinds:
        worker.communicate()
        worker = site.worker()
    if RUN not in kinds:
        site.resume()
    found, known_s = site.wait(run, lambda run: run["state_type"] in ENDED)
    assert found["state_type"] == ("CRASHED" if RUN in kinds else "COMPLETED"), found["state"]
    site.resume()
    following, _ = site.wait(site.due(), lambda run: run["state_type"] in ENDED)
    assert following["state_name"] in GOOD, following["state"]
    assert (following["run_count"], site.slots()) == (1, 0)
    assert "fault" not in stop(worker)
    return known_s


def _tell(line: str) -> None:
    sys.stdout.write(f"{line}\n")
    sys.stdout.flush()


if __name__ == "__main__":
    main()
