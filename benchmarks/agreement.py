"""How a model's modes agree with a test, and the residual that scripts minimise.

Frequencies alone are compared in their order. With shapes, modes are paired by MAC, and each unit
shape u_c is compared with the test's, brought to its scale: (u_m . u_c) u_m - u_c. The residual is
divided by the deviations of the campaign, so that its square is what modetune minimises too.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from modetune.core.correlation.pairing import pair_by_shape
from modetune.core.modes import Floats, ModeSet

#: Deviations and emphasis as campaigns have them unless told otherwise.
FREQUENCY_DEVIATION = 0.002
SHAPE_DEVIATION = 0.05
SHAPE_WEIGHT = 0.1
#: Least MAC of a model that agrees.
LEAST_MAC = 0.9


@dataclass(frozen=True, slots=True)
class Agreement:
    """errors: (n_modes,), relative frequency errors of the measured modes. macs: (n_modes,), empty
    without shapes. residual: (n_residuals,), over its deviations."""

    errors: Floats
    macs: Floats
    residual: Floats

    def holds(self, target: float) -> bool:
        """Whether every frequency is within the target, and every shape is the test's."""
        return bool(np.abs(self.errors).max() <= target and (self.macs >= LEAST_MAC).all())


def agreement(measured: ModeSet, computed: ModeSet) -> Agreement:
    """Compare the measured modes with computed elastic ones at the same degrees of freedom.

    computed: at least as many, in ascending order, rows as those of the measured shapes.
    """
    if measured.n_dof == 0:
        errors = computed.frequencies_hz[: measured.n_modes] / measured.frequencies_hz - 1.0
        return Agreement(errors, np.zeros(0), errors / FREQUENCY_DEVIATION)
    pairing = pair_by_shape(measured, computed, lost_mac=0.0)
    paired = computed.select(pairing.computed[np.argsort(pairing.measured)])
    errors = paired.frequencies_hz / measured.frequencies_hz - 1.0
    tests, models = (
        modes.mode_shapes.real / np.linalg.norm(modes.mode_shapes, axis=0)
        for modes in (measured, paired)
    )
    cosines = np.sum(tests * models, axis=0)
    entry = SHAPE_DEVIATION / np.sqrt(SHAPE_WEIGHT * measured.n_dof)
    # The sign of a computed shape means nothing; the difference is taken in the test's.
    shapes = np.sign(cosines) * (cosines * tests - models) / entry
    residual = np.concatenate([errors / FREQUENCY_DEVIATION, shapes.ravel()])
    return Agreement(errors, cosines**2, residual)
