"""Pieces of solver work, and the runners that carry them out. Nothing here knows Prefect.

A piece holds the jobs of one task and makes one try at a time. A runner decides where tries are
made (threads of this process, workers of a Dask cluster, Prefect's task runners); which failed try
may be followed by another is the engine's decision, and travels with the error as
`SolverError.again`. So the same function serves every runner.
"""

from __future__ import annotations

import logging
import math
import threading
from collections import Counter
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextvars import copy_context
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Generic, Protocol, TypeVar

from modetune.core.errors import ModetuneError, SolverCancelled, SolverError
from modetune.flows.jobs.job import Job
from modetune.flows.jobs.limits import CORES, Limit
from modetune.flows.jobs.watching import Ended

T = TypeVar("T")

#: Keys that a task's state names.
SHOWN = 8
#: Characters of a warning that travels from another process.
LONGEST = 2000


class Ledger:
    """What solver runs cost so far, failed ones included; safe from many threads.

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


@dataclass(slots=True)
class Tries:
    """The tries of one job: the time of the first, NaN before it, and the failures by kind."""

    began_s: float = math.nan
    failures: Counter[type[SolverError]] = field(default_factory=Counter)


@dataclass(frozen=True, slots=True)
class Solved:
    """A job whose result is in the store; wall_s: from the first try to the result."""

    key: str
    reused: bool
    wall_s: float


#: One try of a job of this key. Raises the error of a failed try, with `SolverError.again` set.
Attempt = Callable[[Job, str, Tries], Solved]


def tried(attempt: Callable[[], T]) -> T:
    """Try until it succeeds, or fails with an error that allows no other try."""
    while True:
        try:
            return attempt()
        except SolverError as error:
            if not error.again:
                raise


@dataclass(frozen=True, slots=True)
class Order:
    """What another process needs to solve jobs of one model of a run.

    run: distinguishes runs of the same campaign; model: position of the case in the campaign;
    licences: whether a Prefect server counts them; make: gives the attempts there, and counts their
    cost; a function of a module, which travels by its name.
    """

    run: str
    file: Path
    settings: tuple[str, ...]
    store: Path
    threads: int
    model: int
    licences: bool
    make: Callable[[Order, Ledger], Attempt]


@dataclass(frozen=True, slots=True)
class Answer:
    """What a piece gives: its jobs in order; from another process also costs and warnings."""

    jobs: tuple[Solved, ...]
    core_s: float = 0.0
    licence_s: float = 0.0
    warnings: tuple[str, ...] = ()


class Piece:
    """The jobs of one task, tried one at a time.

    A plain object: Prefect looks into collections and dataclasses that it is given. On the way to
    another process it leaves its attempt behind and takes one there, by its order.

    keys: of the jobs, which another process must find too; "" where the piece stays in this one.
    tries: how many at most, the first of each job included; begun: called when the first try
    begins in this process.
    """

    def __init__(
        self,
        jobs: tuple[Job, ...],
        keys: tuple[str, ...],
        attempt: Attempt,
        tries: int,
        order: Order | None,
        begun: Callable[[], None] = lambda: None,
    ) -> None:
        self.jobs = jobs
        self.keys = keys
        self.tries = tries
        self.order = order
        self._attempt: Attempt | None = attempt
        self._begun: Callable[[], None] | None = begun
        self._tries = [Tries() for _ in jobs]
        self._ledger = Ledger()
        self._warnings: list[str] = []
        #: What a try ended with that no solver, model or store can be blamed for.
        self.fault: BaseException | None = None

    @property
    def stays(self) -> bool:
        """Whether its tries are made in this process."""
        return not any(self.keys)

    def __getstate__(self) -> dict[str, Any]:
        return self.__dict__ | {"_attempt": None, "_begun": None, "_ledger": None}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__ |= state | {"_ledger": Ledger()}

    def attempt(self) -> Answer:
        """One try. Raises the error of a job that failed."""
        try:
            return self._tried()
        except ModetuneError:
            raise
        except BaseException as fault:
            self.fault = fault
            raise

    def _tried(self) -> Answer:
        if self._begun is not None:
            self._begun()
            self._begun = None
        if self._attempt is not None:
            return Answer(self._solved(self._attempt))
        assert self.order is not None
        handler, ours = _Warnings(self._warnings), logging.getLogger("modetune")
        ours.addHandler(handler)
        try:
            solved = self._solved(self.order.make(self.order, self._ledger))
        finally:
            ours.removeHandler(handler)
        ledger = self._ledger
        return Answer(solved, ledger.core_s, ledger.licence_s, tuple(self._warnings))

    def _solved(self, attempt: Attempt) -> tuple[Solved, ...]:
        items = zip(self.jobs, self.keys, self._tries, strict=True)
        return tuple(attempt(*item) for item in items)


class _Warnings(logging.Handler):
    """Keeps the warnings of the thread that made it."""

    def __init__(self, found: list[str]) -> None:
        super().__init__(logging.WARNING)
        self.found = found
        self.thread = threading.get_ident()

    def emit(self, record: logging.LogRecord) -> None:
        if record.thread == self.thread:
            self.found.append(record.getMessage()[:LONGEST])


@dataclass(frozen=True, slots=True)
class TaskEnd:
    """The state that a task ends in: its type, name and message."""

    kind: str
    name: str
    message: str


def task_end(ended: Ended) -> TaskEnd:
    """The state of a task that ended so."""
    if isinstance(ended, SolverCancelled):
        return TaskEnd("CANCELLED", "Cancelled", str(ended))
    if isinstance(ended, ModetuneError):
        return TaskEnd("FAILED", "Failed", str(ended))
    if not ended:
        return TaskEnd("COMPLETED", "Derived", "no job was needed")
    keys = ", ".join(outcome.key[:12] for outcome in ended[:SHOWN])
    if len(ended) > SHOWN:
        keys += f" and {len(ended) - SHOWN} more"
    if all(outcome.reused for outcome in ended):
        return TaskEnd("COMPLETED", "Cached", keys)
    return TaskEnd("COMPLETED", "Completed", f"{keys} in {sum(e.wall_s for e in ended):.1f} s")


class Computation(Generic[T]):
    """Something computed in the study's own process, and the state that its task ends in.

    A plain object, as a piece is. It keeps the value, or the error.
    """

    def __init__(self, compute: Callable[[], tuple[T, TaskEnd]]) -> None:
        self._compute = compute
        self._value: list[T] = []
        self._error: BaseException | None = None

    def run(self) -> TaskEnd:
        """Compute. Raises what the computation raises."""
        try:
            value, end = self._compute()
        except BaseException as error:
            self._error = error
            raise
        self._value.append(value)
        return end

    @property
    def has_run(self) -> bool:
        """Whether it ended, with a value or an error."""
        return bool(self._value) or self._error is not None

    @property
    def value(self) -> T:
        """The value. Raises what the computation raised."""
        if self._error is not None:
            raise self._error
        return self._value[0]


class Task(Protocol):
    """A task that a runner has begun."""

    def done(self) -> bool:
        """Whether it has ended."""
        ...

    def wait(self, seconds: float) -> None:
        """Wait for its end, no longer than this."""
        ...

    def result(self) -> Answer:
        """Its answer. Raises what ended it."""
        ...

    def cancel(self) -> None:
        """Do not begin it, if it has not begun."""
        ...

    def on_end(self, call: Callable[[], None]) -> None:
        """Call this when it has ended."""
        ...


class Runner(Protocol):
    """Carries out tasks.

    parallel: tasks at the same time; remote: whether tries are made in other processes.
    """

    parallel: int
    remote: bool

    def submit(self, name: str, piece: Piece, after: Sequence[Task]) -> Task:
        """Begin a piece; after: tasks that it follows from, in the picture of the run."""
        ...

    def compute(self, name: str, work: Computation[Any], after: Sequence[Task]) -> Task | None:
        """Carry out a computation in this thread. Raises what it raises."""
        ...

    def note(self, name: str, end: TaskEnd, after: Sequence[Task]) -> None:
        """Show a task that did not have to run, or was not tried."""
        ...


@dataclass(frozen=True, slots=True)
class PoolTask:
    """A task of a thread pool."""

    future: Future[Answer]

    def done(self) -> bool:
        return self.future.done()

    def wait(self, seconds: float) -> None:
        try:
            self.future.exception(seconds)
        except TimeoutError:
            pass

    def result(self) -> Answer:
        return self.future.result()

    def cancel(self) -> None:
        self.future.cancel()

    def on_end(self, call: Callable[[], None]) -> None:
        self.future.add_done_callback(lambda _: call())


class PoolRunner:
    """Threads of this process, without Prefect; each waits for its external solver."""

    remote = False

    def __init__(self, parallel: int) -> None:
        self.parallel = parallel
        self._pool = ThreadPoolExecutor(parallel, thread_name_prefix="modetune")

    def close(self) -> None:
        """End the threads when their pieces have ended; waits for none."""
        self._pool.shutdown(wait=False)

    def submit(self, name: str, piece: Piece, after: Sequence[Task]) -> Task:
        return PoolTask(self._pool.submit(copy_context().run, tried, piece.attempt))

    def compute(self, name: str, work: Computation[Any], after: Sequence[Task]) -> None:
        work.run()

    def note(self, name: str, end: TaskEnd, after: Sequence[Task]) -> None:
        pass


#: In other processes: which runs are at their end. A run is never taken out: a piece may come late.
_ends: dict[str, threading.Event] = {}


def run_end(run: str) -> threading.Event:
    """In another process: set when this run is over."""
    return _ends.setdefault(run, threading.Event())


def meanwhile(name: str, task: Callable[[], T]) -> Future[T]:
    """What another thread carries out in parallel. Whoever takes its result waits for its end."""
    pool = ThreadPoolExecutor(1, thread_name_prefix=f"modetune-{name}")
    future = pool.submit(copy_context().run, task)
    pool.shutdown(wait=False)
    return future
