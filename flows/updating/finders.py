"""Where the modes of a case come from: the solver's own runs, stored matrices, a reduced model.

Each finder names the work that has to be carried out before modes, or their derivatives, are
found, and finds them from what became of it. The evaluator (`evaluator.py`) carries the work of all
cases out side by side, counts it, pairs the modes and puts the rest together. A finder that cannot
be believed for a model names the one that takes its place.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Protocol

from modetune.adapters.solver import ModalAnalysis
from modetune.core.correlation.pairing import LostMode
from modetune.core.errors import (
    LicenceDenied,
    ModelError,
    ModetuneError,
    SolverCancelled,
    SolverError,
    SolverMissing,
)
from modetune.core.modes import Floats
from modetune.core.updating.responses.response import MatricesAt
from modetune.core.updating.results import ModalResult, ModeDerivatives
from modetune.core.updating.sensitivity import stack_derivatives
from modetune.flows.campaign.campaign import Campaign
from modetune.flows.jobs.engine import JobEngine, JobOutcome
from modetune.flows.jobs.execution import Done, Work
from modetune.flows.jobs.job import Job
from modetune.flows.updating.evaluation import CaseEvaluation, Point
from modetune.flows.updating.matrix_source import MatrixSource
from modetune.flows.updating.semi_analytic import UnlikeMatrices
from modetune.flows.updating.sensitivities import Exact, Sensitivities, UnbalancedEnergies

logger = logging.getLogger(__name__)

#: Who finds modes of a reduced model, in records.
REDUCED = "reduced_model"
#: Failures that are not of the one job that met them.
CAMPAIGNS_OWN = (SolverMissing, SolverCancelled, LicenceDenied)
#: What tells that a finder cannot be believed for a model.
UNFIT = (UnbalancedEnergies, UnlikeMatrices, ModelError)


@dataclass(frozen=True, slots=True)
class Columns:
    """Derivatives of the paired modes with respect to a case's parameters.

    derivatives: of the columns that are not missing, in their order; methods: of all columns;
    keys: of the jobs behind them.
    """

    derivatives: ModeDerivatives
    methods: tuple[str, ...]
    keys: tuple[str, ...]
    missing: tuple[int, ...] = ()


class ModeFinder(Protocol):
    """Finds the modes of one case and their derivatives; with no jobs unless it says which."""

    @property
    def name(self) -> str:
        """Who finds the modes, as records tell it."""
        ...

    @property
    def cheap(self) -> bool:
        """Whether sensitivities cost no job, so that there is nothing for e2 to save."""
        ...

    def works(self, theta: Floats, analysis: ModalAnalysis) -> list[Work]:
        """What has to be carried out before the modes at a set are found."""
        return []

    def modes(
        self, theta: Floats, analysis: ModalAnalysis, done: Sequence[Done]
    ) -> tuple[str, ModalResult]:
        """The key and the modes of a set, from what became of `works`.

        Raises SolverError, ModesError, ModelError, StoreError.
        """
        ...

    def sensitivity_works(self, theta: Floats, analysis: ModalAnalysis) -> list[Work]:
        """What has to be carried out before the derivatives at a set are found."""
        return []

    def columns(self, point: Point, analysis: ModalAnalysis, done: Sequence[Done]) -> Columns:
        """The derivatives at a point, from what became of `sensitivity_works`.

        Raises as `modes` does.
        """
        ...

    def assembled(self, theta: Floats) -> MatricesAt:
        """K and M at a set whose `works` are done. Raises ModelError."""
        ...

    def suits(self, part: CaseEvaluation, analysis: ModalAnalysis) -> bool:
        """Whether the modes of an evaluation point are enough for derivatives."""
        return True

    def instead(self, error: ModetuneError) -> ModeFinder:
        """What takes the place of a finder that met this error. Raises it where nothing does."""
        raise error


@dataclass(frozen=True, slots=True)
class BySolver:
    """Modes by the solver's own runs.

    campaign: of the one case; source: of matrices for derivatives; methods: of the columns.
    """

    campaign: Campaign
    source: MatrixSource
    methods: tuple[Exact, ...]

    @property
    def name(self) -> str:
        return self.campaign.case.solver.program.name

    @property
    def cheap(self) -> bool:
        return all(method == "strain_energy" for method in self.methods)

    def works(self, theta: Floats, analysis: ModalAnalysis) -> list[Work]:
        modal = Work("modal", (self.job(theta, analysis),))
        if not self.campaign.case.needs("matrices"):
            return [modal]
        return [modal, *self.source.works(theta, range(theta.size))]

    def job(self, theta: Floats, analysis: ModalAnalysis) -> Job:
        """The modal job at a set."""
        return Job(self.campaign.parameters.values(theta), analysis)

    def modes(
        self, theta: Floats, analysis: ModalAnalysis, done: Sequence[Done]
    ) -> tuple[str, ModalResult]:
        (outcome,) = unless_failed(done[0])
        for item in done[1:]:
            unless_failed(item)
        return outcome.key, outcome.result(ModalResult)

    def assembled(self, theta: Floats) -> MatricesAt:
        return assembled(self.source, theta)

    def sensitivity_works(self, theta: Floats, analysis: ModalAnalysis) -> list[Work]:
        plans = sensitivities(self.campaign, self.source, analysis)
        works = plans.shared(theta, self.methods)
        for column, method in enumerate(self.methods):
            name = self.campaign.parameters.names[column]
            works.append(Work(f"sensitivity {name}", plans.plan(theta, column, method)))
        return works

    def columns(self, point: Point, analysis: ModalAnalysis, done: Sequence[Done]) -> Columns:
        """A column that is unavailable is left out with a warning; raises where none is left."""
        reasons = self._failed_columns(done)
        columns = [column for column in range(len(self.methods)) if column not in reasons]
        found = self._derivatives(point, analysis, columns, reasons)
        for column, reason in reasons.items():
            logger.warning(
                "the sensitivity of %s is unavailable, so it keeps its value in this iteration: %s",
                self.campaign.parameters.names[column],
                reason,
            )
        keys = tuple(
            outcome.key for item in done if not isinstance(item, ModetuneError) for outcome in item
        )
        by_matrices = [c for c in columns if self.methods[c] == "semi_analytic"]
        keys += self.source.stored(by_matrices)
        return Columns(found, self.methods, keys, tuple(sorted(reasons)))

    def suits(self, part: CaseEvaluation, analysis: ModalAnalysis) -> bool:
        return len(part.modal.groups) >= len(analysis.groups)  # all energies that methods use

    def instead(self, error: ModetuneError) -> BySolver:
        energies = isinstance(error, UnbalancedEnergies)
        if self.campaign.sensitivity.method != "auto" or isinstance(error, ModelError):
            raise error
        failed: Exact = "strain_energy" if energies else "semi_analytic"
        plans = sensitivities(self.campaign, self.source, campaign_analysis(self.campaign))
        methods = tuple(
            method
            if method != failed
            else plans.without_energies(parameter)
            if energies
            else "finite_difference"
            for method, parameter in zip(
                self.methods, self.campaign.parameters.parameters, strict=True
            )
        )
        used = sorted({new for new, old in zip(methods, self.methods, strict=True) if new != old})
        logger.warning("%s: %s is used in place of %s", error, ", ".join(used), failed)
        return replace(self, methods=methods)

    def _failed_columns(self, done: Sequence[Done]) -> dict[int, ModetuneError]:
        """Why columns have no results, by position. Raises what is not a column's own failure."""
        shared = done[: len(done) - len(self.methods)]
        found: dict[int, ModetuneError] = {}
        for column, method in enumerate(self.methods):
            own = done[len(shared) + column]
            needs_shared = method in ("semi_analytic", "solver")
            for item in (*(shared if needs_shared else ()), own):
                if isinstance(item, ModetuneError):
                    found.setdefault(column, item)
        for error in found.values():
            stop = self.campaign.run.failed_column == "stop"
            if stop or not isinstance(error, SolverError) or isinstance(error, CAMPAIGNS_OWN):
                raise error
        return found

    def _derivatives(
        self,
        point: Point,
        analysis: ModalAnalysis,
        columns: Sequence[int],
        reasons: dict[int, ModetuneError],
    ) -> ModeDerivatives:
        """Derivatives of these columns; those whose perturbed modes are lost go to reasons."""
        methods = sensitivities(self.campaign, self.source, analysis)
        parts = {}
        together = [c for c in columns if self.methods[c] != "finite_difference"]
        if together:
            joint = methods.assemble(point, self.methods, together)
            parts = {column: joint.column(place) for place, column in enumerate(together)}
        for column in sorted(set(columns) - set(together)):
            try:
                parts[column] = methods.assemble(point, self.methods, [column])
            except LostMode as error:
                reasons[column] = error
        if not parts:
            raise next(iter(reasons.values()))
        return stack_derivatives([parts[column] for column in sorted(parts)])


