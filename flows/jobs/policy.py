"""Retry policy: whether another attempt follows a failed one, and when."""

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
from modetune.flows.jobs.runner import Tries

logger = logging.getLogger(__name__)

#: Pauses between two requests for a licence grow by this factor up to this length, seconds.
PAUSE_GROWTH, LONGEST_PAUSE_S = 1.5, 600.0


@dataclass(frozen=True, slots=True)
class Policy:
    """Retries and resource limits of jobs.

    stopped, timeout and no_result are the numbers of retries after a crash or kill, a timeout, and
    an invalid result; input that the solver rejects, and jobs too large for the machine, are not
    retried. disk_bytes limits a job's files and output. licence_messages adds to the known messages
    of a refused licence. memory_bytes limits parallel jobs, or this process with its factors; 0
    means all memory. single_factors selects single precision, None lets memory decide.
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
    def max_tries(self) -> int:
        """Maximum number of attempts of one job."""
        return 1 + self.stopped + self.timeout + self.no_result

    def may_retry(self, error: SolverError, tries: Tries) -> bool:
        """Count a failed attempt and return whether another one is allowed."""
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
        logger.warning("%s; retry %d of %d", error, tries.failures[kind], chances)
        return True

    def with_licence(
        self, run: Callable[[], Result], program: str, cancelled: threading.Event
    ) -> Result:
        """Run; while no licence is free, wait and run again, which is not a failure."""
        waited, pause = 0.0, self.licence_pause_s
        while True:
            try:
                return run()
            except LicenceDenied as error:
                if waited + pause > self.licence_wait_s:
                    raise LicenceDenied(
                        f"{error}\nno licence was free for {waited:.3g} s; free one or raise "
                        "`run: licence_wait_s` in the campaign"
                    ) from error
                logger.warning("no %s licence is free; retry in %.0f s", program, pause)
                if cancelled.wait(pause):
                    raise SolverCancelled("cancelled while a job waited for a licence") from error
                waited += pause
                pause = min(PAUSE_GROWTH * pause, LONGEST_PAUSE_S)
