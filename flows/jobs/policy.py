"""What follows from a failed try of a job: whether another one follows, and when."""

from __future__ import annotations

import logging
import threading
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
from modetune.core.updating.job_results import Result
from modetune.flows.jobs.work import Tries

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

    @property
    def most_tries(self) -> int:
        """Tries of one job at most, whatever its failures."""
        return 1 + self.stopped + self.timeout + self.no_result

    def allows_another(self, error: SolverError, tries: Tries) -> bool:
        """Count a failed try, and say whether its kind of failure allows another one."""
        if isinstance(error, NoResult):
            chances = self.no_result
        elif isinstance(error, SolverTimeout):
            chances = self.timeout
        else:
            chances = self.stopped if isinstance(error, SolverCrashed) else 0
        kind = type(error)
        tries.failures[kind] += 1
        if tries.failures[kind] > chances:
            return False
        logger.warning("%s; trying again (%d of %d)", error, tries.failures[kind], chances)
        return True

    def with_licence(
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
