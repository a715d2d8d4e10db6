"""Mean and covariance of a measurement that was repeated, where values are missing or wrong.

Repetitions x_k (k = 1..n) of m values are taken as normal. Where some are missing, mean and
covariance C are found by expectation and maximisation (Dempster, Laird and Rubin 1977): with o the
values that are there and u those that are not,

    x_u <- mean_u + C_uo C_oo^-1 (x_o - mean_o),

their own covariance C_uu - C_uo C_oo^-1 C_ou added to that of what was filled in. A wrong value
would draw both after itself, so a first round is made for Student's t of 3 degrees of freedom:
there a repetition weighs (3 + m_o) / (3 + d^2), d^2 = (x_o - mean_o)^T C_oo^-1 (x_o - mean_o)
(Little 1988; Lange, Little and Taylor 1989). What lies too far from that is left out, value by
value: of a repetition the value without which d^2 falls most, until what is left is nothing
unusual; the whole repetition, where less than half of it would be left. All others then give mean
and covariance, and the two are repeated until they agree.

A repetition is unusual where d^2 is beyond what one in a hundred sets of n good ones has anywhere:
a new normal vector has d^2 n (n - m) / ((n^2 - 1) m) ~ F(m, n - m) (Hotelling).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy
from numpy.typing import NDArray

from modetune.core.errors import ModesError
from modetune.core.modes import Floats

#: Share of sets of good repetitions in which one is called wrong.
FALSE = 0.01
#: Fewer repetitions do not tell which of them is wrong; nor do fewer than so many times the values.
LEAST, EACH = 10, 3
#: Degrees of freedom of Student's t; rounds; change of the mean, in deviations, that ends them.
STUDENT, ROUNDS, SAME = 3.0, 2000, 1e-9
#: What is added to variances of about 1: a value may never have changed.
NOTHING = 1e-12
#: The median of |x| of a standard normal variable, by which a deviation follows from it.
MEDIAN = 0.6744897501960817

Mask = NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class Scatter:
    """Mean (m,) and covariance (m, m) of one repetition; used: (n, m), values they are made of."""

    mean: Floats
    covariance: Floats
    used: Mask

    @property
    def deviations(self) -> Floats:
        """Standard deviations of one repetition, (m,)."""
        return np.asarray(np.sqrt(np.diag(self.covariance)))

    def expected(self, row: Floats, place: int) -> tuple[float, float]:
        """What the other values of a repetition (m,), NaN where missing, lead to expect of one, and
        how exactly."""
        there = np.isfinite(row)
        there[place] = False
        known, own = self.covariance[np.ix_(there, there)], self.covariance[place, there]
        factors = np.linalg.lstsq(known, own, rcond=None)[0]
        mean = self.mean[place] + factors @ (row - self.mean)[there]
        return float(mean), float(np.sqrt(max(self.covariance[place, place] - factors @ own, 0.0)))


def scatter_of(values: Floats) -> Scatter:
    """Mean and covariance of repetitions (n, m), NaN where missing.

    Raises ModesError where a value was measured less than twice, or nothing scatters.
    """
    seen = np.isfinite(values)
    n, m = values.shape
    if (seen.sum(axis=0) < 2).any():
        place = int(np.argmin(seen.sum(axis=0)))
        raise ModesError(f"column {place + 1} was measured {seen.sum(axis=0)[place]} times")
    middle = np.nanmedian(values, axis=0)
    away = np.where(seen, values - middle, np.nan)
    scale = np.nanmedian(np.abs(away), axis=0) / MEDIAN
    scale = np.where(scale > 0.0, scale, np.sqrt(np.nanmean(away**2, axis=0)))
    if not scale.any():
        raise ModesError("the repeated tests are the same; they tell nothing of what scatters")
    scale = np.where(scale > 0.0, scale, scale.max())
    x, used = away / scale, seen
    sought = n >= max(LEAST, EACH * m)
    if sought:
        mean, covariance = _fitted(x, STUDENT)
        used = _usual(x, mean, _consistent(x, mean, covariance))
    for _ in range(n):
        left = np.where(used, x, np.nan)
        mean, covariance = _fitted(left, np.inf)
        counted = int(used.any(axis=1).sum())
        covariance *= counted / (counted - 1)
        now = _usual(x, mean, covariance) if sought else used
        if (now == used).all():
            break
        used = now
    return Scatter(middle + scale * mean, covariance * np.outer(scale, scale), used)


def _fitted(x: Floats, student: float) -> tuple[Floats, Floats]:
    """Mean (m,) and covariance (m, m) of greatest likelihood of rows (n, m), NaN where missing.

    student: degrees of freedom, infinite for a normal distribution. Rows of NaN tell nothing.
    """
    seen = np.isfinite(x)
    x, seen = x[seen.any(axis=1)], seen[seen.any(axis=1)]
    n, m = x.shape
    # Few repetitions leave directions in which nothing scatters; there values are independent.
    ridge = 1.0 + (1e-9 if n > 2 * m else 1.0 / n) * np.eye(m)
    mean, covariance = np.nanmean(x, axis=0), np.diag(np.nanvar(x, axis=0))
    patterns, which = np.unique(seen, axis=0, return_inverse=True)
    for _ in range(ROUNDS):
        filled, own, weights = np.where(seen, x, mean), np.zeros((m, m)), np.ones(n)
        for number, there in enumerate(patterns):
            rows = np.flatnonzero(which.ravel() == number)
            known = (covariance * ridge + NOTHING * np.eye(m))[np.ix_(there, there)]
            across = covariance[np.ix_(there, ~there)]
            off = (x[rows][:, there] - mean[there]).T
            solved = np.linalg.solve(known, off)
            if np.isfinite(student):
                weights[rows] = (student + there.sum()) / (student + (off * solved).sum(axis=0))
            filled[np.ix_(rows, ~there)] = mean[~there] + (across.T @ solved).T
            left: Floats = covariance[np.ix_(~there, ~there)] - across.T @ np.linalg.solve(
                known, across
            )
            own[np.ix_(~there, ~there)] += rows.size * left
        before, mean = mean, weights @ filled / weights.sum()
        away = filled - mean
        last, covariance = covariance, (away.T @ (weights[:, None] * away) + own) / n
        sizes = np.sqrt(np.diag(covariance) + NOTHING)
        moved = np.abs(mean - before) / sizes
        if max(moved.max(), (np.abs(covariance - last) / np.outer(sizes, sizes)).max()) < SAME:
            break
    return mean, covariance


def _squares(x: Floats, mean: Floats, covariance: Floats) -> Floats:
    """Squared distances d^2 of rows, of the values that are there, (n,)."""
    found = np.zeros(len(x))
    for place, row in enumerate(x):
        there = np.isfinite(row)
        off = (row - mean)[there]
        found[place] = off @ np.linalg.solve(covariance[np.ix_(there, there)], off)
    return found


def _consistent(x: Floats, mean: Floats, covariance: Floats) -> Floats:
    """The covariance with which half of all rows are nearer than half of normal ones are."""
    counts = np.isfinite(x).sum(axis=1)
    there = counts > 0
    ratio = _squares(x, mean, covariance)[there] / scipy.special.chdtri(counts[there], 0.5)
    return np.asarray(covariance * np.median(ratio))


def _usual(x: Floats, mean: Floats, covariance: Floats) -> Mask:
    """Which values (n, m) are nothing unusual beside the others."""
    n, m = x.shape
    sizes = np.arange(1, m + 1)
    limits = np.zeros(m + 1)
    quantiles = scipy.special.fdtri(sizes, n - sizes, 1.0 - FALSE / n)
    limits[1:] = sizes * (n**2 - 1) / (n * (n - sizes)) * quantiles
    used = np.isfinite(x)
    for row, there in zip(x, used, strict=True):
        counted = int(there.sum())
        while there.any():
            inverse = np.linalg.inv(covariance[np.ix_(there, there)])
            pulled = inverse @ (row - mean)[there]
            if (row - mean)[there] @ pulled <= limits[there.sum()]:
                break
            worst = int(np.argmax(pulled**2 / np.diag(inverse)))  # what d^2 falls by without it
            there[np.flatnonzero(there)[worst]] = False
        if 2 * there.sum() < counted:
            there[:] = False
    return used
