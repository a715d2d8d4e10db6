"""How far each measured value is trusted: its deviation, and its emphasis in the residual.

A sensor has a deviation d, relative to that of the shape, and an emphasis w. In the residual its
entries are scaled by the root of

    omega = w / d^2,

so that shapes are brought to each other by the least squares that the sensors' weights make, and a
loud sensor that is not trusted draws no other with it. With all of them 1 nothing is scaled.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.linalg import block_diag

from modetune.core.modes import Floats


@dataclass(frozen=True, slots=True)
class Weighting:
    """Deviations and weights of the modes of a test, and of its sensors.

    frequency_deviations: (n_modes,), relative standard deviations of measured frequencies;
    shape_deviations: (n_modes,), of the entries of a shape, relative to its root mean square;
    frequency_weights, shape_weights: (n_modes,), emphasis, dimensionless; 0 leaves out.
    sensor_deviations: (n_dof,), over that of the shape; sensor_weights: (n_dof,), emphasis.
    frequency_correlation: (n_modes, n_modes), of errors of frequencies; (0, 0) where they are
    independent.
    """

    frequency_deviations: Floats
    shape_deviations: Floats
    frequency_weights: Floats
    shape_weights: Floats
    sensor_deviations: Floats
    sensor_weights: Floats
    frequency_correlation: Floats = field(default_factory=lambda: np.zeros((0, 0)))

    @property
    def frequency_covariance(self) -> Floats:
        """Of relative frequencies, (n_modes, n_modes); (n_modes,), variances, where errors are
        independent."""
        sizes = self.frequency_deviations
        if not self.frequency_correlation.size:
            return np.asarray(sizes**2)
        return np.asarray(self.frequency_correlation * np.outer(sizes, sizes))

    @property
    def with_shapes(self) -> bool:
        """Whether any shape is compared."""
        return bool((self.shape_weights > 0.0).any())

    @property
    def frequencies_used(self) -> NDArray[np.bool_]:
        """Which frequencies are compared, (n_modes,)."""
        return self.frequency_weights > 0.0

    @property
    def shapes_used(self) -> NDArray[np.bool_]:
        """Which shapes are compared, (n_modes,)."""
        return self.shape_weights > 0.0

    def modes(self, places: ArrayLike) -> Weighting:
        """That of the modes at these positions, in this order."""
        index = np.asarray(places, dtype=np.int64)
        known = self.frequency_correlation
        return replace(
            self,
            **{name: getattr(self, name)[index] for name in _OF_MODES},
            frequency_correlation=known[np.ix_(index, index)] if known.size else known,
        )

    def sensor_scales(self, rows: ArrayLike) -> tuple[Floats, Floats]:
        """Factors of shape entries at these sensors (n,), and the variances (n,) that entries of a
        unit shape have after it where the shape's deviation is 1."""
        index = np.asarray(rows, dtype=np.int64)
        weights = self.sensor_weights[index]
        omega = weights / self.sensor_deviations[index] ** 2
        return np.sqrt(omega), weights / omega.sum()


#: Fields that have an entry a mode.
_OF_MODES = ("frequency_deviations", "shape_deviations", "frequency_weights", "shape_weights")


def even_weighting(
    n_modes: int,
    n_dof: int,
    frequency_deviation: float,
    shape_deviation: float,
    frequency_weight: float = 1.0,
    shape_weight: float = 1.0,
) -> Weighting:
    """The same for all modes and all sensors."""
    return Weighting(
        np.full(n_modes, frequency_deviation),
        np.full(n_modes, shape_deviation),
        np.full(n_modes, frequency_weight),
        np.full(n_modes, shape_weight),
        np.ones(n_dof),
        np.ones(n_dof),
    )


def weighting_side_by_side(parts: Sequence[Weighting]) -> Weighting:
    """That of several tests, modes after modes and sensors after sensors."""
    names = (*_OF_MODES, "sensor_deviations", "sensor_weights")
    whole = Weighting(*(np.concatenate([getattr(part, name) for part in parts]) for name in names))
    return replace(whole, frequency_correlation=_diagonal_blocks(parts))


def _diagonal_blocks(parts: Sequence[Weighting]) -> Floats:
    """Correlations of several tests, which know nothing of each other."""
    known = [part.frequency_correlation for part in parts]
    if not any(own.size for own in known):
        return np.zeros((0, 0))
    sizes = [part.frequency_deviations.size for part in parts]
    blocks = [own if own.size else np.eye(n) for own, n in zip(known, sizes, strict=True)]
    return np.asarray(block_diag(*blocks))
