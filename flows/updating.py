"""The updating loop: evaluate, compare with the test, step, until e1 holds or nothing is gained.

Each iteration evaluates one parameter set: its modal job and, unless e2 skips them, its
sensitivity jobs go to the execution side by side. A set that makes the residual worse is not
accepted: a step from an older matrix is taken back and the matrix computed anew, one from a
fresh matrix is halved. So skipping never costs convergence. A failed trial (solver failure, lost
mode) is treated likewise.

The loop is deterministic and all results are in the store by content, so a campaign that was
killed is resumed by starting it again: what was finished is answered by the store.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from modetune.core.criteria import slope
from modetune.core.errors import ModesError, SolverCancelled, SolverError, SolverMissing
from modetune.core.estimation import Step, StepProblem, parameter_step
from modetune.core.modes import Floats
from modetune.core.record import CampaignRecord, IterationRecord, RunCounts
from modetune.core.sensitivity import broyden_update
from modetune.flows.campaign import Campaign
from modetune.flows.configurations.joint import JointEvaluator
from modetune.flows.evaluation import Evaluation, expects_agreement
from modetune.flows.evaluator import Evaluator, Matrix
from modetune.flows.recording import campaign_record
from modetune.flows.showing import shown_field
from modetune.flows.trust.judging import checked

logger = logging.getLogger(__name__)

#: A step is halved at most so often before its start counts as stationary.
HALVINGS = 5
#: Relative decrease of the objective below which nothing more is gained.
STATIONARY = 1e-4
#: Largest parameter change that counts as none.
NO_STEP = 1e-8
#: An old matrix whose step gains less than this share of what it promised is computed anew.
KEPT_PROMISE = 0.25


class Progress(Protocol):
    """Who watches a campaign."""

    def working(self, text: str) -> None:
        """What is being computed now."""
        ...

    def iteration(self, record: IterationRecord) -> None:
        """An iteration is complete."""
        ...


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


class Updating:
    """A campaign under way. `run` carries it to its end."""

    def __init__(
        self,
        campaign: Campaign,
        evaluator: Evaluator | JointEvaluator,
        progress: Progress,
        save: Callable[[CampaignRecord], None],
    ) -> None:
        self.campaign = campaign
        self.evaluator = evaluator
        self.progress = progress
        self.save = save
        self.iterations: list[IterationRecord] = []
        self.last_matrix: Matrix | None = None
        self.kept: list[Evaluation] = []
        self.number = 0
        self.started = self.lap = time.monotonic()
        self.counted = RunCounts()

    def run(self) -> CampaignRecord:
        """Update until e1 holds, nothing more is gained, or the iterations are used up."""
        state = self._start()
        while True:
            if state.current.agrees(self.campaign.tolerances):
                return self._end("converged", f"e1 is met: {_distance(state.current)}")
            if self.number == self.campaign.update.max_iterations:
                return self._end("max_iterations", f"all {self.number} iterations are used up and "
                                 f"e1 is not met: {_distance(state.current)}")  # fmt: skip
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
            return self._end("stationary", "the residual cannot be brought down further within the "
                             f"bounds, and e1 is not met: {_distance(state.current)}")  # fmt: skip

    def _start(self) -> State:
        initial = self.campaign.start
        self.progress.working("initial model")
        alone = self.campaign.update.max_iterations == 0
        current, matrix = self.evaluator.evaluate(0, initial, None, alone)
        self.last_matrix = matrix
        self._note(current, None, None, np.nan, True, "initial model", False)
        return State(current, matrix, None)

    def _fresh(self, current: Evaluation) -> Matrix:
        self.progress.working(f"iteration {self.number}: sensitivities")
        return self.evaluator.matrix(self.number, current)

    def _try(self, state: State, matrix: Matrix, step: Step) -> Trial | None:
        """The first set along a step that is better than the current one, or None.

        An old matrix gets one chance; with a fresh one the step is halved until it helps.
        """
        current = state.current
        chances, failures = 1 if matrix.age > 0 else HALVINGS + 1, 0
        for chance in range(chances):
            if np.max(np.abs(step.change)) < NO_STEP:
                return None
            if self.number == self.campaign.update.max_iterations:
                return None
            self.number += 1
            self.progress.working(f"iteration {self.number}")
            ending = "taken back, new sensitivity" if matrix.age > 0 else "step halved"
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
                self._note(trial.evaluation, trial.step, matrix, trial.slope, False,
                           f"worse: {ending}", False)  # fmt: skip
            step = self._halved(current, matrix, step)
        return None

    def _evaluate(self, state: State, step: Step, chance: int) -> Trial:
        current = state.current
        # Sensitivities beside the modal job are in vain where the set is not kept or is the last.
        alone = (
            state.skip is not None
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
        """The state after a better set, and whether more than nothing was gained by it."""
        before = self._objective(state.current, state.current.residual.values, trial.step)
        gain = self._gain(state.current, trial)
        promised = before - self._objective(state.current, trial.step.predicted, trial.step, 1.0)
        e2 = self.campaign.update.e2
        skip = trial.slope if 0.0 < trial.slope <= e2 and not matrix.missing else None
        following = trial.matrix
        if state.skip is not None:
            following = self._older(matrix, state.current, trial)
        if matrix.age > 0 and gain < max(KEPT_PROMISE * promised, STATIONARY * before):
            following, skip = None, None
        skipped = state.skip is not None and following is not None
        if state.skip is not None and skipped:
            self.evaluator.skip(self.number, state.skip)
        self.last_matrix = following or matrix
        decision = "" if skip is None else f"e2: slope {skip:.2g}, no new sensitivity next"
        self._note(trial.evaluation, trial.step, matrix, trial.slope, True, decision, skipped)
        return State(trial.evaluation, following, skip), gain > STATIONARY * before

    def _older(self, matrix: Matrix, current: Evaluation, trial: Trial) -> Matrix:
        """The matrix of before for use once more, as it is or corrected by the last step."""
        if self.campaign.sensitivity.between == "keep":
            return replace(matrix, age=matrix.age + 1)
        change = current.residual.values - trial.evaluation.residual.values
        values = broyden_update(matrix.values, trial.step.change, change)
        return replace(matrix, values=values, age=matrix.age + 1)

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
            lower=np.minimum(np.maximum(parameters.lower - current.theta, -limit), 0.0),
            upper=np.maximum(np.minimum(parameters.upper - current.theta, limit), 0.0),
        )
        return parameter_step(problem, settings.step, settings.regularisation)

    def _halved(self, current: Evaluation, matrix: Matrix, step: Step) -> Step:
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
        now, parameters = time.monotonic(), self.campaign.parameters
        runs, wall_s = self.evaluator.runs.since(self.counted), now - self.lap
        self.counted, self.lap = self.evaluator.runs, now
        record = IterationRecord(
            number=self.number,
            parameters=evaluation.theta,
            step=step.change if step else np.zeros(len(parameters)),
            computed=evaluation.seen,
            pairing=evaluation.pairing,
            frequency_errors=evaluation.errors,
            residual=evaluation.residual,
            sensitivity=matrix.values if matrix else np.zeros((0, len(parameters))),
            sensitivity_methods=matrix.methods_had if matrix else (),
            sensitivity_keys=matrix.keys if matrix else (),
            sensitivity_age=matrix.age if matrix else 0,
            sensitivity_skipped=skipped,
            slope=change,
            accepted=accepted,
            decision=decision,
            regularisation=step.regularisation if step else np.nan,
            condition=step.condition if step else np.nan,
            modal_key=evaluation.key,
            runs=runs,
            wall_s=wall_s,
            field=shown_field(self.campaign, evaluation),
        )
        self.iterations.append(record)
        if accepted:
            self.kept = [*self.kept[:1], evaluation]
        self.progress.iteration(record)
        self.save(self._record("running", ""))

    def _record(self, status: str, reason: str) -> CampaignRecord:
        return campaign_record(
            self.campaign, self.iterations, self.last_matrix, status, reason,
            self.evaluator.runs, time.monotonic() - self.started,
        )  # fmt: skip

    def _end(self, status: str, reason: str) -> CampaignRecord:
        held_out = self.evaluator.held_out(self.kept[0], self.kept[-1])
        record = checked(replace(self._record(status, reason), held_out=held_out))
        at_bounds = self.campaign.parameters.at_bounds(record.updated)
        if at_bounds:
            record = replace(record, reason=f"{reason}; on a bound: {', '.join(at_bounds)}")
        self.save(record)
        return record


def _distance(evaluation: Evaluation) -> str:
    """How far a set is from the test, in words."""
    worst = int(np.argmax(np.abs(evaluation.errors)))
    text = f"largest frequency error {100 * evaluation.errors[worst]:+.2f} %"
    mac = evaluation.pairing.mac
    return text + (f", least MAC {mac.min():.3f}" if np.isfinite(mac).all() else "")
