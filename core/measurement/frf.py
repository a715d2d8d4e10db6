"""Frequency response functions: what moves, how much, per unit harmonic force; how alike two are.

Receptance H = x / f of M x'' + C x' + (1 + i eta) K x = f at circular frequency w, directly,

    H(w) = (K + i D - w^2 M + i w C)^-1,

or from mass-normalised modes of the undamped model,

    H_jk(w) = sum_r phi_jr phi_kr / (w_r^2 - w^2 + i d_r) + upper_jk - lower_jk / w^2,
    d_r = 2 zeta_r w_r w  (viscous)   or   eta_r w_r^2  (structural).

The residual terms stand for the modes left out: upper for those above (residual flexibility), lower
for those below and rigid motion (Ewins 2000, 4.3). Static equilibrium gives the upper term
exactly at rest: upper = K^-1 - sum_r phi_r phi_r^T / w_r^2. Mobility is i w H, accelerance -w^2 H.

Modal damping without a matrix, C = sum_r 2 zeta_r w_r M phi_r phi_r^T M, would be dense. Since
modes are orthogonal it acts only along them:

    H f = sum_r phi_r (phi_r^T f) / (w_r^2 - w^2 + i d_r) + P (K - w^2 M)^-1 (f - M phi phi^T f),
    P = I - phi phi^T M,

whose second term has no pole at the damped modes; the matrix stays real and sparse.

Measured and computed ones are compared by the MAC's cosine with another axis: over the lines of one
response, the frequency response assurance criterion

    FRAC_jk = |sum_w H_X(w) conj(H_A(w))|^2 / (sum_w |H_X|^2 * sum_w |H_A|^2)

is 1 where curves are equal up to a factor, and falls fast with a shift in frequency (Heylen and
Lammens 1996).
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import sparse

from modetune.core.algebra.factorisation import Matrix, factorise, symmetric_matrix
from modetune.core.condensation.reduction import checked_rows
from modetune.core.errors import ModelError, ModesError
from modetune.core.modes import Floats, Integers

Response = Literal["receptance", "mobility", "accelerance"]
Complexes = NDArray[np.complex128]


@dataclass(frozen=True, slots=True)
class NormalModes:
    """Undamped modes with damping.

    eigenvalues: (n_modes,), (rad/s)^2, 0 or more; slightly negative rigid ones are taken for 0.
    mode_shapes: (n_dof, n_modes), real, mass-normalised. damping: (n_modes,), ratio zeta if
    viscous, loss factor eta if structural, 0 or more; empty for none. Raises ModesError otherwise.
    """

    eigenvalues: Floats
    mode_shapes: Floats
    damping: Floats = field(default_factory=lambda: np.zeros(0))
    kind: Literal["viscous", "structural"] = "viscous"

    def __post_init__(self) -> None:
        n_modes = self.eigenvalues.size
        shapes = self.mode_shapes
        if shapes.ndim != 2 or shapes.shape[1] != n_modes or self.eigenvalues.shape != (n_modes,):
            raise ModesError(f"shapes {shapes.shape} and {n_modes} eigenvalues do not fit together")
        if np.iscomplexobj(shapes) or n_modes == 0:
            raise ModesError("responses are superposed from real modes, at least one")
        if self.damping.shape not in ((0,), (n_modes,)):
            raise ModesError(f"damping of shape {self.damping.shape} for {n_modes} modes")
        values = (self.eigenvalues, shapes, self.damping)
        if not all(np.isfinite(value).all() for value in values) or (self.damping < 0.0).any():
            raise ModesError("modes and damping must be finite, and damping not negative")
        if self.eigenvalues.min() < -1e-6 * np.abs(self.eigenvalues).max() - 1.0:
            raise ModesError(f"eigenvalue {self.eigenvalues.min():.3e} is negative: no stable mode")

    def gains(self, omega: Floats) -> Complexes:
        """1 / (w_r^2 - w^2 + i d_r), (n_lines, n_modes), at circular frequencies (n_lines,)."""
        lam = np.maximum(self.eigenvalues, 0.0)
        damping = self.damping if self.damping.size else np.zeros(lam.size)
        if self.kind == "viscous":
            d = 2.0 * damping * np.sqrt(lam) * omega[:, None]
        else:
            d = damping * lam * np.ones_like(omega)[:, None]
        stiffness = lam - omega[:, None] ** 2 + 1j * d
        if (stiffness == 0.0).any():
            raise ModesError("an undamped mode lies exactly at an excitation frequency")
        return np.asarray(1.0 / stiffness)


@dataclass(frozen=True, slots=True)
class Residuals:
    """Modes left out: upper (n_outputs, n_inputs), flexibility; lower likewise, 1/mass."""

    upper: Floats
    lower: Floats


@dataclass(frozen=True, slots=True)
class Damping:
    """Damping given as matrices or a factor; what is not given is zero.

    viscous: C (n, n), force per velocity. structural: D (n, n), imaginary stiffness.
    loss_factor: eta of the whole stiffness, D = eta K.
    """

    viscous: Matrix | None = None
    structural: Matrix | None = None
    loss_factor: float = 0.0


def modal_frf(
    excitation_hz: ArrayLike,
    modes: NormalModes,
    outputs: ArrayLike,
    inputs: ArrayLike,
    response: Response = "receptance",
    residuals: Residuals | None = None,
) -> Complexes:
    """Responses superposed from modes.

    excitation_hz: (n_lines,), 0 or more; outputs, inputs: rows of the shapes. Returns (n_lines,
    n_outputs, n_inputs) in the model's units of length (per s, per s^2) per force. Raises
    ModesError where rows, residuals or frequencies do not fit, or an undamped mode is met.
    Source: Ewins 2000, 2.4 and 4.3.
    """
    omega = _omega(excitation_hz)
    n = modes.mode_shapes.shape[0]
    seen = modes.mode_shapes[checked_rows(outputs, n)]
    driven = modes.mode_shapes[checked_rows(inputs, n)]
    receptance = np.einsum("wr,jr,kr->wjk", modes.gains(omega), seen, driven, optimize=True)
    if residuals is not None:
        shape = receptance.shape[1:]
        if residuals.upper.shape != shape or residuals.lower.shape != shape:
            raise ModesError(
                f"residuals {residuals.upper.shape}, {residuals.lower.shape} for responses {shape}"
            )
        receptance = receptance + residuals.upper
        if residuals.lower.any():
            if (omega == 0.0).any():
                raise ModesError("a lower residual has no response at 0 Hz")
            receptance = receptance - residuals.lower / omega[:, None, None] ** 2
    return _as_response(receptance, omega, response)


def residual_flexibility(
    stiffness: Matrix, modes: NormalModes, outputs: ArrayLike, inputs: ArrayLike
) -> Residuals:
    """What the modes lack at rest; the lower residual is zero.

    stiffness: (n, n), sparse, of a held structure; modes: of all its n unknowns; outputs, inputs:
    rows. Raises ModelError where the structure is free (K^-1 does not exist), ModesError where
    modes do not fit or one has eigenvalue 0. Source: Ewins 2000, 4.3; MacNeal 1971.
    """
    factors = factorise(stiffness)
    seen, driven = checked_rows(outputs, factors.n), checked_rows(inputs, factors.n)
    phi = modes.mode_shapes
    if phi.shape[0] != factors.n or not (modes.eigenvalues > 0.0).all():
        raise ModesError(f"elastic modes of all {factors.n} unknowns are needed, not {phi.shape}")
    flexibility = factors.solve(_unit_forces(factors.n, driven))[seen]
    upper = flexibility - (phi[seen] / modes.eigenvalues) @ phi[driven].T
    return Residuals(upper, np.zeros_like(upper))


def direct_frf(
    excitation_hz: ArrayLike,
    stiffness: Matrix,
    mass: Matrix,
    outputs: ArrayLike,
    inputs: ArrayLike,
    damping: Damping | None = None,
    response: Response = "receptance",
) -> Complexes:
    """Responses from the model's matrices, one factorisation a frequency.

    stiffness, mass: (n, n), sparse, symmetric; others and result as modal_frf. Raises ModelError
    where the matrices are not a model, or are singular at a frequency (undamped resonance, free at
    0 Hz). Source: Ewins 2000, 2.5-2.7.
    """
    omega = _omega(excitation_hz)
    k, m = _model(stiffness, mass)
    seen, driven = checked_rows(outputs, k.shape[0]), checked_rows(inputs, k.shape[0])
    given = Damping() if damping is None else damping
    if not (np.isfinite(given.loss_factor) and given.loss_factor >= 0.0):
        raise ModelError(f"a loss factor of {given.loss_factor} does not damp")
    c = _damping_matrix(given.viscous, k, "viscous damping")
    d = _damping_matrix(given.structural, k, "structural damping")
    complex_k = k + 1j * (given.loss_factor * k + d) if given.loss_factor or d.nnz else k
    forces = _unit_forces(k.shape[0], driven)
    receptance = np.empty((omega.size, seen.size, driven.size), dtype=np.complex128)
    for line, w in enumerate(omega.tolist()):
        dynamic = complex_k - w**2 * m
        receptance[line] = factorise(dynamic + 1j * w * c if c.nnz else dynamic).solve(forces)[seen]
    return _as_response(receptance, omega, response)


def modally_damped_frf(
    excitation_hz: ArrayLike,
    stiffness: Matrix,
    mass: Matrix,
    modes: NormalModes,
    outputs: ArrayLike,
    inputs: ArrayLike,
    response: Response = "receptance",
) -> Complexes:
    """Responses from the matrices with damping known for some modes only; the rest are undamped.

    modes: of this model, all n unknowns, mass-normalised. Otherwise as direct_frf. Raises
    ModesError also where the modes are not orthonormal modes of the model to 10^-4.
    Source: the module's docstring.
    """
    omega = _omega(excitation_hz)
    k, m = _model(stiffness, mass)
    seen, driven = checked_rows(outputs, k.shape[0]), checked_rows(inputs, k.shape[0])
    phi = modes.mode_shapes
    if phi.shape[0] != k.shape[0]:
        raise ModesError(f"modes of {phi.shape[0]} unknowns for a model of {k.shape[0]}")
    m_phi = np.asarray(m @ phi)
    _check_modes(modes, phi.T @ m_phi, phi.T @ (k @ phi))
    receptance = modal_frf(omega / (2.0 * np.pi), modes, outputs, inputs)
    forces = _unit_forces(k.shape[0], driven) - m_phi @ phi[driven].T
    for line, w in enumerate(omega.tolist()):
        # At resonance the matrix is singular along phi alone, which the forces do not reach and P
        # takes out of the answer.
        rest = factorise(k - w**2 * m, singular_condition=np.inf).solve(forces)
        receptance[line] += rest[seen] - phi[seen] @ (m_phi.T @ rest)
    return _as_response(receptance, omega, response)


def _omega(excitation_hz: ArrayLike) -> Floats:
    lines = np.asarray(excitation_hz, dtype=np.float64)
    if lines.ndim != 1 or lines.size == 0 or not np.isfinite(lines).all() or (lines < 0.0).any():
        raise ModesError("excitation frequencies must be a list of finite values from 0 Hz on")
    return np.asarray(2.0 * np.pi * lines)


def _as_response(receptance: Complexes, omega: Floats, response: Response) -> Complexes:
    match response:
        case "receptance":
            return receptance
        case "mobility":
            return np.asarray(1j * omega[:, None, None] * receptance)
        case "accelerance":
            return np.asarray(-(omega[:, None, None] ** 2) * receptance)
        case _:
            raise ModesError(f"a response is receptance, mobility or accelerance, not {response!r}")


def _model(stiffness: Matrix, mass: Matrix) -> tuple[Any, Any]:
    k, m = symmetric_matrix(stiffness, "stiffness"), symmetric_matrix(mass, "mass matrix")
    if k.shape != m.shape:
        raise ModelError(f"stiffness is {k.shape}, mass is {m.shape}: not one model")
    return k, m


def _damping_matrix(matrix: Matrix | None, k: Any, name: str) -> Any:
    if matrix is None:
        return sparse.csr_array(k.shape)
    given = symmetric_matrix(matrix, name)
    if given.shape != k.shape:
        raise ModelError(f"{name} is {given.shape}, stiffness is {k.shape}")
    return given


def _unit_forces(n: int, rows: Integers) -> Floats:
    forces = np.zeros((n, rows.size))
    forces[rows, np.arange(rows.size)] = 1.0
    return forces


def _check_modes(modes: NormalModes, modal_mass: Floats, modal_stiffness: Floats) -> None:
    largest = float(np.abs(modes.eigenvalues).max())
    off_mass = float(np.abs(modal_mass - np.eye(modal_mass.shape[0])).max())
    off_stiffness = float(np.abs(modal_stiffness - np.diag(modes.eigenvalues)).max())
    if off_mass > 1e-4 or off_stiffness > 1e-4 * largest:
        raise ModesError(
            f"these are not mass-normalised modes of this model: phi^T M phi is off the unit "
            f"matrix by {off_mass:.1e}, phi^T K phi off the eigenvalues by {off_stiffness:.1e}"
        )


def frac(measured: Complexes, computed: Complexes) -> Floats:
    """Frequency response assurance criterion of each response, (n_outputs, n_inputs), in [0, 1].

    measured, computed: (n_lines, n_outputs, n_inputs) at the same lines, any unit. Raises
    ModesError where they do not fit, or a response is zero or not finite.
    Source: Heylen and Lammens 1996.
    """
    a, b = _responses(measured), _responses(computed)
    if a.shape != b.shape:
        raise ModesError(f"measured responses {a.shape} and computed ones {b.shape} do not fit")
    size_a, size_b = np.abs(a).max(axis=0), np.abs(b).max(axis=0)
    if (size_a == 0.0).any() or (size_b == 0.0).any():
        raise ModesError("a response is zero at all lines: it has no FRAC")
    a, b = a / size_a, b / size_b
    cross = np.abs(np.sum(a * b.conj(), axis=0)) ** 2
    lengths = np.sum(np.abs(a) ** 2, axis=0) * np.sum(np.abs(b) ** 2, axis=0)
    return np.asarray(np.minimum(cross / lengths, 1.0))


def _responses(values: Complexes) -> Complexes:
    responses = np.asarray(values)
    if responses.ndim != 3 or 0 in responses.shape:
        raise ModesError(
            f"responses must be (n_lines, n_outputs, n_inputs), none empty, not {responses.shape}"
        )
    if not np.isfinite(responses).all():
        raise ModesError("a response is not finite")
    return responses
