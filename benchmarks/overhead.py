"""The cost of Prefect: per job in addition to its solver, and per command.

A program that does nothing runs a thousand times, two at a time: by a bare ThreadPoolExecutor with
subprocess.run; by the same below modetune's supervisor; by the job engine with its store on a plain
pool; as tasks of a Prefect flow; and by the workers of a Dask cluster, without and with Prefect.
Each line gives milliseconds per job, and the difference from the bare pool. Another line gives the
server's CPU time per task.

Then commands, medians of five in turn: a process with a flow of one task, and six masses whose
results are all in the store, on the shared server and with `--no-prefect`.

    python -m benchmarks.overhead [--jobs 1000] [--parallel 2] [--no-prefect] [--profile]

Results go to a temporary folder; name another disk with TMPDIR.
"""

from __future__ import annotations

import argparse
import cProfile
import os
import pstats
import shutil
import statistics
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing, contextmanager
from dataclasses import dataclass
from pathlib import Path

from tests.flows.conftest import ChainDeck, ScriptedProgram
from tests.flows.server.site import SIX_MASS

from modetune.adapters.process import run_process
from modetune.adapters.solver import Analysis, Command, ModalAnalysis, Solver
from modetune.core.parameters import Values
from modetune.core.storage.store import Store
from modetune.core.updating.job_results import Result
from modetune.flows.campaign.site import DaskSection
from modetune.flows.jobs.dask_cluster import dask_runner
from modetune.flows.jobs.engine import JobEngine
from modetune.flows.jobs.execution import Execution, Work
from modetune.flows.jobs.job import Job, Plans
from modetune.flows.jobs.limits import CORES, Limit, MachineLimits
from modetune.flows.jobs.policy import Policy
from modetune.flows.jobs.prefect_server import SharedServer, use_server
from modetune.flows.jobs.runner import Attempt, Costs, PoolRunner, Runner, WorkerRequest
from modetune.flows.jobs.tasks import Tasks
from modetune.flows.server.prefect_client import prefect_client

PROGRAM = "/bin/true"
#: Milliseconds a job, by what ran them.
Figures = dict[str, float]
#: Commands are run so often, in turn.
TIMES = 5
#: A process with a flow of one task.
ONE_TASK = """
from modetune.flows.jobs.prefect_server import use_server
from modetune.flows.server.prefect_client import prefect_client
server = use_server()
with prefect_client(server.settings()):
    from prefect import flow, task
    one = task(lambda: 1)
    @flow
    def bare():
        return one.submit().result()
    assert bare() == 1
server.close()
"""


@dataclass(frozen=True)
class NothingProgram(ScriptedProgram):
    """The scripted chain behind a program that does nothing."""

    def command(self, threads: int) -> Command:
        return Command((PROGRAM,))

    def read(self, deck: Values, analysis: Analysis, folder: Path, return_code: int) -> Result:
        (folder / "solver.log").write_text("END OF JOB")
        return super().read(deck, analysis, folder, return_code)


def bare(count: int, parallel: int) -> None:
    """Run jobs on a bare thread pool."""

    def run(_: int) -> None:
        subprocess.run([PROGRAM], check=True, stdin=subprocess.DEVNULL, capture_output=True)

    with ThreadPoolExecutor(parallel) as pool:
        list(pool.map(run, range(count)))


def supervised(count: int, parallel: int, folder: Path) -> None:
    """Run the same jobs below supervisors, which leave no process behind."""
    never = threading.Event()

    def run(number: int) -> None:
        place = folder / str(number)
        place.mkdir()
        run_process(Command((PROGRAM,)), place, 60.0, never)

    with ThreadPoolExecutor(parallel) as pool:
        list(pool.map(run, range(count)))


def engine(folder: Path, runner: Runner, order: WorkerRequest | None = None) -> JobEngine:
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
        costs=Costs(),
        tasks=Tasks(runner),
        order=order,
    )


def attempt_there(order: WorkerRequest, costs: Costs) -> Attempt:
    """The attempts of the engine in a worker of a Dask cluster."""
    return engine(order.store.parent, PoolRunner(1)).attempt


def works(count: int) -> list[Work]:
    """As many jobs, each another value of the first spring."""
    analysis = ModalAnalysis(6, (1, 2, 3, 4, 5, 6))
    return [
        Work(f"job {number}", (Job({"k1": 1.0 + 1e-4 * number}, analysis),))
        for number in range(count)
    ]


def carry_out(count: int, folder: Path, runner: Runner) -> None:
    """Run as many jobs on a runner; every job must have been run."""
    folder.mkdir()
    order = WorkerRequest(folder.name, folder, (), folder / "store", 1, 0, False, attempt_there)
    outcomes = Execution(engine(folder, runner, order)).run("benchmark", works(count))
    assert all(isinstance(done, tuple) and not done[0].reused for done in outcomes)


@contextmanager
def server() -> Iterator[SharedServer]:
    """The shared server of this benchmark, ready."""
    try:
        with closing(use_server()) as found:
            assert found.wait(200.0) == "ready"
            yield found
    finally:
        subprocess.run([sys.executable, "-m", "modetune", "server", "stop"], check=True)


