"""Who is told of each piece of work, and what became of it: a Prefect server's pages.

A watcher hangs on the engine, so whatever solves a job or computes a result from others tells it.
Nobody waits for a watcher.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass
from typing import Protocol

from modetune.core.errors import ModetuneError, SolverCancelled

#: What is being done, for the names of results that are computed in this thread; not told if empty.
_title: ContextVar[str] = ContextVar("title", default="")


class Solution(Protocol):
    """A result: its key, whether the store had it, and the seconds from first try to result."""

    @property
    def key(self) -> str: ...

    @property
    def reused(self) -> bool: ...

    @property
    def wall_s(self) -> float: ...


#: How a piece ended; no outcomes where it follows from others.
Ended = Sequence[Solution] | ModetuneError


@dataclass(frozen=True, slots=True)
class Derivation:
    """The outcome of what was computed here; see `Solution`."""

    key: str
    reused: bool
    wall_s: float


class JobWatcher(Protocol):
    """Who is told of each piece of work. It never waits."""

    def began(self, iteration: str, name: str) -> Callable[[Ended], None]:
        """A piece begins; what is returned hears how it ended."""
        ...

    def skipped(
        self, iteration: str, names: Sequence[str], reason: str, state: str = "Skipped"
    ) -> None:
        """Work that was not needed, or not tried, and why."""
        ...


@dataclass(frozen=True, slots=True)
class WatchedPart:
    """A watcher of one among several runs that go side by side, told under the part's title."""

    watcher: JobWatcher
    title: str

    def began(self, iteration: str, name: str) -> Callable[[Ended], None]:
        return self.watcher.began(f"{self.title}, {iteration}", name)

    def skipped(
        self, iteration: str, names: Sequence[str], reason: str, state: str = "Skipped"
    ) -> None:
        self.watcher.skipped(f"{self.title}, {iteration}", names, reason, state)


def part_of(watcher: JobWatcher | None, title: str) -> JobWatcher | None:
    """Who is told of one part; the whole's watcher where the part has no title."""
    return WatchedPart(watcher, title) if watcher is not None and title else watcher


class Display(JobWatcher, Protocol):
    """Shows jobs to a person, who wants to know how many there are."""

    def asked(self, pieces: int) -> None:
        """So many pieces are asked for; each begins when there is room."""
        ...


@dataclass(frozen=True, slots=True)
class Displayed:
    """A display beside a watcher, if there is one."""

    display: Display
    watcher: JobWatcher | None

    def began(self, iteration: str, name: str) -> Callable[[Ended], None]:
        ends = [self.display.began(iteration, name)]
        if self.watcher is not None:
            ends.append(self.watcher.began(iteration, name))

        def ended(done: Ended) -> None:
            for end in ends:
                end(done)

        return ended

    def skipped(
        self, iteration: str, names: Sequence[str], reason: str, state: str = "Skipped"
    ) -> None:
        if self.watcher is not None:
            self.watcher.skipped(iteration, names, reason, state)


_display: ContextVar[Display | None] = ContextVar("display", default=None)


@contextmanager
def shown_to(display: Display) -> Iterator[None]:
    """Engines that are made in here tell a display too."""
    token = _display.set(display)
    try:
        yield
    finally:
        _display.reset(token)


def displayed(watcher: JobWatcher | None) -> JobWatcher | None:
    """A watcher with the display of `shown_to` beside it."""
    display = _display.get()
    return watcher if display is None else Displayed(display, watcher)


def ask(watcher: JobWatcher | None, pieces: int) -> None:
    """Tell a display that pieces are asked for."""
    if isinstance(watcher, WatchedPart):
        ask(watcher.watcher, pieces)
    elif isinstance(watcher, Displayed):
        watcher.display.asked(pieces)


@contextmanager
def doing(title: str) -> Iterator[None]:
    """Results computed by this thread in here are told under a title."""
    token = _title.set(title)
    try:
        yield
    finally:
        _title.reset(token)


@contextmanager
def told(watcher: JobWatcher | None, name: str) -> Iterator[list[Solution]]:
    """Tell of a piece that is done in here, under the title of `doing`; outcomes go to the list."""
    outcomes: list[Solution] = []
    title = _title.get()
    if watcher is None or not (title and name):
        yield outcomes
        return
    ended = watcher.began(title, name)
    try:
        yield outcomes
    except BaseException as error:
        ended(error if isinstance(error, ModetuneError) else SolverCancelled("broken off"))
        raise
    ended(outcomes)
