"""The updating loop: evaluate, compare with the test, step, until e1 holds or nothing is gained.

Each iteration evaluates one parameter set: its modal job and, unless e2 skips them, its
sensitivity jobs go to the execution side by side. A set that makes the residual worse is not
accepted: a step from an older matrix is taken back and the matrix computed anew, one from a
fresh matrix is made shorter. So skipping never costs convergence. A failed trial (solver failure,
lost mode) is treated likewise.

The loop is deterministic and all results are in the store by content, so a campaign that was
killed is resumed by starting it again: what was finished is answered by the store.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from modetune.core.errors import ModesError, SolverCancelled, SolverError, SolverMissing
from modetune.core.modes import Floats
from modetune.core.updating.criteria import slope
from modetune.core.updating.estimation import Step, StepProblem, parameter_step
from modetune.flows.campaign.campaign import Campaign
from modetune.flows.updating.between import Between
from modetune.flows.updating.evaluation import Evaluation, Matrix, expects_agreement
from modetune.flows.updating.evaluator import Evaluator

logger = logging.getLogger(__name__)

#: A step is shortened at most so often before its start counts as stationary.
SHORTENINGS = 5
#: Relative decrease of the objective below which nothing more is gained.
STATIONARY = 1e-4
#: Largest parameter change that counts as none.
NO_STEP = 1e-8
#: An old matrix whose step gains less than this share of what it promised is computed anew.
KEPT_PROMISE = 0.25
#: Frequencies by stored matrices and by the solver itself that differ more are not one model's.
CONFIRMED = 1e-4


class Watcher(Protocol):
    """Who is told what a loop does."""

    def working(self, text: str) -> None:
        """What is being computed now."""
        ...

    def noted(self, trial: Noted) -> None:
        """A set was evaluated, and this was decided of it."""
        ...

    def confirmed(self, evaluation: Evaluation) -> None:
        """The solver's own modes at the last accepted set."""
        ...


@dataclass(frozen=True, slots=True)
class Noted:
    """An evaluation point: how it was come by, and what was decided.

    step, matrix: None at the start; matrix: the one of the step; slope: e2's, NaN at the start;
    skipped: whether e2 made this set do without a matrix of its own; newest: the newest matrix.
    """

    number: int
    evaluation: Evaluation
    step: Step | None
    matrix: Matrix | None
    slope: float
    accepted: bool
    decision: str
    skipped: bool
    newest: Matrix | None


@dataclass(frozen=True, slots=True)
class End:
    """How a loop ended: converged, stationary or max_iterations, why, and at which set."""

    status: str
    reason: str
    last: Evaluation
    matrix: Matrix | None


@dataclass(frozen=True, slots=True)
class State:
    """Where the loop stands.

    current: the last accepted set; matrix: for the step from there, None where it has yet to be
    computed; skip: the slope by which e2 lets the next iteration do without a matrix of its own,
    None where it does not.
    """

    current: Evaluation
    matrix: Matrix | None
    skip: float | None


@dataclass(frozen=True, slots=True)
class Trial:
    """A set tried: the step to it, what it gave, its fresh matrix if there is one, its slope."""

    step: Step
    evaluation: Evaluation
    matrix: Matrix | None
    slope: float


