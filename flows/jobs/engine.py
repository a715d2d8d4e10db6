"""The job engine: job -> key -> store -> solver -> result -> store. It does not depend on Prefect.

A job's deck is edited once: the deck rendered for the key is the one that runs, and keys are cached
(`job.py`). A job runs in STORE/jobs/KEY.part. A successful job leaves its result in the store, and
its folder as KEY if the campaign keeps folders; a failed one leaves KEY.failed. One lock per key
makes two campaigns that need the same job run it once.
"""

from __future__ import annotations

import logging
import math
import shutil
import threading
import time
import uuid
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TypeVar

from modetune.adapters.licence import licence_refusal
from modetune.adapters.process import disk_full, run_process
from modetune.adapters.solver import Program, Solver
from modetune.core.algebra.factor_room import MEMORY_VARIABLE, FactorRoom, factor_room
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
    SolverRejected,
    StorageUnavailable,
    StoreDamaged,
)
from modetune.core.storage.files import make_folder, storage_errors
from modetune.core.storage.keys import Json, canonical_json, content_key
from modetune.core.storage.store import Entry, Store
from modetune.core.updating.job_results import Result, finite
from modetune.flows.jobs.job import NOTE_FILE, Job, JobNote, JobPlan, Plans, analysis_kind
from modetune.flows.jobs.limits import CORES, JobMemory, Limit, Limits
from modetune.flows.jobs.policy import Policy
from modetune.flows.jobs.progress import Derivation
from modetune.flows.jobs.runner import Costs, StoredResult, Tries, WorkerRequest, retry
from modetune.flows.jobs.slurm import SlurmLauncher
from modetune.flows.jobs.store_files import factor_files
from modetune.flows.jobs.tasks import Tasks

logger = logging.getLogger(__name__)
R = TypeVar("R", bound=Result)


@dataclass(frozen=True, slots=True)
class JobOutcome:
    """A job whose result is in the store.

    reused is true if the result was stored before; wall_s is the time from first attempt to result.
    """

    job: Job
    key: str
    reused: bool
    wall_s: float
    engine: JobEngine = field(repr=False, compare=False)

    def result(self, kind: type[R]) -> R:
        """Return the result; solve the job again if the entry is damaged. Raises as `solve`."""
        engine = self.engine
        entry = engine.store.get(self.key)
        if entry is None:  # damaged since it was written: after a second time the disk is to blame
            engine.solve(self.job)
            entry = engine.store.get(self.key)
            if entry is None:
                raise damaged_again(engine.store, self.key)
        assert isinstance(entry.result, kind)
        return engine.solver.by_hand(entry.result)


