"""Evaluating parameter sets by the solver's stored matrices.

    matrix jobs, once      K(p), M(p) for all values             `source.py`
    each set               modes of K(theta), M(theta)           `modes.py`: one factorisation
    beside them            a reduced model around the set        `core/reduced.py`
    each step              the whole problem on reduced models   `reduced_step.py`: milliseconds
    at the end             the solver's own modes                one modal job

A step that is short beside one whose end was foreseen well is not solved for by the matrices: where
the reduced model says that e1 holds there, the solver's own modes are looked at next.

Nothing is skipped: sensitivities follow from the reduced model, which the step needs anyhow. Where
the matrices turn out not to be the model's (parts that they do not hold, sensors whose motion does
not follow from them) the solver's own modes take over, which is told.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace

import numpy as np

from modetune.adapters.solver import ModalAnalysis
from modetune.core.errors import ModelError, ModesError
from modetune.core.estimation import Step
from modetune.core.held_out import HeldOut
from modetune.core.modes import Floats
from modetune.core.pairing import LostMode
from modetune.core.record import RunCounts
from modetune.core.results import ModalResult
from modetune.flows.by_matrices.modes import MatrixModes
from modetune.flows.by_matrices.reduced_step import REDUCED, reduced_matrix, refined_step
from modetune.flows.by_matrices.source import MatrixSource
from modetune.flows.campaign import Campaign, cores
from modetune.flows.evaluating import Evaluating, Matrix
from modetune.flows.evaluation import Evaluation, compare, judged
from modetune.flows.evaluator import (
    WIDENINGS,
    Evaluator,
    campaign_analysis,
    outcomes_count,
    unless_failed,
    wider,
)
from modetune.flows.execution.engine import Job, JobEngine
from modetune.flows.execution.work import Execution, Work
from modetune.flows.loop import CONFIRMED
from modetune.flows.semi_analytic import UnlikeMatrices

logger = logging.getLogger(__name__)

#: Who finds modes here, in records.
MATRICES = "stored matrices"
#: Share of e1's frequency tolerance, and of what tells models apart, that a reduced model may be
#: off where it is believed.
BELIEVED = 0.1


@dataclass(frozen=True, slots=True)
class Miss:
    """How far frequencies were from what was foreseen, relative, and after how long a step."""

    error: float
    length: float

    def after(self, length: float) -> float:
        """What to expect after another step: reduced models' errors grow at least as its square."""
        return self.error * (length / self.length) ** 2


