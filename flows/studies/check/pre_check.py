"""The pre-check of a campaign: everything that one modal run shows.

`load_campaign` has refused what cannot work at all. The pre-check examines test, sensors, model and
parameters, first without a solver, then with the modes of the start values. The store keeps these
modes, so `update` reuses them, and a check after an update runs no solver.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from modetune.adapters.solver import ModalAnalysis
from modetune.core.correlation.pairing import alone
from modetune.core.errors import ModesError, SolverError
from modetune.core.modes import Floats, Integers
from modetune.core.parameters import QUANTITIES
from modetune.core.storage.campaign_record import RunCounts
from modetune.core.updating.job_results import ModalResult
from modetune.flows.campaign.campaign import Campaign
from modetune.flows.campaign.case import Case
from modetune.flows.diagnosis.causes import model_causes
from modetune.flows.diagnosis.findings import MODEL, PAIRING, TEST, Finding, Level, setting, worst
from modetune.flows.diagnosis.measured_modes import data_findings
from modetune.flows.diagnosis.pairing import (
    ModePreview,
    margin_findings,
    pairing_findings,
    preview,
    uncertain_findings,
)
from modetune.flows.diagnosis.sensors import sensor_findings
from modetune.flows.jobs.campaign_engine import job_engine
from modetune.flows.jobs.engine import JobEngine
from modetune.flows.jobs.execution import solve_jobs
from modetune.flows.studies.check.model import (
    ModelFacts,
    mass_findings,
    memory_findings,
    mesh_findings,
    model_facts,
    rigid_findings,
    size_findings,
)
from modetune.flows.studies.check.plausibility import (
    EnergyShare,
    bound_findings,
    energy_findings,
    energy_shares,
    from_nothing,
    joined_values,
    loose_findings,
)
from modetune.flows.updating.evaluation import Point
from modetune.flows.updating.evaluator import Evaluator, evaluator_of
from modetune.flows.updating.mode_source import campaign_analysis
from modetune.flows.updating.poses import by_shapes, from_store, may_choose, modal_job

NO_RUN = RunCounts()
WITHOUT_TEST = TEST.doubtful("there is none, so only the model is checked", "test",
    "name the test's files under `test`, or after the deck", setting("test.modes"))  # fmt: skip


@dataclass(frozen=True, slots=True)
class PreCheckReport:
    """The result of the pre-check.

    facts: of the model, None without a run. modes: each test mode with its pair. shares: energy
    shares of the parameters. runs: number of solver runs. failure: the error of the solver run, if
    it failed.
    """

    findings: tuple[Finding, ...]
    facts: ModelFacts | None = None
    modes: tuple[ModePreview, ...] = ()
    shares: tuple[EnergyShare, ...] = ()
    runs: RunCounts = NO_RUN
    failure: SolverError | None = None

    @property
    def level(self) -> Level:
        return worst(self.findings)

    @property
    def exit_code(self) -> int:
        """0 without errors, 2 with errors; the code of the solver error if the solver failed."""
        if self.failure is not None:
            return self.failure.exit_code
        return 2 if self.level == "wrong" else 0


def check_campaign(
    campaign: Campaign, run: bool = True, engine: JobEngine | None = None
) -> PreCheckReport:
    """Judge a campaign that was read; run: with the modes at its start, from the store if there.

    engine: that solves the model; NotStored is raised where it may not run what the store lacks.
    Where parameters start from zero, a second point shows whether they leave parts loose.
    A solver that fails is a finding. Raises StoreError.
    """
    if not run:
        return PreCheckReport(_without_run(*_posed(campaign, from_store(campaign))))
    static, runs = _without_run(campaign), NO_RUN
    analysis, nothing = campaign_analysis(campaign), from_nothing(campaign)
    try:
        campaign.solver_version()
        engine = engine or job_engine(campaign)
        if may_choose(campaign.case):
            (outcome,) = solve_jobs(engine, [modal_job(campaign)])
            runs = RunCounts(modal=int(not outcome.reused), reused=int(outcome.reused))
            posed = by_shapes(campaign.case, outcome.result(ModalResult))
            campaign, text = _posed(campaign, posed)
            static = _without_run(campaign, text)
        evaluator = evaluator_of(campaign, engine)
        result = evaluator.modes(campaign.start, analysis)
        if nothing:
            joined = evaluator.modes(joined_values(campaign, nothing), analysis)
            static += tuple(loose_findings(campaign, nothing, result, joined))
        shares = partial(_shares, evaluator, analysis, campaign.start, result)
        report = judged(campaign, result, static, analysis.n_modes, NO_RUN, shares)
        memory = [item for state in evaluator.used for item in memory_findings(state)]
    except SolverError as error:
        no_modes = MODEL.wrong(f"the solver computed no modes: {error}")
        return PreCheckReport((*static, no_modes), failure=error)
    findings = (*report.findings, *memory)
    return replace(report, findings=findings, runs=runs.plus(evaluator.runs))


def _posed(campaign: Campaign, found: tuple[Case, str] | None) -> tuple[Campaign, str]:
    """The campaign in the pose that measured shapes choose, and what they say; "" of one pose."""
    return (campaign, "") if found is None else (replace(campaign, cases=(found[0],)), found[1])


def _without_run(campaign: Campaign, said: str = "") -> tuple[Finding, ...]:
    """Return the findings that need no solver; said: the remark on the pose chosen by shapes."""
    tested = bool(campaign.test.numbers)
    return (
        *(data_findings(campaign.test) if tested else [WITHOUT_TEST]),
        *(sensor_findings(campaign, said) if tested else []),
        *size_findings(campaign),
        *bound_findings(campaign),
    )


def judged(
    campaign: Campaign,
    result: ModalResult,
    static: tuple[Finding, ...],
    n_asked: int,
    runs: RunCounts,
    shares_in: Callable[[Integers], tuple[EnergyShare, ...]] | None = None,
) -> PreCheckReport:
    """The report on a model that was solved; n_asked: modes that were asked for; shares_in: of
    strain energy in elastic modes, by their positions, where the run's own are not all."""
    facts = model_facts(campaign, result)
    test = campaign.case.measured  # what is held out has its place in the order of frequencies too
    lowest_hz = float(test.modes.frequencies_hz.min(initial=np.inf))
    solver = campaign.case.solver
    components, by_hand = solver.deck.summary.components, solver.rigid_modes is not None
    held = list(rigid_findings(result, components, by_hand))
    up_to_hz = float(test.modes.frequencies_hz.max()) if test.numbers else np.inf
    as_many = result.elastic.frequencies_hz[: len(test.numbers)]  # a coarse model's are too high
    highest_hz = max(1.1 * up_to_hz, float(as_many.max(initial=0.0)))
    mesh = mesh_findings(campaign, result.elastic, highest_hz)
    found = [*static, *mass_findings(campaign, facts), *held, *mesh]
    if worst(held) == "wrong" or lowest_hz <= 0.0 or not test.numbers:
        return PreCheckReport(
            tuple(found), facts, runs=runs
        )  # its modes have nothing to be paired by
    shapes = campaign.test.has_shapes
    elastic = campaign.case.sensors.observe(result.elastic) if shapes else result.elastic
    found += margin_findings(test, elastic, result.modes.n_modes < n_asked)
    try:
        every = preview(test, elastic, campaign.case.rules)
        uncertain = tuple(uncertain_findings(test, elastic, campaign.case.rules))
    except ModesError as error:
        return PreCheckReport((*found, PAIRING.wrong(str(error))), facts, runs=runs)
    modes = tuple(mode for mode in every if mode.mode in campaign.test.numbers)
    paired = np.array([mode.elastic_mode - 1 for mode in modes], dtype=np.int64)
    shares = shares_in(paired) if shares_in else energy_shares(result, paired)
    reasons = model_causes(campaign.case, result, every, _slopes(campaign, modes, shares))
    if worst(reasons) != "wrong":  # no pair within the bounds is right then
        found += uncertain
        found += pairing_findings(modes, float(elastic.frequencies_hz.max()), campaign.case.rules)
    found += reasons
    found += energy_findings(campaign, result, [mode.mode for mode in modes], shares)
    return PreCheckReport(tuple(found), facts, modes, shares, runs)


