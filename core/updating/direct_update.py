"""Direct updating: corrections to mass and stiffness that reproduce measured modes at once.

Direct Matrix Method (Berman and Nagy 1983; thesis (3.1)-(3.3)). The least change of mass, in
the norm that the mass itself weighs, that makes the m measured shapes orthonormal is

    dM = M phi m_a^-1 (I - m_a) m_a^-1 phi^T M,      m_a = phi^T M phi,

and with M' = M + dM, for which phi^T M' phi = I, the least change of stiffness that makes them
modes of the measured frequencies is

    dK = M' phi (phi^T K phi + W) phi^T M' - K phi phi^T M' - M' phi phi^T K,   W = diag(w_r^2).

Baruch and Bar Itzhack (1978) believe the mass instead: the measured shapes are turned to the
nearest that are orthonormal in it, phi (phi^T M phi)^-1/2, and dK is the same with M' = M. Measured
frequencies then come out exactly, and the shapes that were turned.

(3.3) writes M_A for M'; its proof, (K + dK) phi = M' phi W, needs the updated mass, as the
sentence before it says. Frequencies and shapes then come out exactly.

Error Matrix Method (Sidhu and Ewins 1984; thesis (3.10)-(3.12)). To first order in the errors

    dK = K (phi_A W_A^-1 phi_A^T - phi_X W_X^-1 phi_X^T) K,
    dM = M (phi_A phi_A^T - phi_X phi_X^T) M,

with the inverses of K and M approximated by the paired modes; even with every unknown measured
the result is only near.

Every change has rank of the number of modes, U C U^T, and is kept so: the model stays sparse
until someone asks for the dense sum. The corrections are numbers, not physics: they fill zeros of
the matrices and spread with the noise of the test.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike

from modetune.core.algebra.factorisation import Matrix
from modetune.core.condensation.expansion import (
    Expansion,
    kidder_expansion,
    model_shape_expansion,
    serep_expansion,
    static_expansion,
)
from modetune.core.condensation.reduction import HOPELESS_BASIS, partition
from modetune.core.errors import ModesError
from modetune.core.modes import Floats, Normalisation

Filling = Literal["kidder", "static", "serep", "model"]


@dataclass(frozen=True, slots=True)
class LowRankChange:
    """A symmetric change U C U^T of a matrix: basis U (n, r), core C (r, r)."""

    basis: Floats
    core: Floats

    def times(self, columns: Floats) -> Floats:
        """The change times (n, n_columns), without forming it."""
        return self.basis @ (self.core @ (self.basis.T @ columns))

    def dense(self) -> Floats:
        """The change as (n, n)."""
        return self.basis @ self.core @ self.basis.T

    def added_to(self, matrix: Matrix) -> Floats:
        """The changed matrix, dense (n, n): n^2 numbers."""
        whole: Any = matrix
        return np.asarray(whole + self.dense())


@dataclass(frozen=True, slots=True)
class DirectUpdate:
    """Corrections of a model by a direct method.

    mass_change, stiffness_change: add them to the model's matrices. mode_shapes: (n, n_modes),
    the measured ones as they were used: at all unknowns, scaled. condition: of the worst inverse
    taken, expansion included.
    """

    mass_change: LowRankChange
    stiffness_change: LowRankChange
    mode_shapes: Floats
    condition: float


@dataclass(frozen=True, slots=True)
class ReferenceModes:
    """Measured modes to impose on a model.

    frequencies_hz: (n_modes,), above 0. shapes: (n_rows, n_modes), real. rows: (n_rows,) of the
    model's unknowns where they were measured. normalisation: 'mass' keeps their scale, and so
    lets the test change the model's mass; any other is scaled to unit modal mass in the model.
    filling: how unmeasured unknowns are filled; 'serep' and 'model' need the model's modes.
    """

    frequencies_hz: Floats
    shapes: Floats
    rows: ArrayLike
    normalisation: Normalisation = "unknown"
    filling: Filling = "kidder"


def direct_matrix_update(
    stiffness: Matrix,
    mass: Matrix,
    measured: ReferenceModes,
    model_shapes: Floats | None = None,
    keep_mass: bool = False,
) -> DirectUpdate:
    """Smallest changes of mass and stiffness that give the model the measured modes exactly.

    stiffness, mass: (n, n), sparse; model_shapes: (n, n_model_modes), for the fillings 'serep'
    (any modes) and 'model' (paired, in measured order); keep_mass: turn the shapes and leave the
    mass as it is. Raises ModesError where shapes do not fit or are not independent, ModelError
    where the matrices are not a model or an inverse fails.
    Source: Berman and Nagy 1983; thesis (3.1)-(3.3); Baruch and Bar Itzhack 1978.
    """
    model = partition(stiffness, mass, measured.rows)
    k, m = model.stiffness, model.mass
    phi, expanded = _full_shapes(k, m, measured, model_shapes)
    lam = (2.0 * np.pi * np.asarray(measured.frequencies_hz, dtype=np.float64)) ** 2
    m_phi = np.asarray(m @ phi)
    m_a = phi.T @ m_phi
    condition = float(np.linalg.cond(m_a))
    if not condition < HOPELESS_BASIS:
        raise ModesError(
            f"the measured shapes are not independent of each other: their modal mass matrix has "
            f"condition number {condition:.1e}"
        )
    if keep_mass:
        values, axes = np.linalg.eigh(m_a)
        turn = (axes / np.sqrt(values)) @ axes.T
        phi, m_phi, m_a = phi @ turn, m_phi @ turn, np.eye(lam.size)
    m_a_inverse = np.linalg.inv(m_a)
    mass_change = LowRankChange(m_phi, m_a_inverse @ (np.eye(lam.size) - m_a) @ m_a_inverse)
    new_m_phi = m_phi + mass_change.times(phi)
    k_phi = np.asarray(k @ phi)
    one, none = np.eye(lam.size), np.zeros((lam.size, lam.size))
    core = np.block([[phi.T @ k_phi + np.diag(lam), -one], [-one, none]])
    stiffness_change = LowRankChange(np.hstack([new_m_phi, k_phi]), core)
    worst = max(condition, float(expanded.condition.max()))
    return DirectUpdate(mass_change, stiffness_change, phi, worst)


def error_matrix_update(
    stiffness: Matrix,
    mass: Matrix,
    measured: ReferenceModes,
    frequencies_hz: ArrayLike,
    model_shapes: Floats,
) -> DirectUpdate:
    """First-order estimate of the errors of mass and stiffness from pairs of modes.

    stiffness, mass: (n, n), sparse; frequencies_hz: (n_modes,), computed, above 0; model_shapes:
    (n, n_modes), computed, paired with the measured modes in their order, of any scale. Rigid
    modes have no place in it. Raises as direct_matrix_update. Source: Sidhu and Ewins 1984;
    thesis (3.10)-(3.12).
    """
    model = partition(stiffness, mass, measured.rows)
    k, m = model.stiffness, model.mass
    phi_x, expanded = _full_shapes(k, m, measured, model_shapes)
    phi_a = np.asarray(model_shapes, dtype=np.float64)
    if phi_a.shape != phi_x.shape:
        raise ModesError(f"{phi_a.shape} computed shapes for {phi_x.shape} measured ones")
    phi_a = _unit_modal_mass(phi_a, m)
    lam_x = _eigenvalues(measured.frequencies_hz, phi_x.shape[1], "measured")
    lam_a = _eigenvalues(frequencies_hz, phi_x.shape[1], "computed")
    both = np.hstack([phi_a, phi_x])
    signs = np.repeat([1.0, -1.0], lam_x.size)
    flexibility = signs / np.concatenate([lam_a, lam_x])
    return DirectUpdate(
        mass_change=LowRankChange(np.asarray(m @ both), np.diag(signs)),
        stiffness_change=LowRankChange(np.asarray(k @ both), np.diag(flexibility)),
        mode_shapes=phi_x,
        condition=float(expanded.condition.max()),
    )


def _full_shapes(
    k: Any, m: Any, measured: ReferenceModes, model_shapes: Floats | None
) -> tuple[Floats, Expansion]:
    """Measured shapes at all unknowns, scaled; and the expansion that filled them."""
    shapes = np.asarray(measured.shapes)
    if np.iscomplexobj(shapes):
        raise ModesError("direct methods are for undamped models: real shapes are needed")
    _eigenvalues(measured.frequencies_hz, shapes.shape[1] if shapes.ndim == 2 else 0, "measured")
    if measured.filling in ("serep", "model") and model_shapes is None:
        raise ModesError(f"filling unmeasured unknowns by '{measured.filling}' needs model modes")
    expanded = _expanded(k, m, measured, np.zeros((0, 0)) if model_shapes is None else model_shapes)
    phi = np.asarray(expanded.mode_shapes, dtype=np.float64)
    if measured.normalisation != "mass":
        phi = _unit_modal_mass(phi, m)
    return phi, expanded


def _expanded(k: Any, m: Any, measured: ReferenceModes, model_shapes: Floats) -> Expansion:
    match measured.filling:
        case "kidder":
            return kidder_expansion(k, m, measured.frequencies_hz, measured.shapes, measured.rows)
        case "static":
            return static_expansion(k, measured.shapes, measured.rows)
        case "serep":
            return serep_expansion(model_shapes, measured.shapes, measured.rows)
        case "model":
            return model_shape_expansion(model_shapes, measured.shapes, measured.rows)


def _eigenvalues(frequencies_hz: ArrayLike, n_modes: int, whose: str) -> Floats:
    frequencies = np.asarray(frequencies_hz, dtype=np.float64)
    if frequencies.shape != (n_modes,) or n_modes == 0:
        raise ModesError(f"{frequencies.shape} {whose} frequencies for {n_modes} shapes")
    if not (np.isfinite(frequencies).all() and (frequencies > 0.0).all()):
        raise ModesError(f"every {whose} frequency must be above 0 Hz: leave out rigid modes")
    return np.asarray((2.0 * np.pi * frequencies) ** 2)


def _unit_modal_mass(shapes: Floats, m: Any) -> Floats:
    modal_mass = np.sum(shapes * (m @ shapes), axis=0)
    if not (modal_mass > 0.0).all():
        raise ModesError("a mode shape carries no modal mass: it cannot be normalised")
    return np.asarray(shapes / np.sqrt(modal_mass))
