"""What the updating loop asks of whatever evaluates parameter sets."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

from modetune.core.estimation import Step
from modetune.core.held_out import HeldOut
from modetune.core.modes import Floats
from modetune.core.record import RunCounts
from modetune.flows.evaluation import Evaluation
from modetune.flows.execution.engine import Job
from modetune.flows.execution.work import Work


@dataclass(frozen=True, slots=True)
class Matrix:
    """A sensitivity matrix.

    values: (n_residuals, n_parameters); methods: how each column was computed; keys: of the jobs
    behind it; age: iterations since; missing: positions of columns that could not be had, zero in
    values.
    """

    values: Floats
    methods: tuple[str, ...]
    keys: tuple[str, ...]
    age: int
    missing: tuple[int, ...] = ()

    @property
    def methods_had(self) -> tuple[str, ...]:
        """How each column was computed, `missing` where it could not be."""
        return tuple(
            "missing" if column in self.missing else method
            for column, method in enumerate(self.methods)
        )


class Evaluating(Protocol):
    """Evaluates parameter sets of one campaign and counts what it cost."""

    @property
    def cheap(self) -> bool:
        """Whether sensitivities cost no job, so that there is nothing for e2 to save."""
        return False

    @property
    def steps_run(self) -> bool:
        """Whether each step runs the solver."""
        return True

    @property
    def runs(self) -> RunCounts:
        """Solver runs so far, and what they cost."""
        ...

    def evaluate(
        self, number: int, theta: Floats, previous: Evaluation | None, alone: bool
    ) -> tuple[Evaluation, Matrix | None]:
        """A set's evaluation, and its sensitivity unless the modal job is to go alone.

        Raises SolverError, ModesError, StoreError.
        """
        ...

    def matrix(self, number: int, evaluation: Evaluation) -> Matrix:
        """The sensitivity at an evaluated set."""
        ...

    def skip(self, number: int, slope: float) -> None:
        """Note that e2 makes this iteration do without a sensitivity of its own."""
        ...

    def planned(self, theta: Floats) -> list[Work]:
        """The work of an iteration at a set, with sensitivities."""
        ...

    def first_job(self, theta: Floats) -> Job | None:
        """The job that the evaluation of a set begins with; None where it may need none."""
        return None

    def held_out(self, initial: Evaluation, updated: Evaluation) -> HeldOut | None:
        """What is only judged by, before and after."""
        ...

    def refined(
        self, current: Evaluation, step: Step, region: tuple[Floats, Floats]
    ) -> Step | None:
        """A better step than the linear one, to a set within a region (lower, upper).

        None where nothing better than the linear model is known.
        """
        return None

    def confirmed(self, number: int, evaluation: Evaluation) -> Evaluation | None:
        """A set evaluated by the solver's own modes; None where it was so already."""
        return None

    def refuted(self, evaluation: Evaluation, apart: float) -> None:
        """The solver's own frequencies at this set differ by apart, relative: what found others
        is to be believed no more."""
        return
