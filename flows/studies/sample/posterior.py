"""The posterior of a campaign: points over the range, a surrogate, samples and their checks."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from modetune import __version__
from modetune.core.errors import CampaignError
from modetune.core.modes import Floats
from modetune.core.planning.latin_hypercube import latin_hypercube
from modetune.core.storage.campaign_record import CampaignRecord
from modetune.flows.campaign.campaign import Campaign
from modetune.flows.campaign.schema import STORE_REMEDY
from modetune.flows.jobs.campaign_engine import solving_engine
from modetune.flows.studies.result import near
from modetune.flows.studies.sample.chains import LONGER, LONGEST, Chains, check_walkers, sample
from modetune.flows.studies.sample.points import PointSolver, ReducedFeatures
from modetune.flows.studies.sample.record import PosteriorRecord
from modetune.flows.studies.sample.refinement import Checks, Refinement, check, learn
from modetune.flows.studies.sample.request import SamplingRequest
from modetune.flows.studies.study import ModelState
from modetune.flows.studies.update_record import update_record
from modetune.flows.updating.evaluator import evaluator_of
from modetune.flows.updating.mode_source import MANY, Demand
from modetune.flows.updating.poses import settled

#: Without a number: runs over the range and walkers a parameter, and the least of both.
POINTS_EACH, LEAST_POINTS, WALKERS_EACH, LEAST_WALKERS = 10, 16, 4, 32
#: ... times as many sets where a reduced model gives them, and as many runs near the posterior at
#: most, which end as soon as what they teach is good.
SETS_EACH, NEAR_EACH = 4, 2
#: The range around the end of an update, in standard deviations of the prior.
RANGE = 3.0


def sample_campaign(
    campaign: Campaign,
    request: SamplingRequest,
    working: Callable[[str], None],
    earlier: CampaignRecord | None = None,
) -> PosteriorRecord:
    """The posterior of a campaign's parameters. earlier: an updated campaign to start from.

    working: is called with what is being computed.

    Raises CampaignError (what was asked cannot be; the surrogate stays too poor), SolverError,
    ModesError, StoreError.
    """
    started = time.monotonic()
    with learned_posterior(campaign, request, working, earlier) as known:
        learned, solver = known.learned, known.solver
        working("sampling")
        longest = LONGEST if learned.surrogate is known.reduced else LONGER
        chains = sample(
            learned.posterior,
            learned.peaks,
            known.walkers,
            request.steps,
            known.at_chains,
            longest,
            learned.foreseen,
        )
        working("sets of the posterior")
        checks = check(solver, learned, chains, request.checks, known.at_checks)
    return _record(known, chains, checks, request.seed, time.monotonic() - started)


def _record(
    known: PosteriorModel, chains: Chains, checks: Checks, seed: int, wall_s: float
) -> PosteriorRecord:
    campaign, learned, solver = known.campaign, known.learned, known.solver
    parameters, posterior, flat = campaign.parameters, learned.posterior, chains.flat
    samples, log_densities = chains.thinned()
    interval = np.quantile(flat, [0.025, 0.975], axis=0)
    which = learned.peaks.nearest(flat)
    n = len(parameters)
    return PosteriorRecord(
        name=campaign.name,
        seed=seed,
        walkers=chains.samples.shape[1],
        steps=chains.steps,
        burned=chains.burned,
        acceptance=chains.acceptance,
        enough=chains.are_enough,
        solver=campaign.solver_name,
        solver_version=known.version,
        modetune_version=__version__,
        units=campaign.case.units,
        wall_s=wall_s,
        campaign_text=campaign.text,
        names=parameters.names,
        lower=posterior.lower,
        upper=posterior.upper,
        bound_lower=parameters.lower,
        bound_upper=parameters.upper,
        prior_mean=posterior.prior_mean,
        prior_deviation=posterior.prior_deviation,
        mean=flat.mean(axis=0),
        deviation=flat.std(axis=0),
        interval_lower=interval[0],
        interval_upper=interval[1],
        most_likely=learned.peaks.points[0],
        linear_deviation=np.sqrt(np.diag(learned.peaks.covariances[0])),
        correlation=np.corrcoef(flat, rowvar=False).reshape(n, n),
        autocorrelation_times=chains.autocorrelation_times,
        effective_sizes=chains.effective_sizes,
        r_hat=chains.r_hat,
        samples=samples,
        log_densities=log_densities,
        peaks=learned.peaks.points,
        shares=np.bincount(which, minlength=learned.peaks.n_peaks) / which.size,
        training=learned.training,
        training_keys=learned.keys,
        near=learned.near,
        begun=learned.begun,
        left_out=learned.errors,
        density_error=learned.density_error,
        check_points=checks.points,
        check_keys=checks.keys,
        check_errors=checks.errors,
        failures=tuple(solver.failures),
        runs=solver.evaluator.runs,
        reduced_model=solver.evaluator.range_use,
    )


@dataclass(frozen=True, slots=True)
class PosteriorModel:
    """The posterior of a campaign with the solver that it came from.

    reduced: a reduced model between the bounds, where there is one; walkers: of a sampler;
    at_chains, at_checks: random numbers; version: of the solver.
    """

    campaign: Campaign
    solver: PointSolver
    learned: Refinement
    reduced: ReducedFeatures | None
    walkers: int
    at_chains: np.random.Generator
    at_checks: np.random.Generator
    version: str


@contextmanager
def learned_posterior(
    campaign: Campaign,
    request: SamplingRequest,
    working: Callable[[str], None],
    earlier: CampaignRecord | None = None,
) -> Iterator[PosteriorModel]:
    """Learn the posterior from points over the range and near it; raises as `sample_campaign`."""
    campaign = campaign.alone(campaign.case)  # several are refused before anything runs
    parameters = campaign.parameters
    if problems := request.problems(len(parameters)):
        raise CampaignError(problems)
    campaign = settled(campaign)
    walkers = request.walkers or max(LEAST_WALKERS, WALKERS_EACH * len(parameters))
    check_walkers(walkers, len(parameters))
    centre = campaign.start if earlier is None else carried_over(campaign, earlier)
    limits = learning_range(campaign, None if earlier is None else centre)
    at_points, at_search, at_chains, at_checks = np.random.default_rng(request.seed).spawn(4)
    asked = request.points or max(LEAST_POINTS, POINTS_EACH * len(parameters))
    version = campaign.solver_version()  # report a missing solver before anything else starts
    campaign.store.check_usable(STORE_REMEDY)
    with solving_engine(campaign) as engine:
        try:
            evaluator = evaluator_of(campaign, engine, demand=Demand(1, asked))
            evaluator.tell = working
            solver = PointSolver(campaign, evaluator)
            # Where nothing was measured but frequencies, pairs are those that updating begins with.
            solver.solve("start", campaign.start[None])
            reduced = solver.reduced() if asked >= MANY else None
            n_sets = SETS_EACH * asked if reduced and request.points is None else asked
            unit = latin_hypercube(n_sets, len(parameters), at_points)
            points = np.vstack([centre, limits[0] + unit * (limits[1] - limits[0])])
            more = request.points or NEAR_EACH * asked
            learned = learn(solver, points, limits, more, walkers, at_search, working, reduced)
            yield PosteriorModel(
                campaign, solver, learned, reduced, walkers, at_chains, at_checks, version
            )
        except BaseException:
            engine.cancelled.set()  # jobs of other threads end with the sampling
            raise


def sampling_start(
    campaign: Campaign, record: Path | None, state: ModelState | None, folder: Path
) -> tuple[CampaignRecord | None, str]:
    """Return the update to start from, None for the campaign's start, and a sentence about it.

    record: run folder or campaign.h5, by default the newest update of the campaign in its run
    folder. Raises CampaignError, StoreError.
    """
    found = update_record(campaign, record, state, folder)
    if found is None:
        return None, "points over the bounds, from the campaign's start"
    names = found.parameters.names
    if record is None and state is None and not set(names).issuperset(campaign.parameters.names):
        return None, (
            "points over the bounds, from the campaign's start: the update in "
            f"{near(folder)} is of {', '.join(names)}"
        )
    return found, (
        f"points around the end of the update in {near(record or folder)} (--state initial: over "
        "the bounds)"
    )


def carried_over(campaign: Campaign, earlier: CampaignRecord) -> Floats:
    """The parameters (n_parameters,) that an update ended on, relative to the campaign's deck.

    Raises CampaignError where the update was of other parameters.
    """
    ends = zip(earlier.parameters.assigned(earlier.updated), earlier.deck_values, strict=True)
    updated = {item.name: item.number(deck, value) for (item, value), deck in ends}
    missing = [name for name in campaign.parameters.names if name not in updated]
    if missing:
        raise CampaignError(
            f"the record of the update is of {', '.join(updated)} and lacks "
            f"{', '.join(missing)}; name the run folder of this campaign, or start without an "
            "update with --state initial"
        )
    values = [
        item.relative_to(campaign.case.solver.deck.deck_value(item), updated[item.name])
        for item in campaign.parameters.parameters
    ]
    return np.clip(np.array(values), campaign.parameters.lower, campaign.parameters.upper)


def learning_range(campaign: Campaign, centre: Floats | None) -> tuple[Floats, Floats]:
    """Lower and upper end, (n_parameters,): the bounds, or nearer around a centre that is known."""
    parameters = campaign.parameters
    if centre is None:
        return parameters.lower, parameters.upper
    reach = RANGE * parameters.standard_deviations
    return (
        np.maximum(parameters.lower, centre - reach),
        np.minimum(parameters.upper, centre + reach),
    )
