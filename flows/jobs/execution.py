"""Parallel execution of a study's named work.

The updating loop submits work and gets outcomes in the same order; errors are returned as values,
because the loop decides how to react to them.

A broken solver (missing licence file, wrong option, missing library) would fail in all jobs of the
first iteration, each with its retries, and a hanging one would hold all cores until the time limit.
So until one job has succeeded, now or in an earlier run, at most FIRST_FAILURES jobs of one kind
run at a time. A modal job runs before its sensitivities; the matrix jobs of a model run together,
because in sequence they would take longer than the rest of a campaign.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextvars import copy_context
from dataclasses import dataclass, field
from functools import partial
from itertools import groupby
from threading import Lock
from typing import TypeVar

from modetune.core.errors import ModetuneError, SolverCancelled, SolverError, StorageUnavailable
from modetune.core.storage.campaign_record import RunCounts
from modetune.flows.jobs.engine import JobEngine, JobOutcome
from modetune.flows.jobs.job import Job
from modetune.flows.jobs.limits import CORES, Limit
from modetune.flows.jobs.progress import doing
from modetune.flows.jobs.runner import Task, TaskResult, TaskRun

logger = logging.getLogger(__name__)
T = TypeVar("T")

#: Before the first success, this many failures of one kind (at different values) end the run.
FIRST_FAILURES = 3
#: Above this number, all cached work is shown as one task.
EACH_A_TASK = 100
#: Seconds until a result from another machine must be visible on the shared disk.
PATIENCE_S = 60.0
#: Seconds between two checks of a remote task and of cancellation.
LOOK_S = 0.1


@dataclass(frozen=True, slots=True)
class Work:
    """Named work of an iteration and its jobs, none if it follows from other results.

    engine is None if the execution's own engine solves them.
    """

    name: str
    jobs: tuple[Job, ...]
    engine: JobEngine | None = None

    def counts(self, outcomes: tuple[JobOutcome, ...]) -> RunCounts:
        """Return the runs of its jobs by kind."""
        ran = sum(not outcome.reused for outcome in outcomes)
        modal = self.name.startswith("modal")
        return RunCounts(
            modal=ran if modal else 0,
            sensitivity=0 if modal else ran,
            reused=len(outcomes) - ran,
        )


#: One outcome per job, or the error that ended the work.
Done = tuple[JobOutcome, ...] | ModetuneError


class Execution:
    """Runs the work of one update, screening or other study as tasks of an engine."""

    def __init__(self, engine: JobEngine) -> None:
        self.engine = engine
        self._proven = not engine.may_run  # without solver runs no solver can fail

    def run(self, iteration: str, works: Sequence[Work]) -> list[Done]:
        """Return outcomes in the order of the works; work not attempted has the first failure."""
        done: list[Done] = []
        failures = 0
        while len(done) < len(works):
            rest = works[len(done) :]
            if self._proven:
                return done + self._together(iteration, rest)
            alike = list(next(groupby(rest, _kind))[1])
            first = self._together(iteration, alike[: FIRST_FAILURES - failures])
            done, rest = done + first, rest[len(first) :]
            # A stored result is an earlier success.
            self._proven = not all(isinstance(outcome, ModetuneError) for outcome in first)
            failed = [outcome for outcome in first if isinstance(outcome, SolverError)]
            failures += len(failed)
            ended = any(isinstance(error, SolverCancelled) for error in failed)
            if not failed or (self._proven and not ended):
                continue
            more = any(_kind(other) == _kind(alike[0]) for other in rest)
            if failures >= FIRST_FAILURES or not more or ended:
                error = failed[0]
                reason = f"no job has succeeded so far: {error}"
                if rest:
                    names = [other.name for other in rest]
                    self.engine.tasks.note(iteration, names, "Not tried", reason)
                return [*done, *(type(error)(f"not tried: {reason}") for _ in rest)]
        return done

    def skip(self, iteration: str, names: Sequence[str], state: str, reason: str) -> None:
        """Show work that was skipped, and why."""
        self.engine.tasks.note(iteration, names, state, reason)

    def _together(self, iteration: str, works: Sequence[Work]) -> list[Done]:
        engine = self.engine
        engine.tasks.opens(sum(bool(work.jobs) for work in works))
        if engine.tasks.runner.remote or len(works) > EACH_A_TASK:
            return _Feed(self, iteration, len(works)).run(works)
        begun: list[tuple[Work, TaskRun]] = []
        try:
            begun += [(work, self.begin(iteration, work)) for work in works]
            return [self.ended(work, task) for work, task in begun]
        except BaseException:
            engine.cancelled.set()
            for _, task in begun:
                task.cancel()
            raise

    def begin(self, iteration: str, work: Work) -> TaskRun:
        engine = work.engine or self.engine
        tries = engine.policy.max_tries * max(len(work.jobs), 1)
        keys = ("",) * len(work.jobs)
        if self.engine.tasks.runner.remote:
            keys = tuple(engine.key(job) for job in work.jobs)

        def make_task(begun: Callable[[], None]) -> Task:
            return Task(work.jobs, keys, engine.attempt, tries, engine.order, begun)

        return self.engine.tasks.begin(iteration, work.name, make_task)

    def ended(self, work: Work, task: TaskRun) -> Done:
        """Wait for begun work and return its outcomes."""
        engine = work.engine or self.engine
        try:
            answer = task.result()
        except ModetuneError as error:
            return error
        found = zip(work.jobs, answer.jobs, strict=True)
        return tuple(engine.outcome(job, solved) for job, solved in found)


def on_threads(
    engine: JobEngine, calls: Sequence[Callable[[], T]], at_once: int, name: str
) -> list[T]:
    """Return the results of calls in their order; the first error cancels the engine's work.

    name: of the threads.
    """
    with ThreadPoolExecutor(at_once, name) as pool:
        futures = [pool.submit(copy_context().run, call) for call in calls]
        try:
            return [future.result() for future in futures]
        except BaseException:
            engine.cancelled.set()
            for future in futures:
                future.cancel()
            raise


@dataclass
class _Feed:
    """Feeds remote or numerous work to the runner, `parallel` at a time.

    Cached results need no remote process and, if numerous, no task each.
    """

    execution: Execution
    iteration: str
    size: int
    stored: list[JobOutcome] = field(default_factory=list)
    lock: Lock = field(default_factory=Lock)

    def run(self, works: Sequence[Work]) -> list[Done]:
        engine = self.execution.engine
        calls = [partial(self._one, work) for work in works]
        done = on_threads(engine, calls, engine.tasks.runner.parallel, "modetune-feed")
        if self.stored:
            with doing(self.iteration):
                name = f"{len(self.stored)} cached results"
                engine.tasks.compute(name, lambda: (None, self.stored))
        return done

    def _one(self, work: Work) -> Done:
        engine = work.engine or self.execution.engine
        try:
            if work.jobs and engine.has(work.jobs):
                return self._from_store(engine, work)
        except ModetuneError as error:
            return error
        task = self.execution.begin(self.iteration, work)
        if not engine.tasks.runner.remote:
            return self.execution.ended(work, task)
        try:
            while not task.done():
                task.wait(LOOK_S)
                if engine.cancelled.is_set():
                    raise SolverCancelled("cancelled while another process ran a job")
            _account(engine, task.result())
            done = self.execution.ended(work, task)
            for outcome in () if isinstance(done, ModetuneError) else done:
                _wait_until_seen(engine, outcome.key)
        except ModetuneError as error:
            task.cancel()
            return error
        return done

    def _from_store(self, engine: JobEngine, work: Work) -> Done:
        def found() -> tuple[tuple[JobOutcome, ...], tuple[JobOutcome, ...]]:
            outcomes = tuple(engine.solve(job) for job in work.jobs)
            return outcomes, outcomes

        if self.size <= EACH_A_TASK:
            with doing(self.iteration):
                return self.execution.engine.tasks.compute(work.name, found)
        outcomes, _ = found()
        self.execution.engine.tasks.opens(-1)  # no task will run for it
        with self.lock:
            self.stored.extend(outcomes)
        return outcomes


def solve_jobs(
    engine: JobEngine, jobs: Sequence[Job], name: str = "modal"
) -> tuple[JobOutcome, ...]:
    """Solve jobs of a study's model as one task. Raises as `JobEngine.solve`."""
    (done,) = Execution(engine).run("model", [Work(name, tuple(jobs))])
    if isinstance(done, ModetuneError):
        raise done
    return done


def _kind(work: Work) -> str:
    """The first word of the name: modal, matrices, finite, ..."""
    return work.name.partition(" ")[0]


def _account(engine: JobEngine, answer: TaskResult) -> None:
    """Add the costs of a remote process and repeat its warnings."""
    engine.costs.add(answer.core_s, (Limit(CORES, 1, 1),))
    engine.costs.add(answer.licence_s, (Limit("licences", 1, 1),))
    for warning in answer.warnings:
        logger.warning("%s", warning)


def _wait_until_seen(engine: JobEngine, key: str) -> None:
    store, left = engine.store, PATIENCE_S
    while key not in store:
        if left <= 0.0:
            raise StorageUnavailable(
                f"a Dask worker stored {key[:12]}, but {store.folder} does not have it here; put "
                "the store on a disk that all machines share"
            )
        if engine.cancelled.wait(0.2):
            raise SolverCancelled("the campaign was cancelled")
        left -= 0.2
