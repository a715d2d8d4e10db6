"""How the pieces of work of a study are carried out side by side.

The updating loop hands over pieces with names for people and gets outcomes back in order; errors
come back as values, because the loop decides what follows from them.

The first runs of a solver stand alone, so that a broken solver fails fast: one that always fails
(no licence file, a wrong option, a missing library) would fail in all jobs of the first iteration
at once, each with its retries, and one that hangs would hold every core until the time limit. Until
a job has succeeded, now or in an earlier run, no more pieces of one kind go together than may fail
before nothing else is tried. A modal job goes before its sensitivities; the matrix jobs of a model
go together, for one after another they would be the longest part of a campaign.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextvars import copy_context
from dataclasses import dataclass, field
from itertools import groupby
from threading import Lock

from modetune.core.errors import ModetuneError, SolverCancelled, SolverError, StorageUnavailable
from modetune.flows.jobs.engine import JobEngine, JobOutcome
from modetune.flows.jobs.job import Job
from modetune.flows.jobs.limits import CORES, Limit
from modetune.flows.jobs.watching import doing
from modetune.flows.jobs.work import Answer, Piece, Task

logger = logging.getLogger(__name__)

#: Of the first pieces of one kind so many may fail, at other values each, before none is tried.
FIRST_FAILURES = 3
#: Of more pieces at once those that the store has are one task together.
EACH_A_TASK = 100
#: Seconds that a shared disk may take to show a result that another process wrote there.
PATIENCE_S = 60.0
#: Seconds between two looks at a task in another process, and at cancellation.
LOOK_S = 0.1


@dataclass(frozen=True, slots=True)
class Work:
    """A named piece of an iteration: the jobs it needs, none where it follows from others.

    engine: of the model they are for, where that is not the execution's own.
    """

    name: str
    jobs: tuple[Job, ...]
    engine: JobEngine | None = None


#: How a piece of work ended: an outcome a job, or the error that ended it.
Done = tuple[JobOutcome, ...] | ModetuneError


class Execution:
    """Carries out the work of one chain (an update, a screening) on an engine's tasks."""

    def __init__(self, engine: JobEngine) -> None:
        self.engine = engine
        self._proven = not engine.may_run  # the store alone fails in no solver

    def run(self, iteration: str, works: Sequence[Work]) -> list[Done]:
        """Outcomes in the order of the works; for pieces not tried the first failure."""
        done: list[Done] = []
        failures = 0
        while len(done) < len(works):
            rest = works[len(done) :]
            if self._proven:
                return done + self._together(iteration, rest)
            alike = list(next(groupby(rest, _kind))[1])
            tried = self._together(iteration, alike[: FIRST_FAILURES - failures])
            done, rest = done + tried, rest[len(tried) :]
            # A stored result is an earlier success.
            self._proven = not all(isinstance(outcome, ModetuneError) for outcome in tried)
            failed = [outcome for outcome in tried if isinstance(outcome, SolverError)]
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
        """Show work that did not have to run, and why."""
        self.engine.tasks.note(iteration, names, state, reason)

    def _together(self, iteration: str, works: Sequence[Work]) -> list[Done]:
        """Outcomes of pieces that go side by side."""
        engine = self.engine
        engine.tasks.opens(sum(bool(work.jobs) for work in works))
        if engine.tasks.runner.remote or len(works) > EACH_A_TASK:
            return _Feed(self, iteration, len(works)).run(works)
        begun: list[tuple[Work, Task]] = []
        try:
            begun += [(work, self.begin(iteration, work)) for work in works]
            return [self.ended(work, task) for work, task in begun]
        except BaseException:
            engine.cancelled.set()
            for _, task in begun:
                task.cancel()
            raise

    def begin(self, iteration: str, work: Work) -> Task:
        """Begin a piece of work."""
        engine = work.engine or self.engine
        tries = engine.policy.most_tries * max(len(work.jobs), 1)
        keys = ("",) * len(work.jobs)
        if self.engine.tasks.runner.remote:
            keys = tuple(engine.key(job) for job in work.jobs)

        def piece(begun: Callable[[], None]) -> Piece:
            return Piece(work.jobs, keys, engine.attempt, tries, engine.order, begun)

        return self.engine.tasks.begin(iteration, work.name, piece)

    def ended(self, work: Work, task: Task) -> Done:
        """The outcomes of a piece that has begun, when it has ended."""
        engine = work.engine or self.engine
        try:
            answer = task.result()
        except ModetuneError as error:
            return error
        found = zip(work.jobs, answer.jobs, strict=True)
        return tuple(engine.outcome(job, solved) for job, solved in found)


@dataclass
class _Feed:
    """Pieces of many, or for another process: so many at a time, each looked up in the store first.

    What the store has needs no other process, and of many pieces no task each.
    """

    execution: Execution
    iteration: str
    size: int
    stored: list[JobOutcome] = field(default_factory=list)
    lock: Lock = field(default_factory=Lock)

    def run(self, works: Sequence[Work]) -> list[Done]:
        engine = self.execution.engine
        with ThreadPoolExecutor(engine.tasks.runner.parallel, "modetune-feed") as pool:
            futures = [pool.submit(copy_context().run, self._one, work) for work in works]
            try:
                done = [future.result() for future in futures]
            except BaseException:
                engine.cancelled.set()
                for future in futures:
                    future.cancel()
                raise
        if self.stored:
            with doing(self.iteration):
                name = f"{len(self.stored)} results of the store"
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
                    raise SolverCancelled("the campaign is ending while another process runs a job")
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
        self.execution.engine.tasks.opens(-1)  # nobody waits for it
        with self.lock:
            self.stored.extend(outcomes)
        return outcomes


def solved(engine: JobEngine, jobs: Sequence[Job], name: str = "modal") -> tuple[JobOutcome, ...]:
    """Jobs of a study's model, as one piece. Raises what `JobEngine.solve` raises."""
    (done,) = Execution(engine).run("model", [Work(name, tuple(jobs))])
    if isinstance(done, ModetuneError):
        raise done
    return done


def _kind(work: Work) -> str:
    """What a piece of work is of: modal, finite differences of a parameter, ..."""
    return work.name.partition(" ")[0]


def _account(engine: JobEngine, answer: Answer) -> None:
    """Count the costs of another process here, and repeat its warnings."""
    engine.ledger.add(answer.core_s, (Limit(CORES, 1, 1),))
    engine.ledger.add(answer.licence_s, (Limit("licences", 1, 1),))
    for warning in answer.warnings:
        logger.warning("%s", warning)


def _wait_until_seen(engine: JobEngine, key: str) -> None:
    """Wait until this machine sees what a process on another one wrote."""
    store, left = engine.store, PATIENCE_S
    while key not in store:
        if left <= 0.0:
            raise StorageUnavailable(
                f"a Dask worker stored {key[:12]}, but it is not in {store.folder} here; the "
                "store must be on a disk that all machines share"
            )
        if engine.cancelled.wait(0.2):
            raise SolverCancelled("the campaign is ending")
        left -= 0.2
