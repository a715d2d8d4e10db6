"""Refinement of the surrogate: points over the whole range, then near the posterior.

A test is far more accurate than the prior, so the posterior fills a small part of the range. Points
over the whole range locate it; further points are drawn from a widened copy of the current
posterior, each as far as possible from the existing ones. Refinement ends when enough points are
near the posterior and the surrogate predicts the log density of each left-out point in its 95 %
region within GOOD.

The points are solver runs, or come from a cheap reduced model: then there are many, and the
surrogate must also predict points drawn from the posterior itself. If it cannot, the samples use
the reduced model directly.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.distance import cdist
from scipy.stats import chi2

from modetune.core.errors import CampaignError
from modetune.core.modes import Floats
from modetune.flows.studies.sample.chains import Chains, walk
from modetune.flows.studies.sample.density import Peaks, Posterior, find_peaks
from modetune.flows.studies.sample.points import PointSolver, ReducedFeatures
from modetune.flows.studies.sample.surrogate import (
    Surrogate,
    Training,
    density_error,
    fit_surrogate,
    limits_of,
)
from modetune.flows.updating.mode_source import MANY

#: Limits of errors: of the log density of left-out points; of points from the posterior, if points
#: are cheap; and leave-one-out error of a response in standard deviations of the test. Beyond the
#: last one the surrogate, not the test, would determine the result.
GOOD, EXACT, REFUSED = 0.3, 0.1, 1.0
#: Factor on the width of the posterior from which new points are drawn, and on the radius (99.9 %
#: of the posterior) within which points count as near it.
WIDER = 1.5
#: Steps of walkers that look for the posterior between two rounds; points to choose new sets from.
SEARCH_STEPS, CANDIDATES = 300, 400
#: Number of points from which the search for peaks of the reduced model starts.
CLIMBS = 5
#: Maximum number of points over the range to learn from: the cost grows with the cube.
MOST_LEARNED = 1000
#: For cheap points: batches per round, maximum number of points, and number of points from the
#: posterior that the surrogate must predict.
BATCHES, MOST_SETS, FORESEEN = 8, 1600, 64
#: Default number of points of the posterior to check; two are enough for a reduced model, which
#: was not learned from a few points.
CHECKS, FEW = 8, 2


@dataclass(frozen=True, slots=True)
class Refinement:
    """What was learned. near: (n_points,), which sets lie near the posterior; begun: sets before
    any was added there; errors: (n_responses,), leave-one-out errors in its 95 % region, and
    density_error, of the log density there; NaN where a reduced model itself gives the samples.
    foreseen: what was learned then."""

    training: Training
    keys: tuple[str, ...]
    surrogate: Surrogate | ReducedFeatures
    posterior: Posterior
    peaks: Peaks
    near: NDArray[np.bool_]
    begun: int
    errors: Floats
    density_error: float
    foreseen: Posterior | None = None

    def missed(self, truth: Training) -> Floats:
        """Of the residual at sets that it was not learned from, (n, n_residuals)."""
        return truth.values - self.surrogate.residuals(truth.points)

    def drawn(self, count: int, walkers: int, rng: np.random.Generator) -> Floats:
        """Points (count, n_parameters) of the posterior as far as it is known, none twice."""
        found = np.unique(walk(self.posterior, self.peaks, walkers, SEARCH_STEPS, rng), axis=0)
        return np.asarray(rng.permutation(found)[:count])

    def by_model(self, reduced: ReducedFeatures, rng: np.random.Generator) -> Refinement:
        """A reduced model itself in the place of what was learned from it, which foresees it."""
        posterior = replace(self.posterior, surrogate=reduced)
        best = np.argsort((self.training.values**2).sum(axis=1))[:CLIMBS]
        starts = np.vstack([self.peaks.points, self.training.points[best]])
        return replace(
            self,
            surrogate=reduced,
            posterior=posterior,
            foreseen=self.posterior,
            peaks=find_peaks(posterior, rng, starts, drawn=0),
            errors=np.full(self.errors.size, np.nan),
            density_error=np.nan,
        )


@dataclass(frozen=True, slots=True)
class Checks:
    """Full solutions at points of the posterior, (n_checks, n_parameters), and their jobs.

    errors: (n_responses,), root mean square over the points of what the samples' residual misses,
    in standard deviations of the test; NaN where nothing was checked.
    """

    points: Floats
    keys: tuple[str, ...]
    errors: Floats


def learn(
    solver: PointSolver,
    points: Floats,
    limits: tuple[Floats, Floats],
    more: int,
    walkers: int,
    rng: np.random.Generator,
    tell: Callable[[str], None],
    reduced: ReducedFeatures | None = None,
) -> Refinement:
    """Sets at points (n, n_parameters), then further ones near the posterior.

    limits: lower and upper end of the range; more: runs of the solver near the posterior at most;
    reduced: a reduced model that gives sets instead. Raises CampaignError where the surrogate stays
    too poor; SolverError, StoreError.
    """
    tell(f"{points.shape[0]} sets over the range")
    solved, names = solver.solve("training", points)
    best = np.sort(np.argsort((solved.values**2).sum(axis=1))[:MOST_LEARNED])
    training, keys = solved.some(best), tuple(names[place] for place in best.tolist())
    begun = len(keys)
    each = 2 * points.shape[1] + 2
    left, batch = (MOST_SETS, BATCHES * each) if reduced else (more, each)
    while True:
        tell(f"learning from {len(keys)} sets")
        learned = _learned(solver, training, keys, limits, begun, rng)
        good = learned.near.sum() >= each and learned.density_error <= GOOD
        if left < (MANY if reduced else 1) or (good and not reduced):
            break
        new = (
            learned.drawn(FORESEEN, walkers, rng)
            if good
            else new_points(learned, min(batch, left), walkers, rng)
        )
        tell(f"{new.shape[0]} sets near the posterior")
        solved, names = solver.solve(
            "training near the posterior", new, each, grows=reduced is None
        )
        if good and len(names) == len(new):
            error = density_error(solved.values, learned.missed(solved))
            if error <= EXACT:
                return replace(learned, density_error=error)
        left -= new.shape[0]
        training, keys = training.plus(solved), keys + names
    if reduced:
        tell("looking for the posterior by the reduced model itself")
        return learned.by_model(replace(reduced, known=solver.fitting(each)[0]), rng)
    refuse_poor(learned, each)
    return learned


def refuse_poor(learned: Refinement, least: int) -> None:
    """Raise CampaignError if the surrogate is less accurate than the test."""
    poor = np.flatnonzero(learned.errors > REFUSED)
    if not poor.size and learned.near.sum() >= least // 2:
        return
    names = learned.training.names
    found = ", ".join(
        f"{names[place]} by {learned.errors[place]:.2g}"
        for place in poor[np.argsort(-learned.errors[poor])][:6].tolist()
    )
    text = (
        f"misses runs near the posterior: {found} standard deviations of the test"
        if found
        else f"has {int(learned.near.sum())} runs near the posterior, where {least // 2} are needed"
    )
    raise CampaignError(
        f"after {learned.near.size} solver runs the surrogate {text}; raise --points, update the "
        "campaign first (`modetune update`), narrow the parameters' bounds, or leave out what "
        "changes too wildly (shapes of close modes: --set residuals.shape_weight=0)"
    )


def near_posterior(
    training: Training, posterior: Posterior, missing: float, wider: float = 1.0
) -> NDArray[np.bool_]:
    """Return which points are near the posterior, (n_points,).

    missing: share of a normal posterior outside the radius. wider: factor on the radius.
    """
    points = training.points
    pull = (points - posterior.prior_mean) / posterior.prior_deviation
    squares = (training.values**2).sum(axis=1) + (pull**2).sum(axis=1)
    reach = wider**2 * float(chi2.isf(missing, points.shape[1]))
    inside = posterior.inside(points)
    return np.asarray((squares <= squares[inside].min(initial=np.inf) + reach) & inside)


def new_points(learned: Refinement, count: int, walkers: int, rng: np.random.Generator) -> Floats:
    """Return new points (count, n_parameters) near the posterior, far from existing ones."""
    posterior, peaks = learned.posterior, learned.peaks
    drawn = learned.drawn(max(CANDIDATES, 4 * count), walkers, rng)
    which = peaks.nearest(drawn)
    for peak in np.unique(which).tolist():
        own = which == peak
        middle = drawn[own].mean(axis=0)
        drawn[own] = middle + WIDER * (drawn[own] - middle)
    drawn = np.clip(drawn, posterior.lower, posterior.upper)
    width = drawn.std(axis=0) + 1e-12 * (posterior.upper - posterior.lower)
    apart = cdist(drawn / width, learned.training.points / width).min(axis=1)
    chosen: list[int] = []
    for _ in range(count):
        chosen.append(int(np.argmax(apart)))
        apart = np.minimum(apart, np.linalg.norm((drawn - drawn[chosen[-1]]) / width, axis=1))
    return np.asarray(drawn[chosen])


def check(
    solver: PointSolver,
    learned: Refinement,
    chains: Chains,
    count: int | None,
    rng: np.random.Generator,
) -> Checks:
    """Solve `count` points drawn from the samples (default: CHECKS or FEW).

    The solver solves them, or its matrices in full if a reduced model gives the samples; the solver
    has confirmed the reduced model at its worst point. Raises SolverError, StoreError.
    """
    if count is None:
        count = FEW if solver.evaluator.range_use else CHECKS
    drawn = chains.flat[rng.choice(chains.flat.shape[0], count, replace=len(chains.flat) < count)]
    solved, keys = solver.solve("checks", drawn) if count else (learned.training, ())
    if not keys:
        return Checks(drawn[:0], (), np.full(len(learned.training.names), np.nan))
    return Checks(solved.points, keys, solved.sizes(learned.missed(solved)))


def _learned(
    solver: PointSolver,
    training: Training,
    keys: tuple[str, ...],
    limits: tuple[Floats, Floats],
    begun: int,
    rng: np.random.Generator,
) -> Refinement:
    parameters = solver.campaign.parameters
    surrogate = fit_surrogate(training, *limits)
    prior = parameters.initial, parameters.standard_deviations
    posterior = Posterior(surrogate, *prior, *limits, limits=limits_of(solver.known, *limits))
    # The best sets so far are starts too: a narrow peak is easily missed by others.
    order = np.argsort((training.values**2).sum(axis=1))[:3]
    peaks = find_peaks(posterior, rng, training.points[order])
    near = near_posterior(training, posterior, 1e-3, WIDER)
    core = near_posterior(training, posterior, 0.05)
    core = core if core.sum() > posterior.lower.size else near
    return Refinement(
        training,
        keys,
        surrogate,
        posterior,
        peaks,
        near,
        begun,
        training.sizes(surrogate.left_out[core]),
        density_error(training.values[core], surrogate.left_out[core]),
    )
