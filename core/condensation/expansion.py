"""Measured mode shapes filled out to all unknowns of the model.

A test sees a few unknowns (m); the others (s) follow from one of these:

    Kidder    (K_ss - w_r^2 M_ss) phi_s = -(K_sm - w_r^2 M_sm) phi_m        thesis A (26)-(28)
    static    the same at w = 0, the inverse of Guyan's reduction
    SEREP     phi = Phi Phi_m^+ phi_m                                       A (29)-(33)
    model     phi_s = phi_s of the paired computed mode, at the measured one's scale
    spline    phi_s from the smoothest surface through phi_m over the geometry

Kidder (1973) needs matrices, and trusts them away from the sensors; it fails where w_r is close
to a natural frequency of the model with its sensors held. SEREP replaces measured values too: it
takes the nearest combination of the model's modes and so smooths noise, and what it takes away
shows how far the test leaves the model's space. The spline knows nothing of the model: it minimises
bending energy of u(x) = sum_i w_i g(|x - x_i|) + affine, with g(r) = r^3 on lines and in
space, r^2 log r on planes (Duchon 1977), each component on its own, over as many principal
directions as the sensors span; outside them the shape is constant.

Measured values are kept, except by SEREP. Every inverse is judged: the result contains the
condition number, and beyond a limit there is no result.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import sparse
from scipy.spatial.distance import cdist

from modetune.core.algebra.factorisation import SINGULAR_CONDITION, Matrix, symmetric_matrix
from modetune.core.condensation.reduction import basis_inverse, checked_rows, partition
from modetune.core.correlation.correlation import Shapes
from modetune.core.errors import ModesError
from modetune.core.modes import COMPONENTS, Floats, Integers

# Share of the sensors' greatest extent below which their extent in a direction does not show how a
# shape changes along it.
_FLAT = 1e-3
_TARGETS_AT_ONCE = 4096  # bounds the matrix of distances from targets to sensors


@dataclass(frozen=True, slots=True)
class Expansion:
    """Measured modes at all unknowns.

    mode_shapes: (n, n_modes), at the measured scale, complex where the measured ones are.
    condition: (n_modes,), of the inverse behind each mode; 1 where none was taken.
    """

    mode_shapes: Shapes
    condition: Floats


@dataclass(frozen=True, slots=True)
class Places:
    """Where some unknowns are: coordinates (n, 3) in the model's length, components (n,) 1..6.

    Raises ModesError where they do not fit together or are not finite.
    """

    coordinates: Floats
    components: Integers

    def __post_init__(self) -> None:
        n = self.components.size
        if self.components.shape != (n,) or self.coordinates.shape != (n, 3) or n == 0:
            raise ModesError(
                f"coordinates of shape {self.coordinates.shape} for components of shape "
                f"{self.components.shape}: (n, 3) and (n,) are needed, n at least 1"
            )
        if not np.isfinite(self.coordinates).all():
            raise ModesError("a coordinate is not finite")
        if self.components.min() < 1 or self.components.max() > 6:
            raise ModesError("components are numbered 1 to 6 (x, y, z, rx, ry, rz)")


def kidder_expansion(
    stiffness: Matrix, mass: Matrix, frequencies_hz: ArrayLike, measured: Shapes, rows: ArrayLike
) -> Expansion:
    """Fill unmeasured unknowns so that the model is in dynamic balance at each frequency.

    stiffness, mass: (n, n), sparse; frequencies_hz: (n_modes,), measured; measured: (n_rows,
    n_modes), real or complex, at these rows of the model. One factorisation for each frequency
    that differs. Raises ModelError where a frequency is one of the model with its sensors held,
    ModesError where shapes do not fit. Source: Kidder 1973; thesis A (26)-(28).
    """
    model = partition(stiffness, mass, rows)
    shapes = _measured(measured, model.masters)
    frequencies = np.asarray(frequencies_hz, dtype=np.float64)
    if frequencies.shape != (shapes.shape[1],) or not (frequencies >= 0.0).all():
        raise ModesError(
            f"{shapes.shape[1]} shapes need as many frequencies of 0 Hz or more, "
            f"not {frequencies.shape}"
        )
    if not np.isfinite(frequencies).all():
        raise ModesError("a measured frequency is not finite")
    whole = _kept(model.stiffness.shape[0], shapes, model.masters)
    condition = np.ones(shapes.shape[1])
    if model.slaves.size:
        for frequency in np.unique(frequencies):
            modes = np.flatnonzero(frequencies == frequency)
            shift = float(2.0 * np.pi * frequency) ** 2
            factors = model.factorise_slaves(shift)
            filled = -factors.solve(model.coupling(shift) @ shapes[:, modes])
            whole[np.ix_(model.slaves, modes)] = filled
            condition[modes] = factors.condition
    return Expansion(whole, condition)


def static_expansion(stiffness: Matrix, measured: Shapes, rows: ArrayLike) -> Expansion:
    """Fill unmeasured unknowns with the shape that costs least strain energy.

    stiffness: (n, n); measured: (n_rows, n_modes) at these rows. Raises as kidder_expansion.
    Source: Guyan 1965, thesis A (3).
    """
    shapes: Any = np.asarray(measured)
    n_modes = shapes.shape[1] if shapes.ndim == 2 else 0
    k = symmetric_matrix(stiffness, "stiffness")
    return kidder_expansion(k, sparse.csr_array(k.shape), np.zeros(n_modes), shapes, rows)


def serep_expansion(mode_shapes: Floats, measured: Shapes, rows: ArrayLike) -> Expansion:
    """The combination of the model's modes nearest to each measured shape, at all unknowns.

    mode_shapes: (n, n_model_modes), real; measured: (n_rows, n_modes) at these rows. Raises
    ModesError if shapes do not fit or cannot be separated at these rows.
    Source: O'Callahan, Avitabile and Riemer 1989; thesis A (29)-(33).
    """
    phi = np.asarray(mode_shapes)
    if phi.ndim != 2:
        raise ModesError(f"mode shapes must be (n, n_modes), not {phi.shape}")
    places = checked_rows(rows, phi.shape[0])
    shapes = _measured(measured, places)
    inverse, condition = basis_inverse(phi, places, phi.shape[0])
    return Expansion(phi @ (inverse @ shapes), np.full(shapes.shape[1], condition))


def model_shape_expansion(paired: Shapes, measured: Shapes, rows: ArrayLike) -> Expansion:
    """Fill unmeasured unknowns with the computed mode that each measured one is paired with.

    paired: (n, n_modes), computed, in the measured modes' order; measured: (n_rows, n_modes) at
    these rows. Each computed shape is scaled by least squares to the measured one. Raises
    ModesError where shapes do not fit or a computed one is zero at the sensors.
    Source: thesis 2.2.1, with the factor of (2.3) inverted.
    """
    computed = np.asarray(paired)
    places = checked_rows(rows, computed.shape[0] if computed.ndim == 2 else 0)
    shapes = _measured(measured, places)
    if computed.shape[1] != shapes.shape[1] or not np.isfinite(computed).all():
        raise ModesError(f"{computed.shape[1]} finite computed shapes for {shapes.shape[1]} modes")
    at_sensors = computed[places]
    lengths = np.sum(np.abs(at_sensors) ** 2, axis=0)
    if (lengths == 0.0).any():
        raise ModesError("a computed mode does not move any measured unknown")
    whole = computed * (np.sum(at_sensors.conj() * shapes, axis=0) / lengths)
    whole[places] = shapes
    return Expansion(whole, np.ones(shapes.shape[1]))


def spline_expansion(measured: Shapes, sensors: Places, targets: Places) -> Expansion:
    """The smoothest surface through the measured shapes, at other places.

    measured: (n_sensors, n_modes), in the order of sensors; targets: where to evaluate. Returns
    shapes (n_targets, n_modes). Components do not mix; axes are the model's. Raises ModesError
    if a target's component was measured nowhere, or two sensors of one component are at one place.
    Source: Duchon 1977; thesis 2.2.1.
    """
    shapes = _measured(measured, np.arange(sensors.components.size, dtype=np.int64))
    missing = np.setdiff1d(targets.components, sensors.components)
    if missing.size:
        names = ", ".join(COMPONENTS[number - 1] for number in missing.tolist())
        raise ModesError(f"no sensor measures component {names}: a spline cannot fill it")
    whole: Any = np.zeros((targets.components.size, shapes.shape[1]), dtype=shapes.dtype)
    worst = 1.0
    for component in np.unique(targets.components):
        seen, wanted = sensors.components == component, targets.components == component
        whole[wanted], condition = _spline(
            sensors.coordinates[seen], shapes[seen], targets.coordinates[wanted]
        )
        worst = max(worst, condition)
    return Expansion(whole, np.full(shapes.shape[1], worst))


def _measured(measured: Shapes, rows: Integers) -> Any:
    shapes: Any = np.asarray(measured)
    if shapes.ndim != 2 or shapes.shape[0] != rows.size or shapes.shape[1] == 0:
        raise ModesError(f"measured shapes {shapes.shape} at {rows.size} unknowns do not fit")
    if not np.isfinite(shapes).all():
        raise ModesError("a measured mode shape is not finite")
    return shapes.astype(np.result_type(shapes.dtype, np.float64))


def _kept(n: int, shapes: Shapes, rows: Integers) -> Any:
    whole = np.zeros((n, shapes.shape[1]), dtype=shapes.dtype)
    whole[rows] = shapes
    return whole


def _spline(points: Floats, values: Shapes, targets: Floats) -> tuple[Shapes, float]:
    """Polyharmonic spline through values (n, n_modes) at points, at the targets; its condition."""
    centre = points.mean(axis=0)
    _, spread, directions = np.linalg.svd(points - centre, full_matrices=False)
    n_axes = int(np.sum(spread > _FLAT * float(spread[0])))
    if n_axes == 0 and points.shape[0] == 1:
        return np.broadcast_to(values.mean(axis=0), (targets.shape[0], values.shape[1])), 1.0
    size = float(np.abs(points - centre).max())
    axes = directions[:n_axes] / (size if size > 0.0 else 1.0)
    x = (points - centre) @ axes.T
    affine = np.column_stack([np.ones(x.shape[0]), x])
    corner = np.zeros((n_axes + 1, n_axes + 1))
    system = np.block([[_kernel(cdist(x, x), n_axes), affine], [affine.T, corner]])
    condition = float(np.linalg.cond(system))
    if not condition < SINGULAR_CONDITION:
        raise ModesError(
            f"two sensors of one component are at (nearly) one place: the spline through "
            f"{x.shape[0]} sensors has condition number {condition:.1e}"
        )
    sides = np.concatenate([values, np.zeros((n_axes + 1, values.shape[1]))])
    weights = np.linalg.solve(system, sides)
    result = np.empty((targets.shape[0], values.shape[1]), dtype=weights.dtype)
    for start in range(0, targets.shape[0], _TARGETS_AT_ONCE):
        part = slice(start, start + _TARGETS_AT_ONCE)
        y = (targets[part] - centre) @ axes.T
        result[part] = _kernel(cdist(y, x), n_axes) @ weights[: x.shape[0]]
        result[part] += np.column_stack([np.ones(y.shape[0]), y]) @ weights[x.shape[0] :]
    return result, condition


def _kernel(distances: NDArray[np.float64], n_axes: int) -> NDArray[np.float64]:
    if n_axes != 2:
        return np.asarray(distances**3)
    return np.asarray(distances**2 * np.log(np.where(distances > 0.0, distances, 1.0)))
