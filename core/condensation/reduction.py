"""A model condensed to a few of its unknowns: the masters.

Each method gives a transformation x = T x_m from the masters to all unknowns; energy then gives
the reduced matrices K_r = T^T K T and M_r = T^T M T. The rows of T at the masters are a unit
matrix (not with SEREP of fewer modes than masters), those at the slaves are t:

    Guyan      K_ss t = -K_sm                                                  thesis A (1)-(9)
    dynamic    (K_ss - w^2 M_ss) t = -(K_sm - w^2 M_sm)                        A (10)
    IRS        t_1 = t_0 + K_ss^-1 (M_sm + M_ss t_0) M_r^-1 K_r                A (11)-(17)
    SEREP      T = Phi Phi_m^+                                                 A (18)-(25)

Guyan (1965) is exact at rest, dynamic reduction at w; IRS (O'Callahan 1989) lets the slaves'
inertia follow the static shapes; SEREP (O'Callahan, Avitabile and Riemer 1989) keeps the given
modes exactly.

A (15) as printed multiplies M_ss by K_ss^-1 and K_sm with a plus sign; the derivation before it
and A (17) need M_sm - M_ss K_ss^-1 K_sm, which is what stands above.

Only K_ss is factorised, once. Nothing of size n x n is ever dense; T is n x n_masters. Each
inverse is judged: the largest condition number (of matrices scaled to a unit diagonal, so that
units do not matter) is a field of the result, and beyond 10^14 there is no result.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike
from scipy import sparse

from modetune.core.algebra.factorisation import (
    SINGULAR_CONDITION,
    Factorisation,
    Matrix,
    factorise,
    symmetric_matrix,
)
from modetune.core.errors import ModelError, ModesError
from modetune.core.modes import Floats, Integers

# Least squares on shapes beyond this have less than four digits left of double precision.
HOPELESS_BASIS = 1e12


@dataclass(frozen=True, slots=True)
class Reduction:
    """A reduced model and how its masters move the rest.

    stiffness, mass: (n_masters, n_masters), in the order of masters. transformation:
    (n, n_masters). masters: (n_masters,), rows of the full model. condition: of the worst
    inverse taken.
    """

    method: Literal["guyan", "dynamic", "irs", "serep"]
    stiffness: Floats
    mass: Floats
    transformation: Floats
    masters: Integers
    condition: float


@dataclass(frozen=True, slots=True)
class Partition:
    """A model's matrices (n, n) and its rows: masters in the order asked for, slaves ascending."""

    stiffness: sparse.csr_array
    mass: sparse.csr_array
    masters: Integers
    slaves: Integers

    def factorise_slaves(self, shift: float = 0.0) -> Factorisation:
        """Factors of K_ss - shift M_ss, shift in (rad/s)^2; ModelError where it is singular."""
        s = self.slaves
        inner: Any = self.stiffness[s][:, s] - shift * self.mass[s][:, s]
        try:
            return factorise(inner)
        except ModelError as error:
            raise ModelError(
                f"the model with its {self.masters.size} masters held cannot be solved for the "
                f"other unknowns at {np.sqrt(max(shift, 0.0)) / (2.0 * np.pi):.6g} Hz: {error}"
            ) from error

    def coupling(self, shift: float = 0.0) -> Any:
        """K_sm - shift M_sm, (n_slaves, n_masters), sparse."""
        whole: Any = self.stiffness[self.slaves] - shift * self.mass[self.slaves]
        return whole[:, self.masters]

    def inertia(self, slave_rows: Floats) -> Floats:
        """M_sm + M_ss t of slaves that follow the masters by t, (n_slaves, n_masters)."""
        rows = self.mass[self.slaves]
        return np.asarray(rows[:, self.masters].toarray() + rows[:, self.slaves] @ slave_rows)

    def transformation(self, slave_rows: Floats) -> Floats:
        """T with a unit matrix at the masters and t at the slaves, (n, n_masters)."""
        whole = np.zeros((self.stiffness.shape[0], self.masters.size))
        whole[self.masters] = np.eye(self.masters.size)
        whole[self.slaves] = slave_rows
        return whole

    def project(self, transformation: Floats) -> tuple[Floats, Floats]:
        """T^T K T and T^T M T, freed of the rounding that makes them unsymmetric."""
        k = transformation.T @ (self.stiffness @ transformation)
        m = transformation.T @ (self.mass @ transformation)
        return 0.5 * (k + k.T), 0.5 * (m + m.T)


