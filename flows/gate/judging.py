"""The gate before updating: what can be told of a campaign at the cost of one modal run.

`load_campaign` has refused what cannot work at all. Here test, sensors, model and parameters are
judged, first without a solver, then with the modal job that updating begins with: it has the same
key, so updating finds it in the store.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from modetune.core.errors import ModesError, SolverError
from modetune.core.record import RunCounts
from modetune.core.results import ModalResult
from modetune.flows.campaign import Campaign
from modetune.flows.deck_texts import keep_text
from modetune.flows.evaluator import campaign_analysis
from modetune.flows.execution.engine import Job
from modetune.flows.gate.findings import Finding, Level, worst
from modetune.flows.gate.model import (
    ModelFacts,
    mass_findings,
    model_facts,
    rigid_findings,
    size_findings,
)
from modetune.flows.gate.pairing import (
    ModePreview,
    margin_findings,
    pairing_findings,
    preview,
    unmeasured,
)
from modetune.flows.gate.parameters import (
    EnergyShare,
    bound_findings,
    energy_findings,
    energy_shares,
)
from modetune.flows.gate.sensors import sensor_findings
from modetune.flows.gate.suspects import suspected_sensors
from modetune.flows.gate.test_data import data_findings
from modetune.flows.running import job_engine

NO_RUN = RunCounts()


@dataclass(frozen=True, slots=True)
class GateReport:
    """What the gate found.

    facts: of the model, None where nothing was run; modes: each test mode with its pair; shares:
    of strain energy by parameter; runs: what it cost; failure: of the solver run, None if it is
    there or was not wanted.
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
        """0 where nothing is wrong, 2 where something is; the solver's own where it failed."""
        if self.failure is not None:
            return self.failure.exit_code
        return 2 if self.level == "wrong" else 0


def check_campaign(campaign: Campaign, run: bool = True) -> GateReport:
    """Judge a campaign that was read; run: with its first modal job, from the store if there.

    A solver that fails is a finding. Raises StoreError.
    """
    static = (
        *data_findings(campaign.test),
        *sensor_findings(campaign),
        *size_findings(campaign),
        *bound_findings(campaign),
    )
    if not run:
        return GateReport(static)
    engine = job_engine(campaign)
    analysis = campaign_analysis(campaign)
    job = Job(campaign.parameters.values(campaign.start), analysis)
    try:
        campaign.solver.version()
        outcome = engine.solve(job)
        result = engine.result(job)
    except SolverError as error:
        told = Finding("wrong", "model", f"the solver gave no modes: {error}")
        return GateReport((*static, told), failure=error)
    assert isinstance(result, ModalResult)
    keep_text(campaign.store, campaign.solver)
    runs = RunCounts(modal=int(not outcome.reused), reused=int(outcome.reused))
    return judged(campaign, result, static, analysis.n_modes, runs)


def judged(
    campaign: Campaign,
    result: ModalResult,
    static: tuple[Finding, ...],
    n_asked: int,
    runs: RunCounts,
) -> GateReport:
    """The report on a model that was solved; n_asked: modes that were asked for."""
    facts = model_facts(campaign, result)
    test = campaign.measured  # what is held out has its place in the order of frequencies too
    lowest_hz = float(test.modes.frequencies_hz.min())
    held = rigid_findings(result, campaign.solver.model.components, lowest_hz)
    found = [*static, *mass_findings(campaign, facts), *held]
    if worst(held) == "wrong" or lowest_hz <= 0.0:
        return GateReport(tuple(found), facts, runs=runs)  # its modes have nothing to be paired by
    shapes = campaign.test.has_shapes
    elastic = campaign.sensors.observe(result.elastic) if shapes else result.elastic
    found += margin_findings(test, elastic, result.modes.n_modes < n_asked)
    try:
        every = preview(test, elastic)
    except ModesError as error:
        return GateReport((*found, Finding("wrong", "pairing", str(error))), facts, runs=runs)
    modes = tuple(mode for mode in every if mode.number in campaign.test.numbers)
    shares = energy_shares(result, np.array([mode.computed - 1 for mode in modes]))
    found += pairing_findings(modes, float(elastic.frequencies_hz.max()))
    found += suspected_sensors(test, elastic, every)
    found += unmeasured(test, elastic, every, _leaves_modes_out(campaign))
    found += energy_findings(campaign, result, shares)
    return GateReport(tuple(found), facts, modes, shares, runs)


def _leaves_modes_out(campaign: Campaign) -> bool:
    """Whether the test measured modes that the campaign neither uses nor judges by."""
    there = campaign.measurement.modes
    return there is not None and not set(there.numbers) <= set(campaign.measured.numbers)
