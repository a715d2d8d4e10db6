"""A surrogate of the residual: a spline through sets that were solved for.

The residual is taken in standard deviations of the test, w = (measured - computed) / sigma, so that
every error below is in that unit and the misfit of a parameter set is |w|^2. With the inputs x
scaled to [-1, 1] over the range, each entry of w is a polyharmonic spline (Duchon 1977; Wendland
2005, 8.4) of an order m:

    w(x) = sum_i c_i phi(|x - x_i|) + p(x),   phi(r) = (-1)^(m + 1) r^(2 m + 1),

p a polynomial of degree m, and sum_i c_i q(x_i) = 0 for all of these. It goes through all points
and has no lengths to be found; between points that lie close together it is as exact as they are
close, and so where a posterior is. All entries share one matrix A of the points, so that c = B w
with B the first block of the inverse of [A P; P^T 0]. Leaving out point i misses it by (Rippa 1999)

    e_i = (B w)_i / B_ii,

and the order taken is the one that misses least of the points of largest density. Entries span few
directions V (singular value decomposition over the points); w V is enough, as |w V| = |w|.

Rows of the residual that have limits, as of a mass, end a posterior inside its range. They are
learned in the same way. Mass properties are polynomials of moduli and densities of a low order, so
this is as good as exact; rows with limits alone take no part in the density itself.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cache
from itertools import combinations_with_replacement

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.distance import cdist

from modetune.core.errors import CampaignError
from modetune.core.modes import Floats, Integers
from modetune.flows.updating.evaluation import Evaluation

#: Orders of splines, and points that each term of their polynomials takes.
ORDERS, POINTS_EACH = (1, 2, 3), 1.5
#: Singular values below this share of a standard deviation, root mean square, move nothing.
NOTHING = 1e-4
#: Parameter sets that are predicted at once: what that takes of memory stays small.
TOGETHER = 1024


@dataclass(frozen=True, slots=True)
class Training:
    """Sets that a surrogate learns from.

    points: (n_points, n_parameters); values: (n_points, n_residuals), in standard deviations of the
    test; responses: (n_residuals,), which response each entry is of; names: of the responses.
    """

    points: Floats
    values: Floats
    responses: Integers
    names: tuple[str, ...]

    def plus(self, other: Training) -> Training:
        """With the points of another one."""
        return replace(
            self,
            points=np.vstack([self.points, other.points]),
            values=np.vstack([self.values, other.values]),
        )

    def some(self, places: Integers) -> Training:
        """With some of the points only."""
        return replace(self, points=self.points[places], values=self.values[places])

    def sizes(self, errors: Floats) -> Floats:
        """Root mean squares (n_responses,) over rows of errors (n, n_residuals): of a shape, of the
        length of what is missed of it. Infinite where there are no rows."""
        squares = (errors**2).mean(axis=0) if len(errors) else np.full(errors.shape[1], np.inf)
        return np.sqrt(np.bincount(self.responses, squares, len(self.names)))


@dataclass(frozen=True, slots=True)
class Surrogate:
    """The residual as a function of the parameters.

    lower, upper: (n_parameters,), range that the inputs are scaled by; inputs: (n_points,
    n_parameters), scaled; order: of the spline; factors: (n_points + n_terms, n_features); basis:
    (n_residuals, n_features), orthonormal; left_out: (n_points, n_residuals), errors with a point
    left out.
    """

    lower: Floats
    upper: Floats
    inputs: Floats
    order: int
    factors: Floats
    basis: Floats
    left_out: Floats

    def features(self, points: Floats) -> Floats:
        """(n, n_features) at points (n, n_parameters), in standard deviations of the test."""
        found = np.empty((len(points), self.basis.shape[1]))
        for first in range(0, len(points), TOGETHER):
            some = slice(first, first + TOGETHER)
            inputs = scaled(points[some], self.lower, self.upper)
            found[some] = _functions(inputs, self.inputs, self.order) @ self.factors
        return found

    def residuals(self, points: Floats) -> Floats:
        """(n, n_residuals) at points (n, n_parameters)."""
        return np.asarray(self.features(points) @ self.basis.T)


def scaled(points: Floats, lower: Floats, upper: Floats) -> Floats:
    """Points (n, n_parameters) with the range brought to [-1, 1]."""
    return np.asarray((2.0 * points - lower - upper) / (upper - lower))


def fit_surrogate(training: Training, lower: Floats, upper: Floats) -> Surrogate:
    """The surrogate through these sets, inputs scaled by this range.

    Raises CampaignError where there are too few of them for a linear trend.
    """
    n_points, n_parameters = training.points.shape
    if n_points < n_parameters + 3:
        raise CampaignError(
            f"{n_points} solver runs are too few to learn {n_parameters} parameters from; "
            "raise --points"
        )
    inputs = scaled(training.points, lower, upper)
    # A half of the points, those that fit the test best: where the posterior is, sooner or later.
    best = np.argsort((training.values**2).sum(axis=1))[: (n_points + 1) // 2]
    least, taken = np.inf, None
    for order in ORDERS:
        if order > ORDERS[0] and POINTS_EACH * len(_terms(n_parameters, order)) > n_points:
            break
        factors, left_out = _fit(inputs, training.values, order)
        error = float((left_out[best] ** 2).mean())
        if error < least:
            least, taken = error, (order, factors, left_out)
    if taken is None:
        raise CampaignError(
            "two training points are all but the same, so that nothing can be learned from them; "
            "take another --seed"
        )
    order, factors, left_out = taken
    _, sizes, directions = np.linalg.svd(training.values, full_matrices=False)
    basis = directions[sizes > NOTHING * np.sqrt(n_points)].T
    return Surrogate(lower, upper, inputs, order, factors @ basis, basis, left_out)


@cache
def _terms(n_parameters: int, order: int) -> Integers:
    """Products of inputs up to a degree, (n_terms, order), by the inputs that each multiplies,
    counted from one; 0 is the number one."""
    return np.array(list(combinations_with_replacement(range(n_parameters + 1), order)))


def _functions(inputs: Floats, points: Floats, order: int) -> Floats:
    """What a spline of this order is the sum of, at inputs, (n, n_points + n_terms)."""
    radial = (-1.0) ** (order + 1) * cdist(inputs, points) ** (2 * order + 1)
    factors = np.hstack([np.ones((len(inputs), 1)), inputs])[:, _terms(points.shape[1], order)]
    return np.hstack([radial, factors.prod(axis=2)])


def _fit(inputs: Floats, values: Floats, order: int) -> tuple[Floats, Floats]:
    """Factors (n_points + n_terms, n_residuals) of a spline's functions, and errors (n_points,
    n_residuals) with a point left out; infinite if the points do not determine all terms."""
    n_points = len(inputs)
    functions = _functions(inputs, inputs, order)
    whole = np.zeros((functions.shape[1],) * 2)
    whole[:n_points], whole[n_points:, :n_points] = functions, functions[:, n_points:].T
    with suppress(np.linalg.LinAlgError):
        found = np.linalg.solve(whole, np.pad(values, ((0, len(whole) - n_points), (0, 0))))
        own = np.diag(np.linalg.inv(whole))[:n_points, None]
        # Points close together distinguish terms of high order by their last digits only:
        # then the spline does not go through them.
        beside = values - functions @ found
        if np.isfinite(found).all() and own.all():
            return found, found[:n_points] / own + beside
    return np.zeros((len(whole), values.shape[1])), np.full(values.shape, np.inf)


def density_error(values: Floats, missed: Floats) -> float:
    """Return the error of the differences of log densities, of 95 % of some points.

    values, missed: (n, n_residuals), true ones and what is missed of them, true less foreseen.
    """
    off = 0.5 * ((values - missed) ** 2 - values**2).sum(axis=1)
    return float(np.quantile(np.abs(off - np.median(off)), 0.95)) if off.size else np.inf


#: Rows are learned in so small a part of what they span over the sets: all digits of them count.
UNIT = 1e-6
#: Sets that are learned from at most.
MOST = 400


@dataclass(frozen=True, slots=True)
class ResponseLimits:
    """rows: the residual's rows that have limits, in UNIT of what they span; ends: (n_rows, 2), in
    the same; names: of the rows, for people."""

    rows: Surrogate
    ends: Floats
    names: tuple[str, ...]

    def breach(self, points: Floats, inside: float = 0.0) -> Floats:
        """How far rows are beyond their limits, or what is so far inside of them, (n, n_rows), at
        points (n, n_parameters): shares of what they span over the sets."""
        values = self.rows.residuals(points)
        low, high = UNIT * (self.ends[:, 0] - values), UNIT * (values - self.ends[:, 1])
        return np.asarray(np.maximum(0.0, np.maximum(low, high) + inside))

    def hold(self, points: Floats) -> NDArray[np.bool_]:
        """Whether points keep all of them, (n,)."""
        return np.asarray(~self.breach(points).any(axis=1))


def limits_of(known: Sequence[Evaluation], lower: Floats, upper: Floats) -> ResponseLimits | None:
    """The limits of a campaign from sets that were solved; None where it has none.

    lower, upper: (n_parameters,), of the range.
    """
    ends = known[0].residual.limits
    held = np.isfinite(ends).any(axis=1)
    if not held.any():
        return None
    names = [name for name, has in zip(known[0].residual.labels, held.tolist(), strict=True) if has]
    sets = list({item.theta.tobytes(): item for item in known}.values())[:MOST]  # each once
    values = [item.residual.values[np.isfinite(item.residual.limits).any(axis=1)] for item in sets]
    spans = np.ptp(values, axis=0)
    units = UNIT * np.where(spans > 0.0, spans, 1.0)
    points, numbers = np.array([item.theta for item in sets]), np.arange(units.size)
    rows = fit_surrogate(Training(points, values / units, numbers, tuple(names)), lower, upper)
    return ResponseLimits(rows, ends[held] / units[:, None], tuple(names))
