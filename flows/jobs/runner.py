"""Tasks of solver work and the runners that execute them, independent of Prefect.

A task contains some jobs and makes one attempt at a time. A runner decides where attempts run:
threads of this process, workers of a Dask cluster, or Prefect's task runners. The engine decides
whether a failed attempt may be repeated and puts this into the error as `SolverError.again`, so
every runner can call the same function.
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
from modetune.flows.jobs.progress import Ended

T = TypeVar("T")

#: At most this many keys appear in the state of a task.
SHOWN = 8
#: Warnings from another process are cut to this number of characters.
LONGEST = 2000


class Costs:
    """The cost of all solver runs so far, including failed ones; thread-safe.

    core_s is cores times seconds, licence_s licences times seconds.
    """

    def __init__(self) -> None:
        self.core_s = 0.0
        self.licence_s = 0.0
        self._lock = threading.Lock()

    def add(self, seconds: float, limits: tuple[Limit, ...]) -> None:
        """Add a run that held these limits."""
        with self._lock:
            for limit in limits:
                if limit.name == CORES:
                    self.core_s += limit.taken * seconds
                else:
                    self.licence_s += limit.taken * seconds


@dataclass(slots=True)
class Tries:
    """The attempts of one job: start of the first (NaN before it) and failures by kind."""

    began_s: float = math.nan
    failures: Counter[type[SolverError]] = field(default_factory=Counter)


@dataclass(frozen=True, slots=True)
class StoredResult:
    """A job whose result is in the store; wall_s is the time from first attempt to result."""

    key: str
    reused: bool
    wall_s: float


#: Attempts a job with a key once. Raises the error of a failure, with `SolverError.again` set.
Attempt = Callable[[Job, str, Tries], StoredResult]


def retry(attempt: Callable[[], T]) -> T:
    """Repeat until success, or until an error that allows no retry."""
    while True:
        try:
            return attempt()
        except SolverError as error:
            if not error.again:
                raise


@dataclass(frozen=True, slots=True)
class WorkerRequest:
    """What a worker process needs to solve the jobs of one model.

    run distinguishes runs of the same campaign; model is the position of the case in the campaign;
    licences is true if a Prefect server counts them. make is called in the worker and returns the
    function that attempts jobs and adds their costs; it is pickled by name.
    """

    run: str
    file: Path
    settings: tuple[str, ...]
    store: Path
    threads: int
    model: int
    licences: bool
    make: Callable[[WorkerRequest, Costs], Attempt]


@dataclass(frozen=True, slots=True)
class TaskResult:
    """The results of a task's jobs in order; from another process also its costs and warnings."""

    jobs: tuple[StoredResult, ...]
    core_s: float = 0.0
    licence_s: float = 0.0
    warnings: tuple[str, ...] = ()


class Task:
    """The jobs of one task.

    Not a dataclass, because Prefect searches dataclasses and collections for futures. In another
    process the attempt function is created again from `order`.

    keys are those of the jobs, which the other process must reproduce, or "" if the task stays in
    this process; tries is the maximum number of attempts; begun is called before the first attempt
    in this process.
    """

    def __init__(
        self,
        jobs: tuple[Job, ...],
        keys: tuple[str, ...],
        attempt: Attempt,
        tries: int,
        order: WorkerRequest | None,
        begun: Callable[[], None] = lambda: None,
    ) -> None:
        self.jobs = jobs
        self.keys = keys
        self.tries = tries
        self.order = order
        self._attempt: Attempt | None = attempt
        self._begun: Callable[[], None] | None = begun
        self._tries = [Tries() for _ in jobs]
        self._costs = Costs()
        self._warnings: list[str] = []
        #: An error that is not a ModetuneError, such as a bug or an interrupt.
        self.fault: BaseException | None = None

    @property
    def stays(self) -> bool:
        """Whether it runs in this process."""
        return not any(self.keys)

    def __getstate__(self) -> dict[str, Any]:
        return self.__dict__ | {"_attempt": None, "_begun": None, "_costs": None}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__ |= state | {"_costs": Costs()}

    def attempt(self) -> TaskResult:
        """Attempt all jobs once. Raises the error of the first that fails."""
        try:
            return self._attempt_all()
        except ModetuneError:
            raise
        except BaseException as fault:
            self.fault = fault
            raise

    def _attempt_all(self) -> TaskResult:
        if self._begun is not None:
            self._begun()
            self._begun = None
        if self._attempt is not None:
            return TaskResult(self._solved(self._attempt))
        assert self.order is not None
        handler, ours = _Warnings(self._warnings), logging.getLogger("modetune")
        ours.addHandler(handler)
        try:
            solved = self._solved(self.order.make(self.order, self._costs))
        finally:
            ours.removeHandler(handler)
        costs = self._costs
        return TaskResult(solved, costs.core_s, costs.licence_s, tuple(self._warnings))

    def _solved(self, attempt: Attempt) -> tuple[StoredResult, ...]:
        items = zip(self.jobs, self.keys, self._tries, strict=True)
        return tuple(attempt(*item) for item in items)


