"""Modal damping ratios: z = zeta_m - zeta_c of each pair, zeta_c by the quadratic problem.

Values and exact derivatives come from `core/algebra/damped_modes`, which starts from the real modes
of K and M; `core/updating/damped_pairs` follows each real mode to its damped mode.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np

from modetune.core.algebra.damped_modes import ALIKE, ratio_slope
from modetune.core.modes import Floats
from modetune.core.updating.damped_pairs import DampedPairs
from modetune.core.updating.responses.response import (
    ModelState,
    Need,
    Residual,
    StateDerivatives,
    residual_of,
)


@dataclass(frozen=True, slots=True)
class DampingRatios:
    """Modal damping ratios of the pairs.

    weights: by the number of the test's mode, 0 where its ratio is not above 0. deviation,
    tolerance: relative to the measured ratio. covariance: (n_modes, n_modes), of the test's mean
    ratios; (0, 0) where the deviation is used instead.
    """

    weights: Mapping[int, float]
    deviation: float
    tolerance: float
    pairs: DampedPairs
    covariance: Floats = field(default_factory=lambda: np.zeros((0, 0)))
    kind: ClassVar[str] = "damping"
    needs: ClassVar[frozenset[Need]] = frozenset({"matrices", "losses"})

    def residual(self, state: ModelState) -> Residual:
        pairs = state.pairing.measured
        measured = state.test.modes.damping_ratios[pairs]
        return residual_of(
            self.kind,
            [f"damping of mode {number}" for number in state.numbers],
            None,
            measured - self.pairs.of(state).modes.damping_ratios,
            np.array([self.weights[number] for number in state.numbers]),
            self.covariance[np.ix_(pairs, pairs)]
            if self.covariance.size
            else (self.deviation * np.where(measured > 0.0, measured, 1.0)) ** 2,
            measured=measured,
        )

    def sensitivity(self, state: ModelState, derivatives: StateDerivatives) -> Floats:
        solved = self.pairs.of(state)
        roots, columns = solved.modes.roots, list(derivatives.columns)
        slopes = np.array(
            [
                [ratio_slope(root, change) for change in changes]
                for root, changes in zip(roots, solved.slopes[:, columns], strict=True)
            ]
        ).reshape(-1, len(columns))
        for root in roots:  # of repeated modes only the mean has derivatives
            alike = np.abs(roots - root) <= ALIKE * abs(root)
            slopes[alike] = slopes[alike].mean(axis=0)
        return slopes

    def agrees(self, part: Residual) -> bool:
        within = np.abs(part.values) <= self.tolerance * part.blocks[0].measured
        return bool(within[part.weights > 0.0].all())