def partition(stiffness: Matrix, mass: Matrix, masters: ArrayLike) -> Partition:
    """Check a model and the rows to keep, and split its unknowns.

    stiffness, mass: (n, n), sparse, symmetric; masters: (n_masters,), rows counted from 0.
    Raises ModelError where the matrices are not a model, ModesError where a row is not one of it,
    stands twice, or there is none.
    """
    k, m = symmetric_matrix(stiffness, "stiffness"), symmetric_matrix(mass, "mass matrix")
    if np.iscomplexobj(k.data) or np.iscomplexobj(m.data):
        raise ModelError("reduction and expansion need real matrices")
    n = k.shape[0]
    if m.shape != k.shape:
        raise ModelError(f"stiffness is {k.shape}, mass is {m.shape}: not one model")
    rows = checked_rows(masters, n)
    return Partition(k, m, rows, np.setdiff1d(np.arange(n, dtype=np.int64), rows))


def checked_rows(rows: ArrayLike, n: int) -> Integers:
    """Rows of a model of n unknowns as integers; ModesError where they are not."""
    given = np.asarray(rows)
    if given.ndim != 1 or given.size == 0 or not np.issubdtype(given.dtype, np.integer):
        raise ModesError("masters or measured unknowns must be a list of at least one row number")
    if given.min() < 0 or given.max() >= n:
        raise ModesError(f"row {given.max() if given.max() >= n else given.min()} of {n} unknowns")
    if np.unique(given).size != given.size:
        raise ModesError("the same row is named twice among masters or measured unknowns")
    return given.astype(np.int64)


def guyan(stiffness: Matrix, mass: Matrix, masters: ArrayLike) -> Reduction:
    """Static reduction: slaves carry no inertia force.

    stiffness, mass: (n, n), sparse; masters: (n_masters,), rows kept. Raises ModelError where
    the model moves freely with its masters held. Source: Guyan 1965; thesis A (1)-(9).
    """
    model = partition(stiffness, mass, masters)
    t, _, condition = _static_rows(model)
    return _reduction("guyan", model, model.transformation(t), condition)


def dynamic(stiffness: Matrix, mass: Matrix, masters: ArrayLike, frequency_hz: float) -> Reduction:
    """Reduction that is exact at one frequency.

    As guyan; frequency_hz: in Hz, at which the slaves' inertia is taken. Raises ModelError also
    where that is a natural frequency of the model with its masters held. Source: thesis A (10).
    """
    if not (np.isfinite(frequency_hz) and frequency_hz >= 0.0):
        raise ModesError(f"a frequency of {frequency_hz} Hz cannot be reduced at")
    model = partition(stiffness, mass, masters)
    shift = (2.0 * np.pi * frequency_hz) ** 2
    t, _, condition = _static_rows(model, shift)
    return _reduction("dynamic", model, model.transformation(t), condition)


def irs(stiffness: Matrix, mass: Matrix, masters: ArrayLike) -> Reduction:
    """Improved reduced system: slaves' inertia follows the static shapes.

    As guyan. Raises ModelError also where the masters have no mass of their own or from slaves.
    Source: O'Callahan 1989; thesis A (11)-(17).
    """
    model = partition(stiffness, mass, masters)
    t_0, factors, condition = _static_rows(model)
    k, m = model.project(model.transformation(t_0))
    t, worst = _with_inertia(model, factors, t_0, k, m)
    return _reduction("irs", model, model.transformation(t), max(condition, worst))


