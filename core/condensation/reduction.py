"""A model condensed to a few of its unknowns: the masters.

Each method gives a transformation x = T x_m from the masters to all unknowns; energy then gives
the reduced matrices K_r = T^T K T and M_r = T^T M T. The rows of T at the masters are a unit
matrix (not with SEREP of fewer modes than masters), those at the slaves are t:

    Guyan      K_ss t = -K_sm                                                  thesis A (1)-(9)
    dynamic    (K_ss - w^2 M_ss) t = -(K_sm - w^2 M_sm)                        A (10)
    IRS        t_1 = t_0 + K_ss^-1 (M_sm + M_ss t_0) M_r^-1 K_r                A (11)-(17)
    iterated   t_{i+1} = t_0 + K_ss^-1 (M_sm + M_ss t_i) M_r,i^-1 K_r,i        Friswell et al. 1995
    SEREP      T = Phi Phi_m^+                                                 A (18)-(25)
    Craig-     x_s = t_0 x_m + Phi_s q,  K_ss Phi_s = M_ss Phi_s W             Craig, Bampton 1968
    Bampton

Guyan (1965) is exact in statics, dynamic reduction at w; IRS (O'Callahan 1989) lets the slaves'
inertia follow the static shapes, and repeated with its own matrices it tends to the exact lowest
modes; SEREP (O'Callahan, Avitabile and Riemer 1989) keeps the given modes exactly. Craig and
Bampton add unknowns q to the masters: the lowest modes of the model with its masters held.

A (15) as printed multiplies M_ss by K_ss^-1 and K_sm with a plus sign; the derivation before it
and A (17) need M_sm - M_ss K_ss^-1 K_sm, as above.

Only K_ss is factorised, once. Nothing of size n x n is ever dense; T is n x n_masters. Each
inverse is judged: the largest condition number (of matrices scaled to a unit diagonal, so that
units do not matter) is a field of the result, and beyond 10^14 there is no result.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike
from scipy import linalg, sparse

from modetune.core.algebra.eigen import solve_modes
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
    """A reduced model, and the motion of the full model by its masters.

    stiffness, mass: (n_masters, n_masters), in the order of masters. transformation:
    (n, n_masters). masters: (n_masters,), rows of the full model. condition: of the worst
    inverse taken. iterations, converged: of iterated IRS; 0 and true for the other methods.
    With fixed-interface modes ("craig_bampton") their amplitudes follow the masters in matrices and
    transformation.
    """

    method: Literal["guyan", "dynamic", "irs", "iterated_irs", "serep", "craig_bampton"]
    stiffness: Floats
    mass: Floats
    transformation: Floats
    masters: Integers
    condition: float
    iterations: int = 0
    converged: bool = True


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
    Raises ModelError if the matrices are not a model, ModesError if a row is not one of it or
    occurs twice, or if there is none.
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

    As guyan. Raises ModelError also if the masters have no mass, neither theirs nor from slaves.
    Source: O'Callahan 1989; thesis A (11)-(17).
    """
    model = partition(stiffness, mass, masters)
    t_0, factors, condition = _static_rows(model)
    k, m = model.project(model.transformation(t_0))
    t, worst = _with_inertia(model, factors, t_0, t_0, k, m)
    return _reduction("irs", model, model.transformation(t), max(condition, worst), 1)


