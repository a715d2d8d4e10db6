"""What follows from a failed job: whether and when it is tried again."""

from __future__ import annotations

import logging
import threading
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass

from modetune.adapters.process import JOB_DISK
from modetune.core.errors import (
    LicenceDenied,
    NoResult,
    SolverCancelled,
    SolverCrashed,
    SolverError,
    SolverTimeout,
)
from modetune.core.updating.results import Result

logger = logging.getLogger(__name__)

#: Pauses before asking again for a licence grow by this factor up to this length, seconds.
PAUSE_GROWTH, LONGEST_PAUSE_S = 1.5, 600.0


@dataclass(frozen=True, slots=True)
class Policy:
    """What follows from a failed job.

    stopped, timeout, no_result: how often it is tried again when it was killed or broke off, ran
    out of time, or left what is not a result. What the solver rejected, and what was too large for
    the machine, is never tried again. disk_bytes: what a job's files and output may take.
    licence_messages: what says that no licence was free, besides what is known. memory_bytes: what
    jobs side by side, or this process with its factors, may take of this machine; 0: what that
    has. single_factors: whether those are in single precision, None where memory decides.
    """

    timeout_s: float
    stopped: int
    timeout: int
    no_result: int
    licence_pause_s: float
    licence_wait_s: float
    disk_bytes: int = JOB_DISK
    licence_messages: tuple[str, ...] = ()
    memory_bytes: int = 0
    single_factors: bool | None = None

    def chances(self, error: SolverError) -> int:
        """How often a job that ended so may be tried again."""
        if isinstance(error, NoResult):
            return self.no_result
        if isinstance(error, SolverTimeout):
            return self.timeout
        return self.stopped if isinstance(error, SolverCrashed) else 0

    def tried(self, run: Callable[[], Result], program: str, cancelled: threading.Event) -> Result:
        """What a run of a program gives, tried as often as its failures allow."""
        failures: Counter[type[SolverError]] = Counter()
        while True:
            try:
                return self._with_licence(run, program, cancelled)
            except SolverError as error:
                chances = self.chances(error)
                failures[type(error)] += 1
                if failures[type(error)] > chances:
                    raise
                logger.warning("%s; trying again (%d of %d)", error, failures[type(error)], chances)

    def _with_licence(
        self, run: Callable[[], Result], program: str, cancelled: threading.Event
    ) -> Result:
        """Where no licence is free wait and ask again, which is not a failure."""
        waited, pause = 0.0, self.licence_pause_s
        while True:
            try:
                return run()
            except LicenceDenied as error:
                if waited + pause > self.licence_wait_s:
                    raise LicenceDenied(
                        f"{error}\nno licence was free for {waited:.3g} s "
                        "(`run: licence_wait_s` in the campaign)"
                    ) from error
                logger.warning("no %s licence is free; asking again in %.0f s", program, pause)
                if cancelled.wait(pause):
                    raise SolverCancelled(
                        "the campaign is ending while a job waits for a licence"
                    ) from error
                waited += pause
                pause = min(PAUSE_GROWTH * pause, LONGEST_PAUSE_S)
