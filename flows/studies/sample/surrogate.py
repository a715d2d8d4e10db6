"""A surrogate of the residual: a trend and a Gaussian process through solver runs, no solver.

The residual is taken in standard deviations of the test, w = (measured - computed) / sigma, so that
every error below is in that unit and the misfit of a parameter set is |w|^2. Frequencies are taken
one by one. A shape has an entry a sensor, all of the same deviation; the training points' shapes
span few directions, found by a singular value decomposition, and turning orthonormally keeps
lengths: the misfit of the shape is |c|^2 of its coordinates there plus what lies outside for good.

Each feature y (a frequency, a coordinate of a shape) is universal kriging (Cressie 1993, 3.4) of
the inputs x, scaled to [-1, 1] over the range:

    y(x) = f(x)^T beta + g(x),   g ~ GP(0, a exp(-|x - x'|^2 / 2 l^2) + nugget),

with f linear or, where there are points enough, quadratic; a, the lengths l of each input and the
nugget by maximum likelihood (scikit-learn), beta by generalised least squares. Leaving out point i,
the trend fitted anew without it, misses it by (Dubrule 1983)

    e_i = (Q y)_i / Q_ii,   Q = K^-1 - K^-1 F (F^T K^-1 F)^-1 F^T K^-1.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations_with_replacement

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import LinAlgError, cho_factor, cho_solve
from scipy.optimize import minimize
from sklearn.gaussian_process import GaussianProcessRegressor
from sklearn.gaussian_process.kernels import RBF, ConstantKernel, WhiteKernel

from modetune.core.errors import CampaignError
from modetune.core.modes import Floats, Integers

#: What a shape's left-out directions may hold at most, root mean square over the points, in
#: standard deviations of the test; directions at most.
LEFTOVER, MOST_DIRECTIONS = 0.1, 20
#: A remainder of the trend below this, in standard deviations of the test, needs no process.
NOTHING_LEFT = 1e-6
#: Bounds of amplitude, lengths and nugget, of a remainder scaled to 1 over inputs in [-1, 1].
AMPLITUDES, LENGTHS, NUGGETS = (1e-2, 1e4), (0.1, 30.0), (1e-9, 1.0)
#: Parameter sets that are predicted at once: what that takes of memory stays small.
TOGETHER = 256


@dataclass(frozen=True, slots=True)
class Training:
    """Solver runs that a surrogate learns from.

    points: (n_points, n_parameters); values: (n_points, n_residuals), in standard deviations of the
    test; responses: (n_residuals,), which response each entry is of; names: of the responses.
    """

    points: Floats
    values: Floats
    responses: Integers
    names: tuple[str, ...]

    def plus(self, other: Training) -> Training:
        """With the points of another one."""
        return Training(
            np.vstack([self.points, other.points]),
            np.vstack([self.values, other.values]),
            self.responses,
            self.names,
        )


@dataclass(frozen=True, slots=True)
class FeatureReduction:
    """From residuals to features, orthonormally.

    mean: (n_residuals,); basis: (n_residuals, n_features), orthonormal columns; responses:
    (n_features,); outside: squared length of what no feature moves; leftover: (n_responses,), root
    mean square over the points of what the features leave out.
    """

    mean: Floats
    basis: Floats
    responses: Integers
    outside: float
    leftover: Floats

    def features(self, values: Floats) -> Floats:
        """(n_points, n_features) of residuals (n_points, n_residuals)."""
        return np.asarray(values @ self.basis)


@dataclass(frozen=True, slots=True)
class Surrogate:
    """The residual's features as functions of the parameters.

    lower, upper: (n_parameters,), range that the inputs are scaled by; inputs: (n_points,
    n_parameters), scaled training points; powers: terms of the trend; trend: (n_terms, n_features);
    amplitudes: (n_features,); lengths: (n_features, n_parameters); pulls: (n_points, n_features),
    K^-1 of what the trend leaves; left_out: (n_points, n_features), errors with a point left out.
    """

    names: tuple[str, ...]
    reduction: FeatureReduction
    lower: Floats
    upper: Floats
    inputs: Floats
    powers: tuple[tuple[int, ...], ...]
    trend: Floats
    amplitudes: Floats
    lengths: Floats
    pulls: Floats
    left_out: Floats

    def features(self, points: Floats) -> Floats:
        """(n, n_features) at points (n, n_parameters), in standard deviations of the test."""
        parts = [
            self._features(points[first : first + TOGETHER])
            for first in range(0, points.shape[0], TOGETHER)
        ]
        return np.vstack(parts) if parts else np.zeros((0, self.amplitudes.size))

    def _features(self, points: Floats) -> Floats:
        inputs = scaled(points, self.lower, self.upper)
        found = trend_terms(inputs, self.powers) @ self.trend
        live = np.flatnonzero(self.amplitudes)
        if live.size == 0:
            return np.asarray(found)
        here = inputs[None] / self.lengths[live, None]
        there = self.inputs[None] / self.lengths[live, None]
        apart = (here**2).sum(2)[:, :, None] + (there**2).sum(2)[:, None, :]
        apart -= 2.0 * np.matmul(here, there.transpose(0, 2, 1))
        near = np.exp(-0.5 * np.maximum(apart, 0.0))
        pulled = np.matmul(near, self.pulls.T[live][:, :, None])[:, :, 0]
        found[:, live] += (self.amplitudes[live, None] * pulled).T
        return np.asarray(found)

    def misfits(self, points: Floats) -> Floats:
        """|w|^2 at points (n, n_parameters), (n,)."""
        return np.asarray((self.features(points) ** 2).sum(axis=1) + self.reduction.outside)

    def errors(self, rows: NDArray[np.bool_]) -> Floats:
        """Leave-one-out errors over these training points (n_points,), (n_responses,).

        Root mean squares, of the worst feature of each; in standard deviations of the test.
        """
        return worst_of(self.left_out[rows], self.reduction.responses, len(self.names))


def worst_of(errors: Floats, responses: Integers, count: int) -> Floats:
    """Root mean square over rows of errors (n, n_features), the worst feature of each response."""
    size = (
        np.sqrt((errors**2).mean(axis=0)) if errors.shape[0] else np.full(errors.shape[1], np.inf)
    )
    found = np.zeros(count)
    np.maximum.at(found, responses, size)
    return found


def scaled(points: Floats, lower: Floats, upper: Floats) -> Floats:
    """Points (n, n_parameters) with the range brought to [-1, 1]."""
    return np.asarray((2.0 * points - lower - upper) / (upper - lower))


def trend_terms(inputs: Floats, powers: Sequence[tuple[int, ...]]) -> Floats:
    """Products of inputs, (n, n_terms); each term names the inputs that it multiplies."""
    return np.stack([inputs[:, list(term)].prod(axis=1) for term in powers], axis=1)


def fit_surrogate(training: Training, lower: Floats, upper: Floats) -> Surrogate:
    """The surrogate through these solver runs, inputs scaled by this range.

    Raises CampaignError where there are too few runs for a linear trend.
    """
    n_points, n_parameters = training.points.shape
    if n_points < n_parameters + 3:
        raise CampaignError(
            f"{n_points} solver runs are too few to learn {n_parameters} parameters from; "
            "raise --points"
        )
    inputs = scaled(training.points, lower, upper)
    reduction = reduce_responses(training)
    features = reduction.features(training.values)
    powers = _trend_powers(n_points, n_parameters)
    terms = trend_terms(inputs, powers)
    fits = [_fit_feature(inputs, terms, y) for y in features.T]
    return Surrogate(
        names=training.names,
        reduction=reduction,
        lower=lower,
        upper=upper,
        inputs=inputs,
        powers=powers,
        trend=np.stack([fit.trend for fit in fits], axis=1),
        amplitudes=np.array([fit.amplitude for fit in fits]),
        lengths=np.stack([fit.lengths for fit in fits]),
        pulls=np.stack([fit.pulls for fit in fits], axis=1),
        left_out=np.stack([fit.left_out for fit in fits], axis=1),
    )


def reduce_responses(training: Training) -> FeatureReduction:
    """Directions in which the responses move over the training points, response by response."""
    mean = training.values.mean(axis=0)
    columns, owners, outside = [], [], 0.0
    leftover = np.zeros(len(training.names))
    for response in range(len(training.names)):
        entries = np.flatnonzero(training.responses == response)
        moves = training.values[:, entries] - mean[entries]
        _, sizes, directions = np.linalg.svd(moves, full_matrices=False)
        rest = np.sqrt(np.append(np.cumsum(sizes[::-1] ** 2)[::-1], 0.0) / moves.shape[0])
        keep = max(1, min(int(np.argmax(rest <= LEFTOVER)), MOST_DIRECTIONS))
        basis = directions[:keep].T
        still = mean[entries] - basis @ (basis.T @ mean[entries])
        outside += float(still @ still)
        leftover[response] = rest[keep]
        for column in basis.T:
            columns.append(np.zeros(mean.size))
            columns[-1][entries] = column
            owners.append(response)
    return FeatureReduction(mean, np.stack(columns, axis=1), np.array(owners), outside, leftover)


@dataclass(frozen=True, slots=True)
class _Fit:
    trend: Floats
    amplitude: float
    lengths: Floats
    pulls: Floats
    left_out: Floats


def _trend_powers(n_points: int, n_parameters: int) -> tuple[tuple[int, ...], ...]:
    """Terms of the trend: no more than half as many as there are points."""
    linear = ((), *((place,) for place in range(n_parameters)))
    squares = tuple((place, place) for place in range(n_parameters))
    products = tuple(combinations_with_replacement(range(n_parameters), 2))
    for more in (products, squares):
        if 2 * (len(linear) + len(more)) <= n_points:
            return linear + more
    return linear


def _fit_feature(inputs: Floats, terms: Floats, y: Floats) -> _Fit:
    n_points, n_parameters = inputs.shape
    rest = y - terms @ np.linalg.lstsq(terms, y, rcond=None)[0]
    size = float(np.sqrt((rest**2).mean()))
    if size < NOTHING_LEFT:
        trend, pulls, left_out = _kriged(np.eye(n_points), terms, y)
        return _Fit(trend, 0.0, np.ones(n_parameters), np.zeros(n_points), left_out)
    amplitude, lengths, nugget = _most_likely(inputs, rest / size)
    apart = inputs[:, None] / lengths - inputs[None] / lengths
    covariance = amplitude * np.exp(-0.5 * (apart**2).sum(axis=2)) + nugget * np.eye(n_points)
    trend, pulls, left_out = _kriged(covariance, terms, y)
    return _Fit(trend, amplitude, lengths, pulls, left_out)


def _most_likely(inputs: Floats, rest: Floats) -> tuple[float, Floats, float]:
    """Amplitude, lengths and nugget of greatest likelihood, from two starts."""
    n_parameters = inputs.shape[1]
    kernel = ConstantKernel(1.0, AMPLITUDES) * RBF(np.ones(n_parameters), LENGTHS) + WhiteKernel(
        1e-6, NUGGETS
    )
    process = GaussianProcessRegressor(kernel, alpha=1e-10, optimizer=None).fit(inputs, rest)

    def unlikeliness(logs: Floats) -> tuple[float, Floats]:
        value, slope = process.log_marginal_likelihood(logs, eval_gradient=True)
        if not np.isfinite(value):  # a covariance that cannot be factorised
            return 1e25, np.zeros_like(logs)
        return -float(value), -np.asarray(slope)

    best, found = np.inf, np.asarray(process.kernel_.theta)
    for amplitude, length in ((1.0, 0.7), (30.0, 3.0)):
        start = np.log([amplitude, *[length] * n_parameters, 1e-6])
        ended = minimize(
            unlikeliness,
            start,
            jac=True,
            method="L-BFGS-B",
            bounds=process.kernel_.bounds,
            options={"maxiter": 100},
        )
        if ended.fun < best:
            best, found = float(ended.fun), np.asarray(ended.x)
    return float(np.exp(found[0])), np.exp(found[1:-1]), float(np.exp(found[-1])) + 1e-10


def _kriged(covariance: Floats, terms: Floats, y: Floats) -> tuple[Floats, Floats, Floats]:
    """Trend by generalised least squares, K^-1 of its remainder, and leave-one-out errors."""
    try:
        factor = cho_factor(covariance, lower=True)
    except LinAlgError:
        raise CampaignError(
            "two training points are all but the same, so that nothing can be learned from them; "
            "take another --seed"
        ) from None
    inverse = cho_solve(factor, np.eye(y.size))
    weighted = inverse @ terms
    inner = np.linalg.pinv(terms.T @ weighted)
    trend = np.asarray(inner @ (weighted.T @ y), dtype=np.float64)
    pulls = np.asarray(inverse @ (y - terms @ trend), dtype=np.float64)
    bare = inverse - weighted @ inner @ weighted.T
    # A point that the trend alone passes through cannot be left out: that tells nothing of it.
    spare = np.maximum(np.diag(bare), 1e-12 * np.diag(inverse))
    return trend, pulls, np.asarray(bare @ y / spare, dtype=np.float64)
