"""Dask clusters: one that runs, worker processes of this machine, or jobs of a queue.

Whoever reaches a Dask scheduler can run programs as its user. Those started here therefore speak
TLS with keys of their own, which leave this process only for the workers.
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
from modetune.flows.jobs.server_client import ServerClient
from modetune.flows.jobs.work import Answer, Piece, PoolRunner, Task, run_end, tried

#: How long a scheduler may take to answer, and workers to end their solvers, seconds.
CONNECT_S, END_S = 20.0, 10.0
MISSING = (
    "`engine: dask` needs the package {}; install all it needs with "
    "`pip install 'modetune[cluster]'`"
)
JOB_CLUSTERS = {"slurm": "SLURMCluster", "pbs": "PBSCluster", "lsf": "LSFCluster"}


def check_packages(section: DaskSection) -> None:
    """Import what a cluster needs, from the main thread. Raises CampaignError."""
    ending = signal.getsignal(signal.SIGINT)
    try:
        import_module("distributed")
        if section.scheduler is None:
            import_module("cryptography")
        if section.cluster != "local":
            # Takes Ctrl-C for itself at its import, which only the main thread may do.
            import_module("dask_jobqueue")
            signal.signal(signal.SIGINT, ending)
    except ImportError as error:
        raise CampaignError(MISSING.format(error.name)) from None


@contextmanager
def cluster(section: DaskSection, threads: int) -> Iterator[str | Any]:
    """The cluster that a campaign asks for: the address of a running scheduler, or a cluster of our
    own, which ends with this. threads: of each job. Raises CampaignError."""
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
    except (OSError, ValueError, RuntimeError) as error:  # what Dask raises where it cannot start
        raise CampaignError(
            f"no Dask cluster ({section.cluster}) could be started: {_reason(error)}"
        ) from error
    try:
        yield own
    finally:
        _close(own)


def connected(connect: Callable[[], Any], section: DaskSection) -> Any:
    """The client of a cluster. Raises CampaignError where no scheduler answers."""
    try:
        return connect()
    except (OSError, ValueError) as error:
        raise CampaignError(
            f"no Dask scheduler answers at {section.scheduler or section.cluster} within "
            f"{CONNECT_S:g} s; start it (`dask scheduler`) or correct `run.dask.scheduler`"
        ) from error


def workers_apart(client: Any, url: str) -> list[str]:
    """Addresses of workers that reach no Prefect server at this URL."""
    found = client.run(_reaches, url, on_error="return")
    return [address for address, reached in found.items() if reached is not True]


def _reaches(url: str) -> bool:
    return ServerClient(url).answer() in ("ready", "asks for a login")


def end_runs(client: Any, runs: Sequence[str]) -> None:
    """Have the workers end the solvers of these runs."""
    # A scheduler that is gone cannot be reached, and has nothing left to end.
    with suppress(OSError, ValueError, RuntimeError):
        client.run(_end_runs, list(runs), on_error="ignore")


def _end_runs(runs: list[str]) -> None:
    for run in runs:
        run_end(run).set()


class DaskTask:
    """A piece on its way through a Dask cluster."""

    def __init__(self, future: Any) -> None:
        self.future = future

    def done(self) -> bool:
        return bool(self.future.done())

    def wait(self, seconds: float) -> None:
        with suppress(TimeoutError):
            self.future.exception(timeout=seconds)

    def result(self) -> Answer:
        return dask_result(self.future.result, self.future)

    def cancel(self) -> None:
        self.future.cancel()

    def on_end(self, call: Callable[[], None]) -> None:
        self.future.add_done_callback(lambda _: call())


def dask_result(result: Callable[[], Answer], future: Any) -> Answer:
    """The answer of a piece. Raises what ended it, in words of ours where Dask did."""
    if future.status in ("cancelled", "lost"):
        raise CampaignError(
            "the Dask scheduler ended or was lost; start it, then run the same command again: "
            "finished jobs are not repeated"
        )
    try:
        return result()
    except ModetuneError:
        raise
    except ImportError as error:
        raise CampaignError(
            f"a Dask worker cannot load modetune ({error}); install the same version there"
        ) from error
    except Exception as error:
        if type(error).__name__ == "KilledWorker":
            raise SolverCrashed(f"the Dask workers that ran this job died: {error}") from error
        raise


class DaskRunner(PoolRunner):
    """Tries on the workers of a Dask cluster, without Prefect; computations stay here."""

    remote = True

    def __init__(self, client: Any, parallel: int) -> None:
        super().__init__(parallel)
        self.client = client
        self.runs: set[str] = set()

    def submit(self, name: str, piece: Piece, after: Sequence[Task]) -> Task:
        if piece.stays:
            return super().submit(name, piece, after)
        if piece.order is not None:
            self.runs.add(piece.order.run)
        return DaskTask(self.client.submit(tried, piece.attempt, key=uuid.uuid4().hex, pure=False))


@contextmanager
def dask_runner(section: DaskSection, threads: int, parallel: int) -> Iterator[DaskRunner]:
    """A runner on the cluster that a campaign asks for. Raises CampaignError."""
    with cluster(section, threads) as own:
        client_of = import_module("distributed").Client
        with connected(lambda: client_of(own, timeout=CONNECT_S), section) as client:
            runner = DaskRunner(client, parallel)
            try:
                yield runner
            finally:
                end_runs(client, sorted(runner.runs))


def _local(section: DaskSection, distributed: Any) -> Any:
    # By default Dask sets the threads of BLAS to one, in this process too: its algebra would be
    # slower than without Dask, and its results would differ in the last bits.
    with import_module("dask").config.set({"distributed.nanny.pre-spawn-environ": {}}):
        return distributed.LocalCluster(
            n_workers=section.workers,
            threads_per_worker=1,
            processes=True,
            host="127.0.0.1",
            dashboard_address="127.0.0.1:0",  # pages on loopback, on any free port
            security=True,
            silence_logs=logging.CRITICAL,
            memory_limit=0,  # solvers have processes of their own, which Dask does not see
            local_directory=str(_scratch()),
        )


def _queued(section: DaskSection, threads: int) -> Any:
    """A cluster whose workers are jobs of Slurm, PBS or LSF."""
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
        # The job has a core a thread of the solver; the worker itself does one job at a time.
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
    # Asked for here, because `n_workers` and `scale` do not tell that the queue refused.
    for _ in range(section.workers):
        cluster.worker_spec.update(cluster.new_worker_spec())
    try:
        cluster.sync(cluster._correct_state)
    except (OSError, RuntimeError):
        cluster.worker_spec.clear()
        cluster.workers.clear()  # what never started cannot be closed
        _close(cluster)
        raise
    return cluster


def _quiet() -> None:
    """Dask's own log tells of workers that come and go, which the campaign bears."""
    for name in ("distributed", "tornado", "asyncio"):
        logging.getLogger(name).setLevel(logging.CRITICAL)


def _close(cluster: Any) -> None:
    # An assertion of Dask's own fails where a worker was never started.
    with suppress(OSError, RuntimeError, AssertionError):
        cluster.close(timeout=END_S)


def _reason(error: Exception) -> str:
    """An error's text on one line, the queue's own words at its end."""
    return " ".join(line.strip() for line in str(error).splitlines() if line.strip())[:500]


def _exports() -> list[str]:
    """What a worker on another node must know of our environment."""
    return [
        f"export {name}={shlex.quote(value)}"
        for name, value in sorted(os.environ.items())
        if name.startswith("MODETUNE_") and name.isidentifier() and value.isprintable()
    ]


def _scratch() -> Path:
    """Where Dask keeps what is its own."""
    folder = server_home() / "dask"
    folder.mkdir(parents=True, exist_ok=True)
    folder.chmod(0o700)  # keys of workers lie here
    return folder
