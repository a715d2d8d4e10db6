"""What reduced models foresee: steps to where updating ends on them, and sets not solved for.

A reduced model knows the modes around a set for all parameter values, so the updating loop itself
runs on it, in milliseconds, to its own end: with the campaign's step form, bounds and criteria,
within the region in which the step may end. What it finds is one step of the real campaign, which
the full model then confirms or does not. Of several cases each has a reduced model of its own.

A step that is short beside one whose end was foreseen well is not solved for by the matrices: where
the reduced models say that e1 holds there, the solver's own modes are looked at next.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from modetune.adapters.solver import MatrixAnalysis, ModalAnalysis
from modetune.core.algebra.matrices import MatrixResult
from modetune.core.correlation.pairing import LostMode, close_modes
from modetune.core.errors import ModelError, ModesError
from modetune.core.modes import Floats
from modetune.core.updating.estimation import Step
from modetune.core.updating.results import ModalResult
from modetune.flows.jobs.engine import JobOutcome
from modetune.flows.jobs.execution import Work
from modetune.flows.jobs.job import Job
from modetune.flows.jobs.watching import doing
from modetune.flows.jobs.work import meanwhile
from modetune.flows.updating.asked import CaseState
from modetune.flows.updating.by_matrices import ByMatrices, ByReduced
from modetune.flows.updating.evaluation import CaseEvaluation, Evaluation
from modetune.flows.updating.evaluator import Evaluator
from modetune.flows.updating.finders import REDUCED
from modetune.flows.updating.loop import CONFIRMED, Loop
from modetune.flows.updating.modes_choice import confirms_by_matrices
from modetune.flows.updating.semi_analytic import UnlikeMatrices
from modetune.flows.updating.trials import Watcher

logger = logging.getLogger(__name__)

#: Share of e1's frequency tolerance, and of what tells models apart, that a reduced model may be
#: off where it is believed.
BELIEVED = 0.1
#: Steps on the reduced models at most; they cost next to nothing.
ITERATIONS = 100


@dataclass(frozen=True, slots=True)
class Miss:
    """How far frequencies were from what was foreseen, relative, and after how long a step."""

    error: float
    length: float

    def after(self, length: float) -> float:
        """What to expect after another step: reduced models' errors grow at least as its square."""
        return self.error * (length / self.length) ** 2