def _shares(
    evaluator: Evaluator,
    analysis: ModalAnalysis,
    theta: Floats,
    result: ModalResult,
    computed: Integers,
) -> tuple[EnergyShare, ...]:
    """Return energy shares from the run, or, for modes from matrices, from eigenvalue derivatives.

    A share is theta / lambda times the derivative of lambda, if stiffness or mass is proportional
    to theta. The first step of updating uses the same derivatives.
    """
    if result.groups or not evaluator.cheap:
        return energy_shares(result, computed)
    seen = result.at(evaluator.only.case.nodes)
    point = Point(theta, "", seen, alone(computed))
    slopes = evaluator.derivatives(point, analysis).eigenvalues
    shares = slopes * theta / result.eigenvalues[result.n_rigid :][computed, None]
    deck, items = evaluator.only.case.solver.deck, evaluator.campaign.parameters.parameters
    return tuple(
        EnergyShare(item.name, "strain" if strain else "kinetic", np.abs(own))
        for item, own in zip(items, shares.T, strict=True)
        if (strain := deck.energy_sets(item)) or QUANTITIES[item.quantity].powers == (0, 1)
    )


def _slopes(
    campaign: Campaign, modes: tuple[ModePreview, ...], shares: tuple[EnergyShare, ...]
) -> Floats | None:
    """Return derivatives of ln lambda of the measured modes, NaN where shares do not give them."""
    parameters, numbers = campaign.parameters.parameters, campaign.case.measured.numbers
    if not parameters:
        return None
    slopes = np.full((len(numbers), len(parameters)), np.nan)
    linear = all(QUANTITIES[item.quantity].powers in ((1, 0), (0, 1)) for item in parameters)
    if linear and len(shares) == len(parameters):
        rows = [numbers.index(mode.mode) for mode in modes]
        slopes[rows] = np.stack([item.shares for item in shares], axis=1)
    return slopes
