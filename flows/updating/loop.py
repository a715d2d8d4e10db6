"""The updating loop: evaluate, compare with the test, step, until e1 holds or nothing is gained.

Each iteration tries a set (`trials.py`): its modal job and, unless e2 skips them, its sensitivity
jobs go to the execution side by side. A better one is accepted, and e2 decides whether it does with
the matrix that is there. Where sets cost little the loop goes on from where e1 holds to the least
misfit (`polishing.py`). Where modes were found otherwise the solver's own confirm the end.

The loop is deterministic and all results are in the store by content, so a campaign that was
killed is resumed by starting it again: what was finished is answered by the store.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from modetune.core.modes import Floats
from modetune.flows.campaign.campaign import Campaign
from modetune.flows.updating.evaluation import Evaluation, Matrix
from modetune.flows.updating.evaluator import Evaluator
from modetune.flows.updating.polishing import polished
from modetune.flows.updating.trials import State, Trial, Trials, Watcher

#: Relative decrease of the objective below which nothing more is gained.
STATIONARY = 1e-4
#: An old matrix whose step gains less than this share of what it promised is computed anew.
KEPT_PROMISE = 0.25
#: Frequencies by stored matrices and by the solver itself that differ more are not one model's.
CONFIRMED = 1e-4


@dataclass(frozen=True, slots=True)
class End:
    """How a loop ended: converged, stationary or max_iterations, why, and at which set."""

    status: str
    reason: str
    last: Evaluation
    matrix: Matrix | None


@dataclass
class Loop:
    """Updating from a start to its end; `run` carries it there.

    region: lower and upper values that it keeps to within the parameters' bounds, each
    (n_parameters,), where it may not go everywhere. around: an evaluation point that the
    modes of the start are tracked from. first, title: number and name of the first set. confirms:
    whether the end is looked at by the solver's own modes where it was found otherwise.
    """

    campaign: Campaign
    evaluator: Evaluator
    watcher: Watcher
    region: tuple[Floats, Floats] | None = None
    around: Evaluation | None = None
    first: int = 0
    title: str = "initial model"
    confirms: bool = True

    def __post_init__(self) -> None:
        self.trials = Trials(self.campaign, self.evaluator, self.watcher, self.region, self.first)

    def run(self) -> End:
        """Update until e1 holds, nothing more is gained, or the iterations are used up.

        Where modes came from the solver's matrices its own modes at the end are looked at; if these
        do not agree with them, updating goes on with less belief in what was found otherwise.
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
                    self.evaluator.refuted(last, apart)
                    continue
            reason = self._reason(status, state.current)
            return End(status, reason, state.current, self.trials.newest)

    def _until(self, state: State) -> tuple[str, State]:
        """How the iterations from a state end, and where."""
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
        """The least misfit beside a state that meets e1, without leaving e1."""
        gained = True
        while gained and (trial := polished(self.trials, state)) is not None:
            state, gained = self._accept(state, trial)
        return state

    def _reason(self, status: str, last: Evaluation) -> str:
        if status == "converged":
            return f"e1 is met: {_distance(last)}"
        if status == "max_iterations":
            taken = self.campaign.update.max_iterations
            said = f"all {taken} iterations are used up and e1 is not met: {_distance(last)}"
            return "; ".join(filter(None, (said, self.trials.stepping.held_back)))
        return (
            "the residual cannot be brought down further within the bounds, and e1 is not met: "
            + _distance(last)
        )

    def _accept(self, state: State, trial: Trial) -> tuple[State, bool]:
        """The state after a better set, and whether more than nothing was gained by it.

        e2 spares this set its sensitivity where Broyden's formula can stand in, and the next set
        where the old matrix is kept as it is (thesis, 4.2), as long as steps keep their promise.
        """
        trials, by, there = self.trials, trial.by, trial.evaluation
        current, step, matrix, stepping = state.current, by.step, by.matrix, trials.stepping
        before = stepping.objective(current, current.residual.values, step)
        gain = stepping.gain(current, there, step)
        promised = before - stepping.objective(current, step.predicted, step, 1.0)
        kept = gain >= max(KEPT_PROMISE * promised, STATIONARY * before)
        small = 0.0 < trial.slope <= self.campaign.update.e2 and not matrix.missing
        # Then no sensitivity would follow, and there is none to spare.
        ends = trials.used_up() or there.agrees(self.campaign.tolerances)
        spared, skip = None, None
        if trials.between.waits:
            left = (before - gain) / before
            pays = kept and trials.between.pays(matrix, step, there, left)
            spared = trial.slope if small and pays else None
        elif self.campaign.sensitivity.between == "broyden":
            pass  # its matrix could only take the place of one that takes no time
        elif not self.evaluator.cheap and (kept or matrix.age == 0):
            spared, skip = state.skip, trial.slope if small else None
        following = trial.matrix
        if spared is not None:
            following = trials.between.older(matrix, by.begun, there)
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
