"""Frequencies: z = (lambda_m - lambda_c) / lambda_m of a pair, derivative d lambda_c / lambda_m.

A relative frequency deviation s is 2 s of the eigenvalue. Where neither side separates the
frequencies of a cluster (`core/correlation/clusters`), each has the derivative of their mean.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from modetune.core.correlation.pairing import FINE
from modetune.core.modes import REPEATED, Floats, Integers, close_sets
from modetune.core.updating.responses.response import (
    ModelState,
    Need,
    Residual,
    StateDerivatives,
    residual_of,
)


@dataclass(frozen=True, slots=True)
class Frequencies:
    """Relative eigenvalue differences; tolerance: e1's relative frequency error."""

    tolerance: float = np.inf
    kind: ClassVar[str] = "frequencies"
    needs: ClassVar[frozenset[Need]] = frozenset()

    def residual(self, state: ModelState) -> Residual:
        measured, computed = state.pairing.measured, state.pairing.computed
        own = state.weighting.modes(measured)
        lam_m = state.test.modes.eigenvalues[measured]
        names = [f"frequency of mode {number}" for number in state.numbers]
        values = (lam_m - state.seen.eigenvalues[computed]) / lam_m
        noise = 4.0 * own.frequency_covariance
        return residual_of(self.kind, names, None, values, own.frequency_weights, noise)

    def sensitivity(self, state: ModelState, derivatives: StateDerivatives) -> Floats:
        return self.slopes(state, derivatives.modes.eigenvalues)

    def slopes(self, state: ModelState, eigenvalues: Floats) -> Floats:
        """Return the sensitivity by derivatives of the pairs' eigenvalues (n_pairs, n_columns)."""
        slopes = eigenvalues / state.test.modes.eigenvalues[state.pairing.measured][:, None]
        for alike in _unsplit(state):
            slopes[alike] = slopes[alike].mean(axis=0)
        return np.asarray(slopes)

    def agrees(self, part: Residual) -> bool:
        # z is of eigenvalues: twice the frequency's
        errors = part.of_used(self.kind, 0.5 * part.values)
        return bool((np.abs(errors) <= self.tolerance).all())


def _unsplit(state: ModelState) -> list[Integers]:
    """Return pairs whose frequencies neither side separates: only their mean has a slope."""
    measured = state.pairing.measured
    test_hz = state.test.modes.frequencies_hz[measured]
    model_hz = state.seen.frequencies_hz[state.pairing.computed]
    return [
        alike[members]
        for alike in close_sets(test_hz, FINE * state.weighting.frequency_deviations[measured])
        if alike.size > 1
        for members in close_sets(model_hz[alike], 0.5 * REPEATED)
        if members.size > 1
    ]