class _Warnings(logging.Handler):
    """Collects the warnings of the thread that creates it."""

    def __init__(self, found: list[str]) -> None:
        super().__init__(logging.WARNING)
        self.found = found
        self.thread = threading.get_ident()

    def emit(self, record: logging.LogRecord) -> None:
        if record.thread == self.thread:
            self.found.append(record.getMessage()[:LONGEST])


@dataclass(frozen=True, slots=True)
class TaskState:
    """The final state of a task: type, name and message."""

    kind: str
    name: str
    message: str


def task_state(ended: Ended) -> TaskState:
    """Return the state of a task with these outcomes."""
    if isinstance(ended, SolverCancelled):
        return TaskState("CANCELLED", "Cancelled", str(ended))
    if isinstance(ended, ModetuneError):
        return TaskState("FAILED", "Failed", str(ended))
    if not ended:
        return TaskState("COMPLETED", "Derived", "no job was needed")
    keys = ", ".join(outcome.key[:12] for outcome in ended[:SHOWN])
    if len(ended) > SHOWN:
        keys += f" and {len(ended) - SHOWN} more"
    if all(outcome.reused for outcome in ended):
        return TaskState("COMPLETED", "Cached", keys)
    return TaskState("COMPLETED", "Completed", f"{keys} in {sum(e.wall_s for e in ended):.1f} s")


class Computation(Generic[T]):
    """A computation in the study's process; keeps its value or error.

    compute returns the value and the state of the task. Not a dataclass, as for `Task`.
    """

    def __init__(self, compute: Callable[[], tuple[T, TaskState]]) -> None:
        self._compute = compute
        self._value: list[T] = []
        self._error: BaseException | None = None

    def run(self) -> TaskState:
        """Compute and return the task's state. Raises what the computation raises."""
        try:
            value, end = self._compute()
        except BaseException as error:
            self._error = error
            raise
        self._value.append(value)
        return end

    @property
    def has_run(self) -> bool:
        return bool(self._value) or self._error is not None

    @property
    def value(self) -> T:
        """The value. Raises what the computation raised."""
        if self._error is not None:
            raise self._error
        return self._value[0]


class TaskRun(Protocol):
    """A submitted task."""

    def done(self) -> bool:
        """Return whether it has ended."""
        ...

    def wait(self, seconds: float) -> None:
        """Wait for its end, at most this long."""
        ...

    def result(self) -> TaskResult:
        """Wait for the result. Raises the error that ended the task."""
        ...

    def cancel(self) -> None:
        """Cancel it unless it has begun."""
        ...

    def on_end(self, call: Callable[[], None]) -> None:
        """Call a function when it has ended."""
        ...


class Runner(Protocol):
    """Executes tasks, `parallel` at a time; remote is true if they run in other processes."""

    parallel: int
    remote: bool

    def submit(self, name: str, task: Task, after: Sequence[TaskRun]) -> TaskRun:
        """Submit a task; after lists its predecessors in the graph of the run."""
        ...

    def compute(
        self, name: str, work: Computation[Any], after: Sequence[TaskRun]
    ) -> TaskRun | None:
        """Run a computation in this thread. Raises what it raises."""
        ...

    def note(self, name: str, end: TaskState, after: Sequence[TaskRun]) -> None:
        """Show a task that was skipped or not attempted."""
        ...


@dataclass(frozen=True, slots=True)
class PoolTaskRun:
    """A task in a thread pool."""

    future: Future[TaskResult]

    def done(self) -> bool:
        return self.future.done()

    def wait(self, seconds: float) -> None:
        try:
            self.future.exception(seconds)
        except TimeoutError:
            pass

    def result(self) -> TaskResult:
        return self.future.result()

    def cancel(self) -> None:
        self.future.cancel()

    def on_end(self, call: Callable[[], None]) -> None:
        self.future.add_done_callback(lambda _: call())


class PoolRunner:
    """Runs tasks in threads of this process, without Prefect; each waits for its solver."""

    remote = False

    def __init__(self, parallel: int) -> None:
        self.parallel = parallel
        self._pool = ThreadPoolExecutor(parallel, thread_name_prefix="modetune")

    def close(self) -> None:
        """Let the threads end after their tasks; does not wait for them."""
        self._pool.shutdown(wait=False)

    def submit(self, name: str, task: Task, after: Sequence[TaskRun]) -> TaskRun:
        return PoolTaskRun(self._pool.submit(copy_context().run, retry, task.attempt))

    def compute(self, name: str, work: Computation[Any], after: Sequence[TaskRun]) -> None:
        work.run()

    def note(self, name: str, end: TaskState, after: Sequence[TaskRun]) -> None:
        pass


#: In a worker process: the end of each run. Runs are never removed, because a task may arrive late.
_ends: dict[str, threading.Event] = {}


def end_event(run: str) -> threading.Event:
    """Return the event of a worker process that is set when this run ends."""
    return _ends.setdefault(run, threading.Event())


def in_background(name: str, task: Callable[[], T]) -> Future[T]:
    """Run a function in another thread and return its future."""
    pool = ThreadPoolExecutor(1, thread_name_prefix=f"modetune-{name}")
    future = pool.submit(copy_context().run, task)
    pool.shutdown(wait=False)
    return future
