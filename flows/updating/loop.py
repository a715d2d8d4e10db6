"""The updating loop: evaluate, compare with the test, step, until e1 holds or nothing is gained.

Where sets cost little it goes on from where e1 holds to the least misfit, without leaving e1.

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
from modetune.core.updating.estimation import Step
from modetune.core.updating.trust_region import TrustRegion
from modetune.flows.campaign.campaign import Campaign
from modetune.flows.updating.between import Between
from modetune.flows.updating.evaluation import Evaluation, Matrix, expects_agreement
from modetune.flows.updating.evaluator import Evaluator
from modetune.flows.updating.stepping import Stepping

logger = logging.getLogger(__name__)

#: A step is shortened at most so often before its start counts as stationary.
SHORTENINGS = 5
#: Relative decrease of the objective below which nothing more is gained.
STATIONARY = 1e-4
#: Largest parameter change that counts as none.
NO_STEP = 1e-8
#: Largest parameter change that the least misfit is not worth, where e1 holds.
POLISHED = 1e-4
#: ... where an old matrix led there, and new ones are to end at the same values.
SAME_END = 1e-3
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
    None where it does not; region: where the next step may go.
    """

    current: Evaluation
    matrix: Matrix | None
    skip: float | None
    region: TrustRegion


@dataclass(frozen=True, slots=True)
class Trial:
    """A set tried: the step to it, what it gave, its fresh matrix if there is one, its slope.

    region: that the step was taken in. used, begun: the matrix of its last part, and the set where
    that began: the current one but after a step by an old matrix that made things worse.
    """

    step: Step
    evaluation: Evaluation
    matrix: Matrix | None
    slope: float
    region: TrustRegion
    used: Matrix
    begun: Evaluation


