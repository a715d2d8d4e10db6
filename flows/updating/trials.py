"""Trials: sets that are tried from an accepted one, each with a number, until one is better.

A set that makes the residual worse is not accepted: a step from an older matrix is taken back and
the matrix computed anew, one from a fresh matrix is made shorter. So skipping never costs
convergence. A failed trial (solver failure, lost mode) is treated likewise.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from modetune.core.errors import ModesError, SolverError
from modetune.core.modes import Floats
from modetune.core.updating.criteria import slope
from modetune.core.updating.estimation import Step
from modetune.core.updating.trust_region import TrustRegion
from modetune.flows.campaign.campaign import Campaign
from modetune.flows.updating.between import Between
from modetune.flows.updating.evaluation import Evaluation, Matrix, expects_agreement
from modetune.flows.updating.evaluator import Evaluator
from modetune.flows.updating.finders import CAMPAIGNS_OWN
from modetune.flows.updating.stepping import Stepping

logger = logging.getLogger(__name__)

#: A step is shortened at most so often before its start counts as stationary.
SHORTENINGS = 5
#: Largest parameter change that counts as none.
NO_STEP = 1e-8

#: Parameters that the task of a step names, those that change most.
SHOWN = 8


class Watcher(Protocol):
    """Who is told what a loop does, as far as it has a method for it."""

    def working(self, text: str) -> None:
        """What is being computed now."""
        return

    def noted(self, trial: Noted) -> None:
        """A set was evaluated, and this was decided of it."""
        return

    def confirmed(self, evaluation: Evaluation) -> None:
        """The solver's own modes at the last accepted set."""
        return


@dataclass(frozen=True, slots=True)
class Noted:
    """An evaluation point: how it was come by, and what was decided.

    by: the step to it, None at the start; slope: e2's, NaN at the start; skipped: whether e2 made
    this set do without a matrix of its own; newest: the newest matrix.
    """

    number: int
    evaluation: Evaluation
    by: TrialStep | None
    slope: float
    accepted: bool
    decision: str
    skipped: bool
    newest: Matrix | None


@dataclass(frozen=True, slots=True)
class State:
    """Where a loop stands.

    current: the last accepted set; matrix: for the step from there, None where it has yet to be
    computed; skip: the slope by which e2 lets the next iteration do without a matrix of its own,
    None where it does not; region: where the next step may go.
    """

    current: Evaluation
    matrix: Matrix | None
    skip: float | None
    region: TrustRegion


@dataclass(frozen=True, slots=True)
class TrialStep:
    """A step to a set to be tried, by a matrix, taken in a region.

    begun: where its last part began: the current set but after a step by an old matrix that made
    things worse; the matrix is that of this part.
    """

    step: Step
    matrix: Matrix
    region: TrustRegion
    begun: Evaluation


@dataclass(frozen=True, slots=True)
class Trial:
    """What a step led to: the set, its fresh matrix if there is one, and e2's slope."""

    by: TrialStep
    evaluation: Evaluation
    matrix: Matrix | None
    slope: float


