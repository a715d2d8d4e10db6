"""How alike two sets of mode shapes are, mode by mode and point by point.

The modal assurance criterion of two shapes a and b is the squared cosine of the angle between
them, |a^H b|^2 / (a^H a)(b^H b): 1 for scaled copies, 0 for orthogonal ones (Allemang and Brown
1982). The modal scale factor is the number that brings a measured shape to the scale of the
computed one, a^T b / a^T a with a measured.

COMAC looks along a row of paired shapes instead of down a column, so it shows where the sets
differ: with a_il the measured shape l at point i, brought to the length and sign of b_l,

    COMAC_i  = (sum_l |a_il conj(b_il)|)^2 / (sum_l |a_il|^2 * sum_l |b_il|^2)
    eCOMAC_i = sum_l |a_il - b_il| / 2L,  shapes of largest entry 1 and like sign.

(2.2) of the thesis prints the square inside the sum; then equal sets would not give 1, which the
text says they do, so the square belongs outside (Lieven and Ewins 1988). COMAC is blind to a
sensor mounted upside down, eCOMAC (Hunt 1992) is not, and there 0 is good.

With a mass matrix at the common unknowns, orthogonality replaces the angle: a^H M b of shapes of
unit modal mass is the MAC's cosine in the metric of kinetic energy. The effective mass of a mode
is the share of the structure's mass that base motion along a rigid direction r drives in it,
(phi^T M r)^2 / phi^T M phi; over all modes it adds up to r^T M r.
"""

from __future__ import annotations

from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from modetune.core.algebra.factorisation import Matrix, symmetric_matrix
from modetune.core.errors import ModesError
from modetune.core.modes import Floats, Integers

Shapes: TypeAlias = NDArray[np.float64] | NDArray[np.complex128]


def mac(first: Shapes, second: Shapes) -> Floats:
    """Modal assurance criterion of every column of first with every column of second.

    first: (n_dof, n_first), second: (n_dof, n_second), same rows, real or complex.
    Returns (n_first, n_second) in [0, 1]. Source: thesis (2.1); Allemang and Brown 1982.
    Raises ModesError where the rows differ, there are none, or a shape is zero or not finite.
    """
    a, b = _unit_columns(first), _unit_columns(second)
    if a.shape[0] != b.shape[0]:
        raise ModesError(f"shapes at {a.shape[0]} and {b.shape[0]} degrees of freedom have no MAC")
    return np.asarray(np.minimum(np.abs(a.conj().T @ b) ** 2, 1.0), dtype=np.float64)


def auto_mac(mode_shapes: Shapes) -> Floats:
    """MAC of a set with itself, (n_modes, n_modes).

    mode_shapes: (n_dof, n_modes). Its off-diagonal values show which modes the measured degrees of
    freedom cannot distinguish. Raises as mac. Source: Allemang 2003.
    """
    return mac(mode_shapes, mode_shapes)


def modal_scale_factor(measured: Shapes, computed: Shapes) -> float:
    """The factor that brings a measured shape to the scale of the computed one.

    measured, computed: (n_dof,); of complex shapes the real part of the best factor. Raises
    ModesError where they differ in size, or the measured one is zero or not finite.
    Source: thesis (2.3); Allemang and Brown 1982.
    """
    if np.ndim(measured) != 1 or np.shape(measured) != np.shape(computed):
        raise ModesError(
            f"shapes {np.shape(measured)} and {np.shape(computed)} have no common scale factor"
        )
    largest = float(np.abs(measured).max(initial=0.0))
    if largest == 0.0:
        raise ModesError("a measured mode shape is zero at all common degrees of freedom")
    if not (np.isfinite(largest) and np.isfinite(computed).all()):
        raise ModesError("a mode shape is not finite")
    # Tiny or huge shapes would leave the range of numbers when squared.
    unit = measured / largest
    return float(np.vdot(unit, computed).real / np.vdot(unit, unit).real) / largest


def subspace_mac(shape: Shapes, basis: Shapes) -> float:
    """Share of a shape (n_dof,) that lies in the space of several others, in [0, 1].

    As `subspace_macs`. With one column of the basis it is the MAC.
    """
    return float(subspace_macs(shape[:, None], basis)[0])


def subspace_macs(shapes: Shapes, basis: Shapes) -> Floats:
    """Share of each shape that lies in the space of several others, (n_shapes,), in [0, 1].

    shapes: (n_dof, n_shapes), basis: (n_dof, n). It does not change when
    close modes turn within their common space, as their shapes do at the least change of the
    model, so it is how a member of a cluster of close modes is judged. Raises as mac.
    """
    units, columns = _unit_columns(shapes), _unit_columns(basis)
    if units.shape[0] != columns.shape[0]:
        raise ModesError(
            f"shapes at {units.shape[0]} and {columns.shape[0]} degrees of freedom have no MAC"
        )
    directions, sizes, _ = np.linalg.svd(columns, full_matrices=False)
    q = directions[:, sizes > 1e-10 * sizes[0]]
    return np.asarray(np.minimum(np.sum(np.abs(q.conj().T @ units) ** 2, axis=0), 1.0))


