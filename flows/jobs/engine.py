"""The job engine: job -> key -> store -> solver -> result -> store. It knows no Prefect.

A job's deck is edited once: what is rendered for the key is what is run, and a key that was worked
out is remembered (`job.py`). Results are read from the store by the outcome's key.

A job runs in STORE/jobs/KEY.part. A good one leaves its result in the store, and its folder only
where the campaign keeps it (as KEY); a failed one leaves KEY.failed to look at. A lock a key lets
two campaigns that want the same job run it once.
"""

from __future__ import annotations

import logging
import math
import shutil
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Protocol, TypeVar

from modetune.adapters.licence import licence_refusal
from modetune.adapters.process import disk_full, run_process
from modetune.adapters.solver import Command, Program, Solver
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
from modetune.core.storage.files import storage_errors
from modetune.core.storage.keys import Json, canonical_json, content_key
from modetune.core.storage.store import Entry, Store
from modetune.core.updating.job_results import Result, finite
from modetune.flows.jobs.deck_texts import keep_text
from modetune.flows.jobs.job import NOMINAL, NOTE_FILE, Job, JobNote, JobPlan, Plans, analysis_kind
from modetune.flows.jobs.job_memory import JobMemory
from modetune.flows.jobs.limits import CORES, Limit, Limits
from modetune.flows.jobs.policy import Policy
from modetune.flows.jobs.scratch import factor_files
from modetune.flows.jobs.tasks import Tasks
from modetune.flows.jobs.watching import Derivation
from modetune.flows.jobs.work import Ledger, Order, Solved, Tries, tried

logger = logging.getLogger(__name__)
R = TypeVar("R", bound=Result)


@dataclass(frozen=True, slots=True)
class JobOutcome:
    """What became of a job; its result stays in the store until it is asked for.

    key: of the job; reused: whether the store had it; wall_s: from first try to result.
    """

    job: Job
    key: str
    reused: bool
    wall_s: float
    engine: JobEngine = field(repr=False, compare=False)

    def result(self, kind: type[R]) -> R:
        """The result, solved again if its entry was damaged. Raises what `solve` raises."""
        engine = self.engine
        entry = engine.store.get(self.key)
        if entry is None:  # damaged between two breaths: once more, then it is the disk
            engine.solve(self.job)
            entry = engine.store.get(self.key)
            if entry is None:
                raise damaged_again(engine.store, self.key)
        assert isinstance(entry.result, kind)
        return engine.solver.by_hand(entry.result)


class Launcher(Protocol):
    """Starts programs elsewhere than in a process group of this machine."""

    def wrapped(self, command: Command) -> Command:
        """What is started here so that the command runs there."""
        ...

    def check(self, folder: Path, return_code: int) -> None:
        """Raise the SolverError that the launcher, not the program, ended a job with."""
        ...


