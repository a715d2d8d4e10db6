"""The first runs of a solver stand alone: what is wrong with it is told after few, not twenty.

A solver that always fails (no licence file, a wrong option, a library that is missing) would fail
in all jobs of the first iteration at once, each with its retries, and one that hangs would hold
every core until the time limit. So only the first pieces of one kind are carried out, no more than
may fail before nothing else is tried, until a job has succeeded, now or in an earlier run; from
then on all run side by side. A modal job goes before its sensitivities; the matrix jobs of a model
go together, for one after another they would be the longest part of a campaign.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import groupby

from modetune.core.errors import ModetuneError, SolverCancelled, SolverError
from modetune.flows.jobs.work import Done, Execution, Work

#: Of the first pieces of one kind so many may fail, at other values each, before none is tried.
FIRST_FAILURES = 3


class FirstAlone:
    """An execution that carries out a few pieces at a time until a job has run with success."""

    def __init__(self, execution: Execution) -> None:
        self._execution = execution
        self._proven = False

    def run(self, iteration: str, work: Sequence[Work]) -> list[Done]:
        """Outcomes in the order of the work; those of pieces not tried are the first failure."""
        done: list[Done] = []
        failures = 0
        while len(done) < len(work):
            rest = work[len(done) :]
            if self._proven:
                return done + self._execution.run(iteration, rest)
            alike = list(next(groupby(rest, _kind))[1])
            tried = self._execution.run(iteration, alike[: FIRST_FAILURES - failures])
            done, rest = done + tried, rest[len(tried) :]
            # A stored result is a success of earlier.
            self._proven = not all(isinstance(outcome, ModetuneError) for outcome in tried)
            failed = [outcome for outcome in tried if isinstance(outcome, SolverError)]
            failures += len(failed)
            ended = any(isinstance(error, SolverCancelled) for error in failed)
            if not failed or (self._proven and not ended):
                continue
            more = any(_kind(other) == _kind(alike[0]) for other in rest)
            if failures >= FIRST_FAILURES or not more or ended:
                error = failed[0]
                reason = f"no job has succeeded so far: {error}"
                if rest:
                    names = [other.name for other in rest]
                    self._execution.skip(iteration, names, reason, "Not tried")
                return [*done, *(type(error)(f"not tried, for {reason}") for _ in rest)]
        return done

    def skip(
        self, iteration: str, names: Sequence[str], reason: str, state: str = "Skipped"
    ) -> None:
        """Note work that was not needed, or not tried, and why."""
        self._execution.skip(iteration, names, reason, state)


def _kind(work: Work) -> str:
    """What a piece of work is of: modal, finite differences of a parameter, ..."""
    return work.name.partition(" ")[0]
