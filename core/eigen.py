"""Modes from stiffness and mass matrices by shift-invert Lanczos.

K phi = lambda M phi is solved for the eigenvalues nearest a shift s below the spectrum, where
K - s M is positive definite even for a free structure with its singular K; one factorisation
serves all iterations (Ericsson and Ruhe 1980). Small models are solved whole by LAPACK.
"""

from __future__ import annotations

import numpy as np
from scipy import sparse
from scipy.linalg import eigh
from scipy.sparse.linalg import ArpackError, LinearOperator, eigsh

from modetune.core.errors import ModelError
from modetune.core.factorisation import factorise
from modetune.core.modes import Floats

#: Models up to this many unknowns are solved whole.
DENSE = 300


def solve_modes(
    stiffness: sparse.csr_array, mass: sparse.csr_array, n_modes: int, shift: float
) -> tuple[Floats, Floats]:
    """The lowest modes, rigid ones included.

    stiffness, mass: (n, n), symmetric; shift: (rad/s)^2, negative, of the size of the first
    elastic eigenvalue or somewhat smaller. Returns eigenvalues (n_modes,) ascending and
    mass-normalised shapes (n, n_modes). Raises ModelError where the matrices allow no solution.
    """
    size = stiffness.shape[0]
    if not 0 < n_modes <= size:
        raise ModelError(f"{n_modes} modes were asked of a model with {size} unknowns")
    if size <= DENSE or n_modes > size // 2:
        values, vectors = eigh(stiffness.toarray(), mass.toarray())
        return values[:n_modes], vectors[:, :n_modes]
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
