"""Local minima of a misfit: polish them, leave saddles, separate or join them, find exchanges.

The misfit F(x) is a chi-square with the prior, x are logarithms of the parameters, and an
evaluation takes milliseconds (a surrogate). Where F cannot be evaluated (a lost mode) it is
infinite.

**Polishing.** A Levenberg-Marquardt iteration within the bounds: with g the gradient and A the
Gauss-Newton matrix, d = -(A + a diag A)^-1 g on the free parameters, and a falls or rises tenfold.
A parameter is free unless the gradient pushes it against its bound.

**Saddles.** A is never negative, so only the full Hessian H distinguishes a minimum from a saddle.
It follows from central differences of g along the softest directions of A, where second-order terms
of the residual outweigh A first. Along a direction v of negative curvature F falls on both sides,
F(x + t v) = F(x) + t^2 v^T H v / 2 + ...; the lowest of a few points on each side starts a new
search. On the ridge of a symmetric structure these lead to both mirrored minima.

**One minimum or two.** Two points belong to one minimum if a path joins them on which F rises by at
most `RISE` above the higher one. The path starts as the straight line. Where F is too high there,
points move by Gauss-Newton steps perpendicular to the line (a string method: E, Ren and
Vanden-Eijnden 2002), which follows curved valleys, such as that of two springs in series. RISE is
the chi-square of one degree of freedom at 1 %.

**Exchanges.** Parts that can be exchanged give minima whose values are permutations of each other,
with the same misfit. Permutations found once are composed until no new one has this misfit.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import combinations, pairwise
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from modetune.core.modes import Floats, Integers

#: Rise of the misfit between two points of one minimum: chi-square, 1 degree of freedom, 1 %.
RISE = 6.6
#: Points of a path, its ends included.
PATH = 11
#: Steps of a path's point towards lower misfit.
RELAXATIONS = 8
#: Iterations of polishing, and the expected decrease of the misfit that ends it, also as a share.
POLISHINGS, GAIN, SHARE = 40, 1e-8, 1e-5
#: Curvature of the misfit by which a direction counts as undetermined: a change by a factor e moves
#: the misfit by less than this, which is negligible compared with RISE.
FLAT = 1e-3
#: Step of the differences of the gradient, a relative change: far above rounding of the gradient,
#: far below the changes by which curvature varies.
DIFFERENCE = 1e-3
#: Directions, the softest ones, in which curvature is computed.
SOFTEST = 24
#: A negative curvature below this share of the largest one computed is an error of differences,
#: which are good to DIFFERENCE^2.
NEGATIVE = 1e-5
#: Lengths of kicks, relative changes of the parameters.
KICKS = (0.01, 0.03, 0.1, 0.2, 0.4)
#: Logarithms of parameters that differ by less are the same.
SAME = 1e-3
#: Steps up to this length are predicted well by the misfit's slope and curvature.
SHORT = 0.02
#: Two misfits differ by rounding and by the ends of polishing alone, absolute and relative.
EQUAL, EQUAL_SHARE = 1e-3, 1e-4
#: Points that are tested for exchanges, and parameters up to which all pairs are.
TESTED, MOST_FOR_PAIRS = 300, 20


@dataclass(frozen=True, slots=True)
class MisfitAt:
    """The misfit at a point: its value, gradient (n,), and Gauss-Newton matrix (n, n)."""

    value: float
    gradient: Floats
    curvature: Floats


@dataclass(frozen=True, slots=True)
class SearchEnds:
    """The ends of searches from several starts.

    starts, updated: (n_ends, n_parameters), NaN where a search began at another end, or failed.
    misfits: (n_ends,). outcomes: how each ended. labels: (n_ends,), the numbers of their minima in
    order of misfit, -1 for none. n_starts: number of ends that belong to starts, the first ones.
    chosen: the best end. moves: whether it differs from that of the first start.
    """

    starts: Floats
    updated: Floats
    misfits: Floats
    outcomes: tuple[str, ...]
    labels: Integers
    n_starts: int
    chosen: int
    moves: bool


NO_ENDS = SearchEnds(
    np.zeros((0, 0)), np.zeros((0, 0)), np.zeros(0), (), np.zeros(0, dtype=np.int64), 0, 0, False
)


class Misfit(Protocol):
    """A misfit as a function of log parameters (n,) within lower and upper bounds (n,)."""

    lower: Floats
    upper: Floats

    def value(self, x: Floats) -> float:
        """Return the misfit, infinite where the model cannot be compared with the test."""
        ...

    def sample(self, x: Floats) -> MisfitAt | None:
        """Return the misfit with its derivatives, None where it is infinite."""
        ...


def free(misfit: Misfit, x: Floats, gradient: Floats) -> NDArray[np.bool_]:
    """Return which parameters (n,) no bound holds against the gradient."""
    low = (x <= misfit.lower + 1e-9) & (gradient > 0.0)
    high = (x >= misfit.upper - 1e-9) & (gradient < 0.0)
    return ~(low | high)


def polished(
    misfit: Misfit, x: Floats, known: tuple[Floats, float] | None = None
) -> tuple[Floats, float]:
    """Return the minimum near a point, (n,), and the misfit there; it is never above the start.

    known: a minimum (n,) and its misfit. If a short step leads to it, and predicts its misfit, it
    is the one.
    """
    x = np.clip(x, misfit.lower, misfit.upper)
    here, damping = misfit.sample(x), 1e-4
    if here is None:
        return x, np.inf
    for _ in range(POLISHINGS):
        step = _damped_step(misfit, x, here, damping)
        if _decrease(here, step) <= GAIN + SHARE * here.value:
            break
        if known is not None and _leads_to(known, x, step, here):
            return known
        there = misfit.sample(x + step)
        if there is not None and there.value < here.value:
            x, here, damping = x + step, there, max(0.1 * damping, 1e-12)
        elif damping > 1e6:
            break
        else:
            damping *= 10.0
    return x, here.value


def _damped_step(misfit: Misfit, x: Floats, here: MisfitAt, damping: float) -> Floats:
    """Return the Levenberg-Marquardt step within the bounds, (n,)."""
    chosen, step = free(misfit, x, here.gradient), np.zeros(x.size)
    for _ in range(x.size):
        square = here.curvature[np.ix_(chosen, chosen)]
        square = square + np.diag(damping * np.diag(square) + FLAT)
        held = here.gradient[chosen] + here.curvature[np.ix_(chosen, ~chosen)] @ step[~chosen]
        step[chosen] = -np.linalg.solve(square, held)
        beyond = chosen & ((x + step < misfit.lower) | (x + step > misfit.upper))
        if not beyond.any():
            break
        step = np.clip(x + step, misfit.lower, misfit.upper) - x
        chosen = chosen & ~beyond
    return step


def _leads_to(known: tuple[Floats, float], x: Floats, step: Floats, here: MisfitAt) -> bool:
    """Return whether a step from a point is short and leads to a known minimum."""
    place, value = known
    if np.abs(step).max() > SHORT or np.abs(x + step - place).max() > SAME:
        return False
    return value <= here.value and equal(value, here.value - _decrease(here, step))


def _decrease(here: MisfitAt, step: Floats) -> float:
    return float(-here.gradient @ step - 0.5 * step @ here.curvature @ step)


def negative_curvature(misfit: Misfit, x: Floats) -> Floats | None:
    """Return the direction (n,) of the most negative curvature at a stationary point, or None."""
    here = misfit.sample(x)
    if here is None:
        return None
    inside = np.flatnonzero(free(misfit, x, here.gradient))
    _, vectors = np.linalg.eigh(here.curvature[np.ix_(inside, inside)])
    directions = np.zeros((x.size, min(SOFTEST, inside.size)))
    directions[inside] = vectors[:, :SOFTEST]
    slopes = []
    for direction in directions.T:
        ends = [misfit.sample(x + sign * DIFFERENCE * direction) for sign in (1.0, -1.0)]
        if ends[0] is None or ends[1] is None:
            return None
        slopes.append((ends[0].gradient - ends[1].gradient) / (2.0 * DIFFERENCE))
    if not slopes:
        return None
    hessian = directions.T @ np.array(slopes).T
    curvatures, combined = np.linalg.eigh(0.5 * (hessian + hessian.T))
    if curvatures[0] >= -max(FLAT, NEGATIVE * float(np.abs(curvatures).max())):
        return None
    return np.asarray(directions @ combined[:, 0])


def beyond_saddle(misfit: Misfit, x: Floats) -> list[Floats]:
    """Return the lowest of a few points on each side of a saddle; none at a minimum."""
    direction = negative_curvature(misfit, x)
    if direction is None:
        return []
    here, found = misfit.value(x), []
    unit = direction / np.abs(direction).max()
    for sign in (1.0, -1.0):
        points = [np.clip(x + sign * length * unit, misfit.lower, misfit.upper) for length in KICKS]
        values = [misfit.value(point) for point in points]
        lowest = int(np.argmin(values))
        if values[lowest] < here:
            found.append(points[lowest])
    return found


def joined(misfit: Misfit, a: Floats, b: Floats) -> bool:
    """Return whether two points (n,) belong to one minimum."""
    return path_within(misfit, a, b, max(misfit.value(a), misfit.value(b)) + RISE)


def path_within(misfit: Misfit, a: Floats, b: Floats, limit: float) -> bool:
    """Return whether a path from a to b stays at or below a misfit."""
    shares = np.linspace(0.0, 1.0, PATH)[1:-1]
    line = [a + share * (b - a) for share in shares]
    values = [misfit.value(point) for point in line]
    if max(values) <= limit:
        return True
    if a.size == 1:
        return False
    # The highest points first: one that cannot be lowered is enough for two minima.
    for place in np.argsort(values)[::-1].tolist():
        if values[place] > limit:
            lowered = _lowered(misfit, line[place], b - a, limit)
            if lowered is None:
                return False
            line[place] = lowered
    whole = [a, *line, b]
    between = [0.5 * (one + other) for one, other in pairwise(whole)]
    for point in between:
        if misfit.value(point) > limit and _lowered(misfit, point, b - a, limit) is None:
            return False
    return True


def _lowered(misfit: Misfit, x: Floats, along: Floats, limit: float) -> Floats | None:
    """Return a point at or below a misfit, reached perpendicular to a direction; None without."""
    across = np.linalg.svd(along[None])[2][1:].T
    here, damping = misfit.sample(x), 1e-3
    for _ in range(RELAXATIONS):
        if here is None or here.value <= limit:
            break
        square = across.T @ here.curvature @ across
        square = square + np.diag(damping * np.diag(square) + FLAT)
        step = -across @ np.linalg.solve(square, across.T @ here.gradient)
        there = misfit.sample(np.clip(x + step, misfit.lower, misfit.upper))
        if there is None or there.value >= here.value:
            damping *= 100.0
            continue
        if here.value - there.value < 0.01 * (here.value - limit):
            return None
        x, here, damping = np.clip(x + step, misfit.lower, misfit.upper), there, 0.1 * damping
    return x if here is not None and here.value <= limit else None


def minima_of(
    points: Sequence[Floats], values: Floats, one: Callable[[int, int], bool], nearest: int = 3
) -> Integers:
    """Return the number of each point's minimum (n_points,), -1 where its value is not finite.

    values: (n_points,), misfits; one: whether two points belong to one minimum. Minima are numbered
    by their misfit. Each point is compared with the lowest points of the `nearest` minima, so that
    a high point between two minima does not join them.
    """
    labels = np.full(len(points), -1, dtype=np.int64)
    lowest: list[int] = []
    for place in np.argsort(values, kind="stable").tolist():
        if not np.isfinite(values[place]):
            break
        away = [float(np.abs(points[place] - points[low]).max()) for low in lowest]
        for number in np.argsort(away, kind="stable")[:nearest].tolist():
            if away[number] <= SAME or one(lowest[number], place):
                labels[place] = number
                break
        else:
            labels[place] = len(lowest)
            lowest.append(place)
    return labels


def equal(one: float, other: float) -> bool:
    """Return whether two misfits differ by rounding alone."""
    return abs(one - other) <= EQUAL + EQUAL_SHARE * abs(one)


def exchange(one: Floats, other: Floats, tolerance: float = 0.01) -> Integers | None:
    """Return the permutation p (n,) with other = one[p], None where values differ otherwise."""
    if np.abs(np.sort(one) - np.sort(other)).max(initial=0.0) > tolerance:
        return None
    ranks = np.argsort(np.argsort(other, kind="stable"), kind="stable")
    return np.asarray(np.argsort(one, kind="stable")[ranks])


def exchanges(misfit: Misfit, x: Floats, known: Sequence[Integers] = ()) -> list[Floats]:
    """Return the points with the misfit of x and its values in another order.

    known: permutations that have it. They and all exchanges of two values are composed. Of values
    that differ by less than `SAME` the order is the same.
    """
    here, generators = misfit.value(x), list(known)
    tested = {_mark(x)}
    if x.size <= MOST_FOR_PAIRS:
        for one, other in combinations(range(x.size), 2):
            order = np.arange(x.size)
            order[[one, other]] = other, one
            if equal_at(misfit, x[order], here, tested):
                generators.append(order)
    found = [x]
    tested = {_mark(x)}
    for point in found:  # grows
        for order in generators:
            if equal_at(misfit, point[order], here, tested):
                found.append(point[order])
    return found[1:]


def equal_at(misfit: Misfit, x: Floats, value: float, tested: set[bytes]) -> bool:
    """Return whether the misfit at a point not yet tested is this one; it joins those tested."""
    mark = _mark(x)
    if mark in tested or len(tested) > TESTED:
        return False
    tested.add(mark)
    inside = (x >= misfit.lower).all() and (x <= misfit.upper).all()
    return bool(inside and equal(value, misfit.value(x)))


def _mark(x: Floats) -> bytes:
    return bytes(np.round(x / SAME).astype(np.int64).tobytes())
