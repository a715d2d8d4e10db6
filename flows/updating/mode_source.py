"""The source of the modes of a case: the solver's own runs, stored matrices, or a reduced model.

Each source lists the solver work that its modes or their derivatives need, and returns them from
the results of that work. The evaluator (`evaluator.py`) runs the work of all cases in parallel,
counts it, pairs the modes and combines the cases. A source that turns out to be wrong for a model
names its replacement.

Where a campaign leaves the choice open (`model.eigensolver: auto`) it takes the source that is
expected to take less time. A run is expected to take as long as earlier runs of the model, or a
time estimated from the number of elements. The store keeps the first choice, so a repeated run
makes the same choice whatever was measured in between.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from modetune.adapters.solver import ModalAnalysis
from modetune.core.algebra.factor_room import factor_room
from modetune.core.algebra.pardiso import is_available
from modetune.core.correlation.pairing import LostMode, NotAmongComputed, Pairing
from modetune.core.errors import (
    CampaignError,
    LicenceDenied,
    ModelError,
    ModetuneError,
    NotComputed,
    SolverCancelled,
    SolverError,
    SolverMissing,
)
from modetune.core.modes import Floats, Integers, mode_name
from modetune.core.storage.keys import Json
from modetune.core.updating.job_results import ModalResult, ModesForecast
from modetune.core.updating.responses.response import MatricesAt
from modetune.core.updating.sensitivity import ModeDerivatives, stack_derivatives
from modetune.flows.campaign.campaign import Campaign
from modetune.flows.campaign.case import Case
from modetune.flows.campaign.matrix_plan import unsuitable
from modetune.flows.diagnosis.causes import cause_sentences, causes
from modetune.flows.diagnosis.findings import Finding
from modetune.flows.jobs.campaign_engine import job_engine
from modetune.flows.jobs.engine import JobEngine, JobOutcome
from modetune.flows.jobs.execution import Done, Work
from modetune.flows.jobs.job import Job
from modetune.flows.jobs.lookup import job_costs, parallel_time
from modetune.flows.updating.evaluation import CaseEvaluation, Point, compare
from modetune.flows.updating.matrices import MatrixSource
from modetune.flows.updating.sensitivities import (
    Exact,
    Sensitivities,
    UnbalancedEnergies,
    UnlikeMatrices,
)

logger = logging.getLogger(__name__)

#: Maximum number of times the computed range is widened to find a lost mode.
WIDENINGS = 1
#: The source of modes of a reduced model, in records.
REDUCED = "reduced_model"
#: Failures that concern the whole campaign and not one job.
CAMPAIGNS_OWN = (SolverMissing, SolverCancelled, LicenceDenied)
#: Errors that show that a source is wrong for a model.
UNFIT = (UnbalancedEnergies, UnlikeMatrices, ModelError)
#: Increase this number to make campaigns choose again.
VERSION = 1
#: Number of points from which a reduced model within the bounds is worth its cost.
MANY = 16
#: Expected number of successive points of updating.
STEPS = 4
#: Additional time of the first solution from matrices (libraries, threads), and time of a point by
#: a reduced model within the bounds, seconds.
START_S, SET_S = 0.4, 4e-3
#: Time of a run of a small model, additional time per element, and handling of each run, seconds.
RUN_S, ELEMENT_S, HANDLED_S = 0.03, 1e-3, 0.05
#: Times relative to a modal run: a matrix job; the first solution, including reading; later ones.
#: The larger of those measured on solids of 17,000 and 270,000 equations (`benchmarks/eigen.py`).
JOB, FIRST, LATER = 0.45, 0.45, 0.15
#: If the modal run at the end is expected to take longer than this, seconds, matrices confirm it
#: instead, in half the time.
SPARED_S = 10.0
#: Full solutions of an update by matrices after the first, and of a reduced model for many points.
STEPS_IN_FULL, MANY_IN_FULL = 2, 10


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
    """A source of the modes of one case and their derivatives; by default it needs no jobs."""

    @property
    def name(self) -> str:
        """Return the name of the source, for records."""
        ...

    @property
    def cheap(self) -> bool:
        """Return whether sensitivities take no job, so that e2 has none to skip."""
        ...

    def works(self, theta: Floats, analysis: ModalAnalysis) -> list[Work]:
        """Return the work that the modes at a point need."""
        return []

    def modes(
        self, theta: Floats, analysis: ModalAnalysis, done: Sequence[Done]
    ) -> tuple[str, ModalResult]:
        """Return the key and the modes of a point, from the outcomes of `works`.

        Raises SolverError, ModesError, ModelError, StoreError.
        """
        ...

    def sensitivity_works(self, theta: Floats, analysis: ModalAnalysis) -> list[Work]:
        """Return the work that the derivatives at a point need."""
        return []

    def columns(self, point: Point, analysis: ModalAnalysis, done: Sequence[Done]) -> Columns:
        """Return the derivatives at a point, from the outcomes of `sensitivity_works`.

        Raises as `modes` does.
        """
        ...

    def assembled(self, theta: Floats) -> MatricesAt:
        """Return K and M at a point whose `works` are done. Raises ModelError."""
        ...

    def suits(self, part: CaseEvaluation, analysis: ModalAnalysis) -> bool:
        """Return whether the modes of an evaluated case are sufficient for derivatives."""
        return True

    def instead(self, error: ModetuneError) -> ModeFinder:
        """Return the replacement of this source after an error; raise it if there is none."""
        raise error


@dataclass(frozen=True, slots=True)
class BySolver:
    """Modes by the solver's own runs.

    campaign: of this case alone; source: of matrices for derivatives; methods: of the columns.
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
        """Return the modal job at a point."""
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
        """Return the available columns and warn of the others; raises if none is left."""
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
        """Return the errors of columns, by position. Raises errors that concern all."""
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
        """Return derivatives of these columns; reasons: filled with the errors of lost ones."""
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
    """Return a model's matrices at a point, from jobs that are done. Raises ModelError."""
    model = source.matrices(theta, range(theta.size))
    return MatricesAt(model, source.written(theta), source.group_stiffness(theta))


