"""The surrogate of a case: modes, derivatives and errors of frequencies without a solver run.

    matrix jobs, once      K(p), M(p) for all values             `matrices.py`
    each point             modes of K(theta), M(theta)           `solutions.py`: a factorisation
    with them              a reduced model around the point      `core/updating/reduced_basis`
    each step              the whole problem on reduced models   `loop.py`: milliseconds
    many points            a reduced model within the bounds     `core/updating/reduced_basis`
    at the end             the solver's own modes or matrices    one job a case

`ByMatrices` solves the whole matrices at each point; `ReducedModes` takes a reduced model, one
around a point or one within the bounds. Sensitivities follow from the reduced model around a point,
which the step needs too, so there are none for e2 to skip.

A reduced model within the bounds grows until its worst point agrees with the full solution there. A
point whose estimated error is too large is solved in full.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from modetune.adapters.solver import MatrixAnalysis, ModalAnalysis
from modetune.core.algebra.matrices import MatrixResult
from modetune.core.errors import ModelError, ModesError, ModetuneError, NoResult
from modetune.core.modes import Floats
from modetune.core.updating.job_results import ModalResult
from modetune.core.updating.reduced_basis import ReducedModel, ReducedRange
from modetune.core.updating.responses.response import MatricesAt
from modetune.flows.campaign.campaign import Campaign
from modetune.flows.jobs.engine import JobEngine, JobOutcome
from modetune.flows.jobs.execution import Done, Work
from modetune.flows.jobs.job import Job
from modetune.flows.jobs.progress import doing
from modetune.flows.updating.evaluation import CaseEvaluation, Point
from modetune.flows.updating.matrices import LARGE, MatrixSource, return_freed_memory
from modetune.flows.updating.mode_source import (
    REDUCED,
    BySolver,
    CaseState,
    Columns,
    Demand,
    ModeFinder,
    assembled,
    by_solver,
    modes_source,
    unless_failed,
)
from modetune.flows.updating.sensitivities import UnlikeMatrices
from modetune.flows.updating.solutions import MatrixModes

logger = logging.getLogger(__name__)

#: The source of modes from stored matrices, in records.
MATRICES = "stored matrices"
#: Frequencies from stored matrices and from the solver that differ more, relative, are those of
#: different models.
CONFIRMED = 1e-4
#: A reduced model is accepted up to this share of e1's frequency tolerance, and of CONFIRMED.
ACCURATE = 0.1


@dataclass(slots=True)
class ByMatrices(ModeFinder):
    """Modes from the stored matrices of all values, derivatives from a local reduced model.

    solver: the replacement if the matrices turn out not to be the model's (parts that they lack,
    sensors whose motion does not follow from them).
    """

    campaign: Campaign
    engine: JobEngine
    source: MatrixSource
    solver: BySolver
    cheap: bool = True
    _modes: MatrixModes | None = field(default=None, init=False)

    @property
    def name(self) -> str:
        factors = "" if self._modes is None else self._modes.factors
        return f"{MATRICES}, {factors}" if factors else MATRICES

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
        """Free the memory of the factors."""
        if self._modes is not None:
            self._modes.release()
        self._modes = None

    def stored(self, done: Sequence[Done] = ()) -> MatrixModes:
        """Return the solutions of the matrices of all values, once their jobs are done.

        Raises UnlikeMatrices, ModelError, as do the methods of the result.
        """
        for item in done:
            if isinstance(item, NoResult):
                raise UnlikeMatrices(str(item)) from item
            unless_failed(item)
        found = self._modes or MatrixModes(self.campaign, self.engine, self.source)
        self._modes = found  # a confirmation in another thread may release it
        return found

    def confirmed(
        self,
        title: str,
        state: CaseState,
        part: CaseEvaluation,
        analysis: ModalAnalysis,
        begin: Callable[[str, Work, CaseState], Callable[[], JobOutcome]],
    ) -> CaseEvaluation | None:
        """Evaluate a case by the matrices that the solver assembles at its parameters.

        begin: begins a job and returns a function that waits for its end. Returns None if these
        matrices differ from the stored ones.
        """
        name = state.case.solver.program.name
        job = Job(state.campaign.parameters.values(part.theta), MatrixAnalysis())

        def begun() -> Callable[[], MatrixResult]:
            wait = begin(title, Work(f"matrices by {name}", (job,), state.engine), state)
            return lambda: wait().result(MatrixResult)

        try:
            own = state.engine.key(job)
            with doing(title):
                key, modal, counted = self.stored().assembled(part.theta, analysis, own, begun)
        except (ModelError, UnlikeMatrices) as error:
            logger.warning("%s: using its own modes instead", error)
            return None
        text = "counted" if counted else "not counted"
        text = f"{name}'s matrices, {modal.eigenvalues.size} modes {text}"
        found = state.compared(part.theta, key, modal, part, text)
        apart = float(np.max(np.abs(found.errors - part.errors)))
        if apart <= CONFIRMED:
            return found
        logger.warning(
            "frequencies by %s's matrices differ by %.1e: using its own modes instead", name, apart
        )
        return None

    def around(self, part: CaseEvaluation, analysis: ModalAnalysis) -> ReducedModes:
        """Return modes by the reduced model around an evaluated case."""
        return ReducedModes(self.stored().reduced(part.point, analysis), part, part.key)

    def within(
        self,
        part: CaseEvaluation,
        thetas: Floats,
        analysis: ModalAnalysis,
        accuracy: float,
        tell: Callable[[int, float], None],
    ) -> ReducedModes:
        """Return modes by a reduced model for all these points (n_points, n_parameters).

        part: the evaluated case that the model begins with; accuracy: the largest relative error of
        frequencies; tell: is called with the number of full solutions and the current error.
        """
        key, model = self.stored().over(part.point, thetas, analysis, accuracy, tell)
        return ReducedModes(model, part, key, self)


@dataclass(slots=True)
class Tally:
    """The number of points, those solved in full, and the largest estimated error of the rest."""

    points: int = 0
    in_full: int = 0
    error: float = 0.0


@dataclass(frozen=True, slots=True)
class ReducedModes(ModeFinder):
    """Modes by a reduced model: one around an evaluated case, or one within the bounds.

    around: the evaluated case, whose degrees of freedom the model has. key: of the modes. matrices:
    of a model within the bounds, whose jobs are done. in_full: solve points with them if the
    model's error may be too large. exact: the model has all unknowns.
    """

    model: ReducedModel | ReducedRange
    around: CaseEvaluation
    key: str
    matrices: ByMatrices | None = None
    in_full: bool = True
    name: str = REDUCED
    cheap: bool = True
    tally: Tally = field(default_factory=Tally)
    exact: bool = False

    @property
    def range(self) -> ReducedRange:
        """The model within the bounds."""
        assert isinstance(self.model, ReducedRange)
        return self.model

    def from_worst(self, theta: Floats) -> float:
        """Return the distance of a point from the last one that was solved in full."""
        assert self.matrices is not None
        written = self.matrices.source.written(theta)
        return float(np.abs(written - self.range.solved[-1]).sum())

    def modes(
        self, theta: Floats, analysis: ModalAnalysis, done: Sequence[Done]
    ) -> tuple[str, ModalResult]:
        if self.matrices is None:
            return self.key, self._modal(theta, self.around.modal.modes.n_modes)[0]
        found = self._accurate(theta, analysis.n_modes)
        self.tally.points += 1
        self.tally.in_full += found is None
        return (self.key, found) if found else self.matrices.modes(theta, analysis, done)

    def assembled(self, theta: Floats) -> MatricesAt:
        if self.matrices is not None:
            return self.matrices.assembled(theta)
        assert self.around.matrices is not None
        return replace(self.around.matrices, theta=theta, around=self.around.theta)

    def columns(self, point: Point, analysis: ModalAnalysis, done: Sequence[Done]) -> Columns:
        model = self.model.model if isinstance(self.model, ReducedRange) else self.model
        # Searches come here some thousand times.
        of_shapes = any(item.kind != "frequencies" for item in self.around.responses)
        return reduced_columns(model, point, of_shapes)

    def _accurate(self, theta: Floats, n_modes: int) -> ModalResult | None:
        """Return the modes; None if they must be computed in full."""
        known = self.around.modal.modes.n_modes
        if not self.in_full:
            n_modes = min(n_modes, known)
        if n_modes > known:
            return None
        try:
            modal, error = self._modal(theta, n_modes)
        except ModesError as failure:
            if not self.in_full:
                raise
            logger.debug("solving in full instead of the reduced model: %s", failure)
            return None
        if error > CONFIRMED and self.in_full:
            return None
        self.tally.error = max(self.tally.error, error)
        return modal

    def _modal(self, theta: Floats, n_modes: int) -> tuple[ModalResult, float]:
        """Return the lowest modes, and the estimated relative error of their frequencies.

        A model around a point has no estimate: NaN. Raises ModesError where it has no such modes.
        """
        if isinstance(self.model, ReducedRange):
            assert self.matrices is not None
            written = self.matrices.source.written(theta)
            eigenvalues, shapes, error = self.model.modes(written, n_modes)
        else:
            (eigenvalues, shapes), error = self.model.modes(theta, n_modes), np.nan
        modal, known = self.around.modal, self.around.modal.modes
        energies = 0.5 * eigenvalues
        return ModalResult.of_shapes(
            eigenvalues, shapes, known.nodes, known.components, energies, modal.n_rigid
        ), error


def reduced_columns(reduced: ReducedModel, point: Point, of_shapes: bool = True) -> Columns:
    """Return the derivatives at a point, exact within a reduced model around it."""
    modal = point.modal
    paired = point.pairing.computed + modal.n_rigid
    shapes = np.real(modal.modes.mode_shapes[:, paired])
    found = reduced.derivatives(point.theta, paired, shapes, of_shapes)
    return Columns(found, (REDUCED,) * point.theta.size, (point.key,))


def finder_of(campaign: Campaign, engine: JobEngine, demand: Demand, like: Campaign) -> ModeFinder:
    """Return the source of modes of a campaign's only case, by the `eigensolver` of one like it."""
    own = by_solver(campaign, engine)
    source = modes_source(like, own if like is campaign else by_solver(like, engine), demand)
    if source is None:
        return own
    if campaign.case.solver.deck.summary.n_elements >= LARGE:
        return_freed_memory()
    return ByMatrices(campaign, engine, source, own)
