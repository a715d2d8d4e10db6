"""Named limits shared by all campaigns of a machine: cores, memory, and licences by name.

A limit is a folder of slot files below MODETUNE_HOME; the process that locks a slot file holds the
slot. The system releases the locks of a process that dies, so no slot is lost. A process takes the
slots of a limit only while it holds the limit's gate, so two processes that need several slots
cannot deadlock.
"""

from __future__ import annotations

import logging
import os
import re
import threading
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from modetune.core.algebra.factor_room import machine_memory
from modetune.core.storage.locks import FileLock

#: Limits of the machine itself: cores, and shares of the usable memory; all others are licences.
CORES, MEMORY = "cores", "memory"
OWN = frozenset({CORES, MEMORY})


@dataclass(frozen=True, slots=True)
class Limit:
    """A named limit: the number of slots, and how many of them a job takes."""

    name: str
    slots: int
    taken: int

    def __post_init__(self) -> None:
        if not re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9_.-]*", self.name):
            raise ValueError(f"{self.name!r} is not a name of a limit")
        if not 1 <= self.taken <= self.slots:
            raise ValueError(f"{self.taken} of {self.slots} slots of {self.name} cannot be taken")


class Limits(Protocol):
    """Counts the slots that jobs hold."""

    def held(
        self, limits: tuple[Limit, ...], waiting: Callable[[str], None]
    ) -> AbstractContextManager[None]:
        """Hold the slots of these limits; call `waiting` as long as others hold them."""
        ...


@dataclass(frozen=True, slots=True)
class MachineLimits:
    """Limits enforced by lock files below a folder; without one a batch system enforces them."""

    folder: Path | None

    @contextmanager
    def held(self, limits: tuple[Limit, ...], waiting: Callable[[str], None]) -> Iterator[None]:
        """Hold the slots of these limits, waiting for each until it is free.

        waiting is called repeatedly with the limit's name; it sleeps briefly or raises. Raises
        StorageUnavailable.
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
    """Lock a file until the stack closes; return whether that was possible."""
    lock = FileLock(path)
    if lock.take():
        held.enter_context(lock)
        return True
    return False


logger = logging.getLogger(__name__)

#: Minimum number of equal shares of the memory; a job takes whole shares.
LEAST_SHARES = 32


class JobMemory:
    """Peak memory by kind of job (solver, model, analysis), as shares of the memory; thread-safe.

    The first job of a kind, whose need is unknown, gets all memory if the campaign sets a limit and
    one share otherwise. A job that needs more than there is runs alone.
    """

    def __init__(self) -> None:
        # Both are read from system files, too slow for every job.
        self.of_machine = machine_memory()
        self._slots = max(LEAST_SHARES, 4 * (os.cpu_count() or 1))
        self._peaks: dict[tuple[str, str, str], int] = {}
        self._lock = threading.Lock()

    def limit(self, kind: tuple[str, str, str], memory_bytes: int, named: bool) -> Limit:
        """Return the shares that a job takes; named is true if the campaign sets a limit."""
        slots = self._slots
        peak = self._peaks.get(kind, memory_bytes if named else 0)
        return Limit(MEMORY, slots, min(max(-(-slots * peak // memory_bytes), 1), slots))

    def add(self, kind: tuple[str, str, str], peak_bytes: int, memory_bytes: int) -> None:
        """Record a job's peak memory; warn if the machine has less."""
        with self._lock:
            before = self._peaks.get(kind, 0)
            self._peaks[kind] = max(before, peak_bytes)
        if peak_bytes > memory_bytes >= before:
            logger.warning(
                "a %s job (%s) used %.3g GB of memory, more than the available %.3g GB "
                "(`run.memory_gb`, or the memory of machine or container): such jobs now run one "
                "at a time; reduce their memory by the solver's own options",
                kind[0], kind[2], peak_bytes / 1e9, memory_bytes / 1e9,
            )  # fmt: skip
