"""Modes of models that are small, or have mass at few unknowns only, by LAPACK.

Where M is singular (unknowns without mass, whose eigenvalues are infinite) the problem is turned
round: M phi = mu (K - s M) phi, mu = 1 / (lambda - s).
"""

from __future__ import annotations

import numpy as np
from scipy import sparse
from scipy.linalg import LinAlgError, eigh

from modetune.core.algebra.pencil import Pencil
from modetune.core.errors import ModelError
from modetune.core.modes import Floats


def solve_whole(pencil: Pencil, n_modes: int) -> tuple[Floats, Floats]:
    """Modes of a small model by LAPACK.

    Returns eigenvalues (n_modes,), ascending, (rad/s)^2, and mass-normalised shapes (n, n_modes).
    Raises ModelError where the matrices allow no solution.
    """
    k, m = _mirrored(pencil.stiffness), _mirrored(pencil.mass)
    try:
        values, vectors = eigh(k, m)
    except LinAlgError:  # M is not positive definite
        return _solve_inverted(k, m, n_modes, 1e-3 * pencil.largest_eigenvalue())
    return values[:n_modes], vectors[:, :n_modes]


def solve_condensed(pencil: Pencil, n_modes: int) -> tuple[Floats, Floats]:
    """Modes of a model with few unknowns that have mass, from its flexibility at these.

    pencil: factorised below the spectrum. Returns theta = 1 / (lambda - s), (n_modes,),
    descending, and shapes (n_with_mass, n_modes). Raises ModelError where there are fewer modes.
    """
    flexibility = pencil.apply(np.eye(pencil.n_with_mass, order="F"))[pencil.rows]
    inertia = pencil.inertia(np.eye(pencil.n_with_mass))
    # M G M x = theta M x, with all eigenvalues of M above zero.
    squares, turned = eigh(inertia)
    own = squares > 1e-14 * squares[-1]
    root = turned[:, own] * np.sqrt(squares[own])
    inverted, vectors = eigh(root.T @ flexibility @ root)
    inverted, vectors = inverted[::-1][:n_modes], vectors[:, ::-1][:, :n_modes]
    if inverted.size < n_modes:
        raise ModelError(
            f"{n_modes} modes were asked of a model with {int(own.sum())} unknowns that have mass"
        )
    shapes = turned[:, own] @ (vectors / np.sqrt(squares[own])[:, None])
    return inverted, shapes


def _mirrored(upper: sparse.csr_array) -> Floats:
    above = upper.toarray()
    return np.asarray(above + np.triu(above, 1).T)


def _solve_inverted(k: Floats, m: Floats, n_modes: int, below: float) -> tuple[Floats, Floats]:
    """Modes of a model with unknowns that have no mass, by mu = 1 / (lambda + below)."""
    try:
        inverted, vectors = eigh(m, k + below * m)
    except LinAlgError as error:
        raise ModelError(
            "the mass and stiffness matrices allow no modes: an unknown has neither, or one of "
            "the matrices has negative eigenvalues"
        ) from error
    inverted, vectors = inverted[::-1], vectors[:, ::-1]
    with_mass = int(np.sum(inverted > 1e-12 * inverted[0]))
    if inverted[-1] < -1e-9 * inverted[0]:
        raise ModelError("the mass matrix has negative eigenvalues: it is not a mass matrix")
    if n_modes > with_mass:
        raise ModelError(
            f"{n_modes} modes were asked of a model with {with_mass} unknowns that have mass"
        )
    kept = inverted[:n_modes]
    return 1.0 / kept - below, vectors[:, :n_modes] / np.sqrt(kept)