@dataclass(frozen=True, slots=True)
class JobEngine:
    """Solves jobs of one model against one store; safe to call from many threads.

    tasks: carry out its work. order: makes an engine like this one in another process, where that
    can be. may_run: False where only stored results may be used. launcher: starts the programs,
    where this process does not.
    """

    plans: Plans
    store: Store
    policy: Policy
    threads: int
    keep_jobs: bool
    cancelled: threading.Event
    counter: Limits
    limits: tuple[Limit, ...]
    ledger: Ledger
    tasks: Tasks
    order: Order | None = None
    may_run: bool = True
    launcher: Launcher | None = None
    memory: JobMemory = field(default_factory=JobMemory)

    @property
    def room(self) -> FactorRoom:
        """What factors in this process may take."""
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
        """Memory of this machine that may be taken."""
        return self.policy.memory_bytes or self.memory.of_machine

    @property
    def solver(self) -> Solver:
        """What solves the jobs."""
        return self.plans.solver

    @property
    def program(self) -> Program:
        """What runs them."""
        return self.plans.solver.program

    def solve(self, job: Job) -> JobOutcome:
        """Make sure the store has the job's result. Raises SolverError, StoreError, ModelError."""
        tries = Tries()
        return self.outcome(job, tried(lambda: self.attempt(job, "", tries)))

    def outcome(self, job: Job, solved: Solved) -> JobOutcome:
        """The outcome of a job whose result the store has."""
        return JobOutcome(job, solved.key, solved.reused, solved.wall_s, self)

    def has(self, jobs: Sequence[Job]) -> bool:
        """Whether the store has the results of all these jobs. Raises ModelError, SolverMissing."""
        return all(self.key(job) in self.store for job in jobs)

    def attempt(self, job: Job, key: str, tries: Tries) -> Solved:
        """One try to have the job's result in the store.

        key: of the job, where it is known. Raises as `solve` does; `again` of an error says whether
        another try may follow.
        """
        try:
            key = key or self.key(job)
            reused, wall_s = key in self.store, 0.0  # `JobOutcome.result` finds damaged entries
            if not reused and not self.may_run:
                raise NotStored(f"the store has no result {key[:12]}, and no solver may run here")
            if not reused:
                reused, wall_s = self._solve_here(job, key, tries)
        except SolverError as error:
            error.again = self.policy.allows_another(error, tries)
            if not error.again:
                self.plans.done(job)
            raise
        except BaseException:
            self.plans.done(job)
            raise
        self.plans.done(job)
        return Solved(key, reused, wall_s)

    def _solve_here(self, job: Job, key: str, tries: Tries) -> tuple[bool, float]:
        with self.store.lock(key, self._wait_for_another):
            if key in self.store:  # another campaign was faster
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
            raise SolverCancelled("the campaign is ending while another one runs the same job")

    def key(self, job: Job) -> str:
        """The content key of a job. Raises ModelError, SolverMissing."""
        return self.plans.key(job)

    def note(self, job: Job) -> JobNote:
        """What is told of a job beside its result. Raises ModelError, SolverMissing."""
        return self.plans.note(job, self.threads)

    def keep_text(self) -> None:
        """Keep the deck's text beside the results, so that it can be told where decks differ."""
        keep_text(self.store, self.plans.model_digest(), self.plans.plan(NOMINAL).rendered)
        self.plans.done(NOMINAL)

    def derived(self, asked: Json, compute: Callable[[], R], kind: type[R], name: str = "") -> R:
        """What is computed here from results at a cost, from the store if it is there.

        asked: everything that can change the numbers, keys of the results among it; name: of the
        task. Raises NotComputed where only stored results may be used and there is none.
        """
        text = canonical_json(asked)
        key, begun = content_key(text), time.monotonic()

        def found() -> tuple[R, Sequence[Derivation]]:
            reused = key in self.store
            value = self._derived(key, text, compute, kind)
            return value, [Derivation(key, reused, time.monotonic() - begun)]

        return self.tasks.compute(name, found)

    def _derived(self, key: str, text: str, compute: Callable[[], R], kind: type[R]) -> R:
        found = self._stored(key, kind)
        if found is not None:
            return found
        if not self.may_run:
            raise NotComputed(f"the store has no {key[:12]}, and nothing may be computed here")
        with self.store.lock(key, self._wait_for_another):
            found = self._stored(key, kind)  # another campaign may have been faster
            if found is None:
                self._compute(key, text, compute)
                # As everybody else will read it: arrays in another order have other last digits.
                found = self._stored(key, kind)
        if found is None:
            raise damaged_again(self.store, key)
        return found

    def _compute(self, key: str, asked: str, compute: Callable[[], Result]) -> None:
        started = time.monotonic()
        with factor_room(self.room):
            result = compute()
        self.store.put(Entry(key, result, "modetune", "", time.monotonic() - started), asked)

    def _stored(self, key: str, kind: type[R]) -> R | None:
        entry = self.store.get(key)
        return entry.result if entry is not None and isinstance(entry.result, kind) else None

    @property
    def cores_beside(self) -> int:
        """Cores that a job leaves free."""
        return sum(limit.slots - limit.taken for limit in self.limits if limit.name == CORES)

    @contextmanager
    def all_cores(self, beside: int = 0) -> Iterator[None]:
        """Hold all of the machine's cores for work in this process, and count its cost.

        beside: so many of them alone, where a job has the others.
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
                self.ledger.add(time.monotonic() - started, limits)

    def _wait_for_slot(self, name: str) -> None:
        if self.cancelled.wait(0.05):
            raise SolverCancelled(f"the campaign is ending while a job waits for {name}")

    def _run(self, job: Job, plan: JobPlan, note: str) -> Result:
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
                    self.ledger.add(time.monotonic() - started, self.limits)
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
            except (ModesError, OSError) as error:  # shapes that do not fit together, files gone
                raise NoResult(
                    f"{self.program.name} left no result in {folder}: {error}"
                ) from error

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
                with suppress(FileNotFoundError):  # removed meanwhile, which may be what failed
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
    """The error to raise where an entry cannot be read that was just written."""
    return StoreDamaged(
        f"{store.path(key)} was written anew and is damaged again; look at the disk that holds "
        f"{store.folder}"
    )