def iterated_irs(
    stiffness: Matrix,
    mass: Matrix,
    masters: ArrayLike,
    n_modes: int | None = None,
    tolerance: float = 1e-8,
    max_iterations: int = 50,
) -> Reduction:
    """Repeat IRS with its own matrices until the lowest eigenvalues converge.

    As irs; n_modes: number of eigenvalues that must converge, by default half the masters;
    tolerance: largest change of any, relative to the highest of them. If max_iterations do not
    suffice the last transformation is returned with converged false: the highest of these
    eigenvalues depend on slaves, and other masters show them better.
    Source: Friswell, Garvey and Penny 1995.
    """
    model = partition(stiffness, mass, masters)
    wanted = max(1, model.masters.size // 2) if n_modes is None else n_modes
    if not 1 <= wanted <= model.masters.size or max_iterations < 1 or not tolerance > 0.0:
        raise ModesError(f"{wanted} modes cannot settle on {model.masters.size} masters")
    t_0, factors, condition = _static_rows(model)
    t, before, converged, iteration = t_0, np.full(wanted, np.inf), False, 0
    k, m = model.project(model.transformation(t))
    while not converged and iteration < max_iterations:
        iteration += 1
        t, worst = _with_inertia(model, factors, t_0, t, k, m)
        condition = max(condition, worst)
        k, m = model.project(model.transformation(t))
        _mass_condition(m)
        eigenvalues = linalg.eigh(k, m, eigvals_only=True, subset_by_index=(0, wanted - 1))
        change = float(np.abs(eigenvalues - before).max())
        converged = change <= tolerance * float(np.abs(eigenvalues).max())
        before = eigenvalues
    whole = model.transformation(t)
    return Reduction("iterated_irs", k, m, whole, model.masters, condition, iteration, converged)


def serep(stiffness: Matrix, mass: Matrix, masters: ArrayLike, mode_shapes: Floats) -> Reduction:
    """Reduction that keeps given modes exactly.

    As guyan; mode_shapes: (n, n_modes), real, of the model. With fewer modes than masters the
    reduced matrices have rank n_modes; with more (least-length pseudo-inverse, A (23)) no mode
    is kept exactly. Raises ModesError if the shapes do not fit or cannot be separated at the
    masters. Source: O'Callahan, Avitabile and Riemer 1989; thesis A (18)-(25).
    """
    model = partition(stiffness, mass, masters)
    inverse, condition = basis_inverse(mode_shapes, model.masters, model.stiffness.shape[0])
    whole = np.asarray(mode_shapes, dtype=np.float64) @ inverse
    return _reduction("serep", model, whole, condition)


def craig_bampton(stiffness: Matrix, mass: Matrix, masters: ArrayLike, n_fixed: int) -> Reduction:
    """Static reduction with the lowest modes of the model whose masters are held.

    As guyan; n_fixed: how many of them, 0 for Guyan's. Their amplitudes, each of unit modal mass,
    are unknowns behind the masters, so K_r is [[K_guyan, 0], [0, W]]. Source: Craig and Bampton
    1968.
    """
    model = partition(stiffness, mass, masters)
    if not 0 <= n_fixed <= model.slaves.size:
        raise ModesError(
            f"{n_fixed} fixed-interface modes are asked of a model of {model.slaves.size} unknowns "
            "besides its masters"
        )
    t, _, condition = _static_rows(model)
    whole = np.zeros((model.stiffness.shape[0], model.masters.size + n_fixed))
    whole[:, : model.masters.size] = model.transformation(t)
    if n_fixed:
        inner: list[Any] = [a[model.slaves][:, model.slaves] for a in (model.stiffness, model.mass)]
        whole[model.slaves, model.masters.size :] = solve_modes(inner[0], inner[1], n_fixed)[1]
    return _reduction("craig_bampton", model, whole, condition)


def reduced_modes(reduced: Reduction) -> tuple[Floats, Floats]:
    """Eigenvalues of a reduced model (n_modes,) ascending, and its modes at all unknowns.

    Mass-normalised shapes (n, n_modes). A reduced mass matrix of lower rank (SEREP of fewer modes
    than masters) has as many modes as its rank. Raises ModelError where no master has mass.
    """
    diagonal = np.diag(reduced.mass)
    if not (diagonal > 0.0).any():
        raise ModelError("the reduced mass matrix is zero: keep unknowns that carry mass")
    scale = 1.0 / np.sqrt(np.where(diagonal > 0.0, diagonal, 1.0))  # units do not count
    masses, axes = np.linalg.eigh(reduced.mass * scale[:, None] * scale)
    # An eigenvalue is known to the number of unknowns times eps; products with T cost some more.
    kept = masses > 1e3 * masses.size * np.finfo(np.float64).eps * masses.max()
    basis = scale[:, None] * axes[:, kept] / np.sqrt(masses[kept])
    eigenvalues, shapes = np.linalg.eigh(basis.T @ reduced.stiffness @ basis)
    return eigenvalues, reduced.transformation @ (basis @ shapes)


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
            f"{phi.shape[1]} modes cannot be separated at {rows.size} unknowns: condition number "
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
    model: Partition, factors: Factorisation | None, t_0: Floats, t: Floats, k: Floats, m: Floats
) -> tuple[Floats, float]:
    """The next t of IRS from t_i and its K_r, M_r; with the condition of M_r."""
    worst = _mass_condition(m)
    if factors is None:
        return t_0, worst
    return t_0 + factors.solve(model.inertia(t)) @ np.linalg.solve(m, k), worst


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
    method: Literal["guyan", "dynamic", "irs", "serep", "craig_bampton"],
    model: Partition,
    transformation: Floats,
    condition: float,
    iterations: int = 0,
) -> Reduction:
    k, m = model.project(transformation)
    return Reduction(method, k, m, transformation, model.masters, condition, iterations)
