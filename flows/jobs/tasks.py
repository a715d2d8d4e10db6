"""The tasks of a study: their runner, their display and their dependencies.

All work of a run consists of tasks of one runner. Each chain of work, such as one of several
parallel updates, has its own `Tasks`, which records the predecessors of each task, so that the
graph of the run shows modal -> sensitivity -> step -> next modal. The graph is only for display:
tasks read their inputs from the store.

`use_run` sets the runner for all engines of a study. Without it each engine has a thread pool.
"""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass, field
from typing import TypeVar

from modetune.core.errors import ModetuneError, SolverCancelled
from modetune.flows.jobs.progress import Ended, JobProgress, Solution, title
from modetune.flows.jobs.runner import Computation, Runner, Task, TaskRun, TaskState, task_state

T = TypeVar("T")

#: Maximum number of predecessors of a task: each is an edge of the graph.
UPSTREAM = 20


@dataclass(eq=False)
class StudyRun:
    """The running study: its runner and the cancellation of its solvers.

    licences is true if a Prefect server counts licences for all machines; outer is the study whose
    cancellation ends this one too.
    """

    runner: Runner
    licences: bool = False
    outer: StudyRun | None = None
    _inner: list[StudyRun] = field(default_factory=list)
    _ends: list[threading.Event] = field(default_factory=list)
    _cancelled: bool = False

    def __post_init__(self) -> None:
        if self.outer is not None:
            self.outer._inner.append(self)
            self._cancelled = self.outer._cancelled

    def cancellation(self) -> threading.Event:
        """Return an event for a new engine, set when the study is cancelled."""
        event = threading.Event()
        self._ends.append(event)
        if self._cancelled:
            event.set()
        return event

    def cancel(self) -> None:
        """Stop all solvers of the study; later jobs are cancelled at once."""
        self._cancelled = True
        for event in self._ends:
            event.set()
        for run in self._inner:
            run.cancel()


_run: ContextVar[StudyRun | None] = ContextVar("run", default=None)


def study_run() -> StudyRun | None:
    """Return the running study of this context, None without one."""
    return _run.get()


@contextmanager
def use_run(run: StudyRun) -> Iterator[None]:
    """Give engines created in this context the runner of `run`."""
    token = _run.set(run)
    try:
        yield
    finally:
        _run.reset(token)


@dataclass(eq=False)
class Tasks:
    """The tasks of one chain of work; part is its name if several run in parallel."""

    runner: Runner
    watcher: JobProgress | None = None
    part: str = ""
    _root: list[TaskRun] = field(default_factory=list)
    _modal: deque[TaskRun] = field(default_factory=lambda: deque(maxlen=UPSTREAM))
    _sensitivities: deque[TaskRun] = field(default_factory=lambda: deque(maxlen=UPSTREAM))
    _step: list[TaskRun] = field(default_factory=list)

    def of_part(self, part: str) -> Tasks:
        """Return new tasks for one of several parallel chains; `self` without a name."""
        return Tasks(self.runner, self.watcher, part) if part else self

    def opens(self, tasks: int) -> None:
        """Announce parallel tasks; before the first step they follow from the first task of all."""
        if self.watcher is not None:
            self.watcher.submitted(tasks)
        if not self._root and self._modal:
            self._root = [self._modal[0]]

    def begin(
        self, iteration: str, name: str, make_task: Callable[[Callable[[], None]], Task]
    ) -> TaskRun:
        """Submit a task.

        make_task gets a function to call before the first attempt. Sensitivities follow from
        modes, all other tasks from the last step.
        """
        ended: list[Callable[[Ended], None]] = []

        def begun() -> None:
            if self.watcher is not None:
                ended.append(self.watcher.began(self._titled(iteration), name))

        made = make_task(begun)
        if self.runner.remote:
            begun()
        after = self._modal if _is_derivative(name) else self._step or self._root
        task = self.runner.submit(self._named(iteration, name), made, list(after))
        self._keep(name, task)

        def end() -> None:
            for call in ended:
                call(_ended(task))

        task.on_end(end)
        return task

    def compute(self, name: str, work: Callable[[], tuple[T, Sequence[Solution]]]) -> T:
        """Compute in this thread, shown as a task if it has a name and a title (`doing`).

        work returns the value and the outcomes to show. Raises what it raises.
        """
        iteration = title()
        if not (iteration and name):
            return work()[0]
        call = None if self.watcher is None else self.watcher.began(self._titled(iteration), name)
        shown: Ended = SolverCancelled("interrupted")

        def compute() -> tuple[T, TaskState]:
            nonlocal shown
            try:
                value, shown = work()
            except ModetuneError as error:
                shown = error
                raise
            return value, task_state(shown)

        made = Computation(compute)
        try:
            task = self.runner.compute(self._named(iteration, name), made, list(self._modal))
        finally:
            if call is not None:
                call(shown)
        if task is not None:
            self._keep(name, task)
        return made.value

    def step(self, iteration: str, work: Callable[[], tuple[T, str]]) -> T:
        """Compute a step in this thread as successor of the newest modes and sensitivities.

        work returns the step and a sentence for the task's state.
        """

        def compute() -> tuple[T, TaskState]:
            value, sentence = work()
            return value, TaskState("COMPLETED", "Completed", sentence)

        made = Computation(compute)
        after = [*list(self._modal)[-1:], *self._sensitivities][:UPSTREAM]
        task = self.runner.compute(self._named(iteration, "step"), made, after)
        self._modal.clear()
        self._sensitivities.clear()
        self._step = [] if task is None else [task]
        return made.value

    def note(self, iteration: str, names: Sequence[str], state: str, reason: str) -> None:
        """Show work that was skipped or not attempted."""
        kind = "CANCELLED" if state == "Not tried" else "COMPLETED"
        for name in names:
            end = TaskState(kind, state, reason)
            self.runner.note(self._named(iteration, name), end, list(self._modal))

    def _keep(self, name: str, task: TaskRun) -> None:
        (self._sensitivities if _is_derivative(name) else self._modal).append(task)

    def _titled(self, iteration: str) -> str:
        return f"{self.part}, {iteration}" if self.part else iteration

    def _named(self, iteration: str, name: str) -> str:
        return f"{self._titled(iteration)} / {name}"


def _is_derivative(name: str) -> bool:
    """Whether the task computes derivatives; the name may begin with that of a configuration."""
    return "sensitivit" in name


def _ended(task: TaskRun) -> Ended:
    try:
        return task.result().jobs
    except ModetuneError as error:
        return error
    except BaseException:  # cancelled before it began, or interrupted
        return SolverCancelled("interrupted")
