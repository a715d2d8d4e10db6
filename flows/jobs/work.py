"""How the jobs of an iteration are carried out side by side.

The updating loop hands over pieces of work with names for people and gets outcomes back in order;
errors come back as values, because the loop decides what follows from them.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextvars import copy_context
from dataclasses import dataclass, field
from typing import Protocol, TypeVar

from modetune.core.errors import ModetuneError
from modetune.flows.jobs.engine import JobEngine, JobOutcome
from modetune.flows.jobs.job import Job
from modetune.flows.jobs.watching import ask, doing, told

T = TypeVar("T")


@dataclass(frozen=True, slots=True)
class Work:
    """A named piece of an iteration: the jobs it needs, none where it follows from others.

    engine: of the model they are for, where that is not the execution's own.
    """

    name: str
    jobs: tuple[Job, ...]
    engine: JobEngine | None = None


#: Of more pieces at once those that the store answers are told as one.
TOLD_EACH = 100
#: What became of a piece of work: an outcome a job, or the error that ended it.
Done = tuple[JobOutcome, ...] | ModetuneError


class Execution(Protocol):
    """Runs pieces of work side by side."""

    def run(self, iteration: str, work: Sequence[Work]) -> list[Done]:
        """Outcomes in the order of the work."""
        ...

    def skip(
        self, iteration: str, names: Sequence[str], reason: str, state: str = "Skipped"
    ) -> None:
        """Note work that was not needed, or not tried, and why."""
        ...


#: What carries out the jobs of an engine, so many side by side.
Executes = Callable[[JobEngine, int], Execution]


def solve_work(engine: JobEngine, work: Work) -> Done:
    """Solve the jobs of one piece one after another."""
    try:
        return tuple((work.engine or engine).solve(job) for job in work.jobs)
    except ModetuneError as error:
        return error


def solved(engine: JobEngine, jobs: Sequence[Job], name: str = "modal") -> tuple[JobOutcome, ...]:
    """Jobs of a study's model, one after another, as one piece. Raises what `solve` raises."""
    with doing("model"), told(engine.watcher, name) as outcomes:
        done = tuple(engine.solve(job) for job in jobs)
        outcomes += done
    return done


def meanwhile(name: str, task: Callable[[], T]) -> Future[T]:
    """What another thread carries out meanwhile. Who asks for it waits for its end."""
    pool = ThreadPoolExecutor(1, thread_name_prefix=f"modetune-{name}")
    future = pool.submit(copy_context().run, task)
    pool.shutdown(wait=False)
    return future


@dataclass(frozen=True, slots=True)
class _Batch:
    """Pieces of many that the store answers: one for whoever watches, or each would be a row of a
    server's database."""

    engine: JobEngine
    iteration: str
    size: int
    outcomes: list[JobOutcome] = field(default_factory=list)

    def has(self, work: Work) -> bool:
        engine = work.engine or self.engine
        return self.size > TOLD_EACH and all(engine.key(job) in engine.store for job in work.jobs)

    def add(self, done: Done) -> Done:
        if not isinstance(done, ModetuneError):
            self.outcomes.extend(done)
        return done

    def tell(self) -> None:
        if self.outcomes and self.engine.watcher is not None:
            name = f"{len(self.outcomes)} results of the store"
            self.engine.watcher.began(self.iteration, name)(self.outcomes)


@dataclass(frozen=True, slots=True)
class ThreadExecution:
    """A bounded pool of threads; each waits for its external solver.

    The engine's watcher hears of each piece as it begins and ends, and of many that the store
    answers as one.
    """

    engine: JobEngine
    parallel: int

    def run(self, iteration: str, work: Sequence[Work]) -> list[Done]:
        ask(self.engine.watcher, sum(bool(piece.jobs) for piece in work))
        with ThreadPoolExecutor(self.parallel, thread_name_prefix="modetune") as pool:
            batch = _Batch(self.engine, iteration, len(work))
            futures = [pool.submit(self._solve, iteration, piece, batch) for piece in work]
            try:
                done = [future.result() for future in futures]
                batch.tell()
                return done
            except BaseException:
                self.engine.cancelled.set()
                for future in futures:
                    future.cancel()
                raise

    def skip(
        self, iteration: str, names: Sequence[str], reason: str, state: str = "Skipped"
    ) -> None:
        if self.engine.watcher is not None:
            self.engine.watcher.skipped(iteration, names, reason, state)

    def _solve(self, iteration: str, work: Work, batch: _Batch) -> Done:
        if self.engine.watcher is None:
            return solve_work(self.engine, work)
        if batch.has(work):
            ask(self.engine.watcher, -1)  # nobody waits for it
            return batch.add(solve_work(self.engine, work))
        ended = self.engine.watcher.began(iteration, work.name)
        done = solve_work(self.engine, work)
        ended(done)
        return done
