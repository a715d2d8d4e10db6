"""Evaluating a parameter set: solver jobs out, modes, pairs, residual and sensitivity back."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from modetune.adapters.solver import ModalAnalysis
from modetune.core.errors import (
    LicenceDenied,
    ModetuneError,
    SolverCancelled,
    SolverError,
    SolverMissing,
)
from modetune.core.held_out import HeldOut
from modetune.core.modes import Floats
from modetune.core.pairing import LostMode
from modetune.core.record import RunCounts
from modetune.core.residual import residual_sensitivity
from modetune.core.results import ModalResult, ModeDerivatives
from modetune.core.sensitivity import stack_derivatives
from modetune.flows.campaign import Campaign
from modetune.flows.evaluating import Evaluating, Matrix
from modetune.flows.evaluation import Evaluation, compare, judged
from modetune.flows.execution.engine import Job, JobEngine, JobOutcome
from modetune.flows.execution.work import Done, Execution, Work
from modetune.flows.semi_analytic import UnlikeMatrices
from modetune.flows.sensitivities import Exact, Sensitivities, UnbalancedEnergies

logger = logging.getLogger(__name__)

#: How often the computed range is widened in search of a lost mode.
WIDENINGS = 2
#: Failures that are not of the one job that met them.
CAMPAIGNS_OWN = (SolverMissing, SolverCancelled, LicenceDenied)


def campaign_analysis(campaign: Campaign) -> ModalAnalysis:
    """The modal analysis that a campaign asks for: modes, nodes, and the parameters' energies."""
    solver = campaign.solver
    groups = tuple(
        (item.name, solver.energy_sets(item))
        for item in campaign.parameters.parameters
        if solver.capabilities.strain_energies and solver.energy_sets(item)
    )
    return ModalAnalysis(campaign.n_modes, campaign.result_nodes, groups)