def by_solver(campaign: Campaign, engine: JobEngine) -> BySolver:
    """Return the source of the solver's own modes for a campaign's only case."""
    parameters, step = campaign.parameters, campaign.sensitivity.step
    source = MatrixSource(engine, parameters, step, campaign.case.needs("losses"))
    plans = sensitivities(campaign, source, campaign_analysis(campaign))
    return BySolver(campaign, source, plans.methods())


def campaign_analysis(campaign: Campaign) -> ModalAnalysis:
    """Return the modal analysis of a campaign's only case: modes, nodes, energies."""
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
    """Return the sensitivity methods of a campaign at the nodes that derivatives need."""
    return Sensitivities(
        source=source,
        settings=campaign.sensitivity,
        with_shapes=campaign.case.needs("shapes"),
        modal=replace(analysis, nodes=campaign.case.nodes),
    )


def unless_failed(done: Done) -> tuple[JobOutcome, ...]:
    """Return the outcomes of a piece of work. Raises its error."""
    if isinstance(done, ModetuneError):
        raise done
    return done


@dataclass(frozen=True, slots=True)
class Demand:
    """Points to be evaluated: steps with their sensitivities, one after another, and others.

    matrices: whether the model's matrices are needed in any case.
    """

    steps: int = STEPS
    sets: int = 0
    matrices: bool = False


UPDATING = Demand()


def modes_source(
    campaign: Campaign, own: BySolver, demand: Demand = UPDATING
) -> MatrixSource | None:
    """Return the matrices whose modes replace the solver's; None where the solver finds them.

    own: the source of the solver's modes.
    """
    solver, asked = campaign.case.solver, campaign.case.eigensolver
    auto = asked == "auto"
    # Without a test the search for modes has no shift; without parameters there is one point.
    alone = not campaign.case.measured.numbers or (auto and not len(campaign.parameters))
    if asked == "solver" or alone:
        return None
    reason = unsuitable(solver, campaign.parameters.parameters, campaign.sensitivity.method)
    if reason is None and auto and not is_available():
        reason = "MKL's PARDISO is not installed"
    if reason is None and auto:
        forecast = modes_forecast(campaign, own, demand)
        logger.info("%s", forecast.sentence)
        reason = None if forecast.by_matrices else forecast.sentence
    elif reason is not None:
        logger.info("modes are the solver's own: %s", reason)
    if reason is None:
        return own.source
    if campaign.update.confirm == "matrices" and demand == UPDATING:
        logger.warning("`update.confirm: matrices` has nothing to confirm: %s", reason)
    return None


def confirms_by_matrices(campaign: Campaign, own: BySolver, run_s: float = np.nan) -> bool:
    """Return whether matrices at the final values confirm the end; else a modal run does.

    own: as in `modes_source`; run_s: expected time of that run, by default from its forecast.
    """
    if campaign.update.confirm in ("modes", "matrices"):
        return campaign.update.confirm == "matrices"
    if np.isnan(run_s):
        run_s = modes_forecast(campaign, own, UPDATING).run_s
    return run_s >= SPARED_S


