"""Whose modes a campaign takes: its solver's own, or those of its stored matrices.

Where the campaign leaves it open (`model.eigensolver: auto`) the way goes that is expected to take
less time. A run takes what runs of the model took before, or else what its elements let expect. The
first choice stays in the store: a run that is repeated takes the way it took, whatever was measured
meanwhile.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass

import numpy as np

from modetune.core.algebra.pardiso import is_available
from modetune.core.errors import NotComputed
from modetune.core.storage.keys import Json
from modetune.core.updating.modes_forecast import ModesForecast
from modetune.flows.campaign.campaign import Campaign
from modetune.flows.campaign.matrix_plan import unsuitable
from modetune.flows.jobs.job_prices import job_prices, side_by_side
from modetune.flows.updating.finders import BySolver, campaign_analysis
from modetune.flows.updating.matrix_source import MatrixSource

logger = logging.getLogger(__name__)

#: Raised by hand when the same campaign is to be looked at anew.
VERSION = 1
#: So many sets are worth a reduced model that holds for all of them.
MANY = 16
#: Sets that updating is expected to take, one after another.
STEPS = 4
#: What the first solution of a model by matrices takes besides (libraries, threads), seconds, and
#: a set by a reduced model for all of them.
START_S, SET_S = 0.4, 4e-3
#: A run of few elements takes, each element adds, and each run is handled in, seconds.
RUN_S, ELEMENT_S, HANDLED_S = 0.03, 1e-3, 0.05
#: Shares of a modal run: a matrix job; the first solution, reading included; later ones. Seen on
#: solids of 17,000 and 270,000 equations (`benchmarks/eigen.py`), the larger share of both.
JOB, FIRST, LATER = 0.45, 0.45, 0.15
#: A modal run at the end that is expected to take so long, seconds, is left to matrices, which take
#: half of it.
SPARED_S = 10.0
#: Full solutions of an update by matrices after the first, and of a reduced model for many sets.
STEPS_IN_FULL, MANY_IN_FULL = 2, 10


@dataclass(frozen=True, slots=True)
class Demand:
    """What is to be evaluated: sets one after another with their sensitivities, and others.

    matrices: whether the model's matrices are wanted whoever finds the modes.
    """

    steps: int = STEPS
    sets: int = 0
    matrices: bool = False


UPDATING = Demand()


def modes_source(
    campaign: Campaign, own: BySolver, demand: Demand = UPDATING
) -> MatrixSource | None:
    """Where the matrices come from whose modes stand for the solver's; None where none do.

    own: the finder of the solver's modes.
    """
    solver, asked = campaign.case.solver, campaign.case.eigensolver
    auto = asked == "auto"
    # Without a test nothing tells where the search for modes begins; without parameters there is
    # one set.
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
    """Whether matrices at the final values confirm what was found by those of all values; else a
    modal run of the solver does.

    own: as of `modes_source`; run_s: what that run is expected to take, as its forecast unless
    told.
    """
    if campaign.update.confirm != "auto":
        return campaign.update.confirm == "matrices"
    if np.isnan(run_s):
        run_s = modes_forecast(campaign, own, UPDATING).run_s
    return run_s >= SPARED_S


def modes_forecast(campaign: Campaign, own: BySolver, demand: Demand) -> ModesForecast:
    """What both ways are expected to take, as it was when first asked for."""
    every = range(len(campaign.parameters))
    extra = _further_runs(campaign, own)
    asked: Json = {
        "choice of modes": VERSION,
        "matrices": own.source.key(campaign.start, every),
        "extra": extra,
        "derived": own.methods.count("semi_analytic"),
        "steps": demand.steps,
        "sets": demand.sets,
        "wanted": demand.matrices,
        "confirm": campaign.update.confirm,
    }

    def compute() -> ModesForecast:
        return _forecast(campaign, own, demand, extra)

    try:
        return own.source.engine.derived(asked, compute, ModesForecast)
    except NotComputed:  # a dry run keeps nothing
        return compute()


def _further_runs(campaign: Campaign, own: BySolver) -> int:
    """Runs that a set's sensitivity takes beside its modal run."""
    analysis = campaign_analysis(campaign)
    works = own.sensitivity_works(campaign.start, analysis)
    modal = own.job(campaign.start, analysis)
    matrices = own.source.jobs(campaign.start, range(len(campaign.parameters)))
    jobs = {job.identity for work in works for job in work.jobs}
    return len(jobs - {job.identity for job in (modal, *matrices)})


def _forecast(campaign: Campaign, own: BySolver, demand: Demand, extra: int) -> ModesForecast:
    engine = own.source.engine
    prices = job_prices(engine, engine.plans.model_digest())
    modal, parallel = prices.get("modal"), campaign.parallel
    elements = campaign.case.solver.deck.summary.n_elements
    run_s = HANDLED_S + (modal.wall_s if modal else RUN_S + ELEMENT_S * elements)
    job_s = HANDLED_S + prices["matrices"].wall_s if "matrices" in prices else JOB * run_s
    jobs = len(own.source.jobs(campaign.start, range(len(campaign.parameters))))
    jobs_s = side_by_side([job_s] * jobs, parallel)
    step_s = run_s + side_by_side([run_s] * extra, parallel)
    solver_s = demand.steps * step_s + side_by_side([run_s] * demand.sets, parallel)
    derived = "semi_analytic" in own.methods  # from modes of the matrices, once more a set
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
