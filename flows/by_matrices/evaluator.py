"""Evaluating parameter sets by the solver's stored matrices.

    matrix jobs, once      K(p), M(p) for all values             `source.py`
    each set               modes of K(theta), M(theta)           `modes.py`: one factorisation
    beside them            a reduced model around the set        `core/reduced.py`
    each step              the whole problem on reduced models   `reduced_step.py`: milliseconds
    at the end             the solver's own modes                one modal job

Nothing is skipped: sensitivities follow from the reduced model, which the step needs anyhow. Where
the matrices turn out not to be the model's (parts that they do not hold, sensors whose motion does
not follow from them) the solver's own modes take over, which is told.
"""

from __future__ import annotations

import logging

from modetune.core.errors import ModelError
from modetune.core.estimation import Step
from modetune.core.held_out import HeldOut
from modetune.core.modes import Floats
from modetune.core.pairing import LostMode
from modetune.core.record import RunCounts
from modetune.core.results import ModalResult
from modetune.flows.by_matrices.modes import MatrixModes
from modetune.flows.by_matrices.reduced_step import reduced_matrix, refined_step
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
from modetune.flows.semi_analytic import UnlikeMatrices

logger = logging.getLogger(__name__)

#: Who finds modes here, in records.
MATRICES = "stored matrices"


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
                evaluation = self._evaluate(number, theta, previous)
                return evaluation, None if alone else self.matrix(number, evaluation)
            except (UnlikeMatrices, ModelError) as error:
                self.mistrust(str(error))
        return self.native.evaluate(number, theta, previous, alone)

    def matrix(self, number: int, evaluation: Evaluation) -> Matrix:
        if self.trusted:
            try:
                reduced = self._stored(number).reduced(evaluation, self.analysis)
                return reduced_matrix(self.campaign, reduced, evaluation)
            except ModelError as error:
                self.mistrust(str(error))
        if evaluation.solved_by == MATRICES:  # the solver's own methods want its own result
            evaluation, _ = self.native.evaluate(number, evaluation.theta, evaluation, alone=True)
        return self.native.matrix(number, evaluation)

    def skip(self, number: int, slope: float) -> None:
        self.native.skip(number, slope)

    def planned(self, theta: Floats) -> list[Work]:
        if not self.trusted:
            return self.native.planned(theta)
        job = Job(self.campaign.parameters.values(theta), self.analysis)
        return [*self._matrix_works(), Work("modal", (job,))]

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
            self.mistrust(str(error))
            return None
        return refined_step(self.campaign, reduced, current, step, region)

    def confirmed(self, number: int, evaluation: Evaluation) -> Evaluation | None:
        if not self.trusted:
            return None
        # It goes alone, on all the cores that jobs side by side would have.
        shared = self.campaign.parallel * self.campaign.threads
        engine = self.engine.with_threads(min(shared, cores()))
        job = Job(self.campaign.parameters.values(evaluation.theta), self.analysis)
        work = Work(f"modal by {self.campaign.solver.name}", (job,), engine)
        outcomes = unless_failed(self.execution.run(f"iteration {number}", [work])[0])
        self._runs = self._runs.plus(outcomes_count("modal", outcomes))
        modal = engine.result(job)
        assert isinstance(modal, ModalResult)
        return compare(self.campaign, evaluation.theta, outcomes[0].key, modal, evaluation)

    def mistrust(self, reason: str) -> None:
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
