"""Many sets at once: by a reduced model that holds for all of them, where matrices are there.

The model grows until its worst set agrees with the full solution there (`core/updating/
reduced_range`); a set for which its estimate is still not good enough is solved in full. The
solver's own run at the worst set says whether all this is to be believed.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from modetune.adapters.solver import ModalAnalysis
from modetune.core.errors import ModelError, ModesError, ModetuneError
from modetune.core.modes import Floats
from modetune.core.updating.reduced_range import ReducedRange
from modetune.core.updating.results import ModalResult
from modetune.flows.jobs.work import Done, Work
from modetune.flows.updating.by_matrices import ByMatrices, reduced_columns
from modetune.flows.updating.evaluation import CaseEvaluation, Evaluation, Point
from modetune.flows.updating.evaluator import Evaluator
from modetune.flows.updating.finders import REDUCED, Columns, ModeFinder
from modetune.flows.updating.foresight import BELIEVED
from modetune.flows.updating.loop import CONFIRMED
from modetune.flows.updating.semi_analytic import UnlikeMatrices
from modetune.flows.updating.stored_modes import one_thread

logger = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class ByRange:
    """Modes by a reduced model for a range of values, and by the matrices where it may be off.

    key: of the range; around: an evaluated set, whose degrees of freedom the range has.
    """

    key: str
    range: ReducedRange
    around: CaseEvaluation
    matrices: ByMatrices
    name: str = REDUCED
    cheap: bool = True

    def works(self, theta: Floats, analysis: ModalAnalysis) -> list[Work]:
        return self.matrices.works(theta, analysis)

    def modes(
        self, theta: Floats, analysis: ModalAnalysis, done: Sequence[Done]
    ) -> tuple[str, ModalResult]:
        found = self._reduced(theta, analysis.n_modes)
        return found or self.matrices.modes(theta, analysis, done)

    def sensitivity_works(self, theta: Floats, analysis: ModalAnalysis) -> list[Work]:
        return []

    def columns(self, point: Point, analysis: ModalAnalysis, done: Sequence[Done]) -> Columns:
        return reduced_columns(self.range.model, point)

    def suits(self, part: CaseEvaluation, analysis: ModalAnalysis) -> bool:
        return True

    def instead(self, error: ModetuneError) -> ModeFinder:
        raise error

    def _reduced(self, theta: Floats, n_modes: int) -> tuple[str, ModalResult] | None:
        """By the range; None where it may be off by more than what confirms a set."""
        known = self.around.modal
        if n_modes > known.modes.n_modes:
            return None
        try:
            eigenvalues, shapes, off = self.range.modes(
                self.matrices.source.written(theta), n_modes
            )
        except ModesError as error:
            logger.debug("not by the range: %s", error)
            return None
        if off > CONFIRMED:
            return None
        modes = known.modes
        return self.key, ModalResult.of_shapes(
            eigenvalues, shapes, modes.nodes, modes.components, 0.5 * eigenvalues, known.n_rigid
        )


class ReducedRanges:
    """Evaluates many sets by reduced models that hold for all of them, one a case.

    said: how, and what confirmed it, for people; empty where no such model was made.
    """

    def __init__(self, evaluator: Evaluator) -> None:
        self.evaluator = evaluator
        self.said = ""
        self._within: Evaluator | None = None

    def points(
        self, title: str, thetas: Floats, known: Sequence[Evaluation], grows: bool
    ) -> list[Evaluation | ModetuneError] | None:
        """As `Evaluator.points`; None where a case has no such model, or it is not believed."""
        if self._within is not None:
            return _points(self._within, title, thetas, known, grows)
        ranges = self._ranges(thetas, known[0])
        if not ranges:
            return None
        states = [
            replace(state, finder=finder)
            for state, finder in zip(self.evaluator.used, ranges, strict=True)
        ]
        within = Evaluator(
            self.evaluator.campaign, states, self.evaluator.execution, self.evaluator.ledger
        )
        batch = Work(f"reduced model for {len(thetas)} sets", ())
        self.evaluator.execution.run(title, [batch])  # whoever watches hears of it
        found = _points(within, title, thetas, known, grows)
        solved = ranges[0].range.solved
        worst = int(np.argmin(np.linalg.norm(states[0].own(thetas.T).T - solved[-1], axis=1)))
        there = found[worst]
        apart = 0.0
        if isinstance(there, Evaluation):
            confirmed = self.evaluator.confirmed(0, there)
            assert confirmed is not None
            apart = float(np.max(np.abs(confirmed.errors - there.errors)))
            if apart > CONFIRMED:
                self.evaluator.refuted(there, apart)
                return None
        self._within = within
        self.said = (
            f"{len(thetas)} sets by a reduced model of {ranges[0].range.size} vectors, made of "
            f"{1 + len(solved)} full solutions; confirmed by {self.evaluator.campaign.solver_name} "
            f"at set {worst + 1}, where it is worst: frequencies within {apart:.1e}"
        )
        logger.info("%s", self.said)
        return found

    def _ranges(self, thetas: Floats, known: Evaluation) -> list[ByRange]:
        """A reduced model for all sets in each case; none where a case has none."""
        found: list[ByRange] = []
        tolerance = self.evaluator.campaign.tolerances.frequency
        for state, part in zip(self.evaluator.used, known.parts, strict=True):
            if not isinstance(state.finder, ByMatrices):
                return []
            own = np.array([state.own(theta) for theta in thetas])
            analysis = ModalAnalysis(state.case.n_modes, state.case.nodes)
            self.evaluator.carry_out("range", state.finder.works(part.theta, analysis), state)
            try:
                made = state.finder.over(
                    part.point, own, analysis, BELIEVED * min(tolerance, CONFIRMED)
                )
            except (UnlikeMatrices, ModelError) as error:
                state.finder = state.finder.instead(error)
                return []
            except ModesError as error:
                logger.info("no reduced model for all sets: %s", error)
                return []
            found.append(ByRange(*made, part, state.finder))
        return found


def _points(
    within: Evaluator, title: str, thetas: Floats, known: Sequence[Evaluation], grows: bool
) -> list[Evaluation | ModetuneError]:
    with one_thread():
        return within.points(title, thetas, known, grows)