def modes_forecast(campaign: Campaign, own: BySolver, demand: Demand) -> ModesForecast:
    """Return the expected times of both sources, as first forecast."""
    every = range(len(campaign.parameters))
    confirm = campaign.update.confirm
    extra = _further_runs(campaign, own)
    asked: Json = {
        "choice of modes": VERSION,
        "matrices": own.source.key(campaign.start, every),
        "extra": extra,
        "derived": own.methods.count("semi_analytic"),
        "steps": demand.steps,
        "sets": demand.sets,
        "wanted": demand.matrices,
        "confirm": "auto" if confirm == "later" else confirm,
    }

    def compute() -> ModesForecast:
        return _forecast(campaign, own, demand, extra)

    try:
        return own.source.engine.derived(asked, compute, ModesForecast)
    except NotComputed:  # a dry run keeps nothing
        return compute()


def _further_runs(campaign: Campaign, own: BySolver) -> int:
    """Return the number of runs of a point's sensitivity in addition to its modal run."""
    analysis = campaign_analysis(campaign)
    works = own.sensitivity_works(campaign.start, analysis)
    modal = own.job(campaign.start, analysis)
    matrices = own.source.jobs(campaign.start, range(len(campaign.parameters)))
    jobs = {job.identity for work in works for job in work.jobs}
    return len(jobs - {job.identity for job in (modal, *matrices)})


def _forecast(campaign: Campaign, own: BySolver, demand: Demand, extra: int) -> ModesForecast:
    engine = own.source.engine
    prices = job_costs(engine, engine.plans.model_digest())
    modal, parallel = prices.get("modal"), campaign.parallel
    elements = campaign.case.solver.deck.summary.n_elements
    run_s = HANDLED_S + (modal.wall_s if modal else RUN_S + ELEMENT_S * elements)
    job_s = HANDLED_S + prices["matrices"].wall_s if "matrices" in prices else JOB * run_s
    jobs = len(own.source.jobs(campaign.start, range(len(campaign.parameters))))
    jobs_s = parallel_time([job_s] * jobs, parallel)
    step_s = run_s + parallel_time([run_s] * extra, parallel)
    solver_s = demand.steps * step_s + parallel_time([run_s] * demand.sets, parallel)
    derived = "semi_analytic" in own.methods  # from modes of the matrices, one more per point
    if derived or demand.matrices:
        solver_s += START_S + jobs_s + (demand.steps if derived else 1) * FIRST * run_s
    matrices_s = START_S + jobs_s + FIRST * run_s
    if demand.sets >= MANY:
        matrices_s += MANY_IN_FULL * LATER * run_s + demand.sets * SET_S + run_s
    else:
        matrices_s += demand.sets * LATER * run_s
        if demand.steps > 1:
            by_matrices = confirms_by_matrices(campaign, own, run_s)
            last_s = job_s + STEPS_IN_FULL * LATER * run_s if by_matrices else run_s
            matrices_s += STEPS_IN_FULL * LATER * run_s + last_s
    runs = demand.steps * (1 + extra) + demand.sets
    return ModesForecast(jobs, matrices_s, runs, solver_s, run_s, modal is not None)


def parse_values(campaign: Campaign, settings: list[str]) -> dict[str, float]:
    """Return the campaign's initial values with NAME=VALUE texts applied. Raises CampaignError."""
    values = campaign.parameters.values(campaign.parameters.initial)
    known = {item.name: item for item in campaign.parameters.parameters}
    for setting in settings:
        name, separator, text = setting.partition("=")
        if not separator or name not in values:
            raise CampaignError(
                f"--at {setting!r}: expected NAME=VALUE with NAME of {', '.join(values)}"
            )
        try:
            given = float(text)
        except ValueError:
            raise CampaignError(f"--at {setting!r}: {text!r} is not a number") from None
        values[name] = known[name].counted(given)
        relative = known[name].values == "relative"
        if not math.isfinite(given) or (relative and not 0.0 < given < 1e6):
            raise CampaignError(f"--at {setting!r}: a relative value above zero is expected")
    return values


def model_modes(
    campaign: Campaign, values: Mapping[str, float], number: int | None = None
) -> ModalResult:
    """Return modes of the model, from the store or the solver; number: including rigid ones.

    Raises SolverError, StoreError.
    """
    analysis = campaign_analysis(campaign)
    job = Job(values, replace(analysis, n_modes=number or analysis.n_modes))
    return job_engine(campaign).solve(job).result(ModalResult)


