"""Modes from stored matrices and reduced models: the finders that run no solver at a set.

    matrix jobs, once      K(p), M(p) for all values             `matrix_source.py`
    each set               modes of K(theta), M(theta)           `stored_modes.py`: a factorisation
    beside them            a reduced model around the set        `core/updating/reduced`
    each step              the whole problem on reduced models   `foresight.py`: milliseconds
    at the end             the solver's own modes or matrices    one job a case

Nothing is skipped: sensitivities follow from the reduced model, which the step needs anyhow.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from modetune.adapters.solver import ModalAnalysis
from modetune.core.errors import ModetuneError, NoResult
from modetune.core.modes import Floats, Integers
from modetune.core.updating.reduced import ReducedModel
from modetune.core.updating.responses.response import MatricesAt
from modetune.core.updating.results import ModalResult
from modetune.flows.campaign.campaign import Campaign
from modetune.flows.jobs.engine import JobEngine
from modetune.flows.jobs.execution import Done, Work
from modetune.flows.updating.evaluation import CaseEvaluation, Point
from modetune.flows.updating.finders import (
    REDUCED,
    BySolver,
    Columns,
    ModeFinder,
    assembled,
    unless_failed,
)
from modetune.flows.updating.matrix_source import MatrixSource
from modetune.flows.updating.semi_analytic import UnlikeMatrices
from modetune.flows.updating.stored_modes import MatrixModes

logger = logging.getLogger(__name__)

#: Who finds modes, in records.
MATRICES = "stored matrices"


@dataclass(slots=True)
class ByMatrices(ModeFinder):
    """Modes by the stored matrices of all values, derivatives by a reduced model around a set.

    solver: what takes over where the matrices turn out not to be the model's (parts that they do
    not hold, sensors whose motion does not follow from them).
    """

    campaign: Campaign
    engine: JobEngine
    source: MatrixSource
    solver: BySolver
    cheap: bool = True
    _modes: MatrixModes | None = field(default=None, init=False)

    @property
    def name(self) -> str:
        held = "" if self._modes is None else self._modes.held
        return f"{MATRICES}, factors{held}" if held else MATRICES

    def works(self, theta: Floats, analysis: ModalAnalysis) -> list[Work]:
        if self._modes is not None:
            return []
        return self.source.works(self.campaign.start, range(len(self.campaign.parameters)))

    def modes(
        self, theta: Floats, analysis: ModalAnalysis, done: Sequence[Done]
    ) -> tuple[str, ModalResult]:
        return self.stored(done).modal(theta, analysis)

    def assembled(self, theta: Floats) -> MatricesAt:
        return assembled(self.source, theta)

    def sensitivity_works(self, theta: Floats, analysis: ModalAnalysis) -> list[Work]:
        return self.works(theta, analysis)

    def columns(self, point: Point, analysis: ModalAnalysis, done: Sequence[Done]) -> Columns:
        stored = self.stored(done)
        reduced = stored.reduced(point, analysis)
        exact = stored.derivatives(point, analysis)
        if exact is None:
            return reduced_columns(reduced, point)
        return Columns(exact, ("semi_analytic",) * point.theta.size, (point.key,))

    def instead(self, error: ModetuneError) -> BySolver:
        logger.warning("%s: modes are the solver's own from now on", error)
        self.release()
        return self.solver

    def release(self) -> None:
        """Leave the factors' memory to others."""
        if self._modes is not None:
            self._modes.release()
        self._modes = None

    def stored(self, done: Sequence[Done] = ()) -> MatrixModes:
        """Modes and reduced models by the matrices of all values, once their jobs are done.

        Raises UnlikeMatrices, ModelError; so does what it is asked for.
        """
        for item in done:
            if isinstance(item, NoResult):
                raise UnlikeMatrices(str(item)) from item
            unless_failed(item)
        found = self._modes or MatrixModes(self.campaign, self.engine, self.source)
        self._modes = found  # who confirms may release it meanwhile
        return found


@dataclass(frozen=True, slots=True)
class ByReduced(ModeFinder):
    """Modes by a reduced model around a set that was evaluated in full."""

    reduced: ReducedModel
    around: CaseEvaluation
    name: str = REDUCED
    cheap: bool = True

    def modes(
        self, theta: Floats, analysis: ModalAnalysis, done: Sequence[Done]
    ) -> tuple[str, ModalResult]:
        known, n_rigid = self.around.modal.modes, self.around.modal.n_rigid
        modal = reduced_modal(
            self.reduced, theta, known.n_modes, n_rigid, known.nodes, known.components
        )
        return self.around.key, modal

    def assembled(self, theta: Floats) -> MatricesAt:
        assert self.around.matrices is not None
        return replace(self.around.matrices, theta=theta, around=self.around.theta)

    def columns(self, point: Point, analysis: ModalAnalysis, done: Sequence[Done]) -> Columns:
        return reduced_columns(self.reduced, point)


def reduced_modal(
    reduced: ReducedModel,
    theta: Floats,
    n_modes: int,
    n_rigid: int,
    nodes: Integers,
    components: Integers,
) -> ModalResult:
    """The lowest modes of a reduced model at its rows, whose degrees of freedom these are.

    n_rigid: how many of them are rigid, as in the model that was reduced. Raises ModesError where
    it has no such modes.
    """
    eigenvalues, shapes = reduced.modes(theta, n_modes)
    return ModalResult.of_shapes(eigenvalues, shapes, nodes, components, 0.5 * eigenvalues, n_rigid)


def reduced_columns(reduced: ReducedModel, point: Point) -> Columns:
    """The derivatives at a point, exact within a reduced model around it."""
    modal = point.modal
    paired = point.pairing.computed + modal.n_rigid
    shapes = np.real(modal.modes.mode_shapes[:, paired])
    found = reduced.derivatives(point.theta, paired, shapes)
    return Columns(found, (REDUCED,) * point.theta.size, (point.key,))
