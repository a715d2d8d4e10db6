"""What evaluates a campaign: each of its cases with an engine and a finder of its own."""

from __future__ import annotations

import numpy as np

from modetune.flows.campaign.campaign import Campaign
from modetune.flows.jobs.campaign_engine import engine_of
from modetune.flows.jobs.engine import JobEngine
from modetune.flows.jobs.execution import Execution
from modetune.flows.updating.evaluator import CaseState, Evaluator
from modetune.flows.updating.matrices import LARGE, return_freed_memory
from modetune.flows.updating.mode_source import (
    UPDATING,
    Demand,
    ModeFinder,
    by_solver,
    campaign_analysis,
    modes_source,
)


def evaluator_of(
    campaign: Campaign,
    engine: JobEngine,
    demand: Demand = UPDATING,
    like: Campaign | None = None,
    execution: Execution | None = None,
) -> Evaluator:
    """What evaluates a campaign's parameter sets.

    demand: how many of them; like: the campaign for which whose modes are taken is chosen, of the
    same model, parameters and cases, by default the same one; execution: of the work, by default on
    the engine's tasks.
    """
    states: list[CaseState] = []
    for case in campaign.cases:
        own = campaign.alone(case)
        at = engine_of(engine, campaign, case)
        every = range(len(campaign.parameters))
        columns = np.array(every if case.columns is None else case.columns, dtype=np.int64)
        alike = own if like is None else like.alone(like.cases[len(states)])
        finder = by_solver(own, at) if case.aside else finder_of(own, at, demand, alike)
        states.append(CaseState(case, own, columns, at, finder, campaign_analysis(own)))
    evaluator = Evaluator(campaign, states, execution or Execution(engine))
    # A reduced model has directions for each parameter: with a field it is no smaller.
    by_matrices = any(state.finder.name != state.case.solver.program.name for state in states)
    if by_matrices and not campaign.fields:
        from modetune.flows.updating.reduced_model import ReducedForesight, ReducedRanges

        evaluator.foresight = ReducedForesight(evaluator)
        evaluator.ranges = ReducedRanges(evaluator)
    return evaluator


def finder_of(campaign: Campaign, engine: JobEngine, demand: Demand, like: Campaign) -> ModeFinder:
    """What finds the modes of a campaign's only case, by the `eigensolver` of one like it."""
    own = by_solver(campaign, engine)
    source = modes_source(like, own if like is campaign else by_solver(like, engine), demand)
    if source is None:
        return own
    from modetune.flows.updating.reduced_model import ByMatrices

    if campaign.case.solver.deck.summary.n_elements >= LARGE:
        return_freed_memory()
    return ByMatrices(campaign, engine, source, own)
