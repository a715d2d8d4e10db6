"""Dask clusters: a running one, worker processes of this machine, or jobs of a queue.

Anybody who can connect to a Dask scheduler can run programs as its user. Clusters started here
therefore use TLS with new keys, which only the workers receive.
"""

from __future__ import annotations

import logging
import os
import shlex
import signal
import uuid
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from importlib import import_module
from pathlib import Path
from typing import Any

from modetune.core.errors import CampaignError, ModetuneError, SolverCrashed
from modetune.flows.campaign.site import DaskSection, server_home
from modetune.flows.jobs.runner import PoolRunner, Task, TaskResult, TaskRun, end_event, retry
from modetune.flows.jobs.server_client import ServerClient

#: Seconds until a scheduler must answer, and until workers must have stopped their solvers.
CONNECT_S, END_S = 20.0, 10.0
MISSING = (
    "`engine: dask` needs the package {}; install all it needs with "
    "`pip install 'modetune[cluster]'`"
)
LOST = (
    "the connection to the Dask scheduler was lost; start it and run the same command again: "
    "finished jobs are not repeated"
)
JOB_CLUSTERS = {"slurm": "SLURMCluster", "pbs": "PBSCluster", "lsf": "LSFCluster"}


def check_packages(section: DaskSection) -> None:
    """Import the packages of a cluster, in the main thread. Raises CampaignError."""
    ending = signal.getsignal(signal.SIGINT)
    try:
        import_module("distributed")
        if section.scheduler is None:
            import_module("cryptography")
        if section.cluster != "local":
            # Installs a handler of Ctrl-C at import, which is possible only in the main thread.
            import_module("dask_jobqueue")
            signal.signal(signal.SIGINT, ending)
    except ImportError as error:
        raise CampaignError(MISSING.format(error.name)) from None


@contextmanager
def cluster(section: DaskSection, threads: int) -> Iterator[str | Any]:
    """Open a campaign's cluster: the address of a running scheduler, or a new cluster.

    A new cluster ends with the context; threads is the number per job. Raises CampaignError.
    """
    check_packages(section)
    _quiet()
    if section.scheduler is not None:
        yield section.scheduler
        return
    try:
        if section.cluster == "local":
            own = _local(section, import_module("distributed"))
        else:
            own = _queued(section, threads)
    except (OSError, ValueError, RuntimeError) as error:  # raised by Dask if it cannot start
        raise CampaignError(
            f"the Dask cluster ({section.cluster}) did not start: {_reason(error)}"
        ) from error
    try:
        yield own
    finally:
        _close(own)


def connected(connect: Callable[[], Any], section: DaskSection) -> Any:
    """Return the client of a cluster. Raises CampaignError if no scheduler answers."""
    try:
        return connect()
    except (OSError, ValueError) as error:
        raise CampaignError(
            f"no Dask scheduler answered at {section.scheduler or section.cluster} within "
            f"{CONNECT_S:g} s; start it (`dask scheduler`) or correct `run.dask.scheduler`"
        ) from error


def check_connection(client: Any) -> None:
    """Raise CampaignError where the scheduler is gone: Dask would hold a new task for ever."""
    if client.status != "running":
        raise CampaignError(LOST)


def workers_apart(client: Any, url: str) -> list[str]:
    """Return the addresses of workers that cannot reach a Prefect server at this URL."""
    found = client.run(_reaches, url, on_error="return")
    return [address for address, reached in found.items() if reached is not True]


def _reaches(url: str) -> bool:
    return ServerClient(url).answer() in ("ready", "asks for a login")


def end_runs(client: Any, runs: Sequence[str]) -> None:
    """Stop the solvers of these runs on all workers."""
    if client.status != "running":  # if the scheduler is gone, so are its workers
        return
    with suppress(OSError, ValueError, RuntimeError):
        client.run(_end_runs, list(runs), on_error="ignore")


def _end_runs(runs: list[str]) -> None:
    for run in runs:
        end_event(run).set()


class DaskTaskRun:
    """A task on a Dask cluster."""

    def __init__(self, future: Any) -> None:
        self.future = future

    def done(self) -> bool:
        return bool(self.future.done())

    def wait(self, seconds: float) -> None:
        with suppress(TimeoutError):
            self.future.exception(timeout=seconds)

    def result(self) -> TaskResult:
        return dask_result(self.future.result, self.future)

    def cancel(self) -> None:
        self.future.cancel()

    def on_end(self, call: Callable[[], None]) -> None:
        self.future.add_done_callback(lambda _: call())


