"""The updating loop: evaluate, compare with the test and step until e1 holds or nothing is gained.

Each iteration tries a point: its modal job and, unless e2 skips them, its sensitivity jobs run in
parallel. A better point is accepted; e2 decides whether the existing matrix is used again. A worse
point is rejected: if the matrix was old, it is computed again; if it was new, the step is
shortened. So skipping never prevents convergence. A failed trial (solver failure, lost mode) is
treated in the same way.

Where evaluations are cheap, the loop continues after e1 is met to the minimum misfit, as far as the
test determines the parameters and e1 stays met. If the modes came from another source, the solver's
own modes confirm the end.

Where a sensitivity takes solver runs, an accepted point may use the previous matrix: unchanged
(`keep`, thesis, 4.2), or updated by Broyden's formula with the change over the last step. In an
updated matrix the rows of frequencies come from strain energies, which are exact and take no job. A
Broyden update takes one round of runs per step; a new matrix takes a round for its parallel jobs
and another for the step. docs/how-it-works.md compares them.

The loop is deterministic and the store keeps all results by content key, so starting a killed
campaign again resumes it.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from modetune.core.errors import ModelError, ModesError, SolverError
from modetune.core.modes import Floats
from modetune.core.updating.criteria import slope
from modetune.core.updating.parameter_steps import BELIEVED, Step, TrustRegion
from modetune.core.updating.sensitivity import broyden_update
from modetune.flows.campaign.campaign import Campaign
from modetune.flows.jobs.progress import doing
from modetune.flows.updating.evaluation import Evaluation, Matrix, expects_agreement
from modetune.flows.updating.evaluator import Evaluator
from modetune.flows.updating.mode_source import CAMPAIGNS_OWN, REDUCED, CaseState
from modetune.flows.updating.reduced_model import ACCURATE, CONFIRMED, ByMatrices
from modetune.flows.updating.sensitivities import UnlikeMatrices
from modetune.flows.updating.step import Stepping

logger = logging.getLogger(__name__)

#: Smallest factor by which Broyden updates must reduce errors: a lower rate counts as none, even if
#: the frequencies already meet e1 and only the shapes do not.
LEAST_WAY = 2.0
#: Number of times a step is shortened before its start counts as stationary.
SHORTENINGS = 5
#: Parameter changes up to this size count as zero.
NO_STEP = 1e-8
#: Number of parameters in the name of a step's task: those with the largest changes.
SHOWN = 8
#: After e1 is met, steps towards the minimum misfit stop below this parameter change.
POLISHED = 1e-4
#: ... or below this one after steps by an old matrix, so that a new one ends at the same values.
SAME_END = 1e-3
#: Smaller relative decreases of the objective are negligible.
STATIONARY = 1e-4
#: If a step by an old matrix gains less than this share of its prediction, the matrix is renewed.
KEPT_PROMISE = 0.25
#: Maximum number of steps on reduced models, which take almost no time.
ITERATIONS = 100


@dataclass(frozen=True, slots=True)
class Reuse:
    """The reuse of an older sensitivity; lower, upper: (n_parameters,), the region of the loop."""

    campaign: Campaign
    evaluator: Evaluator
    lower: Floats
    upper: Floats

    @property
    def waits(self) -> bool:
        """Return whether to evaluate a point first, since a Broyden update may suffice."""
        e2, between = self.campaign.update.e2, self.campaign.sensitivity.between
        if e2 == 0.0 or between == "keep" or self.evaluator.cheap:
            return False
        return self.n_jobs > self.campaign.parallel  # otherwise a sensitivity takes no extra time

    @property
    def n_jobs(self) -> int:
        """Return the number of jobs of a point and its sensitivity, without those all points share.

        It follows from comparing the plans of two distant points, without a run.
        """
        low, high = (
            [job for work in self.evaluator.planned(theta) for job in work.jobs]
            for theta in (self.lower, self.upper)
        )
        return sum(job not in low for job in high)

    def pays(self, matrix: Matrix, step: Step, evaluation: Evaluation, left: float) -> bool:
        """Whether a Broyden update after a step reaches e1 as soon as a new matrix.

        matrix: of the step; evaluation: at its end; left: the remaining share of the objective. A
        new matrix takes the rounds of its parallel jobs and one for the step, which is assumed to
        reach e1. An updated matrix takes one round per step and converges at the rate of the last
        step. After a new matrix this rate is unknown, so the update is tried.
        """
        if step.rank < step.change.size and step.regularisation == 0.0:
            return False  # errors of the matrix would change undetermined parameters
        if matrix.age == 0:
            return True
        rounds = 1 + math.ceil((self.n_jobs - 1) / self.campaign.parallel)
        worst = float(np.max(np.abs(evaluation.used_errors), initial=0.0))
        far = worst / self.campaign.tolerances.frequency
        # The objective is a square: its remaining share is that of the errors, squared.
        return 2.0 * math.log(max(far, LEAST_WAY)) <= -rounds * math.log(max(left, 1e-300))

    def tries_again(self, slope: float) -> bool:
        """Return whether to continue from the worse end of a step by an old matrix.

        Yes with Broyden updates, if the residual changed by at most e2 per parameter."""
        campaign = self.campaign
        return campaign.sensitivity.between == "broyden" and 0.0 < slope <= campaign.update.e2

    def continues(self, matrix: Matrix | None, evaluation: Evaluation) -> bool:
        """Return whether an old matrix that led to e1 continues to the minimum misfit.

        It does if e1's tolerance is smaller than the deviations of frequencies: there is no noise.
        """
        if matrix is None or matrix.age == 0 or self.campaign.fields:
            return False
        if self.campaign.sensitivity.between == "keep":
            return False
        noise = evaluation.residual.noise[evaluation.residual.rows("frequencies")]
        asked = 2.0 * self.campaign.tolerances.frequency  # of an eigenvalue
        return noise.size > 0 and asked <= BELIEVED * math.sqrt(float(noise.min()))

    def older(self, matrix: Matrix, begun: Evaluation, evaluation: Evaluation) -> Matrix:
        """Return the matrix of a step for further use, unchanged or updated; begun: its start."""
        if self.campaign.sensitivity.between == "keep":
            return replace(matrix, age=matrix.age + 1)
        change = begun.residual.values - evaluation.residual.values
        rows = begun.residual.rows("frequencies")
        step = evaluation.theta - begun.theta
        values = broyden_update(matrix.values, step, change, rows.stop)
        exact = self.evaluator.by_energies(evaluation)
        known = np.isfinite(exact)
        values[rows][known] = exact[known]
        methods = tuple(
            f"{name}+strain_energy" if new and "strain_energy" not in name else name
            for name, new in zip(matrix.methods, known.any(axis=0).tolist(), strict=True)
        )
        return replace(matrix, values=values, methods=methods, age=matrix.age + 1)


class Watcher(Protocol):
    """The observer of a loop; these methods do nothing."""

    def working(self, text: str) -> None:
        """Take note of the computation in progress."""
        return

    def noted(
        self,
        number: int,
        evaluation: Evaluation,
        trial: Trial | None,
        newest: Matrix | None,
        decision: str,
        accepted: bool,
        skipped: bool,
    ) -> None:
        """Take note of an evaluated point and the decision about it.

        trial: the trial that led to it, None at the start. newest: the newest matrix. skipped: e2
        skipped the point's own matrix.
        """
        return

    def confirmed(self, evaluation: Evaluation) -> None:
        """Take note of the solver's own modes at the last accepted point."""
        return