class ReducedForesight:
    """What the reduced models of an evaluator's cases foresee, and whether it is believed."""

    def __init__(self, evaluator: Evaluator) -> None:
        self.evaluator = evaluator
        self.campaign = evaluator.campaign
        self._foreseen: Evaluation | None = None
        self._miss: Miss | None = None
        self._foresees = True
        #: The cases on the newest reduced models; none before the first step.
        self.states: list[CaseState] = []

    def refined(
        self, current: Evaluation, step: Step, region: tuple[Floats, Floats]
    ) -> Step | None:
        """The step to where updating ends on reduced models around the current set.

        step: the linear one, whose regularisation and condition it keeps; region: lower and upper
        values. None where there is not a reduced model in every case, or it cannot be updated.
        """
        states = []
        for state, part in zip(self.evaluator.used, current.parts, strict=True):
            if not isinstance(state.finder, ByMatrices):
                return None
            try:
                reduced = ByReduced(state.finder.stored().reduced(part.point, state.analysis), part)
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
            end = Loop(inner, evaluator, Unnoted(), region, current).run()
        except ModesError as error:
            logger.debug("no reduced step: %s", error)
            return None
        self._foreseen = end.last
        change = end.last.theta - current.theta
        return replace(step, change=change, predicted=end.last.residual.values)

    def believed(self, theta: Floats, previous: Evaluation | None) -> Evaluation | None:
        """What the reduced models foresee at a set, if e1 holds there and they can be believed."""
        foreseen = self._foreseen_at(theta)
        if foreseen is None or previous is None or self._miss is None or not self._foresees:
            return None
        tolerances, length = self.campaign.tolerances, _length(theta, previous)
        doubt = self._miss.after(length)
        least = BELIEVED * min(tolerances.frequency, CONFIRMED)
        if doubt > least or not foreseen.agrees(tolerances):
            return None
        parts = []
        try:
            for state, before in zip(self.evaluator.used, previous.parts, strict=True):
                if not isinstance(state.finder, ByMatrices):
                    return None
                own = state.own(theta)
                key, modal = state.finder.stored().foreseen(own, state.analysis)
                parts.append(state.compared(own, key, modal, before, REDUCED))
        except ModesError as error:
            logger.debug("nothing is foreseen: %s", error)
            return None
        found = self.evaluator.whole(theta, parts)
        return found if found.agrees(tolerances) else None

    def look_back(self, evaluation: Evaluation, previous: Evaluation | None) -> None:
        """Keep how far the reduced models' frequencies were from those found now."""
        foreseen = self._foreseen_at(evaluation.theta)
        if foreseen is not None and previous is not None:
            error = float(np.max(np.abs(foreseen.errors - evaluation.errors)))
            self._miss = Miss(error, _length(evaluation.theta, previous))

    def confirmed(self, title: str, evaluation: Evaluation) -> Evaluation | None:
        """A set evaluated by the solvers' own modes; None where it was so already."""
        pairs = list(zip(self.evaluator.used, evaluation.parts, strict=True))
        if all(part.solved_by == state.case.solver.program.name for state, part in pairs):
            return None
        for state, _ in pairs:
            finder = state.finder
            if isinstance(finder, ByMatrices) and not confirms_by_matrices(
                state.campaign, finder.solver
            ):
                finder.release()  # the factors' memory is the solver's now
        parts = [
            part
            if part.solved_by == state.case.solver.program.name
            else self._confirmed(title, state, part)
            for state, part in pairs
        ]
        return self.evaluator.whole(evaluation.theta, parts)

    def refuted(self, evaluation: Evaluation, apart: float) -> None:
        """The solver's own frequencies at this set differ by apart, relative."""
        foreseen = any(part.solved_by == REDUCED for part in evaluation.parts)
        if foreseen and apart <= CONFIRMED:  # e1 is just not met
            logger.info("the reduced model's frequencies differ by %.1e from the solver's", apart)
            self._foresees = False
            return
        error = UnlikeMatrices(f"the solver's own frequencies differ by {apart:.1e}")
        for state in self.evaluator.used:
            if isinstance(state.finder, ByMatrices):
                state.finder = state.finder.instead(error)

    def _confirmed(self, title: str, state: CaseState, part: CaseEvaluation) -> CaseEvaluation:
        wanted = [part.pairing.computed]
        if part.held_out is not None:
            wanted.append(part.held_out.computed)
        # Each mode and all energies cost the solver time: only what is compared is asked for, with
        # the modes next to it, in whose space it is judged.
        compared = int(np.max(np.concatenate(wanted)))
        last = part.modal.n_rigid + int(close_modes(part.seen.frequencies_hz, compared).max()) + 1
        every = replace(state.analysis, groups=())
        try:
            return self._by_solver(title, state, part, replace(every, n_modes=last))
        except LostMode:
            return self._by_solver(title, state, part, every)

    def _by_solver(
        self, title: str, state: CaseState, part: CaseEvaluation, analysis: ModalAnalysis
    ) -> CaseEvaluation:
        finder = state.finder
        if isinstance(finder, ByMatrices) and confirms_by_matrices(state.campaign, finder.solver):
            found = self._by_assembled(title, state, finder, part, analysis)
            if found is not None:
                return found
            finder.release()
        job = Job(state.campaign.parameters.values(part.theta), analysis)
        name = state.case.solver.program.name
        work = Work(f"modal confirmation by {name}", (job,), state.engine)
        outcome = self._begun(title, work, state)()
        modal = outcome.result(ModalResult)
        return state.compared(part.theta, outcome.key, modal, part, name)

    def _by_assembled(
        self,
        title: str,
        state: CaseState,
        finder: ByMatrices,
        part: CaseEvaluation,
        analysis: ModalAnalysis,
    ) -> CaseEvaluation | None:
        """By the matrices that the solver assembles at the set; None where they do not agree."""
        name = state.case.solver.program.name
        job = Job(state.campaign.parameters.values(part.theta), MatrixAnalysis())

        def begun() -> Callable[[], MatrixResult]:
            wait = self._begun(title, Work(f"matrices by {name}", (job,), state.engine), state)
            return lambda: wait().result(MatrixResult)

        try:
            own = state.engine.key(job)
            with doing(title):
                key, modal, counted = finder.stored().assembled(part.theta, analysis, own, begun)
        except (ModelError, UnlikeMatrices) as error:
            logger.warning("%s: its own modes are looked at", error)
            return None
        said = "counted" if counted else "not counted"
        said = f"{name}'s matrices, {modal.eigenvalues.size} modes {said}"
        found = state.compared(part.theta, key, modal, part, said)
        apart = float(np.max(np.abs(found.errors - part.errors)))
        if apart > CONFIRMED:
            logger.warning(
                "frequencies by %s's matrices differ by %.1e: its own modes are looked at",
                name,
                apart,
            )
            return None
        return found

    def _begun(self, title: str, work: Work, state: CaseState) -> Callable[[], JobOutcome]:
        """What waits for the end of a job that begins, and does what there is to do meanwhile."""
        job = meanwhile("confirm", lambda: self.evaluator.carry_out(title, [work], state))

        def wait() -> JobOutcome:
            if not job.done():
                self.evaluator.idle()
            ((outcome,),) = job.result()
            return outcome

        return wait

    def _foreseen_at(self, theta: Floats) -> Evaluation | None:
        """The end of the last step on reduced models, if it is this set."""
        foreseen = self._foreseen
        if foreseen is None or not np.allclose(foreseen.theta, theta, rtol=0.0, atol=1e-12):
            return None
        return foreseen


def _length(theta: Floats, previous: Evaluation) -> float:
    """How far a set is from another one; never zero."""
    return max(float(np.max(np.abs(theta - previous.theta))), float(np.finfo(np.float64).eps))


class Unnoted(Watcher):
    """A loop that nobody watches."""