def serep(stiffness: Matrix, mass: Matrix, masters: ArrayLike, mode_shapes: Floats) -> Reduction:
    """Reduction that keeps given modes exactly.

    As guyan; mode_shapes: (n, n_modes), real, of the model. With fewer modes than masters the
    reduced matrices have rank n_modes; with more (least-length pseudo-inverse, A (23)) no mode
    is kept exactly. Raises ModesError where the shapes do not fit or cannot be told apart at the
    masters. Source: O'Callahan, Avitabile and Riemer 1989; thesis A (18)-(25).
    """
    model = partition(stiffness, mass, masters)
    inverse, condition = basis_inverse(mode_shapes, model.masters, model.stiffness.shape[0])
    whole = np.asarray(mode_shapes, dtype=np.float64) @ inverse
    return _reduction("serep", model, whole, condition)


def basis_inverse(mode_shapes: Floats, rows: Integers, n: int) -> tuple[Floats, float]:
    """Phi_m^+ (n_modes, n_rows) of shapes (n, n_modes) at some rows, and its condition.

    Columns are scaled to unit length first, so the shapes' own scales do not count. Raises
    ModesError where the shapes do not fit or are hopelessly alike at these rows.
    Source: thesis A (20)-(23); singular values instead of the normal equations, which square the
    condition number.
    """
    phi = np.asarray(mode_shapes)
    if phi.ndim != 2 or phi.shape[0] != n or phi.shape[1] == 0 or np.iscomplexobj(phi):
        raise ModesError(f"mode shapes of shape {phi.shape} are not real modes of {n} unknowns")
    if not np.isfinite(phi).all():
        raise ModesError("a mode shape of the model is not finite")
    at_rows = phi[rows].astype(np.float64)
    lengths = np.linalg.norm(at_rows, axis=0)
    if (lengths == 0.0).any():
        raise ModesError(f"mode {int(np.argmin(lengths))} (from 0) does not move any kept unknown")
    unit = at_rows / lengths
    condition = float(np.linalg.cond(unit))
    if not condition < HOPELESS_BASIS:
        raise ModesError(
            f"{phi.shape[1]} modes cannot be told apart at {rows.size} unknowns: condition number "
            f"{condition:.1e}; keep more or other unknowns, or fewer modes"
        )
    return np.asarray(np.linalg.pinv(unit) / lengths[:, None]), condition


def _static_rows(
    model: Partition, shift: float = 0.0
) -> tuple[Floats, Factorisation | None, float]:
    if model.slaves.size == 0:
        return np.zeros((0, model.masters.size)), None, 1.0
    factors = model.factorise_slaves(shift)
    return np.negative(factors.solve(model.coupling(shift))), factors, factors.condition


def _with_inertia(
    model: Partition, factors: Factorisation | None, t_0: Floats, k: Floats, m: Floats
) -> tuple[Floats, float]:
    """t of IRS from Guyan's t_0 and its K_r, M_r; with the condition of M_r."""
    worst = _mass_condition(m)
    if factors is None:
        return t_0, worst
    return t_0 + factors.solve(model.inertia(t_0)) @ np.linalg.solve(m, k), worst


def _mass_condition(m: Floats) -> float:
    diagonal = np.diag(m)
    scale = 1.0 / np.sqrt(np.where(diagonal > 0.0, diagonal, 1.0))
    condition = float(np.linalg.cond(m * scale[:, None] * scale)) if diagonal.all() else np.inf
    if not condition < SINGULAR_CONDITION:
        raise ModelError(
            f"the reduced mass matrix is singular (condition number {condition:.1e}): a master "
            "has no inertia; keep unknowns that carry mass"
        )
    return condition


def _reduction(
    method: Literal["guyan", "dynamic", "irs", "serep"],
    model: Partition,
    transformation: Floats,
    condition: float,
) -> Reduction:
    k, m = model.project(transformation)
    return Reduction(method, k, m, transformation, model.masters, condition)
