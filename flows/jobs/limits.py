"""Named limits that hold over all campaigns of a machine: cores, and licences by name.

A limit is a folder of slot files below MODETUNE_HOME; who holds the lock of a slot holds the slot.
The locks of a process that dies are free at once, so no slot is ever lost. Slots of one limit are
taken one at a time by whoever holds the limit's gate, so two that need several never block each
other.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from modetune.core.storage.locks import FileLock

#: The machine's own limits: processor cores, and shares of the memory that may be taken; every
#: other name is a licence's.
CORES, MEMORY = "cores", "memory"
OWN = frozenset({CORES, MEMORY})


@dataclass(frozen=True, slots=True)
class Limit:
    """A named limit: how many slots there are, and how many a job takes."""

    name: str
    slots: int
    taken: int

    def __post_init__(self) -> None:
        if not re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9_.-]*", self.name):
            raise ValueError(f"{self.name!r} is not a name of a limit")
        if not 1 <= self.taken <= self.slots:
            raise ValueError(f"{self.taken} of {self.slots} slots of {self.name} cannot be taken")


class Limits(Protocol):
    """Who counts what jobs hold."""

    def held(
        self, limits: tuple[Limit, ...], waiting: Callable[[str], None]
    ) -> AbstractContextManager[None]:
        """Hold the slots of these limits; `waiting` is called while others hold them."""
        ...


@dataclass(frozen=True, slots=True)
class MachineLimits:
    """Limits kept by lock files below one folder; without one somebody else keeps them."""

    folder: Path | None

    @contextmanager
    def held(self, limits: tuple[Limit, ...], waiting: Callable[[str], None]) -> Iterator[None]:
        """Hold the slots of these limits, waiting for each until it is free.

        waiting: called over and over with the limit's name while others hold it; it sleeps a
        little, or raises. Raises StorageUnavailable.
        """
        with ExitStack() as held:
            if self.folder is None:
                limits = ()
            for limit in sorted(limits, key=lambda item: item.name):
                self._take(limit, held, waiting)
            yield

    def _take(self, limit: Limit, held: ExitStack, waiting: Callable[[str], None]) -> None:
        assert self.folder is not None
        folder = self.folder / limit.name
        with ExitStack() as gate:
            while not _lock(folder / "gate", gate):
                waiting(limit.name)
            free = list(range(limit.slots))
            missing = limit.taken
            while missing:
                got = next((slot for slot in free if _lock(folder / f"slot{slot}", held)), None)
                if got is None:
                    waiting(limit.name)
                else:
                    free.remove(got)
                    missing -= 1


def _lock(path: Path, held: ExitStack) -> bool:
    """Lock a file for as long as the stack lives, unless another has it."""
    lock = FileLock(path)
    if lock.take():
        held.enter_context(lock)
        return True
    return False
