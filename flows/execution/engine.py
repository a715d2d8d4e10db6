"""The job engine: job -> key -> store -> solver -> result -> store. It knows no Prefect.

A job runs in STORE/jobs/KEY.part. A good one leaves its result in the store, and its folder only
where the campaign keeps it (as KEY); a failed one leaves KEY.failed to look at. A lock a key lets
two campaigns that want the same job run it once.
"""

from __future__ import annotations

import logging
import shutil
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TypeVar

from modetune.adapters.process import disk_full, run_process
from modetune.adapters.solver import Analysis, Solver
from modetune.core.errors import (
    LicenceDenied,
    ModelError,
    ModesError,
    NoResult,
    NotComputed,
    NotStored,
    SolverCancelled,
    SolverCrashed,
    SolverError,
    SolverTimeout,
    StorageUnavailable,
    StoreDamaged,
)
from modetune.core.keys import Json, canonical_json, content_key
from modetune.core.parameters import Values
from modetune.core.results import Result, finite
from modetune.core.store import Entry, Store, storage_errors
from modetune.flows.execution.limits import CORES, Limit, Limits
from modetune.flows.notes import NOTE_FILE, job_note

logger = logging.getLogger(__name__)
R = TypeVar("R", bound=Result)

#: Pauses before asking again for a licence grow by this factor up to this length, seconds.
PAUSE_GROWTH, LONGEST_PAUSE_S = 1.5, 600.0


@dataclass(frozen=True, slots=True)
class Job:
    """One analysis of the model at some parameter values (relative to the deck)."""

    values: Values
    analysis: Analysis


@dataclass(frozen=True, slots=True)
class JobOutcome:
    """Where a job's result is, whether the store had it, and the time from first try to result."""

    key: str
    reused: bool
    wall_s: float


@dataclass(frozen=True, slots=True)
class Policy:
    """What follows from a failed job.

    stopped, timeout, no_result: how often it is tried again when it was killed or broke off, ran
    out of time, or left what is no result. What the solver rejected, and what was too large for
    the machine, is never tried again.
    """

    timeout_s: float
    stopped: int
    timeout: int
    no_result: int
    licence_pause_s: float
    licence_wait_s: float

    def chances(self, error: SolverError) -> int:
        """How often a job that ended so may be tried again."""
        if isinstance(error, NoResult):
            return self.no_result
        if isinstance(error, SolverTimeout):
            return self.timeout
        return self.stopped if isinstance(error, SolverCrashed) else 0


class Ledger:
    """What a campaign's solver runs cost so far, failed ones included; safe from many threads.

    core_s: cores times the time that jobs held them; licence_s: licences times that time.
    """

    def __init__(self) -> None:
        self.core_s = 0.0
        self.licence_s = 0.0
        self._lock = threading.Lock()

    def add(self, seconds: float, limits: tuple[Limit, ...]) -> None:
        """Count a run that held these limits."""
        with self._lock:
            for limit in limits:
                if limit.name == CORES:
                    self.core_s += limit.taken * seconds
                else:
                    self.licence_s += limit.taken * seconds