def server_cpu_s() -> float:
    """Seconds of CPU that servers of this user have used."""
    total = 0
    for entry in Path("/proc").glob("[0-9]*"):
        try:
            if b"prefect\0server\0start" in (entry / "cmdline").read_bytes():
                times = (entry / "stat").read_text().rpartition(")")[2].split()[11:13]
                total += sum(map(int, times))
        except OSError:
            continue
    return total / os.sysconf("SC_CLK_TCK")


def overheads_ms(count: int, folder: Path, parallel: int = 2, prefect: bool = True) -> Figures:
    """Milliseconds of a job in each way; prefect: also as tasks on a server, and on Dask."""
    os.environ["MODETUNE_HOME"] = str(folder / "home")
    os.environ["PREFECT_LOGGING_LEVEL"] = "WARNING"  # no line for each task
    (folder / "supervised").mkdir()
    found = {
        "bare pool": timed(lambda: bare(count, parallel)),
        "supervised": timed(lambda: supervised(count, parallel, folder / "supervised")),
        "engine, threads": timed(lambda: carry_out(count, folder / "pool", PoolRunner(parallel))),
    }
    if prefect:
        cluster = DaskSection(workers=parallel)
        with dask_runner(cluster, 1, parallel) as runner:
            carry_out(parallel, folder / "warm", runner)  # workers import what they need
            found["engine, Dask"] = timed(lambda: carry_out(count, folder / "dask", runner))
        with server() as ours, prefect_client(ours.settings()):
            found |= as_tasks(count, folder, parallel, cluster)
    return {name: 1e3 * wall_s / count for name, wall_s in found.items()}


def as_tasks(count: int, folder: Path, parallel: int, cluster: DaskSection) -> Figures:
    """Seconds of all jobs as tasks of a flow, on threads and on Dask, and of the server's CPU."""
    from prefect import flow
    from prefect.task_runners import ThreadPoolTaskRunner

    from modetune.flows.jobs.prefect_runner import dask_task_runner, task_runner

    @flow
    def on_threads() -> float:
        with task_runner(ThreadPoolTaskRunner(max_workers=parallel), parallel) as runner:
            return timed(lambda: carry_out(count, folder / "tasks", runner))

    @flow
    def on_dask() -> float:
        with dask_task_runner(cluster, 1, parallel) as runner:
            carry_out(parallel, folder / "warm-tasks", runner)
            return timed(lambda: carry_out(count, folder / "dask-tasks", runner))

    before = server_cpu_s()
    found = {"engine, tasks": on_threads()}
    time.sleep(2.0)  # the server records events for a while
    found["server's CPU"] = server_cpu_s() - before
    return {**found, "engine, Dask tasks": on_dask()}


def commands_s(folder: Path) -> Figures:
    """Median wall seconds of whole commands, which take turns."""
    os.environ["MODETUNE_HOME"] = str(folder / "home")
    os.environ["MODETUNE_STORE"] = str(folder / "six-store")
    place = folder / "six"
    shutil.copytree(SIX_MASS, place, ignore=shutil.ignore_patterns("__py*", "*.py"))
    update = [sys.executable, "-m", "modetune", "update", "campaign.yaml", "--json"]
    ways = {
        "a flow of one task": [sys.executable, "-c", ONE_TASK],
        "six masses, cached": update,
        "... --no-prefect": [*update, "--no-prefect"],
    }
    walls: dict[str, list[float]] = {name: [] for name in ways}
    with server():
        subprocess.run(ways["... --no-prefect"], cwd=place, check=True, capture_output=True)
        for _ in range(TIMES):
            for name, words in ways.items():
                began = time.monotonic()
                subprocess.run(words, cwd=place, check=True, capture_output=True)
                walls[name].append(time.monotonic() - began)
    return {name: statistics.median(each) for name, each in walls.items()}


def timed(work: Callable[[], object]) -> float:
    started = time.monotonic()
    work()
    return time.monotonic() - started


def main() -> None:
    """Print what a job and a command cost in each way."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--jobs", type=int, default=1000)
    parser.add_argument("--parallel", type=int, default=2)
    parser.add_argument("--no-prefect", action="store_true")
    parser.add_argument("--profile", action="store_true", help="Profile the engine in one thread.")
    chosen = parser.parse_args()
    count = chosen.jobs
    with tempfile.TemporaryDirectory(prefix="modetune-overhead-") as name:
        folder = Path(name)
        if chosen.profile:
            (folder / "profile").mkdir()
            one, jobs = engine(folder / "profile", PoolRunner(1)), works(count)
            profile = cProfile.Profile()
            profile.runcall(lambda: [one.solve(work.jobs[0]) for work in jobs])
            pstats.Stats(profile).sort_stats("tottime").print_stats(30)
            return
        found = overheads_ms(count, folder, chosen.parallel, not chosen.no_prefect)
        commands = {} if chosen.no_prefect else commands_s(folder)
    reference = found["bare pool"]
    for way, each in found.items():
        sys.stdout.write(f"{way:18} {each:7.2f} ms of a job, {each - reference:+7.2f} ms\n")
    for way, each in commands.items():
        sys.stdout.write(f"{way:18} {each:7.2f} s\n")


if __name__ == "__main__":
    main()