def comac(measured: Shapes, computed: Shapes) -> Floats:
    """Coordinate MAC: how well each degree of freedom agrees over paired modes, (n_dof,).

    measured, computed: (n_dof, n_pairs), column by column paired. Each measured shape is given the
    computed one's length and sign first, so its own do not count. In [0, 1], 1 is
    good; a degree of freedom without motion in both sets agrees. Raises ModesError if the sets do
    not fit, or a pair is orthogonal and has no common scale.
    Source: thesis (2.2), see above; Lieven and Ewins 1988.
    """
    b = _shapes(computed)
    a = _to_scale_of(_shapes(measured), b)
    size = np.abs(b).max()
    a, b = a / size, b / size
    cross = np.sum(np.abs(a * b.conj()), axis=1) ** 2
    lengths = np.sum(np.abs(a) ** 2, axis=1) * np.sum(np.abs(b) ** 2, axis=1)
    rests = (np.abs(a).max(axis=1) == 0.0) & (np.abs(b).max(axis=1) == 0.0)
    ratio = np.divide(cross, lengths, out=rests.astype(np.float64), where=lengths > 0.0)
    return np.asarray(np.minimum(ratio, 1.0))


def ecomac(measured: Shapes, computed: Shapes) -> Floats:
    """Enhanced coordinate MAC: mean difference of paired shapes at each point, (n_dof,).

    As comac, but in [0, 1] with 0 good, and large where a sensor has the wrong sign or gain.
    Raises as comac. Source: Hunt 1992.
    """
    b = _shapes(computed)
    a = _to_scale_of(_shapes(measured), b)
    a, b = a / np.abs(a).max(axis=0), b / np.abs(b).max(axis=0)
    return np.asarray(np.sum(np.abs(a - b), axis=1) / (2.0 * b.shape[1]))


def cross_orthogonality(first: Shapes, second: Shapes, mass: Matrix) -> Shapes:
    """a^H M b of every pair of shapes, each of unit modal mass, (n_first, n_second).

    first: (n_dof, n_first), second: (n_dof, n_second), mass: (n_dof, n_dof) at the same degrees
    of freedom, for instance reduced to the sensors. Signs (phases) are the shapes' own; complex
    for complex shapes. A set with itself should give a unit matrix. Raises ModesError where
    shapes do not fit or carry no mass, ModelError where the mass is not a matrix.
    Source: Ewins 2000, 5.3.
    """
    a, b = _unit_columns(first), _unit_columns(second)
    m = symmetric_matrix(mass, "mass matrix")
    if a.shape[0] != m.shape[0] or b.shape[0] != m.shape[0]:
        raise ModesError(f"shapes {a.shape} and {b.shape} do not fit a mass matrix {m.shape}")
    m_a, m_b = np.asarray(m @ a), np.asarray(m @ b)
    mass_a, mass_b = _modal_mass(a, m_a), _modal_mass(b, m_b)
    return np.asarray(a.conj().T @ m_b / np.sqrt(mass_a[:, None] * mass_b))


def rigid_body_shapes(coordinates: Floats, components: Integers) -> Floats:
    """Unit translations along and rotations about x, y, z through the origin, (n_dof, 6).

    coordinates: (n_dof, 3), place of each degree of freedom, global axes; components: (n_dof,),
    1..6. Raises ModesError where they do not fit.
    """
    x, component = np.asarray(coordinates, dtype=np.float64), np.asarray(components)
    if x.shape != (component.size, 3) or not np.isfinite(x).all() or component.size == 0:
        raise ModesError(f"coordinates {x.shape} for {component.size} components do not fit")
    if component.min() < 1 or component.max() > 6:
        raise ModesError("components are numbered 1 to 6 (x, y, z, rx, ry, rz)")
    rigid = np.zeros((component.size, 6))
    rigid[np.arange(component.size), component - 1] = 1.0
    for axis in range(3):
        turned = np.cross(np.eye(3)[axis], x)
        moves = component <= 3
        rigid[moves, 3 + axis] = turned[moves, component[moves] - 1]
    return rigid


def _shapes(mode_shapes: Any) -> Any:
    shapes = np.asarray(mode_shapes)
    if shapes.ndim != 2 or 0 in shapes.shape:
        raise ModesError(f"mode shapes must be (n_dof, n_modes), neither empty, not {shapes.shape}")
    if not np.isfinite(shapes).all():
        raise ModesError("a mode shape is not finite")
    return shapes


def _unit_columns(mode_shapes: Any) -> Any:
    """Shapes of length one."""
    shapes = _shapes(mode_shapes)
    # Scaled to a largest entry of one first: squares of tiny or huge shapes leave the range.
    largest = np.abs(shapes).max(axis=0)
    if (largest == 0.0).any():
        raise ModesError("a mode shape is zero at all common degrees of freedom: it has no MAC")
    shapes = shapes / largest
    return shapes / np.linalg.norm(shapes, axis=0)


def _to_scale_of(measured: Any, computed: Any) -> Any:
    """Each measured shape with the length of its pair, and its sign or, if complex, its phase."""
    if measured.shape != computed.shape:
        raise ModesError(f"shapes {measured.shape} and {computed.shape} are not paired")
    a, b = _unit_columns(measured), _unit_columns(computed)
    cosine = np.sum(a.conj() * b, axis=0)
    if (np.abs(cosine) < 1e-12).any():
        raise ModesError("paired shapes are orthogonal: they have no common scale, and no pairing")
    return a * (cosine / np.abs(cosine)) * np.linalg.norm(computed, axis=0)


def _modal_mass(shapes: Any, m_shapes: Any) -> Floats:
    modal_mass = np.sum(shapes.conj() * m_shapes, axis=0).real
    if not (modal_mass > 0.0).all():
        raise ModesError("a mode shape carries no modal mass")
    return np.asarray(modal_mass)