@dataclass(frozen=True, slots=True)
class JobEngine:
    """Solves jobs of one model against one store; safe to call from many threads.

    may_run: False where the store alone may answer. elsewhere: runs a job of this key so that the
    store has it, in place of this process. ahead: jobs that were begun before anybody asked.
    """

    solver: Solver
    store: Store
    policy: Policy
    threads: int
    keep_jobs: bool
    cancelled: threading.Event
    counter: Limits
    limits: tuple[Limit, ...]
    ledger: Ledger
    may_run: bool = True
    elsewhere: Callable[[Job, str], JobOutcome] | None = None
    ahead: dict[str, Future[JobOutcome]] = field(default_factory=dict)

    def begin(self, job: Job) -> None:
        """Start a job in the background; the next `solve` of it has its outcome."""
        outcome: Future[JobOutcome] = Future()
        self.ahead[self.key(job)] = outcome

        def run() -> None:
            try:
                outcome.set_result(self._solve(job))
            except BaseException as error:
                outcome.set_exception(error)  # raised where the job is asked for

        threading.Thread(target=run, name="modetune-ahead").start()

    def solve(self, job: Job) -> JobOutcome:
        """Make sure the store has the job's result. Raises SolverError, StoreError, ModelError."""
        begun = self.ahead.pop(self.key(job), None) if self.ahead else None
        return self._solve(job) if begun is None else begun.result()

    def _solve(self, job: Job) -> JobOutcome:
        asked = canonical_json(self.solver.content(job.values, job.analysis))
        key = content_key(asked)
        if key in self.store:  # `result` finds out whether it is whole
            return JobOutcome(key, True, 0.0)
        if not self.may_run:
            raise NotStored(f"the store has no result {key[:12]}, and no solver may run here")
        if self.elsewhere is not None:
            return self.elsewhere(job, key)
        with self.store.lock(key, self._wait_for_another):
            if key in self.store:  # another campaign was faster
                return JobOutcome(key, True, 0.0)
            started = time.monotonic()
            result = self._with_retries(job, key)
            wall_s = time.monotonic() - started
            self.store.put(
                Entry(key, result, self.solver.name, self.solver.version(), wall_s), asked,
                self._note(job),
            )  # fmt: skip
            logger.info("%s job %s solved in %.1f s", self.solver.name, key[:12], wall_s)
            return JobOutcome(key, False, wall_s)

    def result(self, job: Job) -> Result:
        """A job's result, solved now if the store lacks it."""
        entry = self.store.get(self.solve(job).key)
        if entry is None:  # damaged between two breaths: once more, then it is the disk
            outcome = self.solve(job)
            entry = self.store.get(outcome.key)
            if entry is None:
                raise StoreDamaged(
                    f"{self.store.path(outcome.key)} was written anew and is damaged again; look "
                    f"at the disk that holds {self.store.folder}"
                )
        return entry.result

    def _wait_for_another(self) -> None:
        if self.cancelled.wait(0.1):
            raise SolverCancelled("the campaign is ending while another one runs the same job")

    def key(self, job: Job) -> str:
        """The content key of a job."""
        return content_key(canonical_json(self.solver.content(job.values, job.analysis)))

    def _note(self, job: Job) -> str:
        return job_note(self.solver, job.values, job.analysis, self.threads).text()

    def derived(self, asked: Json, compute: Callable[[], R], kind: type[R]) -> R:
        """What is computed here from results at a cost, from the store if it is there.

        asked: everything that can change the numbers, keys of the results among it.
        Raises NotComputed where the store alone may answer and has no answer.
        """
        text = canonical_json(asked)
        key = content_key(text)
        entry = self.store.get(key)
        if entry is not None and isinstance(entry.result, kind):
            return entry.result
        if not self.may_run:
            raise NotComputed(f"the store has no {key[:12]}, and nothing may be computed here")
        with self.store.lock(key, self._wait_for_another):
            entry = self.store.get(key)  # another campaign may have been faster
            if entry is not None and isinstance(entry.result, kind):
                return entry.result
            started = time.monotonic()
            result = compute()
            self.store.put(Entry(key, result, "modetune", "", time.monotonic() - started), text)
        return result

    def with_threads(self, threads: int) -> JobEngine:
        """The same engine with so many threads a job."""
        limits = tuple(
            replace(limit, taken=min(threads, limit.slots)) if limit.name == CORES else limit
            for limit in self.limits
        )
        return replace(self, threads=threads, limits=limits)

    @contextmanager
    def all_cores(self) -> Iterator[None]:
        """Hold all of the machine's cores for work in this process, and count its cost."""
        limits = tuple(
            replace(limit, taken=limit.slots) for limit in self.limits if limit.name == CORES
        )
        with self.counter.held(limits, self._wait_for_slot):
            started = time.monotonic()
            try:
                yield
            finally:
                self.ledger.add(time.monotonic() - started, limits)

    def _with_retries(self, job: Job, key: str) -> Result:
        failures: Counter[type[SolverError]] = Counter()
        while True:
            try:
                return self._with_licence(job, key)
            except SolverError as error:
                chances = self.policy.chances(error)
                failures[type(error)] += 1
                if failures[type(error)] > chances:
                    raise
                logger.warning("%s; trying again (%d of %d)", error, failures[type(error)], chances)

    def _with_licence(self, job: Job, key: str) -> Result:
        """Run the job; where no licence is free wait and ask again, which is no failure."""
        waited, pause = 0.0, self.policy.licence_pause_s
        while True:
            try:
                return self._run(job, key)
            except LicenceDenied as error:
                if waited + pause > self.policy.licence_wait_s:
                    raise LicenceDenied(
                        f"{error}\nno licence was free for {waited:.3g} s "
                        "(`run: licence_wait_s` in the campaign)"
                    ) from error
                logger.warning("no %s licence is free; asking again in %.0f s",
                               self.solver.name, pause)  # fmt: skip
                if self.cancelled.wait(pause):
                    raise SolverCancelled(
                        "the campaign is ending while a job waits for a licence"
                    ) from error
                waited += pause
                pause = min(PAUSE_GROWTH * pause, LONGEST_PAUSE_S)

    def _wait_for_slot(self, name: str) -> None:
        if self.cancelled.wait(0.05):
            raise SolverCancelled(f"the campaign is ending while a job waits for {name}")

    def _run(self, job: Job, key: str) -> Result:
        with self._job_folder(key) as folder:
            self.solver.write(job.values, job.analysis, folder)
            (folder / NOTE_FILE).write_text(self._note(job), encoding="utf-8")
            with self.counter.held(self.limits, self._wait_for_slot):
                started = time.monotonic()
                try:
                    finished = run_process(
                        self.solver.command(self.threads), folder, self.policy.timeout_s,
                        self.cancelled,
                    )  # fmt: skip
                finally:
                    self.ledger.add(time.monotonic() - started, self.limits)
            try:
                code = finished.return_code
                return finite(self.solver.read(job.values, job.analysis, folder, code))
            except ModesError as error:  # shapes that do not fit together, numbers that are none
                raise NoResult(f"{self.solver.name} left no result in {folder}: {error}") from error

    @contextmanager
    def _job_folder(self, key: str) -> Iterator[Path]:
        base = self.store.folder / "jobs"
        part, failed = base / f"{key}.part", base / f"{key}.failed"
        with storage_errors(part):
            for old in (part, failed):
                shutil.rmtree(old, ignore_errors=True)
            part.mkdir(parents=True)
            try:
                yield part
            except (SolverError, ModelError) as error:
                if disk_full(part):  # solvers end with good grace and half a file
                    shutil.rmtree(part, ignore_errors=True)
                    raise StorageUnavailable(
                        f"the disk that holds {base} is full, so a solver run was cut short; "
                        "nothing stored before was harmed; free some space and run the same "
                        "command again: finished jobs are not repeated"
                    ) from error
                part.rename(failed)
                raise type(error)(str(error).replace(str(part), str(failed))) from error
            except BaseException:
                shutil.rmtree(part, ignore_errors=True)
                raise
            if self.keep_jobs:
                shutil.rmtree(base / key, ignore_errors=True)
                part.rename(base / key)
            else:
                shutil.rmtree(part, ignore_errors=True)