@dataclass(frozen=True, slots=True)
class State:
    """The state of a loop.

    current: the last accepted point. matrix: for the step from there, None until it is computed.
    skip: the slope for which e2 skips the next iteration's matrix, None if it does not. region: of
    the next step.
    """

    current: Evaluation
    matrix: Matrix | None
    skip: float | None
    region: TrustRegion


@dataclass(frozen=True, slots=True)
class TrialStep:
    """A step to a point, by a matrix, within a region.

    begun: the point to which the matrix belongs: the current point, or the worse end of a step by
    an old matrix from which updating continued.
    """

    step: Step
    matrix: Matrix
    region: TrustRegion
    begun: Evaluation


@dataclass(frozen=True, slots=True)
class Trial:
    """The end of a step: the point, its new matrix if any, and e2's slope."""

    by: TrialStep
    evaluation: Evaluation
    matrix: Matrix | None
    slope: float


@dataclass
class Trials:
    """The trials of a loop.

    region: lower and upper values within the parameters' bounds, each (n_parameters,), that limit
    it further. first: number of the first point.
    """

    campaign: Campaign
    evaluator: Evaluator
    watcher: Watcher
    region: tuple[Floats, Floats] | None
    first: int
    foresight: Foresight | None = None
    newest: Matrix | None = None

    def __post_init__(self) -> None:
        own, self.number = self.campaign.parameters, self.first
        low, high = self.region or (own.lower, own.upper)
        box = np.maximum(own.lower, low), np.minimum(own.upper, high)
        self.reuse = Reuse(self.campaign, self.evaluator, *box)
        refined = self.foresight.refined if self.foresight else lambda *_: None
        self.stepping = Stepping(self.campaign, refined, *box)

    def used_up(self) -> bool:
        """Whether there are no iterations left."""
        return self.number - self.first == self.campaign.update.max_iterations

    def start(self, title: str, around: Evaluation | None) -> State:
        """Evaluate the first point; around: an evaluation from which its modes are tracked."""
        self.watcher.working(title)
        theta, alone = self.campaign.start, self.campaign.update.max_iterations == 0
        current, matrix = self.evaluator.evaluate(self.first, theta, around, alone)
        self.newest = matrix
        self.watcher.noted(self.first, current, None, matrix, title, True, False)
        return State(current, matrix, None, self.stepping.first)

    def matrix(self, state: State) -> Matrix:
        """Return the matrix of the step from a state; compute it if there is none."""
        if state.matrix is None:
            self.watcher.working(f"iteration {self.number}: sensitivities")
        title = f"iteration {self.number}"
        self.newest = state.matrix or self.evaluator.matrix(title, state.current)
        return self.newest

    def step(self, compute: Callable[[], Step]) -> Step:
        """Compute a step to the next point as its own task."""

        def computed() -> tuple[Step, str]:
            step, names = compute(), self.campaign.parameters.names
            largest = np.argsort(-np.abs(step.change), kind="stable")[:SHOWN]
            return step, ", ".join(f"{names[n]} {step.change[n]:+.3g}" for n in largest)

        return self.evaluator.step(f"iteration {self.number + 1}", computed)

    def better(self, state: State, matrix: Matrix) -> Trial | None:
        """Return the first point that is better than the current one, or None.

        With a new matrix the step is shortened until it is better. An old matrix gets one attempt,
        and a Broyden update a second one: along a narrow valley a long step may be worse only
        because of the valley's curvature. The next step, with the updated matrix, then reaches the
        bottom for one round of runs instead of those of a new matrix.
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
                again = old and chance == 0 and self.reuse.tries_again(trial.slope)
                self.note(trial, f"worse: {'corrected, and continued from' if again else ending}")
                if again:
                    by = self._continued(current, trial)
                    continue
            if old:
                return None
            step, region = stepping.shorter(current, by.matrix, by.step, by.region)
            by = replace(by, step=step, region=region)
        return None

    def _continued(self, current: Evaluation, trial: Trial) -> TrialStep:
        """Return the next step from the worse end of a step, with the updated matrix."""
        by, begun = trial.by, trial.evaluation
        matrix = self.reuse.older(by.matrix, by.begun, begun)
        step = self.step(lambda: self.stepping.step(begun, matrix, by.region))
        step = replace(step, change=begun.theta + step.change - current.theta)
        return TrialStep(step, matrix, by.region, begun)

    def tried(self, state: State, by: TrialStep, alone: bool = False) -> Trial:
        """Evaluate the end of a step; alone: run the modal job without sensitivities.

        Raises SolverError, ModesError, StoreError.
        """
        self.number += 1
        current = state.current
        # Sensitivities are wasted if the point is rejected or is the last one.
        alone = (
            alone
            or self.reuse.waits
            or state.skip is not None
            or self.used_up()
            or expects_agreement(by.step, current, self.campaign.tolerances)
        )
        theta = current.theta + by.step.change
        evaluation, fresh = self._evaluated(theta, current, alone)
        change = slope(evaluation.residual, current.residual, theta.size)
        return Trial(by, evaluation, fresh, change)

    def _evaluated(
        self, theta: Floats, previous: Evaluation, alone: bool
    ) -> tuple[Evaluation, Matrix | None]:
        """Return the evaluation of a point, or its prediction where that is accurate enough."""
        if self.foresight is None:
            return self.evaluator.evaluate(self.number, theta, previous, alone)
        with doing(f"iteration {self.number}"):
            predicted = self.foresight.predicted(theta, previous)
        if predicted is not None:
            return predicted, None
        found = self.evaluator.evaluate(self.number, theta, previous, alone)
        self.foresight.compare(found[0], previous)
        return found

    def note(
        self, trial: Trial, decision: str, accepted: bool = False, skipped: bool = False
    ) -> None:
        """Report the decision about a trial to the watcher."""
        self.watcher.noted(
            self.number, trial.evaluation, trial, self.newest, decision, accepted, skipped
        )


def polished(trials: Trials, state: State) -> Trial | None:
    """Return the next point from a state that meets e1; None if the gain is negligible."""
    current, stepping = state.current, trials.stepping
    old = trials.reuse.continues(state.matrix, current)
    if not old and not trials.evaluator.polishes(current):
        return None
    matrix = trials.matrix(state)
    if old:
        step = trials.step(lambda: stepping.step(current, matrix, state.region))
        least = SAME_END
    else:
        step = trials.step(lambda: stepping.to_least_misfit(current, matrix))
        least = POLISHED
    while np.max(np.abs(step.change)) >= least and not trials.used_up():
        found = _better(trials, state, TrialStep(step, matrix, state.region, current))
        if found is not None or old:
            return found
        step = stepping.halved(current, matrix, step)
    return None


def _better(trials: Trials, state: State, by: TrialStep) -> Trial | None:
    """Evaluate the end of a step; None if it is not better or does not meet e1."""
    try:
        trial = trials.tried(state, by)
    except (SolverError, ModesError) as error:
        if isinstance(error, CAMPAIGNS_OWN):
            raise
        logger.info("%s; shorter step", error)
        return None
    better = trials.stepping.better(state.current, trial.evaluation, by.step)
    if better and trial.evaluation.agrees(trials.campaign.tolerances):
        return trial
    trials.note(trial, "worse: shorter step")
    return None


@dataclass(frozen=True, slots=True)
class End:
    """The end of a loop: converged, stationary or max_iterations, the reason, and the point."""

    status: str
    reason: str
    last: Evaluation
    matrix: Matrix | None


@dataclass
class Loop:
    """Updating from a start to its end, by `run`.

    region: lower and upper values within the parameters' bounds, each (n_parameters,), that limit
    it further. around: an evaluation from which the modes of the start are tracked. first, title:
    number and name of the first point. confirms: let the solver's own modes confirm the end if the
    modes came from another source. foresight: predictions by reduced models.
    """

    campaign: Campaign
    evaluator: Evaluator
    watcher: Watcher
    region: tuple[Floats, Floats] | None = None
    around: Evaluation | None = None
    first: int = 0
    title: str = "initial model"
    confirms: bool = True
    foresight: Foresight | None = None

    def __post_init__(self) -> None:
        self.trials = Trials(
            self.campaign, self.evaluator, self.watcher, self.region, self.first, self.foresight
        )

    def run(self) -> End:
        """Update until e1 holds, nothing more is gained, or the iterations are used up.

        If the modes came from another source and the solver's own modes do not confirm them,
        updating continues without that source.
        """
        state = self.trials.start(self.title, self.around)
        while True:
            status, state = self._until(state)
            last, confirmed = state.current, None
            if self.confirms:
                confirmed = self.evaluator.confirmed(self.trials.number, last)
            if confirmed is not None:
                self.watcher.confirmed(confirmed)
                apart = float(np.max(np.abs(confirmed.errors - last.errors)))
                unmet = status == "converged" and not confirmed.agrees(self.campaign.tolerances)
                state = replace(state, current=confirmed, matrix=None, skip=None)
                if apart > CONFIRMED or unmet:
                    assert self.foresight is not None
                    self.foresight.refute(last, apart)
                    continue
            reason = self._reason(status, state.current)
            return End(status, reason, state.current, self.trials.newest)

    def _until(self, state: State) -> tuple[str, State]:
        """Iterate from a state; return the end and the state there."""
        trials = self.trials
        while True:
            if state.current.agrees(self.campaign.tolerances):
                return "converged", self._polished(state)
            if trials.used_up():
                return "max_iterations", state
            matrix = trials.matrix(state)
            trial = trials.better(state, matrix)
            if trial is not None:
                state, gained = self._accept(state, trial)
                if gained or matrix.age > 0 or state.current.agrees(self.campaign.tolerances):
                    continue
                if trials.stepping.adapts and not state.region.boldest:
                    state = replace(state, region=state.region.emboldened())
                    continue
            elif matrix.age > 0:
                state = replace(state, matrix=None, skip=None)
                continue
            elif trials.used_up():
                continue
            return "stationary", state

    def _polished(self, state: State) -> State:
        """Continue from a state that meets e1 to the minimum misfit, without leaving e1."""
        gained = True
        while gained and (trial := polished(self.trials, state)) is not None:
            state, gained = self._accept(state, trial)
        return state

    def _reason(self, status: str, last: Evaluation) -> str:
        if status == "converged":
            return f"e1 is met: {_distance(last)}"
        if status == "max_iterations":
            taken = self.campaign.update.max_iterations
            text = f"all {taken} iterations are used up and e1 is not met: {_distance(last)}"
            return "; ".join(filter(None, (text, self.trials.stepping.held_back)))
        return (
            "the residual cannot be brought down further within the bounds, and e1 is not met: "
            + _distance(last)
        )

    def _accept(self, state: State, trial: Trial) -> tuple[State, bool]:
        """Return the state after a better point, and whether the gain is more than negligible.

        While steps gain what they predict, e2 skips this point's sensitivity if a Broyden update
        can replace it, or the next one's if the old matrix is kept unchanged (thesis, 4.2).
        """
        trials, by, there = self.trials, trial.by, trial.evaluation
        current, step, matrix, stepping = state.current, by.step, by.matrix, trials.stepping
        before = stepping.objective(current, current.residual.values, step)
        gain = stepping.gain(current, there, step)
        promised = before - stepping.objective(current, step.predicted, step, 1.0)
        kept = gain >= max(KEPT_PROMISE * promised, STATIONARY * before)
        small = 0.0 < trial.slope <= self.campaign.update.e2 and not matrix.missing
        # No sensitivity follows then, so there is none to skip.
        ends = trials.used_up() or there.agrees(self.campaign.tolerances)
        spared, skip = None, None
        if trials.reuse.waits:
            left = (before - gain) / before
            pays = kept and trials.reuse.pays(matrix, step, there, left)
            spared = trial.slope if small and pays else None
        elif self.campaign.sensitivity.between == "broyden":
            pass  # its matrix could only replace one that takes no time
        elif not self.evaluator.cheap and (kept or matrix.age == 0):
            spared, skip = state.skip, trial.slope if small else None
        following = trial.matrix
        if spared is not None:
            following = trials.reuse.older(matrix, by.begun, there)
            if not ends:
                self.evaluator.skip(trials.number, spared)
        trials.newest = following or matrix
        decision = f"e2: slope {skip:.2g}, no new sensitivity next" if skip and not ends else ""
        trials.note(trial, decision, accepted=True, skipped=spared is not None and not ends)
        share = gain / promised if promised > 0.0 else 0.0
        region = stepping.region_after(current, matrix, step, by.region, share)
        gained = gain > STATIONARY * before or stepping.nears_limits(current, there)
        return State(there, following, skip, region), gained


def _distance(evaluation: Evaluation) -> str:
    """Return a sentence about the difference from the test."""
    errors = evaluation.used_errors
    if errors.size == 0:
        text = "no frequency is compared"
    else:
        worst = int(np.argmax(np.abs(errors)))
        text = f"largest frequency error {100 * errors[worst]:+z.2f} %"
    mac = evaluation.pairing.judged_mac
    text += f", lowest MAC {mac.min():.3f}" if np.isfinite(mac).all() else ""
    return text + (f"; not met: {', '.join(evaluation.unmet)}" if evaluation.unmet else "")


class Silent(Watcher):
    """A watcher of a loop that reports nothing."""


class Foresight:
    """Predictions by the reduced models of an evaluator's cases: ends of steps, and evaluations.

    A reduced model gives the modes around a point for any parameter values. The loop therefore runs
    on it to the end, with the campaign's step type, bounds and criteria, within the region in which
    the step may end. That end is one step of the real campaign. If the prediction meets e1, and the
    step is short compared with one whose end was predicted well, the matrices are not solved there:
    the solver's own modes confirm the prediction next.
    """

    def __init__(self, evaluator: Evaluator) -> None:
        self.evaluator = evaluator
        self.campaign = evaluator.campaign
        self._end: Evaluation | None = None
        #: Relative error of the last predicted frequencies, and the length of that step.
        self._miss: tuple[float, float] | None = None
        self._predicts = True
        #: Cases on the newest reduced models; empty before the first step.
        self.states: list[CaseState] = []

    def refined(
        self, current: Evaluation, step: Step, region: tuple[Floats, Floats]
    ) -> Step | None:
        """Return the step to the end of updating on reduced models around the current point.

        step: the linear step, whose regularisation and condition are kept. region: lower and upper
        values. None if a case has no reduced model, or updating on it fails.
        """
        states = []
        for state, part in zip(self.evaluator.used, current.parts, strict=True):
            if not isinstance(state.finder, ByMatrices):
                return None
            try:
                reduced = state.finder.around(part, state.analysis)
            except (UnlikeMatrices, ModelError) as error:
                state.finder = state.finder.instead(error)
                return None
            case = replace(state.case, held_out=None)
            states.append(replace(state, case=case, finder=reduced))
        inner = replace(
            self.campaign,
            cases=tuple(state.case for state in states),
            begin=tuple(current.theta.tolist()),
            update=self.campaign.update.model_copy(update={"max_iterations": ITERATIONS}),
        )
        self.states = states
        evaluator = Evaluator(inner, states, self.evaluator.execution)
        try:
            end = Loop(inner, evaluator, Silent(), region, current).run()
        except ModesError as error:
            logger.debug("no reduced step: %s", error)
            return None
        self._end = end.last
        change = end.last.theta - current.theta
        return replace(step, change=change, predicted=end.last.residual.values)

    def predicted(self, theta: Floats, previous: Evaluation) -> Evaluation | None:
        """Return the prediction at a point, if e1 holds there and its error is small enough.

        The error of a reduced model grows at least with the square of the step.
        """
        end = self._end_at(theta)
        if end is None or self._miss is None or not self._predicts:
            return None
        tolerances, (error, length) = self.campaign.tolerances, self._miss
        error *= (_length(theta, previous) / length) ** 2
        if error > ACCURATE * min(tolerances.frequency, CONFIRMED) or not end.agrees(tolerances):
            return None
        parts = []
        try:
            for state, before in zip(self.evaluator.used, previous.parts, strict=True):
                if not isinstance(state.finder, ByMatrices):
                    return None
                own = state.own(theta)
                key, modal = state.finder.stored().foreseen(own, state.analysis)
                parts.append(state.compared(own, key, modal, before, REDUCED))
        except ModesError as failure:
            logger.debug("no prediction: %s", failure)
            return None
        found = self.evaluator.whole(theta, parts)
        return found if found.agrees(tolerances) else None

    def compare(self, evaluation: Evaluation, previous: Evaluation) -> None:
        """Record the error of the prediction of an evaluated point."""
        end = self._end_at(evaluation.theta)
        if end is not None:
            error = float(np.max(np.abs(end.errors - evaluation.errors)))
            self._miss = error, _length(evaluation.theta, previous)

    def refute(self, evaluation: Evaluation, apart: float) -> None:
        """Stop predicting, or replace the matrices.

        apart: relative difference from the solver's own frequencies at this point.
        """
        predicted = any(part.solved_by == REDUCED for part in evaluation.parts)
        if predicted and apart <= CONFIRMED:  # the predictions agree; e1 is narrowly missed
            logger.info("the reduced model's frequencies differ by %.1e from the solver's", apart)
            self._predicts = False
        else:
            self.evaluator.refute_matrices(apart)

    def _end_at(self, theta: Floats) -> Evaluation | None:
        """Return the end of the last step on reduced models, if it is this point."""
        end = self._end
        if end is None or not np.allclose(end.theta, theta, rtol=0.0, atol=1e-12):
            return None
        return end


def _length(theta: Floats, previous: Evaluation) -> float:
    """Return the distance between two points; never zero."""
    return max(float(np.max(np.abs(theta - previous.theta))), float(np.finfo(np.float64).eps))
