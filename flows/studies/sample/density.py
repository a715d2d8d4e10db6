"""The posterior density of the parameters, its peaks, and what a linear model would say of it.

Measured values have independent normal errors of the campaign's deviations, the parameters a normal
prior around their initial values, cut at the range:

    log p(theta | test) = -1/2 |w(theta)|^2 - 1/2 sum ((theta - theta_0) / s)^2 + constant

with w the surrogate's residual in standard deviations of the test. Emphasis takes no part: it says
what an updating shall care for, not how exactly something was measured. Limits of responses end the
density as the range does (`limits.py`).

Both terms are squares, so peaks are found by bounded least squares from many starts, with a steep
third one just inside of limits. Two ends are two peaks where the density sinks between them. The
share of a peak is Laplace's estimate: density times the volume of the normal distribution with the
same curvature.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from modetune.core.errors import CampaignError
from modetune.core.modes import Floats, Integers
from modetune.core.planning.latin_hypercube import latin_hypercube
from modetune.core.updating.parameter_steps import parameter_covariance
from modetune.flows.studies.sample.surrogate import ResponseLimits

#: End points are distinct peaks where the log density falls by this much between them.
SINK = 1.0
#: How far the straight path between two points on a limit may cross it, as a share of the span of
#: the limited value: its surrogate is that rough.
DIVIDES = 1e-3
#: A peak with a smaller share of the whole is left out.
LEAST_SHARE = 1e-3
#: How far inside a limit peaks are, and what rises there to a thousand standard deviations beyond:
#: shares of what the limited value spans over the range.
INSIDE, WALL = 1e-5, 1e-6
#: Search for peaks: number of points drawn from the range, and of starting points among them.
DRAWN, STARTS = 400, 16


class Features(Protocol):
    """A residual in standard deviations of the test."""

    def features(self, points: Floats) -> Floats:
        """(n, n_features) at points (n, n_parameters)."""
        ...


@dataclass(frozen=True, slots=True)
class Posterior:
    """A posterior density over a range.

    prior_mean, prior_deviation: (n_parameters,); lower, upper: (n_parameters,), where the density
    ends: the bounds, or the range that was learned where that is less. limits: of responses.
    """

    surrogate: Features
    prior_mean: Floats
    prior_deviation: Floats
    lower: Floats
    upper: Floats
    limits: ResponseLimits | None = None

    def inside(self, points: Floats) -> NDArray[np.bool_]:
        """Which points (n, n_parameters) are in the range and keep the limits, (n,)."""
        found = ((points >= self.lower) & (points <= self.upper)).all(axis=1)
        if self.limits is not None and found.any():
            found[found] = self.limits.hold(points[found])
        return np.asarray(found)

    def log_density(self, points: Floats) -> Floats:
        """(n,), up to a constant; minus infinity outside. points: (n, n_parameters)."""
        found, inside = np.full(points.shape[0], -np.inf), self.inside(points)
        if inside.any():
            found[inside] = -0.5 * (self._squares(points[inside]) ** 2).sum(axis=1)
        return found

    def slopes(self, point: Floats) -> Floats:
        """Derivatives of the features, (n_features, n_parameters), by central differences."""
        return self._slopes_of(self.surrogate.features, point, 1e-4)

    def _slopes_of(
        self, function: Callable[[Floats], Floats], point: Floats, share: float
    ) -> Floats:
        reach = share * (self.upper - self.lower)
        found = function(np.vstack([point + np.diag(reach), point - np.diag(reach)]))
        n = point.size
        return np.asarray((found[:n] - found[n:]).T / (2.0 * reach))

    def linear_covariance(self, point: Floats) -> Floats:
        """Covariance (n, n) that the slopes at a point and the prior give, bounds left aside."""
        slopes = self.slopes(point)
        ones = np.ones(slopes.shape[0])
        return parameter_covariance(slopes, ones, ones, self.prior_deviation**-2)

    def _squares(self, points: Floats) -> Floats:
        pull = (points - self.prior_mean) / self.prior_deviation
        return np.hstack([self.surrogate.features(points), pull])

    def _wall(self, points: Floats) -> Floats:
        if self.limits is None:
            return np.zeros((len(points), 0))
        return 1e3 * self.limits.breach(points, INSIDE) / WALL

    def _squares_at(self, point: Floats) -> Floats:
        return np.hstack([self._squares(point[None])[0], self._wall(point[None])[0]])

    def _slopes_at(self, point: Floats) -> Floats:
        own = [self.slopes(point), np.diag(1.0 / self.prior_deviation)]
        return np.vstack([*own, self._slopes_of(self._wall, point, WALL)])

    def _climb(self, start: Floats) -> tuple[Floats, float]:
        """Where the density is greatest, uphill from a point, and the log density there."""
        width = self.upper - self.lower
        margin = 1e-9 * width  # the method starts inside the bounds only
        ended = least_squares(
            self._squares_at,
            np.clip(start, self.lower + margin, self.upper - margin),
            self._slopes_at,
            bounds=(self.lower, self.upper),
            x_scale=width,
            xtol=1e-10,
            ftol=1e-12,
            max_nfev=200,
        )
        there = np.asarray(ended.x)
        return there, -float(ended.cost) if self.inside(there[None])[0] else -np.inf


@dataclass(frozen=True, slots=True)
class Peaks:
    """Maxima of the density, the one of greatest density first.

    points: (n_peaks, n_parameters); shares: (n_peaks,), of the whole, by Laplace;
    covariances: (n_peaks, n_parameters, n_parameters), linear.
    """

    points: Floats
    shares: Floats
    covariances: Floats

    @property
    def n_peaks(self) -> int:
        return self.points.shape[0]

    def nearest(self, samples: Floats) -> Integers:
        """Which peak each of samples (n, n_parameters) belongs to, by its own covariance."""
        squares = np.stack(
            [
                _squared_distances(samples - point, covariance)
                for point, covariance in zip(self.points, self.covariances, strict=True)
            ]
        )
        return np.asarray(squares.argmin(axis=0))


def find_peaks(
    posterior: Posterior, rng: np.random.Generator, also: Floats | None = None, drawn: int = DRAWN
) -> Peaks:
    """The peaks of a density. also: (n, n_parameters), starts in addition to those that are drawn.

    Raises CampaignError where limits leave no set of the range.
    """
    n_parameters = posterior.lower.size
    unit = latin_hypercube(drawn, n_parameters, rng)
    starts = posterior.lower + unit * (posterior.upper - posterior.lower)
    order = np.argsort(-posterior.log_density(starts))
    # The best draws crowd around one peak, so half of the starts are the first draws.
    chosen = [*starts[order[: STARTS // 2]], *starts[: STARTS // 2]]
    chosen += [] if also is None else list(also)
    ends = sorted((posterior._climb(start) for start in chosen), key=lambda end: -end[1])
    ends = [end for end in ends if np.isfinite(end[1])]
    if not ends:
        names = ", ".join(posterior.limits.names) if posterior.limits else "none"
        raise CampaignError(
            f"no set of the range keeps all limits ({names}): widen them, or the parameters' bounds"
        )
    kept: list[tuple[Floats, float]] = []
    for point, height in ends:
        if all(_is_apart(posterior, point, height, other) for other, _ in kept):
            kept.append((point, height))
    points = np.stack([point for point, _ in kept])
    heights = np.array([height for _, height in kept])
    covariances = np.stack([posterior.linear_covariance(point) for point in points])
    sizes = 0.5 * np.linalg.slogdet(covariances)[1]
    weights = heights - heights[0] + np.maximum(sizes, np.finfo(np.float64).min)  # at a jump: none
    shares = np.exp(weights - weights.max())
    shares /= shares.sum()
    large = shares >= LEAST_SHARE
    return Peaks(points[large], shares[large] / shares[large].sum(), covariances[large])


def _is_apart(posterior: Posterior, point: Floats, height: float, other: Floats) -> bool:
    """Whether the density sinks, or a limit is crossed, between a point and a higher one."""
    path = point + np.linspace(0.0, 1.0, 41)[1:-1, None] * (other - point)
    if posterior.limits is not None and posterior.limits.breach(path).max() > DIVIDES:
        return True
    between = -0.5 * (posterior._squares(path) ** 2).sum(axis=1)
    return bool(between.min() < height - SINK)


def _squared_distances(differences: Floats, covariance: Floats) -> Floats:
    turned = np.linalg.solve(np.linalg.cholesky(covariance), differences.T)
    return np.asarray((turned**2).sum(axis=0))