@dataclass(slots=True, eq=False)
class CaseState:
    """A case under evaluation.

    campaign: the campaign of this case alone; columns: positions of its parameters among all;
    engine: of its model; analysis: the request of its next modal runs.
    """

    case: Case
    campaign: Campaign
    columns: Integers
    engine: JobEngine
    finder: ModeFinder
    analysis: ModalAnalysis

    def own(self, theta: Floats) -> Floats:
        """Return the case's own parameters."""
        return theta[self.columns]

    def compared(
        self,
        theta: Floats,
        key: str,
        modal: ModalResult,
        before: CaseEvaluation | None,
        solved_by: str,
        drop: bool = False,
    ) -> CaseEvaluation:
        """Compare modes at the case's own parameters with its test, as `compare` does."""
        matrices = self.finder.assembled(theta) if self.case.needs("matrices") else None
        with factor_room(self.engine.room):
            return compare(self.case, theta, key, modal, before, solved_by, drop, matrices)

    def named(self, work: Work) -> Work:
        """Return work under the case's name, for its engine."""
        return Work(self.case.of(work.name), work.jobs, work.engine or self.engine)


@dataclass(slots=True, eq=False)
class ModeRequest:
    """The modes of a case at its own parameters, requested until they give an evaluation.

    point: number of the point; widened: how often the computed range was widened so far.
    """

    point: int
    state: CaseState
    theta: Floats
    analysis: ModalAnalysis
    widened: int = 0

    def widen(self, error: LostMode, there: int) -> bool:
        """Request more modes; false where more would not help.

        there: number of modes found, which may be all modes of a small model.
        """
        few = there < self.analysis.n_modes
        if self.widened == WIDENINGS or few or not error.above:
            return False
        self.widened += 1
        n_modes = self.analysis.n_modes + max(4, self.analysis.n_modes // 2)
        self.analysis = replace(self.analysis, n_modes=n_modes)
        logger.info("%s; widening the range to %d modes", error, n_modes)
        return True

    def evaluated(
        self, done: Sequence[Done], before: CaseEvaluation | None
    ) -> CaseEvaluation | None:
        """Return the case's evaluation from the outcomes of its work; None to request it again.

        before: evaluation of the case that modes are tracked from.
        """
        state = self.state
        try:
            key, modal = state.finder.modes(self.theta, self.analysis, done)
        except UNFIT as error:
            state.finder = state.finder.instead(error)
            return None
        try:
            part = self.compared(key, modal, before)
        except LostMode as error:
            found = causes(state.case, modal) if before is None else ()
            wrong = any(item.level == "wrong" for item in found)
            if not wrong and self.widen(error, modal.modes.n_modes):
                return None
            if isinstance(error, NotAmongComputed):
                raise
            if wrong or before is not None or not state.case.rules.drop:
                raise _lost(error, found) from error
            part = self.compared(key, modal, before, drop=True)
        if before is None and part.solved_by != REDUCED:  # searches begin at many points
            _warn_dropped(state.case, part.pairing)
        return part

    def compared(
        self, key: str, modal: ModalResult, before: CaseEvaluation | None, drop: bool = False
    ) -> CaseEvaluation:
        """Compare modes with those of the test. Raises LostMode."""
        state = self.state
        return state.compared(self.theta, key, modal, before, state.finder.name, drop)


def _lost(error: LostMode, found: Sequence[Finding]) -> LostMode:
    """Return the error with its possible causes and the campaign keys that resolve it."""
    wrong = "".join(f"{item.text}. So " for item in found if item.level == "wrong")
    others = " ".join(("", *cause_sentences([item for item in found if item.level != "wrong"])))
    return LostMode(
        f"{wrong}{error}; `test.unmatched: drop` updates without it, and `test.pairs` names its "
        f"partner by hand (see `modetune check`){'.' if others else ''}{others}".rstrip()
    )


def _warn_dropped(case: Case, pairing: Pairing) -> None:
    """Warn of the modes that are left out."""
    for row in np.setdiff1d(np.arange(case.test.modes.n_modes), pairing.measured).tolist():
        logger.warning(
            "%s at %.4g Hz has no partner among the computed modes and is left out "
            "(test.unmatched: drop): nothing is compared with it",
            mode_name(case.test.numbers[row], case.name),
            case.test.modes.frequencies_hz[row],
        )