class Loop:
    """Updating from a start to its end; `run` carries it there.

    region: lower and upper values that it keeps to within the parameters' bounds, each
    (n_parameters,), where it may not go everywhere. around: an evaluation point that the
    modes of the start are tracked from. first, title: number and name of the first set. confirms:
    whether the end is looked at by the solver's own modes where it was found otherwise.
    """

    def __init__(
        self,
        campaign: Campaign,
        evaluator: Evaluator,
        watcher: Watcher,
        region: tuple[Floats, Floats] | None = None,
        around: Evaluation | None = None,
        first: int = 0,
        title: str = "initial model",
        confirms: bool = True,
    ) -> None:
        self.around = around
        self.confirms = confirms
        self.title = title
        self.campaign = campaign
        self.evaluator = evaluator
        self.watcher = watcher
        parameters = campaign.parameters
        low, high = region or (parameters.lower, parameters.upper)
        self.lower = np.maximum(parameters.lower, low)
        self.upper = np.minimum(parameters.upper, high)
        self.between = Between(campaign, evaluator, self.lower, self.upper)
        self.stepping = Stepping(campaign, evaluator, self.lower, self.upper)
        self.last_matrix: Matrix | None = None
        self.number = self.first = first

    def run(self) -> End:
        """Update until e1 holds, nothing more is gained, or the iterations are used up.

        Where modes came from the solver's matrices its own modes at the end are looked at; if these
        do not agree with them, updating goes on with less belief in what was found otherwise.
        """
        state = self._start()
        while True:
            status, state = self._until(state)
            confirmed = None
            if self.confirms:
                confirmed = self.evaluator.confirmed(self.number, state.current)
            if confirmed is not None:
                self.watcher.confirmed(confirmed)
                apart = float(np.max(np.abs(confirmed.errors - state.current.errors)))
                unmet = status == "converged" and not confirmed.agrees(self.campaign.tolerances)
                before, state = (
                    state.current,
                    replace(state, current=confirmed, matrix=None, skip=None),
                )
                if apart > CONFIRMED or unmet:
                    self.evaluator.refuted(before, apart)
                    continue
            return End(status, self._reason(status, state.current), state.current, self.last_matrix)

    def _until(self, state: State) -> tuple[str, State]:
        """How the iterations from a state end, and where."""
        while True:
            if state.current.agrees(self.campaign.tolerances):
                return "converged", self._polished(state)
            if self._used_up():
                return "max_iterations", state
            matrix = state.matrix or self._fresh(state.current)
            self.last_matrix = matrix
            trial = self._try(state, matrix)
            if trial is not None:
                state, gained = self._accept(state, trial)
                if gained or matrix.age > 0 or state.current.agrees(self.campaign.tolerances):
                    continue
                if self.stepping.adapts and not state.region.boldest:
                    state = replace(state, region=state.region.emboldened())
                    continue
            elif matrix.age > 0:
                state = replace(state, matrix=None, skip=None)
                continue
            elif self._used_up():
                continue
            return "stationary", state

    def _polished(self, state: State) -> State:
        """The least misfit beside a state that meets e1, without leaving e1.

        Where sets cost little, and as far as the test tells: what it does not see stays as it is.
        An old matrix that led to the end goes on as long as it moves a value, if new ones would
        end at the same.
        """
        gained = True
        while gained:
            current = state.current
            old = self.between.goes_on(state.matrix, current)
            little = not old and self.evaluator.polishes(current)
            if not old and not little:
                return state
            matrix = state.matrix or self._fresh(current)
            self.last_matrix, state = matrix, replace(state, matrix=matrix)
            if little:
                step = self.stepping.to_least_misfit(current, matrix)
            else:
                step = self.stepping.step(current, matrix, state.region)
            least, trial = POLISHED if little else SAME_END, None
            while trial is None:
                if np.max(np.abs(step.change)) < least or self._used_up():
                    return state
                self.number += 1
                trial = self._polishing(state, matrix, step)
                if trial is None and not little:
                    return state
                step = self.stepping.halved(current, matrix, step)
            state, gained = self._accept(state, trial)
        return state

    def _polishing(self, state: State, matrix: Matrix, step: Step) -> Trial | None:
        """The set of a step, None where it is not better, or e1 does not hold there."""
        try:
            trial = self._evaluate(state, matrix, step, state.region, 0)
        except (SolverError, ModesError) as error:
            if isinstance(error, SolverMissing | SolverCancelled):
                raise
            logger.info("%s; shorter step", error)
            return None
        better = self.stepping.better(state.current, trial.evaluation, step)
        if better and trial.evaluation.agrees(self.campaign.tolerances):
            return trial
        self._note(trial.evaluation, step, matrix, trial.slope, False, "worse: shorter step", False)
        return None

    def _used_up(self) -> bool:
        return self.number - self.first == self.campaign.update.max_iterations

    def _reason(self, status: str, last: Evaluation) -> str:
        if status == "converged":
            return f"e1 is met: {_distance(last)}"
        if status == "max_iterations":
            taken = self.number - self.first
            said = f"all {taken} iterations are used up and e1 is not met: {_distance(last)}"
            return "; ".join(filter(None, (said, self.stepping.held_back)))
        return (
            "the residual cannot be brought down further within the bounds, and e1 is not met: "
            + _distance(last)
        )

    def _start(self) -> State:
        initial = self.campaign.start
        self.watcher.working(self.title)
        alone = self.campaign.update.max_iterations == 0
        current, matrix = self.evaluator.evaluate(self.first, initial, self.around, alone)
        self.last_matrix = matrix
        self._note(current, None, None, np.nan, True, self.title, False)
        return State(current, matrix, None, self.stepping.first)

    def _fresh(self, current: Evaluation) -> Matrix:
        self.watcher.working(f"iteration {self.number}: sensitivities")
        return self.evaluator.matrix(self.number, current)

    def _try(self, state: State, matrix: Matrix) -> Trial | None:
        """The first set that is better than the current one, or None.

        With a fresh matrix the step is made shorter until it helps. An old one gets one chance, and
        Broyden's a second: along a narrow valley a long step is worse by its curvature alone, and
        corrected by what it showed the next one from there ends at the bottom, at the price of a
        round where a new matrix takes all of its own.
        """
        current, region, begun = state.current, state.region, state.current
        step = self.stepping.step(current, matrix, region)
        chances, failures = 2 if matrix.age > 0 else SHORTENINGS + 1, 0
        for chance in range(chances):
            if np.max(np.abs(step.change)) < NO_STEP or self._used_up():
                return None
            self.number += 1
            self.watcher.working(f"iteration {self.number}")
            old = matrix.age > 0
            ending = "taken back, new sensitivity" if old else "shorter step"
            try:
                trial = self._evaluate(state, matrix, step, region, chance, begun)
            except (SolverError, ModesError) as error:
                never_solved = not old and failures == chance == chances - 1
                if isinstance(error, SolverMissing | SolverCancelled) or never_solved:
                    raise
                failures += 1
                level = logging.WARNING if self.evaluator.steps_run else logging.INFO
                logger.log(level, "%s; %s", error, ending)
                if old:
                    return None
            else:
                better = self.stepping.better(current, trial.evaluation, step)
                if better or trial.evaluation.agrees(self.campaign.tolerances):
                    return trial
                again = old and chance == 0 and self.between.tries_again(trial.slope)
                decision = "worse: corrected and gone on from" if again else f"worse: {ending}"
                self._note(trial.evaluation, step, matrix, trial.slope, False, decision, False)
                if again:
                    matrix = self.between.older(matrix, begun, trial.evaluation)
                    begun = trial.evaluation
                    step = self.stepping.step(begun, matrix, region)
                    step = replace(step, change=begun.theta + step.change - current.theta)
                    continue
                if old:
                    return None
            step, region = self.stepping.shorter(current, matrix, step, region)
        return None

    def _evaluate(
        self,
        state: State,
        matrix: Matrix,
        step: Step,
        region: TrustRegion,
        chance: int,
        begun: Evaluation | None = None,
    ) -> Trial:
        current = state.current
        # Sensitivities beside the modal job are in vain where the set is not kept or is the last.
        alone = (
            self.between.waits
            or state.skip is not None
            or chance > 0
            or self._used_up()
            or expects_agreement(step, current, self.campaign.tolerances)
        )
        theta = current.theta + step.change
        evaluation, fresh = self.evaluator.evaluate(self.number, theta, current, alone)
        change = slope(evaluation.residual, current.residual, theta.size)
        return Trial(step, evaluation, fresh, change, region, matrix, begun or current)

    def _accept(self, state: State, trial: Trial) -> tuple[State, bool]:
        """The state after a better set, and whether more than nothing was gained by it.

        e2 spares this set its sensitivity where Broyden's formula can stand in, and the next set
        where the old matrix is kept as it is (thesis, 4.2), as long as steps keep their promise.
        """
        current, step, matrix, stepping = state.current, trial.step, trial.used, self.stepping
        before = stepping.objective(current, current.residual.values, step)
        gain = stepping.gain(current, trial.evaluation, step)
        promised = before - stepping.objective(current, step.predicted, step, 1.0)
        kept = gain >= max(KEPT_PROMISE * promised, STATIONARY * before)
        small = 0.0 < trial.slope <= self.campaign.update.e2 and not matrix.missing
        ends = self.number == self.campaign.update.max_iterations or trial.evaluation.agrees(
            self.campaign.tolerances
        )  # then no sensitivity would follow, and there is none to spare
        spared, skip = None, None
        if self.between.waits:
            left = (before - gain) / before
            pays = kept and self.between.pays(matrix, step, trial.evaluation, left)
            spared = trial.slope if small and pays else None
        elif self.campaign.sensitivity.between == "broyden":
            pass  # its matrix could only take the place of one that takes no time
        elif not self.evaluator.cheap and (kept or matrix.age == 0):
            spared, skip = state.skip, trial.slope if small else None
        following = trial.matrix
        if spared is not None:
            following = self.between.older(matrix, trial.begun, trial.evaluation)
            if not ends:
                self.evaluator.skip(self.number, spared)
        self.last_matrix = following or matrix
        decision = f"e2: slope {skip:.2g}, no new sensitivity next" if skip and not ends else ""
        skipped = spared is not None and not ends
        self._note(trial.evaluation, step, matrix, trial.slope, True, decision, skipped)
        share = gain / promised if promised > 0.0 else 0.0
        region = stepping.region_after(current, matrix, step, trial.region, share)
        gained = gain > STATIONARY * before or stepping.nears_limits(current, trial.evaluation)
        return State(trial.evaluation, following, skip, region), gained

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
    errors = evaluation.used_errors
    if errors.size == 0:
        text = "no frequency is compared"
    else:
        worst = int(np.argmax(np.abs(errors)))
        text = f"largest frequency error {100 * errors[worst]:+z.2f} %"
    mac = evaluation.pairing.judged_mac
    text += f", least MAC {mac.min():.3f}" if np.isfinite(mac).all() else ""
    return text + (f"; not met: {', '.join(evaluation.unmet)}" if evaluation.unmet else "")
