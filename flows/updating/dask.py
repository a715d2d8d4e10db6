"""`engine: dask`: jobs that the store lacks are solved by the workers of a Dask cluster.

What travels is an errand of a few kilobytes: the campaign file's path and settings, and the job's
values and analysis. A worker reads the campaign itself (once), solves the job with the same engine
into the same store, and answers with the key or with what went wrong, as text. Arrays stay in the
store, which must be on a disk that all share. When a worker dies, Dask gives its errand to another
one; the lock on the job is gone with the worker, and so is its solver.
"""

from __future__ import annotations

import logging
import threading
import uuid
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

from modetune.core import errors
from modetune.core.errors import (
    CampaignError,
    ModetuneError,
    SolverCancelled,
    SolverCrashed,
    StorageUnavailable,
)
from modetune.core.storage.store import Store
from modetune.flows.campaign.campaign import Campaign, load_campaign
from modetune.flows.jobs.dask_cluster import Cluster, check_packages, connect
from modetune.flows.jobs.engine import JobEngine, Ledger
from modetune.flows.jobs.job import Job
from modetune.flows.jobs.limits import CORES, Limit

logger = logging.getLogger(__name__)

#: How long a shared disk may take to show here what a worker wrote there, seconds.
PATIENCE_S = 60.0


@dataclass(frozen=True, slots=True)
class Order:
    """One run of a campaign: what a worker needs to set up its engine.

    run: tells runs of the same campaign apart; engine_of: makes the engine, by name on the way.
    """

    run: str
    file: Path
    settings: tuple[str, ...]
    store: Path
    threads: int
    engine_of: Callable[[Campaign], JobEngine]


@dataclass(frozen=True, slots=True)
class Errand:
    """One job for a worker, and the key that it must have there too."""

    order: Order
    job: Job
    key: str


@dataclass(frozen=True, slots=True)
class Answer:
    """What became of an errand.

    reused: whether the store had it, None where it failed, and then the error's class and text;
    wall_s: from first try to result; core_s, licence_s: what it cost; said: warnings on the way.
    """

    reused: bool | None
    wall_s: float
    error: str
    message: str
    core_s: float
    licence_s: float
    said: tuple[str, ...]


class _Warnings(logging.Handler):
    """Keeps the warnings of the thread that made it."""

    def __init__(self) -> None:
        super().__init__(logging.WARNING)
        self.said: list[str] = []
        self.thread = threading.get_ident()

    def emit(self, record: logging.LogRecord) -> None:
        if record.thread == self.thread:
            self.said.append(record.getMessage()[:2000])


#: In a worker: which runs are at their end. A key is never taken out: an errand may come late.
_ending: dict[str, threading.Event] = {}


def end_run(run: str) -> None:
    """In a worker: end the solvers of a run that is over."""
    _ending.setdefault(run, threading.Event()).set()


@lru_cache(maxsize=8)
def _engine(order: Order) -> JobEngine:
    """In a worker: the engine of an order."""
    campaign = load_campaign(order.file, list(order.settings))
    return replace(
        order.engine_of(replace(campaign, store=Store(order.store))),
        threads=order.threads,
        cancelled=_ending.setdefault(order.run, threading.Event()),
    )


def run_errand(errand: Errand) -> Answer:
    """In a worker: solve a job into the store."""
    ledger, warnings = Ledger(), _Warnings()
    ours = logging.getLogger("modetune")
    ours.addHandler(warnings)
    reused, wall_s, error, message = None, 0.0, "", ""
    try:
        engine = replace(_engine(errand.order), ledger=ledger)
        key = engine.key(errand.job)
        if key != errand.key:
            raise CampaignError(
                f"a Dask worker makes another job of {errand.order.file} than was asked for: it "
                f"has {engine.program.name} {engine.program.version()}; solver version, deck and "
                "campaign must be the same on all machines"
            )
        outcome = engine.solve(errand.job)
        reused, wall_s = outcome.reused, outcome.wall_s
    except ModetuneError as failure:
        error, message = type(failure).__name__, str(failure)
    finally:
        ours.removeHandler(warnings)
    return Answer(
        reused, wall_s, error, message, ledger.core_s, ledger.licence_s, tuple(warnings.said)
    )


