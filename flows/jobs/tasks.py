"""The tasks of a study: what carries them out, who watches, and which follows from which.

Every piece of work of a run is one task of one runner. `Tasks` belongs to a job engine and to one
chain of work, an update for example; updates in parallel have one each. It knows which task
followed which, so that the run's graph shows modal -> sensitivity -> step -> next modal. These
edges are a picture: what a task needs it takes from the store.

The runner of a whole study is entered once (`running_with`), and all engines that are made inside
use it. Without one an engine has a thread pool of its own.
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
from modetune.flows.jobs.watching import Display, Ended, Solution, title
from modetune.flows.jobs.work import Computation, Piece, Runner, Task, TaskEnd, task_end

T = TypeVar("T")

#: Tasks upstream that one task names: graphs draw an edge for each, and joins multiply.
UPSTREAM = 20


@dataclass(eq=False)
class StudyRun:
    """A study under way: its runner, and what ends its solvers.

    licences: whether a Prefect server counts licences for all machines.
    """

    runner: Runner
    licences: bool = False
    _ends: list[threading.Event] = field(default_factory=list)
    _cancelled: bool = False

    def cancellation(self) -> threading.Event:
        """What the jobs of a new engine look at; set when the study is cancelled."""
        event = threading.Event()
        self._ends.append(event)
        if self._cancelled:
            event.set()
        return event

    def cancel(self) -> None:
        """End all solvers of the study; jobs that begin later end at once."""
        self._cancelled = True
        for event in self._ends:
            event.set()


_run: ContextVar[StudyRun | None] = ContextVar("run", default=None)


def study_run() -> StudyRun | None:
    """The study under way in this context."""
    return _run.get()


@contextmanager
def running_with(run: StudyRun) -> Iterator[None]:
    """Engines that are made in here have this run's runner."""
    token = _run.set(run)
    try:
        yield
    finally:
        _run.reset(token)


@dataclass(eq=False)
class Tasks:
    """The tasks of one chain of work.

    part: its name, where several go in parallel.
    """

    runner: Runner
    watcher: Display | None = None
    part: str = ""
    _root: list[Task] = field(default_factory=list)
    _modal: deque[Task] = field(default_factory=lambda: deque(maxlen=UPSTREAM))
    _sensitivities: deque[Task] = field(default_factory=lambda: deque(maxlen=UPSTREAM))
    _step: list[Task] = field(default_factory=list)

    def of_part(self, part: str) -> Tasks:
        """Tasks of one chain among several in parallel, under its name; of the whole without."""
        return Tasks(self.runner, self.watcher, part) if part else self

    def opens(self, pieces: int) -> None:
        """So many pieces of work come next, side by side; before a step they follow from the first
        task of all."""
        if self.watcher is not None:
            self.watcher.asked(pieces)
        if not self._root and self._modal:
            self._root = [self._modal[0]]

    def begin(
        self, iteration: str, name: str, piece: Callable[[Callable[[], None]], Piece]
    ) -> Task:
        """Begin a piece of work. piece: makes it; it gets what to call when the first try begins.

        Tasks of sensitivities follow from modes, all others from the last step.
        """
        ended: list[Callable[[Ended], None]] = []

        def begun() -> None:
            if self.watcher is not None:
                ended.append(self.watcher.began(self._titled(iteration), name))

        made = piece(begun)
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
        """Compute in this thread, as a task if it has a name and is done under a title (`doing`).

        work: gives the value and the outcomes that the task shows. Raises what it raises.
        """
        iteration = title()
        if not (iteration and name):
            return work()[0]
        call = None if self.watcher is None else self.watcher.began(self._titled(iteration), name)
        shown: Ended = SolverCancelled("broken off")

        def compute() -> tuple[T, TaskEnd]:
            nonlocal shown
            try:
                value, shown = work()
            except ModetuneError as error:
                shown = error
                raise
            return value, task_end(shown)

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
        """Compute a step in this thread, from the newest modes and sensitivities.

        work: gives the step, and a sentence that the task shows.
        """

        def compute() -> tuple[T, TaskEnd]:
            value, sentence = work()
            return value, TaskEnd("COMPLETED", "Completed", sentence)

        made = Computation(compute)
        after = [*list(self._modal)[-1:], *self._sensitivities][:UPSTREAM]
        task = self.runner.compute(self._named(iteration, "step"), made, after)
        self._modal.clear()
        self._sensitivities.clear()
        self._step = [] if task is None else [task]
        return made.value

    def note(self, iteration: str, names: Sequence[str], state: str, reason: str) -> None:
        """Show work that did not have to run, or was not tried."""
        kind = "CANCELLED" if state == "Not tried" else "COMPLETED"
        for name in names:
            end = TaskEnd(kind, state, reason)
            self.runner.note(self._named(iteration, name), end, list(self._modal))

    def _keep(self, name: str, task: Task) -> None:
        (self._sensitivities if _is_derivative(name) else self._modal).append(task)

    def _titled(self, iteration: str) -> str:
        return f"{self.part}, {iteration}" if self.part else iteration

    def _named(self, iteration: str, name: str) -> str:
        return f"{self._titled(iteration)} / {name}"


def _is_derivative(name: str) -> bool:
    """Whether a task of this name gives derivatives of modes; configurations stand in front."""
    return "sensitivit" in name


def _ended(task: Task) -> Ended:
    """The end of a task, for a display."""
    try:
        return task.result().jobs
    except ModetuneError as error:
        return error
    except BaseException:  # cancelled before it began, or broken off
        return SolverCancelled("broken off")