def dask_result(result: Callable[[], TaskResult], future: Any) -> TaskResult:
    """Return a task's result. Raises its error, or a ModetuneError for a failure of Dask."""
    if future.status in ("cancelled", "lost"):
        raise CampaignError(LOST)
    try:
        return result()
    except ModetuneError:
        raise
    except ImportError as error:
        raise CampaignError(
            f"a Dask worker cannot import modetune ({error}); install the same version there"
        ) from error
    except Exception as error:
        if type(error).__name__ == "KilledWorker":
            raise SolverCrashed(f"the Dask worker running this job died: {error}") from error
        raise


class DaskRunner(PoolRunner):
    """Runs tasks on the workers of a Dask cluster, without Prefect; computations run here."""

    remote = True

    def __init__(self, client: Any, parallel: int) -> None:
        super().__init__(parallel)
        self.client = client
        self.runs: set[str] = set()

    def submit(self, name: str, task: Task, after: Sequence[TaskRun]) -> TaskRun:
        if task.stays:
            return super().submit(name, task, after)
        if task.order is not None:
            self.runs.add(task.order.run)
        check_connection(self.client)
        return DaskTaskRun(
            self.client.submit(retry, task.attempt, key=uuid.uuid4().hex, pure=False)
        )


@contextmanager
def dask_runner(section: DaskSection, threads: int, parallel: int) -> Iterator[DaskRunner]:
    """Open a runner on a campaign's cluster. Raises CampaignError."""
    with cluster(section, threads) as own:
        client_of = import_module("distributed").Client
        with connected(lambda: client_of(own, timeout=CONNECT_S), section) as client:
            runner = DaskRunner(client, parallel)
            try:
                yield runner
            finally:
                end_runs(client, sorted(runner.runs))


def _local(section: DaskSection, distributed: Any) -> Any:
    # By default Dask limits BLAS to one thread, in this process too, which slows the algebra down
    # and changes the last bits of its results.
    with import_module("dask").config.set({"distributed.nanny.pre-spawn-environ": {}}):
        return distributed.LocalCluster(
            n_workers=section.workers,
            threads_per_worker=1,
            processes=True,
            host="127.0.0.1",
            dashboard_address="127.0.0.1:0",  # on loopback, on any free port
            security=True,
            silence_logs=logging.CRITICAL,
            memory_limit=0,  # solvers are separate processes, whose memory Dask does not see
            local_directory=str(_scratch()),
        )


def _queued(section: DaskSection, threads: int) -> Any:
    """Start a cluster whose workers are jobs of Slurm, PBS or LSF."""
    dask_jobqueue = import_module("dask_jobqueue")
    security = import_module("distributed.security").Security.temporary()
    options: dict[str, Any] = {
        "queue": section.queue,
        "walltime": section.walltime,
        "interface": section.interface,
    }
    if section.account is not None:
        options["project" if section.cluster == "lsf" else "account"] = section.account
    cluster = getattr(dask_jobqueue, JOB_CLUSTERS[section.cluster])(
        cores=threads,
        processes=1,
        # The job has a core for each solver thread; the worker runs one task at a time.
        worker_extra_args=["--nthreads", "1", "--memory-limit", "0"],
        memory=section.memory,
        job_name="modetune",
        job_extra_directives=list(section.directives),
        job_script_prologue=[*_exports(), *section.prologue],
        local_directory=str(_scratch()),
        log_directory=str(_scratch()),
        shared_temp_directory=str(_scratch()),
        protocol="tls://",
        security=security,
        scheduler_options={"dashboard_address": "127.0.0.1:0"},
        silence_logs=logging.CRITICAL,
        **{key: value for key, value in options.items() if value is not None},
    )
    _quiet()
    # Start the workers here, because `n_workers` and `scale` hide a refusal by the queue.
    for _ in range(section.workers):
        cluster.worker_spec.update(cluster.new_worker_spec())
    try:
        cluster.sync(cluster._correct_state)
    except (OSError, RuntimeError):
        cluster.worker_spec.clear()
        cluster.workers.clear()  # a worker that never started cannot be closed
        _close(cluster)
        raise
    return cluster


def _quiet() -> None:
    """Silence Dask's log of workers that join and leave, which campaigns tolerate."""
    for name in ("distributed", "distributed.client", "tornado", "asyncio"):
        logging.getLogger(name).setLevel(logging.CRITICAL)


def _close(cluster: Any) -> None:
    # Dask raises AssertionError if a worker was never started.
    with suppress(OSError, RuntimeError, AssertionError):
        cluster.close(timeout=END_S)


def _reason(error: Exception) -> str:
    return " ".join(line.strip() for line in str(error).splitlines() if line.strip())[:500]


def _exports() -> list[str]:
    return [
        f"export {name}={shlex.quote(value)}"
        for name, value in sorted(os.environ.items())
        if name.startswith("MODETUNE_") and name.isidentifier() and value.isprintable()
    ]


def _scratch() -> Path:
    folder = server_home() / "dask"
    folder.mkdir(parents=True, exist_ok=True)
    folder.chmod(0o700)  # contains the workers' keys
    return folder
