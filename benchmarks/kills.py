"""1,000 kills of studies of many kinds, with second faults, and rounds of deployed campaigns.

Studies are killed at random moments and run again (`benchmarks/killed_campaigns`). Deployed
campaigns are killed in rounds: each starts a worker and a run, kills the processes that the round
is named after, starts another worker and waits. Within a minute the run must be marked as crashed
and its slot be free; the next run that is due must start once and finish. If only the server is
killed, the run itself must finish. The first round that violates a condition ends the benchmark.

A journal has each life of a study, from its first start to its end, and each round: an interrupted
benchmark goes on.

    python -m benchmarks.kills [--kills 1000] [--kinds matrices receive] [--rounds 20] [--seed 1]
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import nullcontext
from pathlib import Path
from typing import Any

from benchmarks.journal import FOLDER, Journal
from benchmarks.killed_campaigns import KINDS, SERVED, Field, possible_faults
from tests.flows.server.site import ENDED, GOOD, RUN, SERVER, WORKER, Site, stop

#: Processes to kill together, in turn.
BLOWS = {
    "run": (RUN,),
    "machine, server elsewhere": (WORKER, RUN),
    "machine with its server": (WORKER, RUN, *SERVER),
    "server": SERVER,
}
#: How many of the kills a kind gets compared with the others.
SHARES = {
    "matrices": 4, "solver": 4, "flow": 2, "screen": 2, "sample": 2, "receive": 2, "fleet": 2,
    "go": 2, "compare": 2, "validate": 2,
}  # fmt: skip


def main() -> None:
    """Kill studies and print the outcomes; exit with code 1 if a condition is violated."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--kills", type=int, default=1000, help="Of all kinds together.")
    parser.add_argument("--kinds", nargs="*", default=list(KINDS), choices=list(KINDS))
    parser.add_argument("--rounds", type=int, default=20)
    parser.add_argument("--seed", type=int, help="Default: another one after each whole run.")
    parser.add_argument("--journal", type=Path, default=FOLDER / "kills.jsonl")
    chosen = parser.parse_args()
    shares = {kind: SHARES.get(kind, 1) for kind in chosen.kinds}
    counts = {
        kind: -(-chosen.kills * share // sum(shares.values())) for kind, share in shares.items()
    }
    plan = {"kills": counts, "rounds": chosen.rounds}
    journal = Journal(chosen.journal, plan, chosen.seed)
    _tell(f"seed {journal.seed}: {len(journal.results)} pieces done")
    folder = Path(tempfile.mkdtemp(prefix="modetune-kills-"))
    _lives(journal, counts, folder / "field")
    good = all([_show(journal, kind) for kind in chosen.kinds])
    if chosen.rounds:
        _rounds(journal, chosen.rounds, folder / "site")
    journal.end()
    sys.exit(0 if good else 1)


def _lives(journal: Journal, counts: dict[str, int], folder: Path) -> None:
    """Kill studies, one kind after the other in turn, until each has its kills."""
    todo = _todo(journal, counts)
    first = next(todo, None)
    if first is None:
        return
    field = Field(folder, possible_faults())
    with field.served() if not counts.keys().isdisjoint(SERVED) else nullcontext():
        piece: tuple[str, int] | None = first
        while piece is not None:
            kind, number = piece
            began = time.monotonic()
            seed = [journal.seed, list(KINDS).index(kind), number]
            found = field.life(kind, number % len(KINDS[kind]), seed)
            journal.add(f"{kind} {number}", {**found.as_json(), "wall_s": time.monotonic() - began})
            for sentence in found.wrong:
                _tell(f"{kind} {number}: {sentence}; look into {folder}")
            piece = next(todo, None)


def _todo(journal: Journal, counts: dict[str, int]) -> Iterator[tuple[str, int]]:
    """Yield kinds with the numbers of their next lives, as long as they have too few kills."""
    while True:
        short = [kind for kind, count in counts.items() if _kills(journal, kind) < count]
        if not short:
            return
        for kind in short:
            yield kind, len(_pieces(journal, kind))


def _pieces(journal: Journal, kind: str) -> list[dict[str, Any]]:
    return [found for piece, found in journal.results.items() if piece.split()[0] == kind]


def _kills(journal: Journal, kind: str) -> int:
    return sum(sum(found["blows"].values()) for found in _pieces(journal, kind))


def _show(journal: Journal, kind: str) -> bool:
    """Print what came of the kills of a kind; return whether all conditions held."""
    pieces = _pieces(journal, kind)
    blows, faults = (
        ", ".join(
            f"{name} {times}"
            for name, times in sorted(
                sum((Counter(found[key]) for found in pieces), Counter[str]()).items()
            )
        )
        for key in ("blows", "faults")
    )
    wrong = [sentence for found in pieces for sentence in found["wrong"]]
    _tell(
        f"{kind:10}{_kills(journal, kind):4d} kills ({blows}) in {len(pieces)} lives; {faults}; "
        f"{sum(found['refused'] for found in pieces)} refused for a full disk; "
        f"{sum(found['wall_s'] for found in pieces):.0f} s; wrong: {'; '.join(wrong) or 'nothing'}"
    )
    return not wrong


def _rounds(journal: Journal, count: int, folder: Path) -> None:
    """Rounds of deployed campaigns, a line each. Raises AssertionError."""
    todo = [number for number in range(count) if f"round {number}" not in journal.results]
    if not todo:
        return
    folder.mkdir()
    site = Site(folder)
    try:
        for number in todo:
            name = list(BLOWS)[number % len(BLOWS)]
            known_s = killed_round(site, *BLOWS[name])
            journal.add(f"round {number}", {"blow": name, "known_s": known_s})
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
