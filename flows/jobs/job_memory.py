"""What jobs take of a machine's memory, so that those side by side fit in it."""

from __future__ import annotations

import logging
import os
import threading

from modetune.core.algebra.factor_room import machine_memory
from modetune.flows.jobs.limits import MEMORY, Limit

logger = logging.getLogger(__name__)

#: Shares that the memory is handed out in: a job takes whole ones.
LEAST_SHARES = 32


class JobMemory:
    """The most that jobs of a kind took so far, as shares of the memory; safe from many threads.

    A kind is a solver, a model and an analysis. Nobody knows what the first of a kind takes: where
    the campaign names a limit it gets all of it, else it starts with one share. One that takes more
    than there is gets all of it for itself.
    """

    def __init__(self) -> None:
        # Files of the system tell both: not with every job.
        self.of_machine = machine_memory()
        self._slots = max(LEAST_SHARES, 4 * (os.cpu_count() or 1))
        self._peaks: dict[tuple[str, str, str], int] = {}
        self._lock = threading.Lock()

    def limit(self, kind: tuple[str, str, str], memory_bytes: int, named: bool) -> Limit:
        """The shares that a job of a kind takes; small jobs never keep a core from its work.

        named: whether the campaign names a limit.
        """
        slots = self._slots
        peak = self._peaks.get(kind, memory_bytes if named else 0)
        return Limit(MEMORY, slots, min(max(-(-slots * peak // memory_bytes), 1), slots))

    def add(self, kind: tuple[str, str, str], peak_bytes: int, memory_bytes: int) -> None:
        """Keep what a job took, and tell where the machine cannot give as much."""
        with self._lock:
            before = self._peaks.get(kind, 0)
            self._peaks[kind] = max(before, peak_bytes)
        if peak_bytes > memory_bytes >= before:
            logger.warning(
                "a %s job (%s) took %.3g GB of memory, more than the %.3g GB that may be taken "
                "(`run.memory_gb`, or else what machine or container have): such jobs run one at "
                "a time, and only the solver's own options make them smaller",
                kind[0], kind[2], peak_bytes / 1e9, memory_bytes / 1e9,
            )  # fmt: skip
