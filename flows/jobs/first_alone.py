"""The first run of a solver stands alone: what is wrong with it is told after one job, not twenty.

A solver that always fails (no licence file, a wrong option, a library that is missing) would fail
in all jobs of the first iteration at once, each with its retries, and one that hangs would hold
every core until the time limit. So one piece of work is carried out at a time until a job has
succeeded, now or in an earlier run; from then on all run side by side.
"""

from __future__ import annotations

from collections.abc import Sequence

from modetune.core.errors import ModetuneError, SolverCancelled, SolverError
from modetune.flows.jobs.work import Done, Execution, Work

#: Of the first pieces of one kind so many may fail, at other values each, before none is tried.
FIRST_FAILURES = 3


class FirstAlone:
    """An execution that carries out one piece at a time until a job has been run with success."""

    def __init__(self, execution: Execution) -> None:
        self._execution = execution
        self._proven = False

    def run(self, iteration: str, work: Sequence[Work]) -> list[Done]:
        """Outcomes in the order of the work; those of pieces not tried are the first failure."""
        done: list[Done] = []
        failures = 0
        while len(done) < len(work):
            if self._proven:
                return done + self._execution.run(iteration, work[len(done) :])
            piece = work[len(done)]
            (outcome,) = self._execution.run(iteration, [piece])
            done.append(outcome)
            if not isinstance(outcome, ModetuneError):  # a stored result is a success of earlier
                self._proven = True
            elif isinstance(outcome, SolverError):
                failures += 1
                rest = work[len(done) :]
                alike = any(_kind(other) == _kind(piece) for other in rest)
                if failures >= FIRST_FAILURES or not alike or isinstance(outcome, SolverCancelled):
                    reason = f"no job has succeeded so far: {outcome}"
                    if rest:
                        names = [other.name for other in rest]
                        self._execution.skip(iteration, names, reason, "Not tried")
                    return [*done, *(type(outcome)(f"not tried, for {reason}") for _ in rest)]
        return done

    def skip(
        self, iteration: str, names: Sequence[str], reason: str, state: str = "Skipped"
    ) -> None:
        """Note work that was not needed, or not tried, and why."""
        self._execution.skip(iteration, names, reason, state)


def _kind(work: Work) -> str:
    """What a piece of work is of: modal, finite differences of a parameter, ..."""
    return work.name.partition(" ")[0]