@dataclass(frozen=True, slots=True)
class JobEngine:
    """Solves the jobs of one model and keeps their results in one store; thread-safe.

    order lets a worker process build an equal engine, None if that is impossible. may_run is False
    if only stored results may be used. launcher starts the programs instead of this process.
    """

    plans: Plans
    store: Store
    policy: Policy
    threads: int
    keep_jobs: bool
    cancelled: threading.Event
    counter: Limits
    limits: tuple[Limit, ...]
    costs: Costs
    tasks: Tasks
    order: WorkerRequest | None = None
    may_run: bool = True
    launcher: SlurmLauncher | None = None
    memory: JobMemory = field(default_factory=JobMemory)

    @property
    def room(self) -> FactorRoom:
        """Memory and disk that factorisations in this process may use."""
        store = self.store
        return FactorRoom(
            self.memory_bytes,
            self.policy.disk_bytes,
            lambda: factor_files(store),
            "`run.memory_gb`",
            "`run.disk_gb`",
            self.policy.single_factors,
        )

    @property
    def memory_bytes(self) -> int:
        """Memory of this machine that jobs may use."""
        return self.policy.memory_bytes or self.memory.of_machine

    @property
    def solver(self) -> Solver:
        return self.plans.solver

    @property
    def program(self) -> Program:
        return self.plans.solver.program

    def solve(self, job: Job) -> JobOutcome:
        """Solve a job unless its result is stored. Raises SolverError, StoreError, ModelError."""
        tries = Tries()
        return self.outcome(job, retry(lambda: self.attempt(job, "", tries)))

    def outcome(self, job: Job, solved: StoredResult) -> JobOutcome:
        return JobOutcome(job, solved.key, solved.reused, solved.wall_s, self)

    def has(self, jobs: Sequence[Job]) -> bool:
        """Return whether the store has all these results. Raises ModelError, SolverMissing."""
        return all(self.key(job) in self.store for job in jobs)

    def attempt(self, job: Job, key: str, tries: Tries) -> StoredResult:
        """Attempt once to get a job's result into the store.

        key is the job's if known, else "". Raises as `solve`; `again` of the error is true if the
        policy allows another attempt.
        """
        try:
            key = key or self.key(job)
            reused, wall_s = key in self.store, 0.0  # `JobOutcome.result` finds damaged entries
            if not reused and not self.may_run:
                raise NotStored(f"the store has no result {key[:12]} and solver runs are off")
            if not reused:
                reused, wall_s = self._solve_here(job, key, tries)
        except SolverError as error:
            error.again = self.policy.may_retry(error, tries)
            if not error.again:
                self.plans.done(job)
            raise
        except BaseException:
            self.plans.done(job)
            raise
        self.plans.done(job)
        return StoredResult(key, reused, wall_s)

    def _solve_here(self, job: Job, key: str, tries: Tries) -> tuple[bool, float]:
        with self.store.lock(key, self._wait_for_another):
            if key in self.store:  # another campaign solved it first
                return True, 0.0
            plan, note = self.plans.plan(job), self.note(job).text()
            if math.isnan(tries.began_s):
                tries.began_s = time.monotonic()
            result = self.policy.with_licence(
                lambda: self._run(job, plan, note), self.program.name, self.cancelled
            )
            wall_s = time.monotonic() - tries.began_s
            self.store.put(
                Entry(key, result, self.program.name, self.program.version(), wall_s),
                plan.asked,
                note,
            )
            logger.info("%s job %s solved in %.1f s", self.program.name, key[:12], wall_s)
            return False, wall_s

    def _wait_for_another(self) -> None:
        if self.cancelled.wait(0.1):
            raise SolverCancelled("cancelled while another campaign ran the same job")

    def key(self, job: Job) -> str:
        """Return a job's content key. Raises ModelError, SolverMissing."""
        return self.plans.key(job)

    def note(self, job: Job) -> JobNote:
        """Return the description stored with a job's result. Raises ModelError, SolverMissing."""
        return self.plans.note(job, self.threads)

    def derived(
        self,
        asked: Json,
        compute: Callable[[], R],
        kind: type[R],
        name: str = "",
        note: Callable[[], str] = str,
    ) -> R:
        """Return a result computed in this process, from the store if it has it.

        asked contains everything that can change the numbers, including the keys of the results
        they follow from; name is the task's; note: says, once it is computed, what the store keeps
        with it for people. Raises NotComputed if only stored results may be used
        and there is none.
        """
        text = canonical_json(asked)
        key, begun = content_key(text), time.monotonic()

        def found() -> tuple[R, Sequence[Derivation]]:
            reused = key in self.store
            value = self._derived(key, text, compute, kind, note)
            return value, [Derivation(key, reused, time.monotonic() - begun)]

        return self.tasks.compute(name, found)

    def _derived(
        self, key: str, text: str, compute: Callable[[], R], kind: type[R], note: Callable[[], str]
    ) -> R:
        found = self._stored(key, kind)
        if found is not None:
            return found
        if not self.may_run:
            raise NotComputed(f"the store has no result {key[:12]} and computations are off")
        with self.store.lock(key, self._wait_for_another):
            found = self._stored(key, kind)  # another campaign may have computed it first
            if found is None:
                self._compute(key, text, compute, note)
                # Read it as later runs will: the memory order of arrays affects the last digits.
                found = self._stored(key, kind)
        if found is None:
            raise damaged_again(self.store, key)
        return found

    def _compute(
        self, key: str, asked: str, compute: Callable[[], Result], note: Callable[[], str]
    ) -> None:
        started = time.monotonic()
        with factor_room(self.room):
            result = compute()
        entry = Entry(key, result, "modetune", "", time.monotonic() - started)
        self.store.put(entry, asked, note())

    def _stored(self, key: str, kind: type[R]) -> R | None:
        entry = self.store.get(key)
        return entry.result if entry is not None and isinstance(entry.result, kind) else None

    @property
    def cores_beside(self) -> int:
        """Cores left free by one job."""
        return sum(limit.slots - limit.taken for limit in self.limits if limit.name == CORES)

    @contextmanager
    def all_cores(self, beside: int = 0) -> Iterator[None]:
        """Hold the machine's cores for work in this process, and add its cost.

        beside is the number of cores if a job holds the others; 0 means all.
        """
        limits = tuple(
            replace(limit, taken=beside or limit.slots)
            for limit in self.limits
            if limit.name == CORES
        )
        with self.counter.held(limits, self._wait_for_slot):
            started = time.monotonic()
            try:
                yield
            finally:
                self.costs.add(time.monotonic() - started, limits)

    def _wait_for_slot(self, name: str) -> None:
        if self.cancelled.wait(0.05):
            raise SolverCancelled(f"cancelled while a job waited for {name}")

    def _run(self, job: Job, plan: JobPlan, note: str) -> Result:
        if plan.rendered.call is not None:
            return self._called(plan.rendered.call)
        with self._job_folder(plan.key) as folder:
            plan.rendered.write(folder)
            (folder / NOTE_FILE).write_text(note, encoding="utf-8")
            command = self.program.command(self.threads)
            if self.launcher is not None:
                command = self.launcher.wrapped(command)
            else:
                memory = (MEMORY_VARIABLE, str(self.memory_bytes))
                command = replace(command, environment=(*command.environment, memory))
            kind = self.program.name, self.solver.deck.summary.name, analysis_kind(job.analysis)
            share = self.memory.limit(kind, self.memory_bytes, self.policy.memory_bytes > 0)
            with self.counter.held((*self.limits, share), self._wait_for_slot):
                started = time.monotonic()
                try:
                    finished = run_process(
                        command,
                        folder,
                        self.policy.timeout_s,
                        self.cancelled,
                        self.policy.disk_bytes,
                    )
                finally:
                    self.costs.add(time.monotonic() - started, self.limits)
            if self.launcher is None:
                self.memory.add(kind, finished.peak_memory_bytes, self.memory_bytes)
            try:
                code = finished.return_code
                if self.launcher is not None and code != 0:
                    self.launcher.check(folder, code)
                return finite(self.solver.read(job.values, job.analysis, folder, code))
            except (SolverCrashed, SolverRejected) as error:
                refusal = licence_refusal(folder, self.policy.licence_messages)
                if not refusal:
                    raise
                raise LicenceDenied(
                    f"{self.program.name} got no licence in {folder}: {refusal}"
                ) from error
            except (ModesError, OSError) as error:  # inconsistent shapes or missing files
                raise NoResult(
                    f"{self.program.name} left no result in {folder}: {error}"
                ) from error

    def _called(self, call: Callable[[], Result]) -> Result:
        """Compute a result in this process."""
        with self.counter.held(self.limits, self._wait_for_slot):
            started = time.monotonic()
            try:
                return finite(self.solver.counted(call()))
            finally:
                self.costs.add(time.monotonic() - started, self.limits)

    @contextmanager
    def _job_folder(self, key: str) -> Iterator[Path]:
        base = self.store.folder / "jobs"
        part, failed = base / f"{key}.part", base / f"{key}.failed"
        with storage_errors(part):
            for old in (part, failed):
                shutil.rmtree(old, ignore_errors=True)
                with suppress(FileNotFoundError):  # what another account may only remove
                    old.rename(base / f"{uuid.uuid4().hex}.part")
            make_folder(part)
            try:
                yield part
            except (SolverError, ModelError) as error:
                if disk_full(part):  # solvers may exit normally with half a file
                    shutil.rmtree(part, ignore_errors=True)
                    raise StorageUnavailable(
                        f"the disk of {base} is full and a solver run was incomplete; free some "
                        "space and run the same command again: finished jobs are not repeated"
                    ) from error
                with suppress(FileNotFoundError):  # somebody removed it, perhaps causing the error
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


def damaged_again(store: Store, key: str) -> StoreDamaged:
    """Return the error for an entry that is damaged although it was just rewritten."""
    return StoreDamaged(
        f"{store.path(key)} was rewritten and is damaged again; check the disk of {store.folder}"
    )
