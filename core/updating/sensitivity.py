"""Derivatives of eigenvalues and mode shapes with respect to parameters.

With K phi = lambda M phi and phi^T M phi = 1, a parameter p changes a mode by

    d lambda = phi^T (dK - lambda dM) phi                             (Fox and Kapoor 1968)
    (K - lambda M) d phi = (d lambda M + lambda dM - dK) phi,
    phi^T M d phi = -1/2 phi^T dM phi                                 (Nelson 1976)

The matrix K - lambda M is singular along phi, and along every mode of (nearly) the same
eigenvalue. Nelson's equation is therefore solved outside the space of these modes; the part of
d phi inside it follows, for modes that are distinct at all, from the modal sum

    d phi_i += sum_k phi_k * phi_k^T (dK - lambda_i dM) phi_i / (lambda_i - lambda_k).

Where stiffness is proportional to a parameter E over an element group, phi^T dK phi is
2 U_group / E with U the group's strain energy in the mass-normalised mode.

Broyden's update corrects a sensitivity matrix by what the last step showed. Of all rows that
explain their own part of it, S'_i dtheta = dz_i, it takes those changed least (Broyden 1965),

    sum_j (S'_ij - S_ij)^2 / w_ij least:   S'_ij = S_ij + (dz_i - S_i dtheta) w_ij dtheta_j
                                                          / sum_k w_ik dtheta_k^2.

A frequency hardly depends on a parameter whose part it does not strain, wherever the others are;
its entries are changed in proportion to their own size, w_ij = S_ij^2. Entries of shapes pass
through zero as the shapes turn: w_ij = 1.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from modetune.core.algebra.factorisation import factorise
from modetune.core.errors import ModesError
from modetune.core.modes import REPEATED, Floats, Integers

#: How freely Broyden's update changes an entry of zero among the frequencies', in mean squares of
#: its row.
LEAST_FREEDOM = 1e-4


@dataclass(frozen=True, slots=True)
class ModeDerivatives:
    """Derivatives of modes with respect to all parameters, relative values each.

    eigenvalues: (n_modes, n_parameters), (rad/s)^2.
    mode_shapes: (n_dof, n_modes, n_parameters), of mass-normalised shapes; n_dof is 0 where only
    frequencies were asked for. In an updating step the modes are those of the pairs, in order.
    """

    eigenvalues: Floats
    mode_shapes: Floats

    def column(self, place: int) -> ModeDerivatives:
        """The derivatives with respect to one parameter."""
        return ModeDerivatives(self.eigenvalues[:, [place]], self.mode_shapes[:, :, [place]])


def stack_derivatives(columns: list[ModeDerivatives]) -> ModeDerivatives:
    """Derivatives of several parameters side by side."""
    return ModeDerivatives(
        eigenvalues=np.concatenate([column.eigenvalues for column in columns], axis=1),
        mode_shapes=np.concatenate([column.mode_shapes for column in columns], axis=2),
    )


def strain_energy_derivative(energies: Floats, value: float) -> Floats:
    """d lambda / d p of a parameter to which the stiffness of one group is proportional.

    energies: (n_modes,), strain energy of the group in mass-normalised modes; value: p.
    Source: 2 U = phi^T K_group phi, K_group proportional to p.
    """
    return 2.0 * energies / value


def fox_kapoor(
    eigenvalues: Floats,
    mode_shapes: Floats,
    stiffness_change: sparse.csr_array,
    mass_change: sparse.csr_array,
) -> Floats:
    """d lambda of mass-normalised modes, (n_modes,).

    mode_shapes: (n, n_modes); stiffness_change, mass_change: (n, n), dK/dp and dM/dp.
    Source: Fox and Kapoor 1968. For modes of equal eigenvalue give the shapes that change
    smoothly with p; else the derivatives of the pair are mixed.
    """
    phi = mode_shapes
    return np.asarray(
        np.sum(phi * (stiffness_change @ phi), axis=0)
        - eigenvalues * np.sum(phi * (mass_change @ phi), axis=0)
    )


def nelson(
    stiffness: sparse.csr_array,
    mass: sparse.csr_array,
    eigenvalues: Floats,
    mode_shapes: Floats,
    changes: list[tuple[sparse.csr_array, sparse.csr_array]],
    modes: list[int],
    rows: Integers,
    cluster_width: float = 1e-5,
) -> ModeDerivatives:
    """Derivatives of chosen modes for several parameters from one factorisation a mode.

    stiffness, mass: (n, n); eigenvalues (n_modes,), mode_shapes (n, n_modes): mass-normalised,
    with the neighbours of the chosen modes among them; changes: (dK/dp, dM/dp) of each parameter;
    modes: positions of the modes whose derivatives are wanted; rows: unknowns at which shape
    derivatives are wanted; cluster_width: relative eigenvalue distance below which modes are
    solved for together (K - lambda M is close to singular there; the error made by taking them
    for equal is of the size of this distance). Returns derivatives of those modes and rows only.
    Single modes of exactly equal eigenvalue have no derivative of shape; theirs is the change out
    of their common space. Raises ModesError where an eigenvalue is not finite.
    Source: Nelson 1976; Dailey 1989 for the space orthogonal to a cluster.
    """
    if not np.isfinite(eigenvalues).all():
        raise ModesError("eigenvalues must be finite")
    d_lam = np.empty((len(modes), len(changes)))
    d_phi = np.empty((rows.size, len(modes), len(changes)))
    for place, mode in enumerate(modes):
        lam, phi = float(eigenvalues[mode]), mode_shapes[:, mode]
        near = np.abs(eigenvalues - lam) <= cluster_width * abs(lam)
        basis = mode_shapes[:, near]
        forces = np.stack([lam * (dm @ phi) - dk @ phi for dk, dm in changes], axis=1)
        m_basis = mass @ basis
        # Forces without their part along the cluster leave a solution that needs none of it.
        outside = forces - m_basis @ (basis.T @ forces)
        solution = _solve_shifted(stiffness, mass, lam, mode_shapes[:, near], outside)
        change = solution - basis @ (m_basis.T @ solution)
        for column, (dk, dm) in enumerate(changes):
            d_lam[place, column] = phi @ (dk @ phi) - lam * (phi @ (dm @ phi))
            inside = _inside_cluster(eigenvalues, mode_shapes, mode, near, dk, dm)
            d_phi[:, place, column] = (change[:, column] + inside)[rows]
    return ModeDerivatives(d_lam, d_phi)


def _solve_shifted(
    stiffness: sparse.csr_array, mass: sparse.csr_array, lam: float, basis: Floats, forces: Floats
) -> Floats:
    """Solve (K - lam M) x = f for f without a part along the basis, which K - lam M cannot see.

    Nelson fixes, for each mode of the cluster, the unknown where it moves most; the equations of
    these unknowns are then satisfied automatically. Unlike a shift of the eigenvalue this keeps the
    matrix sparse and the answer exact.
    """
    fixed = _largest_rows(basis)
    keep = np.setdiff1d(np.arange(stiffness.shape[0]), fixed)
    shifted = sparse.csr_array(stiffness - lam * mass)
    reduced = sparse.csc_array(shifted[keep][:, keep])
    solution = np.zeros_like(forces)
    solution[keep] = factorise(reduced, np.inf).solve(forces[keep])
    return solution


def _largest_rows(basis: Floats) -> Integers:
    """Return the rows that separate the columns of a basis best: pivots of an LU with complete
    pivoting."""
    work, rows = basis.copy(), []
    for _ in range(basis.shape[1]):
        row, column = np.unravel_index(int(np.argmax(np.abs(work))), work.shape)
        rows.append(int(row))
        work = work - np.outer(work[:, column] / work[row, column], work[row])
    return np.array(rows, dtype=np.int64)


def _inside_cluster(
    eigenvalues: Floats,
    mode_shapes: Floats,
    mode: int,
    near: NDArray[np.bool_],
    stiffness_change: sparse.csr_array,
    mass_change: sparse.csr_array,
) -> Floats:
    """Return the part of d phi along the modes of the cluster, the mode itself included."""
    lam, phi = eigenvalues[mode], mode_shapes[:, mode]
    mass_part = mass_change @ phi
    force = stiffness_change @ phi - lam * mass_part
    change = np.asarray(-0.5 * (phi @ mass_part) * phi)
    for other in np.flatnonzero(near).tolist():
        gap = lam - eigenvalues[other]
        if other != mode and abs(gap) > REPEATED * abs(lam):
            change = change + mode_shapes[:, other] * (mode_shapes[:, other] @ force) / gap
    return change


def broyden_update(
    sensitivity: Floats, step: Floats, change: Floats, n_frequencies: int = 0
) -> Floats:
    """The sensitivity closest to the given one that explains the last step.

    sensitivity: (n_residuals, n_parameters); step: (n_parameters,), taken; change:
    (n_residuals,), of the computed values in that step. n_frequencies: how many of the first rows
    are of frequencies, whose entries change in proportion to their own size. Source: Broyden 1965.
    """
    if not step.any():
        return sensitivity
    freedom = np.ones_like(sensitivity)
    squares = sensitivity[:n_frequencies] ** 2
    mean = squares.mean(axis=1, keepdims=True)
    # A row of zeros has no sizes to go by, and no step may be one that its row cannot explain.
    freedom[:n_frequencies] = np.where(mean > 0.0, squares + LEAST_FREEDOM * mean, 1.0)
    scaled = freedom * step
    wrong = (change - sensitivity @ step) / (scaled @ step)
    return np.asarray(sensitivity + wrong[:, None] * scaled)
