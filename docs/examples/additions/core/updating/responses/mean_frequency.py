"""The mean of the first n measured frequencies: z = mean(f_m) - mean(f_c) of their pairs, Hz."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from modetune.core.modes import Floats
from modetune.core.updating.responses.response import (
    ModelState,
    Need,
    Residual,
    StateDerivatives,
    residual_of,
)


@dataclass(frozen=True, slots=True)
class MeanFrequency:
    """The mean of the first n paired frequencies; deviation and tolerance: relative."""

    n: int
    weight: float
    deviation: float
    tolerance: float
    kind: ClassVar[str] = "mean_frequency"
    needs: ClassVar[frozenset[Need]] = frozenset()

    def residual(self, state: ModelState) -> Residual:
        measured = state.test.modes.frequencies_hz[state.pairing.measured[: self.n]].mean(
            keepdims=True
        )
        computed = state.seen.frequencies_hz[state.pairing.computed[: self.n]].mean(keepdims=True)
        noise = (self.deviation * measured) ** 2
        name = f"mean of {self.n} frequencies, Hz"
        emphasis = np.array([self.weight])
        return residual_of(
            self.kind, [name], None, measured - computed, emphasis, noise, measured=measured
        )

    def sensitivity(self, state: ModelState, derivatives: StateDerivatives) -> Floats:
        hz = state.seen.frequencies_hz[state.pairing.computed[: self.n]]
        slopes = derivatives.modes.eigenvalues[: self.n] / (8.0 * np.pi**2 * hz[:, None])
        return np.asarray(slopes.mean(axis=0, keepdims=True))

    def agrees(self, part: Residual) -> bool:
        return bool((np.abs(part.values) <= self.tolerance * part.blocks[0].measured).all())
