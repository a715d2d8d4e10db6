"""Progress of running jobs: done and submitted jobs, those running, and the remaining time.

A terminal shows a line that is updated in place; a pipe or log gets plain lines, the first at once
and then one every EVERY_S seconds.
"""

from __future__ import annotations

import json
import math
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from dataclasses import dataclass
from itertools import count
from pathlib import Path
from typing import Protocol

from rich.console import Console
from rich.progress import BarColumn, Progress, SpinnerColumn, TextColumn, TimeElapsedColumn
from rich.text import Text

from modetune.core.errors import ModetuneError

#: The title of this thread's computations; computations without a title are not shown.
_title: ContextVar[str] = ContextVar("title", default="")


class Solution(Protocol):
    """A result: key, whether it was cached, and seconds from first attempt to result."""

    @property
    def key(self) -> str: ...

    @property
    def reused(self) -> bool: ...

    @property
    def wall_s(self) -> float: ...


#: The outcome of a task: its results, empty if it follows from other results, or its error.
Ended = Sequence[Solution] | ModetuneError


@dataclass(frozen=True, slots=True)
class Derivation:
    """A `Solution` computed in this process, which is not a job."""

    key: str
    reused: bool
    wall_s: float


_display: ContextVar[JobProgress | None] = ContextVar("display", default=None)


@contextmanager
def use_display(display: JobProgress) -> Iterator[None]:
    """Show the work of engines created in this context on a display."""
    token = _display.set(display)
    try:
        yield
    finally:
        _display.reset(token)


def current_display() -> JobProgress | None:
    return _display.get()


@contextmanager
def doing(title: str) -> Iterator[None]:
    """Show the computations of this thread under a title."""
    token = _title.set(title)
    try:
        yield
    finally:
        _title.reset(token)


def title() -> str:
    """Return the title set by `doing`, "" without one."""
    return _title.get()


#: Seconds between two lines if the output is not a terminal.
EVERY_S = 15.0
#: At most this many running jobs are named.
NAMED = 3
#: The progress file of a run folder, read by other processes, and seconds between two updates.
PROGRESS_FILE, WRITE_S = "progress.json", 0.2


class JobProgress:
    """Counts and shows jobs; thread-safe, and its methods return at once."""

    def __init__(self, console: Console) -> None:
        self.console = console
        self._live = Progress(
            SpinnerColumn(),
            TextColumn("{task.description}", markup=False),
            BarColumn(bar_width=20),
            TimeElapsedColumn(),
            console=console,
            transient=True,
            disable=not console.is_terminal,
        )
        self._task = self._live.add_task("", total=None)
        self._guard = threading.Lock()
        self._doing, self._ahead = "", ""
        self._submitted = self._done = self._stored = self._failed = 0
        self._solved_s: list[float] = []
        self._running: dict[int, str] = {}
        self._places = count()
        self._printed_s: float | None = None
        self._due: threading.Timer | None = None
        self._file: Path | None = None
        self._written_s = 0.0

    @contextmanager
    def shown(self) -> Iterator[JobProgress]:
        """Show progress in this context, including that of engines created in it."""
        with self._live, use_display(self):
            try:
                yield self
            finally:
                with self._guard:
                    self._printed_s = math.inf  # print nothing more
                if self._due is not None:
                    self._due.cancel()
                if self._file is not None:
                    self._file.unlink(missing_ok=True)

    def keep(self, folder: Path) -> None:
        """Also write the progress to a file of a run folder while it is shown."""
        self._file = folder / PROGRESS_FILE

    def working(self, text: str) -> None:
        """Show the current activity."""
        with self._guard:
            self._doing = text
            self._show(self._printed_s is None)

    def ahead(self, text: str) -> None:
        """Show the forecast of what remains."""
        with self._guard:
            self._ahead = text
            self._show(False)

    def submitted(self, tasks: int) -> None:
        """Count submitted jobs; each begins when a slot is free."""
        with self._guard:
            self._submitted = max(self._submitted, self._done) + tasks
            self._show(False)

    def began(self, iteration: str, name: str) -> Callable[[Ended], None]:
        with self._guard:
            place = next(self._places)
            self._running[place] = name
            self._show(False)

        def ended(done: Ended) -> None:
            failed = isinstance(done, ModetuneError)
            with self._guard:
                self._running.pop(place, None)
                # Results derived from other results are not jobs.
                jobs = (
                    ()
                    if isinstance(done, ModetuneError)
                    else [item for item in done if not isinstance(item, Derivation)]
                )
                self._done += bool(failed or jobs)
                self._failed += failed
                self._stored += bool(jobs) and all(item.reused for item in jobs)
                self._solved_s += [item.wall_s for item in jobs if not item.reused]
                self._show(False)

        return ended

    def line(self) -> str:
        """Return activity, jobs done and submitted, running jobs, and remaining time."""
        submitted = max(self._submitted, self._done)
        parts = [self._doing or "starting"]
        if submitted:
            counts = ((self._stored, "cached"), (self._failed, "failed"))
            of_these = ", ".join(f"{number} {what}" for number, what in counts if number)
            done = f"{self._done} of {submitted} job{'' if submitted == 1 else 's'} done"
            parts.append(f"{done} ({of_these})" if of_these else done)
        if self._running:
            names = list(dict.fromkeys(self._running.values()))
            more = f" and {len(names) - NAMED} others" if len(names) > NAMED else ""
            parts.append(f"running: {', '.join(names[:NAMED])}{more}")
        waiting = submitted - self._done
        if self._solved_s and waiting:
            mean = sum(self._solved_s) / len(self._solved_s)
            parts.append(
                f"about {mean * waiting / max(len(self._running), 1):.0f} s left for these"
            )
        return "; ".join([*parts, *([self._ahead] if self._ahead else [])])

    def _show(self, now: bool) -> None:
        total = max(self._submitted, self._done) or None
        self._live.update(
            self._task, description=self.line(), total=total, completed=self._done if total else 0
        )
        if self._file is not None and time.monotonic() - self._written_s > WRITE_S:
            self._written_s = time.monotonic()
            state = {"text": self.line(), "done": self._done, "asked": total or 0}
            with suppress(OSError):  # no folder yet, or a full disk: the campaign can continue
                part = self._file.with_suffix(".part")
                part.write_text(json.dumps(state), encoding="utf-8")
                part.replace(self._file)
        if self.console.is_terminal:
            return
        left_s = (
            math.inf if self._printed_s is None else self._printed_s + EVERY_S - time.monotonic()
        )
        if now or left_s <= 0.0:
            self._printed_s = time.monotonic()
            self.console.print(Text(self.line()), soft_wrap=True)
        elif self._due is None and left_s < math.inf:  # print a line for a long-running job on time
            self._due = threading.Timer(left_s, self._print_due)
            self._due.daemon = True
            self._due.start()

    def _print_due(self) -> None:
        with self._guard:
            self._due = None
            self._show(False)
