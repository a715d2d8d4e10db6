"""When updating stops, and when a sensitivity may be used again.

e1 (thesis (4.1)): every used frequency, and every used shape where shapes were measured, is
within its tolerance. e2 (thesis (4.2)): where the residual changes by no more than e2 for each
parameter, |z_j - z_(j-1)| / L, the sensitivity of the next iteration is not computed.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from modetune.core.correlation.pairing import Pairing
from modetune.core.modes import Floats, ModeSet
from modetune.core.updating.responses.response import Residual

#: Of a relative eigenvalue, where no frequency is compared: twice the usual one of a frequency.
EIGENVALUE_DEVIATION = 0.004


@dataclass(frozen=True, slots=True)
class Tolerances:
    """e1: largest relative frequency error and lowest MAC of a model that agrees with its test.

    The MAC counts wherever shapes were measured, also if the residual leaves them out.
    """

    frequency: float = np.inf
    mac: float = 0.0


def frequency_errors(measured: ModeSet, computed: ModeSet, pairing: Pairing) -> Floats:
    """Computed over measured frequency less one, of each pair, (n_pairs,)."""
    return np.asarray(
        computed.frequencies_hz[pairing.computed] / measured.frequencies_hz[pairing.measured] - 1.0
    )


def agrees(errors: Floats, mac: Floats, tolerances: Tolerances) -> bool:
    """Whether e1 holds. errors, mac: (n_pairs,); a MAC is NaN without a measured shape."""
    shapes = mac[np.isfinite(mac)]
    return bool((np.abs(errors) <= tolerances.frequency).all() and (shapes >= tolerances.mac).all())


def slope(residual: Residual, previous: Residual, n_parameters: int) -> float:
    """Change of the residual for each parameter, |z_j - z_(j-1)| / L. Source: thesis (4.2).

    Values with a unit (`Block.measured`) count by their deviations, one of which is as much as one
    of an eigenvalue, so that the slope is the same in all units.
    """
    used, scales = previous.weights > 0.0, np.ones(previous.values.size)
    own = [np.full(block.size, block.measured.size > 0) for block in previous.blocks]
    with_unit = np.concatenate([np.zeros(0, dtype=bool), *own])
    if with_unit.any():
        rows = previous.rows("frequencies")
        known = previous.noise[rows][used[rows]]
        one = np.sqrt(known.mean()) if known.size else EIGENVALUE_DEVIATION
        scales[with_unit] = one / np.sqrt(previous.noise[with_unit])
    change = (residual.values - previous.values) * scales
    return float(np.linalg.norm(change[used])) / n_parameters