class MatrixEvaluator(Evaluating):
    """Evaluates sets by matrices, and by the solver's own modes once those cannot be believed."""

    def __init__(
        self, campaign: Campaign, engine: JobEngine, execution: Execution, source: MatrixSource
    ) -> None:
        self.campaign = campaign
        self.engine = engine
        self.execution = execution
        self.source = source
        self.native = Evaluator(campaign, engine, execution)
        self.analysis = campaign_analysis(campaign)
        self.trusted = True
        self._foreseen: Evaluation | None = None
        self._miss: Miss | None = None
        self._foresees = True
        self._modes: MatrixModes | None = None
        self._runs = RunCounts()

    @property
    def cheap(self) -> bool:
        return self.trusted or self.native.cheap

    @property
    def steps_run(self) -> bool:
        return not self.trusted

    @property
    def runs(self) -> RunCounts:
        return self.native.runs.plus(self._runs)

    def evaluate(
        self, number: int, theta: Floats, previous: Evaluation | None, alone: bool
    ) -> tuple[Evaluation, Matrix | None]:
        if self.trusted:
            try:
                foreseen = self._believed(theta, previous)
                if foreseen is not None:
                    return foreseen, None
                evaluation = self._evaluate(number, theta, previous)
                self._look_back(evaluation, previous)
                return evaluation, None if alone else self.matrix(number, evaluation)
            except (UnlikeMatrices, ModelError) as error:
                self._mistrust(str(error))
        return self.native.evaluate(number, theta, previous, alone)

    def matrix(self, number: int, evaluation: Evaluation) -> Matrix:
        if self.trusted:
            try:
                reduced = self._stored(number).reduced(evaluation, self.analysis)
                return reduced_matrix(self.campaign, reduced, evaluation)
            except ModelError as error:
                self._mistrust(str(error))
        # The solver's own methods want its own result, with all energies that they use.
        if len(evaluation.modal.groups) < len(self.native.analysis.groups):
            evaluation, _ = self.native.evaluate(number, evaluation.theta, evaluation, alone=True)
        return self.native.matrix(number, evaluation)

    def skip(self, number: int, slope: float) -> None:
        self.native.skip(number, slope)

    def planned(self, theta: Floats) -> list[Work]:
        if not self.trusted:
            return self.native.planned(theta)
        job = Job(self.campaign.parameters.values(theta), self.analysis)
        return [*self._matrix_works(), Work("modal", (job,))]

    def first_job(self, theta: Floats) -> Job | None:
        return next(iter(self.source.jobs()), None)

    def held_out(self, initial: Evaluation, updated: Evaluation) -> HeldOut | None:
        return judged(self.campaign, initial, updated)

    def refined(
        self, current: Evaluation, step: Step, region: tuple[Floats, Floats]
    ) -> Step | None:
        if not self.trusted:
            return None
        try:
            reduced = self._stored(0).reduced(current, self.analysis)
        except ModelError as error:
            self._mistrust(str(error))
            return None
        found = refined_step(self.campaign, reduced, current, step, region)
        if found is None:
            return None
        refined, self._foreseen = found
        return refined

    def confirmed(self, number: int, evaluation: Evaluation) -> Evaluation | None:
        if not self.trusted or evaluation.solved_by not in (MATRICES, REDUCED):
            return None
        self._modes = None  # the factors' memory is the solver's now
        # It goes alone, on all the cores that jobs side by side would have.
        shared = self.campaign.parallel * self.campaign.threads
        engine = self.engine.with_threads(min(shared, cores()))
        wanted = [evaluation.pairing.computed]
        if evaluation.held_out is not None:
            wanted.append(evaluation.held_out.computed)
        # Each mode and all energies cost the solver time: only what is compared is asked for.
        last = evaluation.modal.n_rigid + int(np.max(np.concatenate(wanted))) + 1
        every = replace(self.analysis, groups=())
        try:
            return self._confirmed(number, evaluation, engine, replace(every, n_modes=last))
        except LostMode:
            return self._confirmed(number, evaluation, engine, every)

    def _confirmed(
        self, number: int, evaluation: Evaluation, engine: JobEngine, analysis: ModalAnalysis
    ) -> Evaluation:
        job = Job(self.campaign.parameters.values(evaluation.theta), analysis)
        work = Work(f"modal by {self.campaign.solver.name}", (job,), engine)
        outcomes = unless_failed(self.execution.run(f"iteration {number}", [work])[0])
        self._runs = self._runs.plus(outcomes_count("modal", outcomes))
        modal = engine.result(job)
        assert isinstance(modal, ModalResult)
        return compare(self.campaign, evaluation.theta, outcomes[0].key, modal, evaluation)

    def refuted(self, evaluation: Evaluation, apart: float) -> None:
        if evaluation.solved_by == REDUCED and apart <= CONFIRMED:  # e1 is just not met
            logger.info("the reduced model's frequencies differ by %.1e from the solver's", apart)
            self._foresees = False
        else:
            self._mistrust(f"the solver's own frequencies differ by {apart:.1e}")

    def _believed(self, theta: Floats, previous: Evaluation | None) -> Evaluation | None:
        """What a reduced model foresees at a set, if e1 holds there and it can be believed."""
        foreseen = self._foreseen_at(theta)
        if foreseen is None or previous is None or self._miss is None or not self._foresees:
            return None
        tolerances, length = self.campaign.tolerances, _length(theta, previous)
        doubt = self._miss.after(length)
        least = BELIEVED * min(tolerances.frequency, CONFIRMED)
        if doubt > least or not foreseen.agrees(tolerances):
            return None
        try:
            key, modal = self._stored(0).foreseen(theta, self.analysis)
            found = compare(self.campaign, theta, key, modal, previous, REDUCED)
        except ModesError as error:
            logger.debug("nothing is foreseen: %s", error)
            return None
        return found if found.agrees(tolerances) else None

    def _look_back(self, evaluation: Evaluation, previous: Evaluation | None) -> None:
        """Keep how far a reduced model's frequencies were from those found now."""
        foreseen = self._foreseen_at(evaluation.theta)
        if foreseen is not None and previous is not None:
            error = float(np.max(np.abs(foreseen.errors - evaluation.errors)))
            self._miss = Miss(error, _length(evaluation.theta, previous))

    def _foreseen_at(self, theta: Floats) -> Evaluation | None:
        """The end of the last step on a reduced model, if it is this set."""
        foreseen = self._foreseen
        if foreseen is None or not np.allclose(foreseen.theta, theta, rtol=0.0, atol=1e-12):
            return None
        return foreseen

    def _mistrust(self, reason: str) -> None:
        logger.warning("%s: modes are the solver's own from now on", reason)
        self.trusted = False
        self._modes = None
        self.native.analysis = self.analysis

    def _evaluate(self, number: int, theta: Floats, previous: Evaluation | None) -> Evaluation:
        modes = self._stored(number)
        for widening in range(WIDENINGS + 1):
            key, modal = modes.modal(theta, self.analysis)
            try:
                return compare(self.campaign, theta, key, modal, previous, MATRICES)
            except LostMode as error:
                if widening == WIDENINGS:
                    raise
                self.analysis = wider(self.analysis)
                logger.warning("%s; widening the range to %d modes", error, self.analysis.n_modes)
        raise AssertionError

    def _stored(self, number: int) -> MatrixModes:
        """Modes by the matrices of all values, which are had by now."""
        if self._modes is None:
            works = self._matrix_works()
            done = self.execution.run(f"iteration {number}", works) if works else []
            for work, item in zip(works, done, strict=True):
                outcomes = unless_failed(item)
                self._runs = self._runs.plus(outcomes_count(work.name, outcomes))
            self._modes = MatrixModes(self.campaign, self.engine, self.source)
        return self._modes

    def _matrix_works(self) -> list[Work]:
        jobs = self.source.jobs()
        return [
            Work(f"matrices {place} of {len(jobs)}", (job,)) for place, job in enumerate(jobs, 1)
        ]


def _length(theta: Floats, previous: Evaluation) -> float:
    """How far a set is from another one; never zero."""
    return max(float(np.max(np.abs(theta - previous.theta))), float(np.finfo(np.float64).eps))
