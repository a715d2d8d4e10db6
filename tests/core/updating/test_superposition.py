"""Response functions with modal damping beside (K - w^2 M + i w C)^-1 of full matrices."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import sparse

from modetune.core.algebra.matrices import MatrixResult
from modetune.core.measurement.frf import Complexes
from modetune.core.modes import Floats
from modetune.core.updating.superposition import FrfModes

SIZE = 400
DOFS = np.array([3, 100, 250])
THETA = np.array([1.2, 0.8])
#: Ratios of the lowest modes, and of all others.
RATIOS, REST = (0.01, 0.02, 0.005, 0.03, 0.01, 0.012, 0.02, 0.02), 0.01


def chain(theta: Floats, free: bool) -> tuple[Floats, Floats]:
    """400 masses; theta: of the stiffness of the first 150 springs, the mass of the last 200."""
    springs = np.full(SIZE + 1, 1e7)
    springs[:150] *= theta[0]
    if free:
        springs[[0, -1]] = 0.0
    stiffness = np.diag(springs[:-1] + springs[1:])
    stiffness -= np.diag(springs[1:-1], 1) + np.diag(springs[1:-1], -1)
    masses = np.ones(SIZE)
    masses[200:] *= theta[1]
    return stiffness, masses


def direct(theta: Floats, free: bool, omega: Floats) -> Complexes:
    """Receptances (n_lines, n_dofs, n_dofs) with the damping matrix of modal ratios."""
    stiffness, masses = chain(theta, free)
    root = np.sqrt(masses)
    lam, turned = np.linalg.eigh(stiffness / np.outer(root, root))
    ratios = np.full(SIZE, REST)
    ratios[: len(RATIOS)] = RATIOS
    ratios[0] *= not free
    moving = root[:, None] * turned
    damping = (moving * (2.0 * ratios * np.sqrt(np.maximum(lam, 0.0)))) @ moving.T
    forces = np.eye(SIZE)[:, DOFS]
    return np.array(
        [
            np.linalg.solve(stiffness - w**2 * np.diag(masses) + 1j * w * damping, forces)[DOFS]
            for w in omega
        ]
    )


@pytest.mark.parametrize("free", [False, True])
def test_values_and_derivatives_are_those_of_full_matrices(free: bool) -> None:
    stiffness, masses = chain(THETA, free)
    hz = 1e7**0.5 / SIZE / 2.0 * np.linspace(0.7, 7.5, 7)  # between the modes of a uniform chain
    omega = 2.0 * np.pi * hz
    matrices = MatrixResult.of_full(
        sparse.csr_array(stiffness),
        sparse.diags_array(masses).tocsr(),
        np.arange(SIZE),
        np.ones(SIZE, dtype=np.int64),
    )
    dofs = sparse.csr_array(np.eye(SIZE)[DOFS])
    modes = FrfModes.of(matrices, dofs, float(hz[-1]), 8)
    ratios = np.full(modes.tau.size, REST)
    ratios[: len(RATIOS)] = RATIOS
    modes = modes.damped(ratios)
    exact = direct(THETA, free, omega)
    pairs = [(j, k) for j in range(DOFS.size) for k in range(DOFS.size)]
    found = np.stack([modes.receptance(omega, j, k) for j, k in pairs], axis=1)
    whole = exact.reshape(omega.size, -1)
    scale = np.abs(whole).max(axis=0)
    # The first that is left out answers with (w / w_r)^2 of its square, after residual vectors.
    assert np.abs(found - whole).max(axis=0) == pytest.approx(np.zeros(9), abs=2e-4 * scale.max())
    step = 1e-4
    for column in range(2):
        moved = step * np.eye(2)[column]
        ahead, behind = chain(THETA + moved, free), chain(THETA - moved, free)
        d_stiffness = sparse.csr_array(np.triu(ahead[0] - behind[0]) / (2.0 * step))
        d_mass = sparse.diags_array((ahead[1] - behind[1]) / (2.0 * step)).tocsr()
        change = modes.change(d_stiffness, d_mass)
        slopes = np.stack([modes.slope(omega, j, k, change) for j, k in pairs], axis=1)
        both = direct(THETA + moved, free, omega) - direct(THETA - moved, free, omega)
        wanted = both.reshape(omega.size, -1) / (2.0 * step)
        assert np.abs(slopes - wanted).max() < 1e-3 * np.abs(wanted).max()


def test_repeated_modes_have_finite_derivatives() -> None:
    """Two equal oscillators: d(1 / (k - w^2 m + i w c))/dk of each is the closed form."""
    base = MatrixResult.of_full(
        sparse.csr_array(np.diag([4.0, 4.0, 50.0])),
        sparse.csr_array(np.eye(3)),
        np.arange(3),
        np.ones(3, dtype=np.int64),
    )
    modes = FrfModes.of(base, sparse.csr_array(np.eye(3)), 0.4, 3).damped(np.full(3, 0.05))
    omega = np.array([1.0, 2.0])
    change = modes.change(sparse.csr_array(np.diag([1.0, 0.0, 0.0])), sparse.csr_array((3, 3)))
    gain = 1.0 / (4.0 - omega**2 + 2j * 0.05 * 2.0 * omega)
    # of k and of c = 2 zeta sqrt(k m)
    wanted = -(gain**2) * (1.0 + 1j * omega * 0.05 / 2.0)
    assert modes.slope(omega, 0, 0, change) == pytest.approx(wanted, rel=1e-9)
    assert modes.slope(omega, 1, 1, change) == pytest.approx(np.zeros(2), abs=1e-9)
