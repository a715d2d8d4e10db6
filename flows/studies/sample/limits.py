"""Limits of responses, as of a mass: where a posterior ends beside its range.

Rows of the residual that have limits are learned as the others are, by a spline through the sets
that were solved. Mass properties are polynomials of moduli and densities of a low order, so this is
as good as exact; rows that have limits alone take no part in the density itself.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from modetune.core.modes import Floats
from modetune.flows.studies.sample.surrogate import Surrogate, Training, fit_surrogate
from modetune.flows.updating.evaluation import Evaluation

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
    sets = known[:MOST]
    values = [item.residual.values[np.isfinite(item.residual.limits).any(axis=1)] for item in sets]
    spans = np.ptp(values, axis=0)
    units = UNIT * np.where(spans > 0.0, spans, 1.0)
    points, numbers = np.array([item.theta for item in sets]), np.arange(units.size)
    rows = fit_surrogate(Training(points, values / units, numbers, tuple(names)), lower, upper)
    return ResponseLimits(rows, ends[held] / units[:, None], tuple(names))
