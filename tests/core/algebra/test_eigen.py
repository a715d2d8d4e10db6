"""Modes by shift-invert and by LAPACK against closed forms, and the shift that is found alone."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import sparse

from modetune.core.algebra import eigen, pencil
from modetune.core.algebra.eigen import solve_modes
from modetune.core.algebra.matrices import upper_triangle
from modetune.core.algebra.pencil import Pencil, estimate_shift
from modetune.core.errors import ModelError

K, M = 50.0, 2e-3


def chain(n: int, *, held: bool) -> tuple[sparse.csr_array, sparse.csr_array]:
    """n equal masses and springs, held at one end or free."""
    diagonal = np.full(n, 2.0 * K)
    diagonal[-1] = K
    diagonal[0] = 2.0 * K if held else K
    off = sparse.diags_array(np.full(n - 1, -K), offsets=1)
    stiffness = sparse.diags_array(diagonal) + off + off.T
    return sparse.csr_array(stiffness), sparse.csr_array(sparse.diags_array(np.full(n, M)))


def held_eigenvalue(mode: int, n: int) -> float:
    """4 k / m sin^2((2 j - 1) pi / (4 n + 2)), modes from 1."""
    return float(4.0 * K / M * np.sin((2 * mode - 1) * np.pi / (4 * n + 2)) ** 2)


def free_eigenvalue(mode: int, n: int) -> float:
    """4 k / m sin^2(j pi / 2 n), rigid mode 0."""
    return float(4.0 * K / M * np.sin(mode * np.pi / (2 * n)) ** 2)


@pytest.mark.parametrize("n", [40, 700])
def test_held_and_free_chains_have_their_closed_forms(n: int) -> None:
    assert (n <= eigen.DENSE) == (n == 40)  # one by LAPACK, one by Lanczos
    for held, closed_form, first in ((True, held_eigenvalue, 1), (False, free_eigenvalue, 0)):
        stiffness, mass = chain(n, held=held)
        eigenvalues, shapes = solve_modes(stiffness, mass, 6)
        expected = [closed_form(mode, n) for mode in range(first, first + 6)]
        np.testing.assert_allclose(eigenvalues, expected, rtol=1e-7, atol=1e-12 * K / M)
        np.testing.assert_allclose(shapes.T @ (mass @ shapes), np.eye(6), atol=1e-8)


def test_the_estimated_shift_is_of_the_size_of_the_first_elastic_eigenvalue() -> None:
    stiffness, mass = chain(400, held=False)
    both = upper_triangle(stiffness), upper_triangle(mass)
    assert 1e-3 < -estimate_shift(Pencil(*both)) / free_eigenvalue(1, 400) < 1.0


@pytest.mark.parametrize("least", [1e-10, 5e-6])  # of 2 K / M; the first mode is at 1.5e-5 K / M
def test_a_held_structure_is_factorised_once(least: float, monkeypatch: pytest.MonkeyPatch) -> None:
    shifts = []
    factorise = Pencil.factorise

    def counted(self: Pencil, shift: float) -> None:
        shifts.append(shift)
        factorise(self, shift)

    monkeypatch.setattr(Pencil, "factorise", counted)
    monkeypatch.setattr(pencil, "LEAST_SHIFT", least)
    for held, times in ((True, 1), (False, 2)):
        stiffness, mass = chain(400, held=held)
        shifts.clear()
        eigen.ModeSolver(count=False).solve(upper_triangle(stiffness), upper_triangle(mass), 6)
        assert len(shifts) == times
        assert shifts[0] == pytest.approx(-2.0 * least * K / M)


def test_two_free_chains_have_two_rigid_modes_and_pairs() -> None:
    stiffness, mass = chain(400, held=False)
    double = [sparse.csr_array(sparse.block_diag([a, a])) for a in (stiffness, mass)]
    eigenvalues, _ = solve_modes(double[0], double[1], 6)
    expected = [free_eigenvalue(mode, 400) for mode in (0, 0, 1, 1, 2, 2)]
    np.testing.assert_allclose(eigenvalues, expected, rtol=1e-7, atol=1e-11 * K / M)


@pytest.mark.parametrize("n_free", [0, 400])
def test_unknowns_without_mass_are_carried_along(n_free: int) -> None:
    # Without the mass of the middle one, two springs in series: k / 2 between two masses. With
    # more unknowns (rigid masses far above) the same by Lanczos.
    stiffness = sparse.block_diag(
        [np.array([[K, -K, 0.0], [-K, 2 * K, -K], [0.0, -K, K]]), 1e3 * K * np.eye(n_free)]
    )
    mass = sparse.csr_array(sparse.diags_array(np.array([M, 0.0, M] + [M] * n_free)))
    eigenvalues, shapes = solve_modes(sparse.csr_array(stiffness), mass, 2)
    np.testing.assert_allclose(eigenvalues, [0.0, K / M], rtol=1e-9, atol=1e-9 * K / M)
    np.testing.assert_allclose(shapes.T @ (mass @ shapes), np.eye(2), atol=1e-9)


def test_modes_beyond_the_unknowns_with_mass_are_refused() -> None:
    stiffness = sparse.csr_array([[2 * K, -K], [-K, K]])
    mass = sparse.csr_array(np.diag([M, 0.0]))
    with pytest.raises(ModelError, match="2 modes were asked of a model with 1 unknowns that have"):
        solve_modes(stiffness, mass, 2)
    with pytest.raises(ModelError, match="3 modes were asked of a model with 2 unknowns"):
        solve_modes(stiffness, mass, 3)
