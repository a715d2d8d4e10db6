"""How far a measured shape is from a standing wave, and the real shape nearest to it.

Damping that is not proportional, and noise, leave mode shapes complex. With x and y the real and
imaginary parts of a shape and S_xx = x.x, S_yy = y.y, S_xy = x.y, the modal phase collinearity is

    MPC = ((S_xx - S_yy)^2 + 4 S_xy^2) / (S_xx + S_yy)^2

which is 1 where all points move in or out of phase and 0 where phases are spread evenly (Juang and
Pappa 1985, without their mean, which makes it depend on where the phase is counted from). It is
|sum phi^2|^2 / (sum |phi|^2)^2, so turning or scaling a shape leaves it alone.

The real shape is Re(phi exp(-i a)) with the angle a for which it is largest: a is half the angle of
sum phi^2. Of the two such angles the one within 90 degrees is taken, so a real shape stays itself,
sign and all.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from modetune.core.modes import Floats

#: A shape whose MPC is below this is named as doubtful: its real part leaves out too much.
DOUBTFUL = 0.9


def modal_phase_collinearity(shapes: NDArray[np.complex128] | Floats) -> Floats:
    """MPC of each shape, (n_modes,), 0 to 1; 1 for real ones and for a shape that is zero.

    shapes: (n_dof, n_modes), any scale. Source: Juang and Pappa 1985.
    """
    phi = _scaled(shapes)
    power = (np.abs(phi) ** 2).sum(axis=0)
    squared = np.abs((phi**2).sum(axis=0)) ** 2
    found = np.divide(squared, power**2, out=np.ones(power.shape), where=power > 0.0)
    return np.minimum(found, 1.0)


def real_shapes(shapes: NDArray[np.complex128] | Floats) -> Floats:
    """The largest real part of each shape over all phases, (n_dof, n_modes).

    shapes: (n_dof, n_modes); a real one comes back as it is.
    """
    if not np.iscomplexobj(shapes):
        return np.asarray(shapes, dtype=np.float64)
    return np.ascontiguousarray(turned(np.asarray(shapes, dtype=np.complex128)).real)


def turned(phi: NDArray[np.complex128]) -> NDArray[np.complex128]:
    """Shapes turned by the phase that makes the real part largest."""
    angles = 0.5 * np.angle((_scaled(phi) ** 2).sum(axis=0))
    return np.asarray(phi * np.exp(-1j * angles))


def _scaled(shapes: NDArray[np.complex128] | Floats) -> NDArray[np.complex128]:
    """Shapes with largest entry 1, so that squares of tiny or huge ones stay in range."""
    phi = np.asarray(shapes, dtype=np.complex128)
    largest = np.abs(phi).max(axis=0, initial=0.0)
    return np.asarray(phi / np.where(largest > 0.0, largest, 1.0))