class Loop:
    """Updating from a start to its end; `run` carries it there.

    region: lower and upper values that it keeps to within the parameters' bounds, each
    (n_parameters,), where it may not go everywhere. around: an evaluation point that the
    modes of the start are tracked from.
    """

    def __init__(
        self,
        campaign: Campaign,
        evaluator: Evaluator,
        watcher: Watcher,
        region: tuple[Floats, Floats] | None = None,
        around: Evaluation | None = None,
    ) -> None:
        self.around = around
        self.campaign = campaign
        self.evaluator = evaluator
        self.watcher = watcher
        parameters = campaign.parameters
        low, high = region or (parameters.lower, parameters.upper)
        self.lower = np.maximum(parameters.lower, low)
        self.upper = np.minimum(parameters.upper, high)
        self.between = Between(campaign, evaluator, self.lower, self.upper)
        self.last_matrix: Matrix | None = None
        self.number = 0

    def run(self) -> End:
        """Update until e1 holds, nothing more is gained, or the iterations are used up.

        Where modes came from the solver's matrices its own modes at the end are looked at; if these
        do not agree with them, updating goes on with less belief in what was found otherwise.
        """
        state = self._start()
        while True:
            status, state = self._until(state)
            confirmed = self.evaluator.confirmed(self.number, state.current)
            if confirmed is not None:
                self.watcher.confirmed(confirmed)
                apart = float(np.max(np.abs(confirmed.errors - state.current.errors)))
                unmet = status == "converged" and not confirmed.agrees(self.campaign.tolerances)
                before, state = state.current, State(confirmed, None, None)
                if apart > CONFIRMED or unmet:
                    self.evaluator.refuted(before, apart)
                    continue
            return End(status, self._reason(status, state.current), state.current, self.last_matrix)

    def _until(self, state: State) -> tuple[str, State]:
        """How the iterations from a state end, and where."""
        while True:
            if state.current.agrees(self.campaign.tolerances):
                return "converged", state
            if self.number == self.campaign.update.max_iterations:
                return "max_iterations", state
            matrix = state.matrix or self._fresh(state.current)
            step = self._step(state.current, matrix)
            trial = self._try(state, matrix, step)
            if trial is not None:
                state, gained = self._accept(state, matrix, trial)
                if gained or matrix.age > 0 or state.current.agrees(self.campaign.tolerances):
                    continue
            elif matrix.age > 0:
                state = State(state.current, None, None)
                continue
            elif self.number == self.campaign.update.max_iterations:
                continue
            return "stationary", state

    def _reason(self, status: str, last: Evaluation) -> str:
        if status == "converged":
            return f"e1 is met: {_distance(last)}"
        if status == "max_iterations":
            return f"all {self.number} iterations are used up and e1 is not met: {_distance(last)}"
        return (
            "the residual cannot be brought down further within the bounds, and e1 is not met: "
            + _distance(last)
        )

    def _start(self) -> State:
        initial = self.campaign.start
        self.watcher.working("initial model")
        alone = self.campaign.update.max_iterations == 0
        current, matrix = self.evaluator.evaluate(0, initial, self.around, alone)
        self.last_matrix = matrix
        self._note(current, None, None, np.nan, True, "initial model", False)
        return State(current, matrix, None)

    def _fresh(self, current: Evaluation) -> Matrix:
        self.watcher.working(f"iteration {self.number}: sensitivities")
        return self.evaluator.matrix(self.number, current)

    def _try(self, state: State, matrix: Matrix, step: Step) -> Trial | None:
        """The first set along a step that is better than the current one, or None.

        An old matrix gets one chance; with a fresh one the step is made shorter until it helps.
        """
        current = state.current
        chances, failures = 1 if matrix.age > 0 else SHORTENINGS + 1, 0
        for chance in range(chances):
            if np.max(np.abs(step.change)) < NO_STEP:
                return None
            if self.number == self.campaign.update.max_iterations:
                return None
            self.number += 1
            self.watcher.working(f"iteration {self.number}")
            ending = "taken back, new sensitivity" if matrix.age > 0 else "shorter step"
            try:
                trial = self._evaluate(state, step, chance)
            except (SolverError, ModesError) as error:
                never_solved = matrix.age == 0 and failures == chance == chances - 1
                if isinstance(error, SolverMissing | SolverCancelled) or never_solved:
                    raise
                failures += 1
                logger.warning("%s; %s", error, ending)
            else:
                better = self._gain(current, trial) > 0.0
                if better or trial.evaluation.agrees(self.campaign.tolerances):
                    return trial
                self._note(
                    trial.evaluation,
                    trial.step,
                    matrix,
                    trial.slope,
                    False,
                    f"worse: {ending}",
                    False,
                )
            step = self._shorter(current, matrix, step)
        return None

    def _evaluate(self, state: State, step: Step, chance: int) -> Trial:
        current = state.current
        # Sensitivities beside the modal job are in vain where the set is not kept or is the last.
        alone = (
            self.between.waits
            or state.skip is not None
            or chance > 0
            or self.number == self.campaign.update.max_iterations
            or expects_agreement(step, current, self.campaign.tolerances)
        )
        theta = current.theta + step.change
        evaluation, fresh = self.evaluator.evaluate(self.number, theta, current, alone)
        used = current.residual.weights > 0.0
        now, before = evaluation.residual.values[used], current.residual.values[used]
        change = slope(now, before, theta.size)
        return Trial(step, evaluation, fresh, change)

    def _accept(self, state: State, matrix: Matrix, trial: Trial) -> tuple[State, bool]:
        """The state after a better set, and whether more than nothing was gained by it.

        e2 spares this set its sensitivity where Broyden's formula can stand in, and the next set
        where the old matrix is kept as it is (thesis, 4.2), as long as steps keep their promise.
        """
        before = self._objective(state.current, state.current.residual.values, trial.step)
        gain = self._gain(state.current, trial)
        promised = before - self._objective(state.current, trial.step.predicted, trial.step, 1.0)
        kept = gain >= max(KEPT_PROMISE * promised, STATIONARY * before)
        small = 0.0 < trial.slope <= self.campaign.update.e2 and not matrix.missing
        spared, skip = None, None
        if self.between.waits:
            left = (before - gain) / before
            pays = kept and self.between.pays(matrix, trial.step, trial.evaluation, left)
            spared = trial.slope if small and pays else None
        elif self.campaign.sensitivity.between == "broyden":
            pass  # its matrix could only take the place of one that takes no time
        elif not self.evaluator.cheap and (kept or matrix.age == 0):
            spared, skip = state.skip, trial.slope if small else None
        following = trial.matrix
        if spared is not None:
            following = self.between.older(matrix, state.current, trial.step, trial.evaluation)
            self.evaluator.skip(self.number, spared)
        self.last_matrix = following or matrix
        decision = "" if skip is None else f"e2: slope {skip:.2g}, no new sensitivity next"
        self._note(
            trial.evaluation, trial.step, matrix, trial.slope, True, decision, spared is not None
        )
        return State(trial.evaluation, following, skip), gain > STATIONARY * before

    def _step(self, current: Evaluation, matrix: Matrix) -> Step:
        self.last_matrix = matrix
        parameters, settings = self.campaign.parameters, self.campaign.update
        limit = np.full(len(parameters), settings.step_limit)
        limit[list(matrix.missing)] = 0.0  # nothing is known of what these would do
        problem = StepProblem(
            sensitivity=matrix.values,
            residual=current.residual.values,
            weights=current.residual.weights,
            parameter_weights=parameters.standard_deviations**-2,
            offset=current.theta - parameters.initial,
            lower=np.minimum(np.maximum(self.lower - current.theta, -limit), 0.0),
            upper=np.maximum(np.minimum(self.upper - current.theta, limit), 0.0),
        )
        step = parameter_step(problem, settings.step, settings.regularisation)
        region = self._region(current, np.full(len(parameters), settings.step_limit))
        return self.evaluator.refined(current, step, region) or step

    def _region(self, current: Evaluation, reach: Floats) -> tuple[Floats, Floats]:
        """Where a step of at most this reach may end."""
        return (
            np.maximum(self.lower, current.theta - reach),
            np.minimum(self.upper, current.theta + reach),
        )

    def _shorter(self, current: Evaluation, matrix: Matrix, step: Step) -> Step:
        """A step of at most half the length."""
        reach = np.full(step.change.size, 0.5 * np.max(np.abs(step.change)))
        refined = self.evaluator.refined(current, step, self._region(current, reach))
        if refined is not None:
            return refined
        change = 0.5 * step.change
        predicted = current.residual.values - matrix.values @ change
        return replace(step, change=change, predicted=predicted)

    def _objective(
        self, current: Evaluation, residual: Floats, step: Step, share: float = 0.0
    ) -> float:
        """What the step form brings down, for a residual found at a share of the step.

        The weights are those of the current set, since weights of shapes grow as these come near;
        pseudo_inverse and minimum_norm know none. A pull to the initial values counts too.
        """
        settings, parameters = self.campaign.update, self.campaign.parameters
        weights = current.residual.weights
        if settings.step in ("pseudo_inverse", "minimum_norm"):
            weights = (weights > 0.0).astype(np.float64)
        pull = 0.0
        if settings.step == "pulled_to_initial":
            theta = current.theta + share * step.change
            offset = (theta - parameters.initial) / parameters.standard_deviations
            pull = step.regularisation * float(offset @ offset)
        return float(residual @ (weights * residual)) + pull

    def _gain(self, current: Evaluation, trial: Trial) -> float:
        """How much lower the objective is at a trial than at the current set."""
        now, there = current.residual.values, trial.evaluation.residual.values
        return self._objective(current, now, trial.step) - self._objective(
            current, there, trial.step, 1.0
        )

    def _note(
        self,
        evaluation: Evaluation,
        step: Step | None,
        matrix: Matrix | None,
        change: float,
        accepted: bool,
        decision: str,
        skipped: bool,
    ) -> None:
        self.watcher.noted(
            Noted(
                self.number,
                evaluation,
                step,
                matrix,
                change,
                accepted,
                decision,
                skipped,
                self.last_matrix,
            )
        )


def _distance(evaluation: Evaluation) -> str:
    """How far a set is from the test, in words."""
    worst = int(np.argmax(np.abs(evaluation.errors)))
    text = f"largest frequency error {100 * evaluation.errors[worst]:+.2f} %"
    mac = evaluation.pairing.judged_mac
    return text + (f", least MAC {mac.min():.3f}" if np.isfinite(mac).all() else "")
