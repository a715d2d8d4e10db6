"""Learning the residual: solver runs over the whole range, then where the posterior is.

A test is far more exact than the knowledge before it, so the posterior fills a small part of the
range. Runs spread over the range find where; further ones are taken there, drawn from a wider copy
of what the surrogate so far says the posterior is, each as far as can be from those that are
there. This ends where enough runs lie near the posterior and each of them, left out, is foreseen
from the others within a share of the test's own deviation.

Where a reduced model gives the residual itself nothing has to be learned: the sets over the range
only tell where to look for the posterior, and modes are tracked from the nearest of them.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from modetune.core.errors import CampaignError
from modetune.core.modes import Floats
from modetune.flows.studies.sample.density import Peaks, Posterior, find_peaks
from modetune.flows.studies.sample.points import PointSolver, ReducedFeatures
from modetune.flows.studies.sample.sampling import walk
from modetune.flows.studies.sample.surrogate import Surrogate, Training, fit_surrogate

#: Leave-one-out error, in standard deviations of the test, at which learning ends; and the one
#: beyond which the surrogate is refused: then it, not the test, would make the answer.
GOOD, REFUSED = 0.3, 1.0
#: New runs are drawn from so many times the posterior's width; near it is what lies within so many
#: times the reach of all but a thousandth of it.
WIDER = 1.5
#: Steps of walkers that look for the posterior between two rounds; points to choose new runs from.
SEARCH_STEPS, CANDIDATES = 300, 400


@dataclass(frozen=True, slots=True)
class Learned:
    """What was learned. near: (n_points,), which runs lie near the posterior; begun: runs before
    any was added there; errors: (n_responses,), leave-one-out errors near the posterior, NaN where
    a reduced model stands for the surrogate."""

    training: Training
    keys: tuple[str, ...]
    surrogate: Surrogate | ReducedFeatures
    posterior: Posterior
    peaks: Peaks
    near: NDArray[np.bool_]
    begun: int
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
) -> Learned:
    """Runs at points (n, n_parameters), then at most `more` of them near the posterior.

    limits: lower and upper end of the range; reduced: what gives the residual without
    learning. Raises CampaignError where the surrogate stays too poor; SolverError, StoreError.
    """
    tell(f"{points.shape[0]} sets over the range")
    solved = solver.solve("training", points)
    training, keys, left = solved.training, solved.keys, more
    begun = len(keys)
    each = 2 * points.shape[1] + 2
    while True:
        tell("looking for the posterior" if reduced else f"learning from {len(keys)} sets")
        learned = _learned(solver, training, keys, limits, begun, rng, reduced)
        if reduced:
            return learned
        good = learned.near.sum() >= each and learned.errors.max() <= GOOD
        if good or left <= 0:
            break
        wanted = new_points(learned, min(each, left), walkers, rng)
        left -= wanted.shape[0]
        tell(f"{wanted.shape[0]} sets near the posterior")
        solved = solver.solve("training near the posterior", wanted)
        training, keys = training.plus(solved.training), keys + solved.keys
    refuse_poor(learned, each)
    return learned


def refuse_poor(learned: Learned, least: int) -> None:
    """Raise CampaignError where the surrogate errs more than the test itself."""
    poor = np.flatnonzero(learned.errors > REFUSED)
    if not poor.size and learned.near.sum() >= least // 2:
        return
    names = learned.training.names
    found = ", ".join(
        f"{names[place]} by {learned.errors[place]:.2g}"
        for place in poor[np.argsort(-learned.errors[poor])][:6].tolist()
    )
    said = (
        f"misses runs near the posterior: {found} standard deviations of the test"
        if found
        else f"has {int(learned.near.sum())} runs near the posterior, where {least // 2} are needed"
    )
    raise CampaignError(
        f"after {learned.near.size} solver runs the surrogate {said}; raise --points, start from "
        "an updated campaign (--record), narrow the parameters' bounds, or leave out what changes "
        "too wildly (shapes of close modes: --set residuals.shape_weight=0)"
    )


def near_posterior(training: Training, posterior: Posterior) -> NDArray[np.bool_]:
    """Which runs lie near the posterior, by what the solver itself gave there, (n_points,)."""
    pull = (training.points - posterior.prior_mean) / posterior.prior_deviation
    squares = (training.values**2).sum(axis=1) + (pull**2).sum(axis=1)
    reach = WIDER**2 * float(chi2.isf(1e-3, training.points.shape[1]))
    return np.asarray(squares <= squares.min() + reach)


def new_points(learned: Learned, count: int, walkers: int, rng: np.random.Generator) -> Floats:
    """Points (count, n_parameters) for runs near the posterior, apart from those that are there."""
    posterior, peaks = learned.posterior, learned.peaks
    found = walk(posterior, peaks, walkers, SEARCH_STEPS, rng)
    drawn = found[rng.choice(found.shape[0], CANDIDATES)]
    which = peaks.nearest(drawn)
    for peak in np.unique(which).tolist():
        own = which == peak
        middle = drawn[own].mean(axis=0)
        drawn[own] = middle + WIDER * (drawn[own] - middle)
    drawn = np.clip(drawn, posterior.lower, posterior.upper)
    width = drawn.std(axis=0) + 1e-12 * (posterior.upper - posterior.lower)
    there = [*learned.training.points]
    chosen: list[Floats] = []
    for _ in range(count):
        taken = np.stack([*there, *chosen])
        apart = (((drawn[:, None] - taken[None]) / width) ** 2).sum(axis=2).min(axis=1)
        chosen.append(drawn[int(np.argmax(apart))])
    return np.stack(chosen)


def _learned(
    solver: PointSolver,
    training: Training,
    keys: tuple[str, ...],
    limits: tuple[Floats, Floats],
    begun: int,
    rng: np.random.Generator,
    reduced: ReducedFeatures | None,
) -> Learned:
    parameters = solver.campaign.parameters
    surrogate = reduced or fit_surrogate(training, *limits)
    posterior = Posterior(surrogate, parameters.initial, parameters.standard_deviations, *limits)
    near = near_posterior(training, posterior)
    # The best runs so far are starts too: a narrow peak is easily missed by others.
    order = np.argsort((training.values**2).sum(axis=1))[:3]
    peaks = find_peaks(posterior, rng, training.points[order])
    near &= within(training.points, limits)
    return Learned(training, keys, surrogate, posterior, peaks, near, begun, surrogate.errors(near))


def within(points: Floats, limits: tuple[Floats, Floats]) -> NDArray[np.bool_]:
    """Which points (n, n_parameters) lie in the range."""
    return np.asarray(((points >= limits[0]) & (points <= limits[1])).all(axis=1))