def assembled(source: MatrixSource, theta: Floats) -> MatricesAt:
    """A model's matrices at a set, from jobs that are done. Raises ModelError."""
    model = source.matrices(theta, range(theta.size))
    return MatricesAt(model, source.written(theta), source.group_stiffness(theta))


def by_solver(campaign: Campaign, engine: JobEngine) -> BySolver:
    """The finder of the solver's own modes for a campaign's only case."""
    parameters, step = campaign.parameters, campaign.sensitivity.step
    source = MatrixSource(engine, parameters, step, campaign.case.needs("losses"))
    plans = sensitivities(campaign, source, campaign_analysis(campaign))
    return BySolver(campaign, source, plans.methods())


def campaign_analysis(campaign: Campaign) -> ModalAnalysis:
    """The modal analysis of a campaign's only case: modes, nodes, and the parameters' energies."""
    case, solver = campaign.case, campaign.case.solver
    groups = tuple(
        (item.name, sets)
        for item in campaign.parameters.parameters
        if solver.program.capabilities.strain_energies and (sets := solver.deck.energy_sets(item))
    )
    return ModalAnalysis(case.n_modes, case.result_nodes, groups)


def sensitivities(
    campaign: Campaign, source: MatrixSource, analysis: ModalAnalysis
) -> Sensitivities:
    """The methods of a campaign, bound to its jobs at the nodes that derivatives need."""
    return Sensitivities(
        source=source,
        settings=campaign.sensitivity,
        with_shapes=campaign.case.needs("shapes"),
        modal=replace(analysis, nodes=campaign.case.nodes),
    )


def unless_failed(done: Done) -> tuple[JobOutcome, ...]:
    """The outcomes of a piece of work. Raises what ended it."""
    if isinstance(done, ModetuneError):
        raise done
    return done
