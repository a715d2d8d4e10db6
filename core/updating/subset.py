"""Choosing parameters: columns of a sensitivity with an effect that the others do not have.

All functions take the weighted sensitivity S: rows divided by the standard deviations of the
measurements, columns multiplied by those of the parameters beforehand, so that an entry is how
many standard deviations of a measurement one standard deviation of a parameter moves it. A column
of zeros is a parameter that the measurements do not see.

Three questions, three answers:

* Which columns are most independent of each other? QR with column pivoting, S P = Q R, takes at
  each turn the column with the longest part outside the span of those before; |R_ii| is the length
  of that part (Golub and Van Loan 2013, 5.4.2; for parameters of models Velez-Reyes and
  Verghese 1995).
* Which few columns explain the residual? Forward selection takes at each turn the column that
  lowers the sum of squares most, together with those before (Lallement and Piranda 1990; Friswell,
  Mottershead and Ahmadian 1998), by changes that the parameters' bounds allow.
* Which columns say the same? Those whose angle is small: |cos| of at least a threshold, directly
  or through others. In a group of like columns at most one parameter can be found.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy import linalg
from scipy.sparse.csgraph import connected_components

from modetune.core.errors import CampaignError
from modetune.core.modes import Floats, Integers
from modetune.core.updating.parameter_steps import RANK_TOLERANCE, least_squares_in

#: Columns whose |cosine| reaches this count as saying the same; an angle of 18 degrees.
COLLINEAR = 0.95
#: A column that explains less than this share of the first misfit ends forward selection.
LEAST_GAIN = 0.01


@dataclass(frozen=True, slots=True)
class QrOrder:
    """Columns, the one that adds most first.

    order: (n_parameters,), positions of columns. added: (n_parameters,), in that order, length of
    what a column adds to those before it. shares: the same as share of the column's own length:
    1 is orthogonal to all before, 0 adds nothing. rank: how many columns add anything.
    """

    order: Integers
    added: Floats
    shares: Floats
    rank: int


def qr_order(sensitivity: Floats) -> QrOrder:
    """Columns in the order of QR with pivoting. Raises CampaignError.

    sensitivity: (n_residuals, n_parameters), weighted.
    """
    _check(sensitivity)
    lengths = np.linalg.norm(sensitivity, axis=0)
    triangle, order = linalg.qr(sensitivity, mode="r", pivoting=True)
    added = np.zeros(lengths.size)
    diagonal = np.abs(np.diag(triangle))
    added[: diagonal.size] = diagonal
    # Rounding leaves parts of columns that add nothing.
    added[added <= RANK_TOLERANCE * added.max(initial=0.0)] = 0.0
    own = lengths[order]
    shares = np.divide(added, own, out=np.zeros_like(own), where=own > 0.0)
    return QrOrder(np.asarray(order, dtype=np.int64), added, shares, int(np.sum(added > 0.0)))


def forward_selection(
    sensitivity: Floats,
    residual: Floats,
    least_gain: float = LEAST_GAIN,
    most: int | None = None,
    lower: ArrayLike = -np.inf,
    upper: ArrayLike = np.inf,
) -> tuple[Integers, Floats]:
    """Return the columns that explain the residual, until the next would explain too little.

    These are their positions (n_chosen,), the one that explains most first, and the sum of squares
    (n_chosen + 1,) that is left before the first and after each.

    sensitivity: (n_residuals, n_parameters), residual: (n_residuals,), both weighted; least_gain:
    share of the first misfit that a column must explain; most: how many are chosen at most;
    lower, upper: (n_parameters,), how far each may move, in the columns' units, 0 between them: a
    weak column explains only what a change that is allowed explains.
    Raises CampaignError.
    """
    _check(sensitivity)
    if residual.shape != sensitivity.shape[:1] or not np.isfinite(residual).all():
        raise CampaignError(f"the residual must have {sensitivity.shape[0]} finite entries")
    n = sensitivity.shape[1]
    bounds = np.broadcast_to(lower, n), np.broadcast_to(upper, n)
    # Q of [S, z] leaves all lengths and angles as they are, in at most n + 1 rows.
    small = np.asarray(np.linalg.qr(np.column_stack([sensitivity, residual]), mode="r"))
    columns, target = small[:, :n], small[:, n]
    chosen: list[int] = []
    misfits = [float(target @ target)]
    limit = min(most if most is not None else n, n, sensitivity.shape[0])
    while len(chosen) < limit and misfits[-1] > 0.0:
        others = [place for place in range(n) if place not in chosen]
        left = [_misfit(columns, target, [*chosen, other], bounds) for other in others]
        best = int(np.argmin(left))
        gain = misfits[-1] - left[best]
        if gain < least_gain * misfits[0] or gain <= 1e-14 * misfits[0]:
            break
        misfits.append(left[best])
        chosen.append(others[best])
    return np.array(chosen, dtype=np.int64), np.array(misfits)


def _misfit(
    columns: Floats, target: Floats, chosen: list[int], bounds: tuple[Floats, Floats]
) -> float:
    """Sum of squares that the best allowed combination of these columns leaves."""
    low, high = (bound[chosen] for bound in bounds)
    picked = columns[:, chosen]
    left = target - picked @ np.linalg.lstsq(picked, target, rcond=RANK_TOLERANCE)[0]
    if np.isfinite([*low, *high]).any():
        left = target - picked @ least_squares_in(low, high, picked, target)
    return float(left @ left)


def column_cosines(sensitivity: Floats) -> Floats:
    """Cosines between columns, (n_parameters, n_parameters); of a column of zeros they are 0.

    sensitivity: (n_residuals, n_parameters), weighted.
    """
    lengths = np.linalg.norm(sensitivity, axis=0)
    units = sensitivity / np.where(lengths > 0.0, lengths, 1.0)
    return np.asarray(np.clip(units.T @ units, -1.0, 1.0))


def collinear_groups(
    sensitivity: Floats, threshold: float = COLLINEAR
) -> tuple[tuple[int, ...], ...]:
    """Return the positions of columns with the same effect, by their first; singles are none.

    sensitivity: (n_residuals, n_parameters), weighted; threshold: least |cosine| of two like
    columns. Raises CampaignError.
    """
    _check(sensitivity)
    if not 0.0 < threshold <= 1.0:
        raise CampaignError(f"the threshold of collinear columns is in (0, 1], not {threshold:g}")
    # 1e-12: the cosine of two equal columns misses 1 by rounding.
    alike = np.abs(column_cosines(sensitivity)) >= threshold - 1e-12
    _, labels = connected_components(alike, directed=False)
    groups = (np.flatnonzero(labels == label) for label in dict.fromkeys(labels.tolist()))
    return tuple(tuple(members.tolist()) for members in groups if members.size > 1)


def _check(sensitivity: Floats) -> None:
    if sensitivity.ndim != 2 or 0 in sensitivity.shape:
        raise CampaignError(f"a sensitivity has rows and columns, not shape {sensitivity.shape}")
    if not np.isfinite(sensitivity).all():
        raise CampaignError("the sensitivity must be finite")
