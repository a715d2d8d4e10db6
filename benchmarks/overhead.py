"""What a job costs beside its solver: a program that does nothing, a thousand times.

Four ways of running `true`, two at a time: a bare ThreadPoolExecutor with subprocess.run; the same
below modetune's supervisor; the job engine with its store, by threads; and the same beside
the pages of the shared Prefect server. Each line gives milliseconds a job, what it is above the
bare pool, and the ratio.

    python -m benchmarks.overhead [--jobs 1000] [--parallel 2] [--no-prefect] [--profile]

Results go to a temporary folder; name another disk with TMPDIR.
"""

from __future__ import annotations

import argparse
import cProfile
import os
import pstats
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path

from tests.flows.conftest import ChainDeck, ScriptedProgram

from modetune.adapters.process import run_process
from modetune.adapters.solver import Analysis, Command, ModalAnalysis, Solver
from modetune.core.parameters import Values
from modetune.core.storage.store import Store
from modetune.core.updating.results import Result
from modetune.flows.jobs.engine import JobEngine, Ledger
from modetune.flows.jobs.job import Job, Plans
from modetune.flows.jobs.limits import CORES, Limit, MachineLimits
from modetune.flows.jobs.policy import Policy
from modetune.flows.jobs.prefect_server import use_server
from modetune.flows.jobs.work import Execution, ThreadExecution, Work
from modetune.flows.updating.prefect import shown

PROGRAM = "/bin/true"
#: Milliseconds a job, by what ran them.
Figures = dict[str, float]


@dataclass(frozen=True)
class NothingProgram(ScriptedProgram):
    """The scripted chain behind a program that does nothing."""

    def command(self, threads: int) -> Command:
        return Command((PROGRAM,))

    def read(self, deck: Values, analysis: Analysis, folder: Path, return_code: int) -> Result:
        (folder / "solver.log").write_text("END OF JOB")
        return super().read(deck, analysis, folder, return_code)


def bare(count: int, parallel: int) -> None:
    """The pool that everybody writes first."""

    def run(_: int) -> None:
        subprocess.run([PROGRAM], check=True, stdin=subprocess.DEVNULL, capture_output=True)

    with ThreadPoolExecutor(parallel) as pool:
        list(pool.map(run, range(count)))


def supervised(count: int, parallel: int, folder: Path) -> None:
    """The same with nothing left behind however this process ends."""
    never = threading.Event()

    def run(number: int) -> None:
        place = folder / str(number)
        place.mkdir()
        run_process(Command((PROGRAM,)), place, 60.0, never)

    with ThreadPoolExecutor(parallel) as pool:
        list(pool.map(run, range(count)))


def engine(folder: Path) -> JobEngine:
    """A job engine on its own store."""
    cores = len(os.sched_getaffinity(0))
    return JobEngine(
        plans=Plans(Solver(ChainDeck(), NothingProgram(folder))),
        store=Store(folder / "store"),
        policy=Policy(60.0, 0, 0, 0, 1.0, 1.0),
        threads=1,
        keep_jobs=False,
        cancelled=threading.Event(),
        counter=MachineLimits(folder / "limits"),
        limits=(Limit(CORES, cores, 1),),
        ledger=Ledger(),
    )


def works(count: int) -> list[Work]:
    """As many jobs, each another value of the first spring."""
    analysis = ModalAnalysis(6, (1, 2, 3, 4, 5, 6))
    return [
        Work(f"job {number}", (Job({"k1": 1.0 + 1e-4 * number}, analysis),))
        for number in range(count)
    ]


def with_threads(count: int, parallel: int, folder: Path) -> None:
    """The engine as `--no-prefect` has it."""
    check(ThreadExecution(engine(folder), parallel), works(count))


def check(execution: Execution, work: Sequence[Work]) -> None:
    """Run the work; every job must have been run."""
    outcomes = execution.run("benchmark", work)
    assert all(isinstance(done, tuple) and not done[0].reused for done in outcomes)


def with_pages(count: int, parallel: int, folder: Path) -> None:
    """The engine as it is beside the pages of a Prefect server."""
    with shown("overhead") as pages:
        watched = replace(engine(folder), watcher=pages)
        check(ThreadExecution(watched, parallel), works(count))
        pages.end("COMPLETED", "Completed", "")


def overheads_ms(count: int, folder: Path, parallel: int = 2, prefect: bool = True) -> Figures:
    """Milliseconds a job of each way, in its order; prefect: a server is started for the last."""
    os.environ["MODETUNE_HOME"] = str(folder / "home")
    for part in ("supervised", "threads", "prefect"):
        (folder / part).mkdir()
    found = {
        "bare pool": timed(lambda: bare(count, parallel)),
        "supervised": timed(lambda: supervised(count, parallel, folder / "supervised")),
        "engine, threads": timed(lambda: with_threads(count, parallel, folder / "threads")),
    }
    if prefect:
        server = use_server()
        try:
            assert server.wait() == "ready"
            found["engine, pages"] = timed(lambda: with_pages(count, parallel, folder / "prefect"))
        finally:
            server.close()
            subprocess.run([sys.executable, "-m", "modetune", "server", "stop"], check=True)
    return {name: 1e3 * wall_s / count for name, wall_s in found.items()}


def timed(work: Callable[[], object]) -> float:
    started = time.monotonic()
    work()
    return time.monotonic() - started


def main() -> None:
    """Run all four and tell what a job costs in each."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--jobs", type=int, default=1000)
    parser.add_argument("--parallel", type=int, default=2)
    parser.add_argument("--no-prefect", action="store_true")
    parser.add_argument("--profile", action="store_true", help="Profile the engine in one thread.")
    chosen = parser.parse_args()
    count, parallel = chosen.jobs, chosen.parallel
    with tempfile.TemporaryDirectory(prefix="modetune-overhead-") as name:
        folder = Path(name)
        if chosen.profile:
            profile = cProfile.Profile()
            one, jobs = engine(folder / "profile"), works(count)
            (folder / "profile").mkdir()
            profile.runcall(lambda: [one.solve(work.jobs[0]) for work in jobs])
            pstats.Stats(profile).sort_stats("tottime").print_stats(30)
            return
        found = overheads_ms(count, folder, parallel, not chosen.no_prefect)
    reference = found["bare pool"]
    for name, each in found.items():
        sys.stdout.write(
            f"{name:18} {each:7.2f} ms a job, {each - reference:+7.2f} ms, "
            f"{each / reference:6.2f} times\n"
        )


if __name__ == "__main__":
    main()