class DaskJobs:
    """The jobs of one run of a campaign on a cluster, which is set up when the first one comes."""

    def __init__(self, campaign: Campaign, engine_of: Callable[[Campaign], JobEngine]) -> None:
        self.campaign = campaign
        self.engine = engine_of(campaign)
        self.order = Order(
            uuid.uuid4().hex,
            campaign.file.resolve(),
            campaign.settings,
            campaign.store.folder.resolve(),
            self.engine.threads,
            engine_of,
        )
        self._cluster: Cluster | None = None
        self._refusal: CampaignError | None = None
        self._setting_up = threading.Lock()

    def solve(self, job: Job, key: str) -> tuple[bool, float]:
        """Have a worker solve a job: whether the store had it, and what it took, seconds.

        Raises what the worker's engine raises.
        """
        answer = self._asked(Errand(self.order, job, key))
        for warning in answer.said:
            logger.warning("%s", warning)
        ledger = self.engine.ledger
        ledger.add(answer.core_s, (Limit(CORES, 1, 1),))
        ledger.add(answer.licence_s, (Limit("licences", 1, 1),))
        if answer.reused is None:
            raise worker_error(answer.error, answer.message)
        self._wait_until_seen(key)
        return answer.reused, answer.wall_s

    def close(self) -> None:
        """End what the workers still do for this run, and the cluster where it is our own."""
        with self._setting_up:
            if self._cluster is not None:
                self._cluster.close(end_run, self.order.run)
                self._cluster = None

    def _asked(self, errand: Errand) -> Answer:
        future = self._client().submit(
            run_errand, errand, key=f"{errand.key[:12]}-{uuid.uuid4().hex}", pure=False
        )
        ended = threading.Event()
        future.add_done_callback(lambda _: ended.set())
        while not ended.wait(0.1):
            if self.engine.cancelled.is_set():
                future.cancel()
                raise SolverCancelled("the campaign is ending while Dask runs a job")
        return self._answer(future)

    def _answer(self, future: Any) -> Answer:
        if self.engine.cancelled.is_set():
            raise SolverCancelled("the campaign is ending while Dask runs a job")
        if future.status in ("cancelled", "lost"):
            raise CampaignError(
                "the Dask scheduler ended or was lost; start it, then run the "
                "same command again: finished jobs are not repeated"
            )
        failure = future.exception() if future.status == "error" else None
        if failure is None:
            answer = future.result()
            assert isinstance(answer, Answer)
            return answer
        if type(failure).__name__ == "KilledWorker":
            raise SolverCrashed(f"the Dask workers that ran this job died: {failure}")
        if isinstance(failure, ImportError):
            raise CampaignError(
                f"a Dask worker cannot load modetune ({failure}); install the same version there"
            ) from failure
        raise failure

    def _client(self) -> Any:
        with self._setting_up:
            if self.engine.cancelled.is_set():
                raise SolverCancelled("the campaign is ending")
            if self._refusal is not None:  # the same would be said to every job
                raise self._refusal
            if self._cluster is None:
                try:
                    self._cluster = connect(self.campaign.run.dask, self.engine.threads)
                except CampaignError as error:
                    self._refusal = error
                    raise
            return self._cluster.client

    def _wait_until_seen(self, key: str) -> None:
        """Wait until this machine sees what a worker on another one wrote."""
        store, left = self.engine.store, PATIENCE_S
        while key not in store:
            if left <= 0.0:
                raise StorageUnavailable(
                    f"a Dask worker stored {key[:12]}, but it is not in {store.folder} here; the "
                    "store must be on a disk that all machines share"
                )
            if self.engine.cancelled.wait(0.2):
                raise SolverCancelled("the campaign is ending")
            left -= 0.2


def worker_error(name: str, message: str) -> ModetuneError:
    """The error that a worker met, by its class's name."""
    kind = getattr(errors, name, None)
    if isinstance(kind, type) and issubclass(kind, ModetuneError):
        return kind(message)
    return SolverCrashed(message)


@contextmanager
def on_dask(campaign: Campaign, engine_of: Callable[[Campaign], JobEngine]) -> Iterator[JobEngine]:
    """The campaign's engine, its jobs solved on the campaign's Dask cluster.

    engine_of: makes engines, here and in the workers: a function of a module.
    """
    check_packages(campaign.run.dask)
    jobs = DaskJobs(campaign, engine_of)
    try:
        yield replace(jobs.engine, elsewhere=jobs.solve)
    finally:
        jobs.close()
