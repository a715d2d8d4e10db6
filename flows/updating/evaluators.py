"""What evaluates a campaign: each of its cases with an engine and a finder of its own."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from modetune.flows.campaign.campaign import Campaign
from modetune.flows.campaign.case import Case
from modetune.flows.jobs.engine import JobEngine
from modetune.flows.jobs.job import Plans
from modetune.flows.jobs.limits import CORES, Limit
from modetune.flows.jobs.work import Execution
from modetune.flows.updating.asked import CaseState
from modetune.flows.updating.evaluator import Evaluator
from modetune.flows.updating.finders import ModeFinder, by_solver, campaign_analysis
from modetune.flows.updating.modes_choice import UPDATING, Demand, modes_source


def evaluator_of(
    campaign: Campaign,
    engine: JobEngine,
    execution: Execution,
    eigensolver: bool = True,
    demand: Demand = UPDATING,
) -> Evaluator:
    """What evaluates a campaign's parameter sets.

    demand: how many of them. eigensolver: whether modes come from where
    the campaign says; else from the solver's own runs, as for cases that are only judged by.
    """
    states = []
    for case in campaign.cases:
        own = campaign.alone(case)
        at = engine_of(engine, campaign, case)
        every = range(len(campaign.parameters))
        columns = np.array(every if case.columns is None else case.columns, dtype=np.int64)
        chosen = eigensolver and not case.aside
        finder = finder_of(own, at, demand) if chosen else by_solver(own, at)
        states.append(CaseState(case, own, columns, at, finder, campaign_analysis(own)))
    evaluator = Evaluator(campaign, states, execution, engine.ledger)
    if any(state.finder.name != state.case.solver.program.name for state in states):
        from modetune.flows.updating.by_range import ReducedRanges
        from modetune.flows.updating.foresight import ReducedForesight

        evaluator.foresight = ReducedForesight(evaluator)
        evaluator.ranges = ReducedRanges(evaluator)
    return evaluator


def finder_of(campaign: Campaign, engine: JobEngine, demand: Demand = UPDATING) -> ModeFinder:
    """What finds the modes of a campaign's only case, by its `eigensolver`."""
    own = by_solver(campaign, engine)
    source = modes_source(campaign, own, demand)
    if source is None:
        return own
    from modetune.flows.updating.by_matrices import ByMatrices

    return ByMatrices(campaign, engine, source, own)


def engine_of(engine: JobEngine, campaign: Campaign, case: Case) -> JobEngine:
    """The campaign's engine for the model of one of its cases."""
    if case.solver is engine.solver:
        return engine
    solver, name = case.solver, case.solver.program.name
    limits = [limit for limit in engine.limits if limit.name == CORES]
    if name in campaign.run.licences:
        limits.append(Limit(name, campaign.run.licences[name], 1))
    return replace(engine, plans=Plans(solver), limits=tuple(limits))