@dataclass
class Trials:
    """The trials of a loop.

    region: lower and upper values that it keeps to within the parameters' bounds, each
    (n_parameters,), where it may not go everywhere. first: number of the first set.
    """

    campaign: Campaign
    evaluator: Evaluator
    watcher: Watcher
    region: tuple[Floats, Floats] | None
    first: int
    newest: Matrix | None = None

    def __post_init__(self) -> None:
        own, self.number = self.campaign.parameters, self.first
        low, high = self.region or (own.lower, own.upper)
        box = np.maximum(own.lower, low), np.minimum(own.upper, high)
        self.between = Between(self.campaign, self.evaluator, *box)
        self.stepping = Stepping(self.campaign, self.evaluator, *box)

    def used_up(self) -> bool:
        """Whether there are no iterations left."""
        return self.number - self.first == self.campaign.update.max_iterations

    def start(self, title: str, around: Evaluation | None) -> State:
        """The first set; around: an evaluation point that its modes are tracked from."""
        self.watcher.working(title)
        theta, alone = self.campaign.start, self.campaign.update.max_iterations == 0
        current, matrix = self.evaluator.evaluate(self.first, theta, around, alone)
        self.newest = matrix
        self.watcher.noted(Noted(self.first, current, None, np.nan, True, title, False, matrix))
        return State(current, matrix, None, self.stepping.first)

    def matrix(self, state: State) -> Matrix:
        """The matrix of the step from a state, computed where it has to be."""
        if state.matrix is None:
            self.watcher.working(f"iteration {self.number}: sensitivities")
        self.newest = state.matrix or self.evaluator.matrix(self.number, state.current)
        return self.newest

    def step(self, compute: Callable[[], Step]) -> Step:
        """A step to the next set, computed as a task of its own."""

        def computed() -> tuple[Step, str]:
            step, names = compute(), self.campaign.parameters.names
            largest = np.argsort(-np.abs(step.change), kind="stable")[:SHOWN]
            return step, ", ".join(f"{names[n]} {step.change[n]:+.3g}" for n in largest)

        return self.evaluator.step(f"iteration {self.number + 1}", computed)

    def better(self, state: State, matrix: Matrix) -> Trial | None:
        """The first set that is better than the current one, or None.

        With a fresh matrix the step is made shorter until it helps. An old one gets one chance, and
        Broyden's a second: along a narrow valley a long step is worse by its curvature alone, and
        corrected by what it showed the next one from there ends at the bottom, at the price of a
        round where a new matrix takes all of its own.
        """
        current, stepping = state.current, self.stepping
        step = self.step(lambda: stepping.step(current, matrix, state.region))
        by = TrialStep(step, matrix, state.region, current)
        chances, failures = 2 if matrix.age > 0 else SHORTENINGS + 1, 0
        for chance in range(chances):
            if np.max(np.abs(by.step.change)) < NO_STEP or self.used_up():
                return None
            self.watcher.working(f"iteration {self.number + 1}")
            old = by.matrix.age > 0
            ending = "taken back, new sensitivity" if old else "shorter step"
            try:
                trial = self.tried(state, by, alone=chance > 0)
            except (SolverError, ModesError) as error:
                never_solved = not old and failures == chance == chances - 1
                if isinstance(error, CAMPAIGNS_OWN) or never_solved:
                    raise
                failures += 1
                level = logging.WARNING if self.evaluator.steps_run else logging.INFO
                logger.log(level, "%s; %s", error, ending)
            else:
                better = stepping.better(current, trial.evaluation, by.step)
                if better or trial.evaluation.agrees(self.campaign.tolerances):
                    return trial
                again = old and chance == 0 and self.between.tries_again(trial.slope)
                self.note(trial, f"worse: {'corrected and gone on from' if again else ending}")
                if again:
                    by = self._gone_on(current, trial)
                    continue
            if old:
                return None
            step, region = stepping.shorter(current, by.matrix, by.step, by.region)
            by = replace(by, step=step, region=region)
        return None

    def _gone_on(self, current: Evaluation, trial: Trial) -> TrialStep:
        """From a set that an old matrix made worse, by the matrix corrected by what it showed."""
        by, begun = trial.by, trial.evaluation
        matrix = self.between.older(by.matrix, by.begun, begun)
        step = self.step(lambda: self.stepping.step(begun, matrix, by.region))
        step = replace(step, change=begun.theta + step.change - current.theta)
        return TrialStep(step, matrix, by.region, begun)

    def tried(self, state: State, by: TrialStep, alone: bool = False) -> Trial:
        """The set that a step leads to; alone: without sensitivities beside its modal job.

        Raises SolverError, ModesError, StoreError.
        """
        self.number += 1
        current = state.current
        # Sensitivities beside the modal job are in vain where the set is not kept or is the last.
        alone = (
            alone
            or self.between.waits
            or state.skip is not None
            or self.used_up()
            or expects_agreement(by.step, current, self.campaign.tolerances)
        )
        theta = current.theta + by.step.change
        evaluation, fresh = self.evaluator.evaluate(self.number, theta, current, alone)
        change = slope(evaluation.residual, current.residual, theta.size)
        return Trial(by, evaluation, fresh, change)

    def note(
        self, trial: Trial, decision: str, accepted: bool = False, skipped: bool = False
    ) -> None:
        """Tell what was decided of a trial."""
        there, newest = trial.evaluation, self.newest
        self.watcher.noted(
            Noted(self.number, there, trial.by, trial.slope, accepted, decision, skipped, newest)
        )
