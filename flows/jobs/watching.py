"""Displays of a run: what shows a person which pieces of work run, and how they ended."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass
from typing import Protocol

from modetune.core.errors import ModetuneError

#: The title of what this thread computes; without one it is not shown.
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
    """The outcome of what was computed in this process; see `Solution`."""

    key: str
    reused: bool
    wall_s: float


class Display(Protocol):
    """Shows pieces of work to a person; nobody waits for it."""

    def asked(self, pieces: int) -> None:
        """So many pieces are asked for; each begins when there is room."""
        ...

    def began(self, iteration: str, name: str) -> Callable[[Ended], None]:
        """A piece begins; the function that is returned is called with its end."""
        ...


_display: ContextVar[Display | None] = ContextVar("display", default=None)


@contextmanager
def shown_to(display: Display) -> Iterator[None]:
    """Engines that are made in here show their work on a display."""
    token = _display.set(display)
    try:
        yield
    finally:
        _display.reset(token)


def current_display() -> Display | None:
    """The display of `shown_to`."""
    return _display.get()


@contextmanager
def doing(title: str) -> Iterator[None]:
    """Results computed by this thread in here are shown under a title."""
    token = _title.set(title)
    try:
        yield
    finally:
        _title.reset(token)


def title() -> str:
    """The title of `doing`; empty without one."""
    return _title.get()
