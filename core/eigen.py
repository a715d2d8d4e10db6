"""Modes from stiffness and mass matrices by shift-invert Lanczos.

K phi = lambda M phi is solved for the eigenvalues nearest a shift s below the spectrum, where
K - s M is positive definite even for a free structure with its singular K; one factorisation
serves all iterations (Ericsson and Ruhe 1980). Small models are solved whole by LAPACK, through

    M phi = mu (K - s M) phi,   mu = 1 / (lambda - s),

where M is singular (unknowns without mass, whose eigenvalues are infinite).

The shift should be of the size of the first elastic eigenvalue: much closer to zero it drowns
the elastic modes of a free structure in the rigid ones, much farther away the modes crowd
together seen from it and Lanczos takes long. Where the caller does not know that eigenvalue it is
estimated: with a shift just far enough below zero to be told from rounding, two steps of block
inverse iteration and the Rayleigh quotients of what they leave.
"""

from __future__ import annotations

import numpy as np
from scipy import sparse
from scipy.linalg import LinAlgError, eigh, qr
from scipy.sparse.linalg import ArpackError, LinearOperator, eigsh

from modetune.core.errors import ModelError
from modetune.core.factorisation import factorise
from modetune.core.modes import Floats, count_rigid_modes

#: Models up to this many unknowns are solved whole.
DENSE = 300
#: A shift of this share of the largest eigenvalue can be told from rounding.
LEAST_SHIFT = 1e-10
#: Shapes in the estimate of the first elastic eigenvalue: six rigid ones and some to spare.
BLOCK = 10


def solve_modes(
    stiffness: sparse.csr_array, mass: sparse.csr_array, n_modes: int, shift: float | None = None
) -> tuple[Floats, Floats]:
    """The lowest modes, rigid ones included.

    stiffness, mass: (n, n), symmetric; shift: (rad/s)^2, negative, of the size of the first
    elastic eigenvalue or somewhat smaller; estimated where it is None. Returns eigenvalues
    (n_modes,) ascending and mass-normalised shapes (n, n_modes). Raises ModelError where the
    matrices allow no solution.
    """
    size = stiffness.shape[0]
    if not 0 < n_modes <= size:
        raise ModelError(f"{n_modes} modes were asked of a model with {size} unknowns")
    if size <= DENSE or n_modes > size // 2:
        return _solve_whole(stiffness, mass, n_modes)
    if shift is None:
        shift = estimate_shift(stiffness, mass)
    inverse = factorise(sparse.csc_array(stiffness - shift * mass))
    operator = LinearOperator((size, size), matvec=inverse.solve, dtype=np.float64)
    # A fixed start makes a run repeat to the last digit.
    start = np.random.default_rng(0).standard_normal(size)
    try:
        values, vectors = eigsh(
            stiffness, n_modes, mass, sigma=shift, OPinv=operator, v0=start,
            ncv=min(size - 1, max(2 * n_modes + 1, 20)),
        )  # fmt: skip
    except ArpackError as error:
        raise ModelError(f"the eigenvalue solution did not end: {error}") from error
    order = np.argsort(values)
    vectors = vectors[:, order]
    lengths = np.sqrt(np.sum(vectors * (mass @ vectors), axis=0))
    return values[order], vectors / lengths


def estimate_shift(stiffness: sparse.csr_array, mass: sparse.csr_array) -> float:
    """A shift below the spectrum, a tenth of about the first elastic eigenvalue, (rad/s)^2.

    stiffness, mass: (n, n), symmetric, n at least 10, stiffness not negative. Raises ModelError
    where there is no mass, or the matrices are singular together. Source: Bathe 2014, 11.6
    (subspace iteration), 11.2.3 (shifts for free structures).
    """
    least = -LEAST_SHIFT * _largest_eigenvalue(stiffness, mass)
    inverse = factorise(sparse.csc_array(stiffness - least * mass))
    start = np.random.default_rng(0).standard_normal((stiffness.shape[0], BLOCK))
    shapes = start
    for _ in range(2):
        shapes = qr(inverse.solve(mass @ shapes), mode="economic")[0]
    small_k, small_m = shapes.T @ (stiffness @ shapes), shapes.T @ (mass @ shapes)
    # Ordered by 1 / (lambda - s): a shape without mass is no obstacle.
    inverted = eigh(small_m, small_k - least * small_m, eigvals_only=True)[::-1]
    eigenvalues = 1.0 / np.maximum(inverted, 1e-300) + least
    rigid = count_rigid_modes(eigenvalues)
    return float(min(-0.1 * eigenvalues[rigid], least))


def _largest_eigenvalue(stiffness: sparse.csr_array, mass: sparse.csr_array) -> float:
    """A number of the size of the largest eigenvalue: the stiffest unknown by itself."""
    inertia = mass.diagonal()
    moving = inertia > 0.0
    if not moving.any():
        raise ModelError("the mass matrix is zero: there is nothing that moves")
    largest = float(np.max(np.abs(stiffness.diagonal()[moving]) / inertia[moving]))
    return largest if largest > 0.0 else 1.0


def _solve_whole(
    stiffness: sparse.csr_array, mass: sparse.csr_array, n_modes: int
) -> tuple[Floats, Floats]:
    k, m = stiffness.toarray(), mass.toarray()
    try:
        values, vectors = eigh(k, m)
    except LinAlgError:  # M is not positive definite
        return _solve_inverted(k, m, n_modes, 1e-3 * _largest_eigenvalue(stiffness, mass))
    return values[:n_modes], vectors[:, :n_modes]


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
        raise ModelError("the mass matrix has negative eigenvalues: it is no mass")
    if n_modes > with_mass:
        raise ModelError(
            f"{n_modes} modes were asked of a model with {with_mass} unknowns that have mass"
        )
    kept = inverted[:n_modes]
    return 1.0 / kept - below, vectors[:, :n_modes] / np.sqrt(kept)