class Evaluator(Evaluating):
    """Evaluates parameter sets by the solver's own modal runs."""

    def __init__(self, campaign: Campaign, engine: JobEngine, execution: Execution) -> None:
        self.campaign = campaign
        self.engine = engine
        self.execution = execution
        self._runs = RunCounts()
        self.analysis = campaign_analysis(campaign)
        self.methods = self.sensitivities().methods()

    @property
    def runs(self) -> RunCounts:
        """Solver runs so far, and what they cost."""
        ledger = self.engine.ledger
        return replace(self._runs, core_s=ledger.core_s, licence_s=ledger.licence_s)

    @property
    def cheap(self) -> bool:
        return all(method == "strain_energy" for method in self.methods)

    def evaluate(
        self, number: int, theta: Floats, previous: Evaluation | None, alone: bool
    ) -> tuple[Evaluation, Matrix | None]:
        """A set's evaluation, and its sensitivity unless the modal job is to go alone.

        A lost mode widens the computed range and pairs again before it is an error.
        Raises SolverError, ModesError, StoreError.
        """
        beside = [] if alone else self._works(theta, self.methods)
        modal_done, *columns = self._run(number, [self._modal_work(theta), *beside])
        key = unless_failed(modal_done)[0].key
        for widening in range(WIDENINGS + 1):
            modal = self.engine.result(Job(self._values(theta), self.analysis))
            assert isinstance(modal, ModalResult)
            try:
                evaluation = compare(self.campaign, theta, key, modal, previous)
                break
            except LostMode as error:
                if widening == WIDENINGS:
                    raise
                self.analysis = wider(self.analysis)
                logger.warning("%s; widening the range to %d modes", error, self.analysis.n_modes)
                key = unless_failed(self._run(number, [self._modal_work(theta)])[0])[0].key
        if alone:
            return evaluation, None
        if widening:  # the jobs beside asked for too few modes
            return evaluation, self.matrix(number, evaluation)
        return evaluation, self._assemble(number, evaluation, columns)

    def matrix(self, number: int, evaluation: Evaluation) -> Matrix:
        """The sensitivity at an evaluated set."""
        done = self._run(number, self._works(evaluation.theta, self.methods))
        return self._assemble(number, evaluation, done)

    def held_out(self, initial: Evaluation, updated: Evaluation) -> HeldOut | None:
        """The modes that are only judged by, before and after; nothing is run for them."""
        return judged(self.campaign, initial, updated)

    def planned(self, theta: Floats) -> list[Work]:
        """The work of an iteration at a set, with sensitivities."""
        return [self._modal_work(theta), *self._works(theta, self.methods)]

    def first_job(self, theta: Floats) -> Job | None:
        return Job(self._values(theta), self.analysis)

    def skip(self, number: int, slope: float) -> None:
        """Note that e2 makes this iteration do without a sensitivity of its own."""
        reason = f"e2: the residual changed by {slope:.3g} a parameter in the iteration before"
        names = [f"sensitivity {name}" for name in self.campaign.parameters.names]
        self.execution.skip(f"iteration {number}", names, reason)

    def _assemble(self, number: int, evaluation: Evaluation, done: Sequence[Done]) -> Matrix:
        """The matrix from the outcomes of `_works`.

        A column that cannot be had is left out with a warning; raises where none is left.
        """
        reasons = self._failed_columns(done)
        columns = [column for column in range(len(self.methods)) if column not in reasons]
        try:
            derivatives = self._derivatives(evaluation, columns, reasons)
        except (UnbalancedEnergies, UnlikeMatrices) as error:
            if self.campaign.sensitivity.method != "auto":
                raise
            self.methods = self._instead(error)
            return self.matrix(number, evaluation)
        names = self.campaign.parameters.names
        for column, reason in reasons.items():
            logger.warning("the sensitivity of %s cannot be had, so it keeps its value in this "
                           "iteration: %s", names[column], reason)  # fmt: skip
        if len(reasons) == len(names):
            raise next(iter(reasons.values()))
        values = np.zeros((evaluation.residual.values.size, len(names)))
        values[:, sorted(set(range(len(names))) - set(reasons))] = residual_sensitivity(
            self.campaign.test.modes, evaluation.seen, evaluation.pairing,
            self.campaign.weighting, seen_derivatives(self.campaign, evaluation, derivatives),
        )  # fmt: skip
        keys = tuple(
            outcome.key for item in done if not isinstance(item, ModetuneError) for outcome in item
        )
        return Matrix(values, self.methods, keys, 0, tuple(sorted(reasons)))

    def _instead(self, error: UnbalancedEnergies | UnlikeMatrices) -> tuple[Exact, ...]:
        """Methods in place of those that cannot be believed in this model."""
        energies = isinstance(error, UnbalancedEnergies)
        failed: Exact = "strain_energy" if energies else "semi_analytic"
        plans = self.sensitivities()
        methods = tuple(
            method if method != failed
            else plans.without_energies(parameter) if energies
            else "finite_difference"
            for method, parameter in zip(
                self.methods, self.campaign.parameters.parameters, strict=True
            )
        )  # fmt: skip
        used = sorted({new for new, old in zip(methods, self.methods, strict=True) if new != old})
        logger.warning("%s: %s is used in place of %s", error, ", ".join(used), failed)
        return methods

    def _failed_columns(self, done: Sequence[Done]) -> dict[int, ModetuneError]:
        """Why columns have no results, by position. Raises what is no column's own failure."""
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
        self, evaluation: Evaluation, columns: Sequence[int], reasons: dict[int, ModetuneError]
    ) -> ModeDerivatives:
        """Derivatives of these columns; those whose perturbed modes are lost go to reasons."""
        methods = self.sensitivities()
        parts = {}
        together = [c for c in columns if self.methods[c] != "finite_difference"]
        if together:
            joint = methods.assemble(evaluation.point, self.methods, together)
            parts = {column: joint.column(place) for place, column in enumerate(together)}
        for column in sorted(set(columns) - set(together)):
            try:
                parts[column] = methods.assemble(evaluation.point, self.methods, [column])
            except LostMode as error:
                reasons[column] = error
        if not parts:
            raise next(iter(reasons.values()))
        return stack_derivatives([parts[column] for column in sorted(parts)])

    def _works(self, theta: Floats, methods: Sequence[Exact]) -> list[Work]:
        plans = self.sensitivities()
        shared = plans.shared(theta, methods)
        works = [Work("sensitivity matrices", shared)] if shared else []
        for column, method in enumerate(methods):
            name = self.campaign.parameters.names[column]
            works.append(Work(f"sensitivity {name}", plans.plan(theta, column, method)))
        return works

    def _modal_work(self, theta: Floats) -> Work:
        return Work("modal", (Job(self._values(theta), self.analysis),))

    def _run(self, number: int, works: list[Work]) -> list[Done]:
        """What became of each piece, in order; counts the runs."""
        done = self.execution.run(f"iteration {number}", works)
        for work, outcomes in zip(works, done, strict=True):
            if not isinstance(outcomes, ModetuneError):
                self._runs = self._runs.plus(outcomes_count(work.name, outcomes))
        return done

    def _values(self, theta: Floats) -> dict[str, float]:
        return self.campaign.parameters.values(theta)

    def sensitivities(self) -> Sensitivities:
        """The methods of the campaign, bound to its jobs at the nodes that derivatives need."""
        return Sensitivities(
            engine=self.engine,
            parameters=self.campaign.parameters,
            settings=self.campaign.sensitivity,
            with_shapes=self.campaign.weighting.shape_weight > 0.0,
            modal=replace(self.analysis, nodes=self.campaign.nodes),
        )


def wider(analysis: ModalAnalysis) -> ModalAnalysis:
    """An analysis of more modes, in search of a lost one."""
    return replace(analysis, n_modes=analysis.n_modes + max(4, analysis.n_modes // 2))


def seen_derivatives(
    campaign: Campaign, evaluation: Evaluation, derivatives: ModeDerivatives
) -> ModeDerivatives:
    """Derivatives of shapes as the test's sensors see them."""
    if campaign.weighting.shape_weight == 0.0:
        return derivatives
    modes = evaluation.modal.modes
    observer = campaign.sensors.matrix(modes.nodes, modes.components)
    shapes = derivatives.mode_shapes
    seen = observer @ shapes.reshape(shapes.shape[0], -1)
    return replace(derivatives, mode_shapes=np.asarray(seen).reshape(-1, *shapes.shape[1:]))


def outcomes_count(name: str, outcomes: tuple[JobOutcome, ...]) -> RunCounts:
    """The runs of one piece of work by kind."""
    ran = sum(not outcome.reused for outcome in outcomes)
    modal = name == "modal"
    return RunCounts(
        modal=ran if modal else 0,
        sensitivity=0 if modal else ran,
        reused=len(outcomes) - ran,
    )


def unless_failed(done: Done) -> tuple[JobOutcome, ...]:
    if isinstance(done, ModetuneError):
        raise done
    return done
