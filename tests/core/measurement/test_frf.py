"""Frequency responses: one oscillator in closed form, and modes against matrices."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import linalg, sparse

from modetune.core.algebra.factorisation import superlu_only
from modetune.core.errors import ModelError, ModesError
from modetune.core.measurement.frf import (
    Damping,
    NormalModes,
    Residuals,
    Response,
    direct_frf,
    modal_frf,
    modally_damped_frf,
    residual_flexibility,
)

LINES = np.linspace(0.0, 0.5, 41)
N = 8


def chain() -> tuple[sparse.csr_array, sparse.csr_array]:
    """Stiffness and mass of N masses in a row, the first held to ground."""
    diagonal = np.full(N, 2.0)
    diagonal[-1] = 1.0
    off = np.full(N - 1, -1.0)
    k: Any = np.diag(diagonal) + np.diag(off, 1) + np.diag(off, -1)
    return sparse.csr_array(k), sparse.csr_array(sparse.diags_array(1.0 + np.arange(N) % 3))


def modes(n_modes: int = N, damping: Any = (), kind: Any = "viscous") -> NormalModes:
    k, m = chain()
    lam, phi = linalg.eigh(k.toarray(), m.toarray())
    return NormalModes(lam[:n_modes], phi[:, :n_modes], np.array(damping, dtype=float), kind)


def test_one_oscillator_answers_in_closed_form() -> None:
    k, m, c = np.array([[200.0]]), np.array([[2.0]]), np.array([[4.0]])
    omega = np.array([0.0, 3.0, 10.0, 40.0])
    expected = 1.0 / (200.0 - 2.0 * omega**2 + 4.0j * omega)
    lines = omega / (2.0 * np.pi)
    direct = direct_frf(lines, k, m, [0], [0], Damping(viscous=c))
    # c = 2 zeta sqrt(k m): zeta = 4 / (2 * 20) = 0.1; the mass-normalised shape is 2^-1/2.
    single = NormalModes(np.array([100.0]), np.array([[2.0**-0.5]]), np.array([0.1]))
    np.testing.assert_allclose(direct[:, 0, 0], expected, rtol=1e-12)
    np.testing.assert_allclose(modal_frf(lines, single, [0], [0])[:, 0, 0], expected, rtol=1e-12)


def test_structural_damping_of_one_oscillator_is_a_complex_spring() -> None:
    omega = np.array([0.0, 10.0])
    expected = 1.0 / (200.0 * (1.0 + 0.05j) - 2.0 * omega**2)
    lines = omega / (2.0 * np.pi)
    k, m = np.array([[200.0]]), np.array([[2.0]])
    by_factor = direct_frf(lines, k, m, [0], [0], Damping(loss_factor=0.05))
    by_matrix = direct_frf(lines, k, m, [0], [0], Damping(structural=0.05 * k))
    single = NormalModes(np.array([100.0]), np.array([[2.0**-0.5]]), np.array([0.05]), "structural")
    np.testing.assert_allclose(by_factor[:, 0, 0], expected)
    np.testing.assert_allclose(by_matrix[:, 0, 0], expected)
    np.testing.assert_allclose(modal_frf(lines, single, [0], [0])[:, 0, 0], expected)


def test_all_modes_with_proportional_damping_are_the_matrices() -> None:
    k, m = chain()
    a, b = 0.01, 0.02
    omega_r = np.sqrt(modes().eigenvalues)
    ratios = 0.5 * (a / omega_r + b * omega_r)  # Rayleigh damping C = a M + b K
    superposed = modal_frf(LINES, modes(damping=ratios), [0, 3, 7], [7, 2])
    direct = direct_frf(LINES, k, m, [0, 3, 7], [7, 2], Damping(viscous=a * m + b * k))
    np.testing.assert_allclose(superposed, direct, rtol=1e-9, atol=1e-12)
    with superlu_only():
        other = direct_frf(LINES, k, m, [0, 3, 7], [7, 2], Damping(viscous=a * m + b * k))
    np.testing.assert_allclose(other, direct, rtol=1e-9, atol=1e-12)


def test_modal_damping_of_some_modes_is_the_dense_matrix_it_stands_for() -> None:
    k, m = chain()
    few = modes(3, [0.01, 0.02, 0.03])
    m_phi = m @ few.mode_shapes
    c = m_phi @ np.diag(2.0 * few.damping * np.sqrt(few.eigenvalues)) @ m_phi.T
    lines = LINES + 0.003  # the undamped modes stay off the lines
    answer = modally_damped_frf(lines, k, m, few, [0, 7], [7])
    expected = direct_frf(lines, k, m, [0, 7], [7], Damping(viscous=c))
    np.testing.assert_allclose(answer, expected, rtol=1e-8, atol=1e-10)


def test_modal_damping_is_finite_exactly_at_an_undamped_frequency() -> None:
    k, m = chain()
    few = modes(3, [0.01, 0.02, 0.03])
    resonances = np.sqrt(few.eigenvalues) / (2.0 * np.pi)
    every = modes(N, [0.01, 0.02, 0.03] + [0.0] * (N - 3))
    answer = modally_damped_frf(resonances, k, m, few, [0, 7], [7])
    np.testing.assert_allclose(answer, modal_frf(resonances, every, [0, 7], [7]), rtol=1e-6)


def test_residual_flexibility_makes_few_modes_exact_at_rest_and_better_above() -> None:
    k, _ = chain()
    few = modes(3, [0.01] * 3)
    residuals = residual_flexibility(k, few, [0, 7], [0, 7])
    static = np.linalg.inv(k.toarray())[np.ix_([0, 7], [0, 7])]
    with_residuals = modal_frf(LINES, few, [0, 7], [0, 7], residuals=residuals)
    without = modal_frf(LINES, few, [0, 7], [0, 7])
    exact = modal_frf(LINES, modes(N, [0.01] * 3 + [0.0] * 5), [0, 7], [0, 7])
    np.testing.assert_allclose(with_residuals[0], static, rtol=1e-10)
    low = few.eigenvalues[2] > (2.0 * np.pi * LINES) ** 2
    better, worse = np.abs(with_residuals - exact)[low], np.abs(without - exact)[low]
    assert better[:, 0, 0].max() < 0.5 * worse[:, 0, 0].max()


def test_a_lower_residual_is_the_rigid_mass_line() -> None:
    # Free mass of 5: H = -1/(5 w^2); as a rigid mode, or as the residual of no mode near.
    rigid = NormalModes(np.array([0.0]), np.array([[5.0**-0.5]]))
    lines = np.array([0.5, 2.0])
    far = NormalModes(np.array([1e12]), np.array([[1e-6]]))
    residual = Residuals(np.zeros((1, 1)), np.array([[0.2]]))
    np.testing.assert_allclose(
        modal_frf(lines, far, [0], [0], residuals=residual), modal_frf(lines, rigid, [0], [0])
    )
    with pytest.raises(ModesError, match="0 Hz"):
        modal_frf([0.0], far, [0], [0], residuals=residual)


def test_mobility_and_accelerance_are_derivatives_of_receptance() -> None:
    k, m = chain()
    some = modes(N, [0.01] * N)
    omega = 2.0 * np.pi * LINES[:, None, None]
    heavy = Damping(loss_factor=0.1)

    def by_modes(kind: Response) -> Any:
        return modal_frf(LINES, some, [1], [2], kind)

    def by_matrices(kind: Response) -> Any:
        return direct_frf(LINES, k, m, [1], [2], heavy, kind)

    for answer in (by_modes, by_matrices):
        receptance = answer("receptance")
        np.testing.assert_allclose(answer("mobility"), 1j * omega * receptance)
        np.testing.assert_allclose(answer("accelerance"), -(omega**2) * receptance)


@given(
    line=st.floats(0.01, 1.0), ratio=st.floats(1e-4, 0.5), pair=st.tuples(*[st.integers(0, 7)] * 2)
)
def test_responses_are_reciprocal_and_passive(
    line: float, ratio: float, pair: tuple[int, int]
) -> None:
    k, m = chain()
    rows = sorted(set(pair))
    damping = Damping(viscous=ratio * (k + m))
    receptance = direct_frf([line], k, m, rows, rows, damping)[0]
    # Maxwell and Betti; and a force does work, so driving-point receptance lags.
    np.testing.assert_allclose(receptance, receptance.T, rtol=1e-8, atol=1e-12)
    assert (np.diag(receptance).imag < 0.0).all()


def test_an_undamped_resonance_is_an_error() -> None:
    k, m = chain()
    line = [float(np.sqrt(modes().eigenvalues[1])) / (2.0 * np.pi)]
    with pytest.raises(ModelError, match="singular"):
        direct_frf(line, k, m, [0], [0])
    exact = NormalModes(np.array([0.0]), np.ones((1, 1)))
    with pytest.raises(ModesError, match="exactly"):
        modal_frf([0.0], exact, [0], [0])


@pytest.mark.parametrize("lines", [[], [-1.0], [np.nan], 3.0])
def test_excitation_frequencies_that_are_none_are_refused(lines: Any) -> None:
    with pytest.raises(ModesError, match="excitation"):
        modal_frf(lines, modes(), [0], [0])
    with pytest.raises(ModesError, match="excitation"):
        direct_frf(lines, *chain(), [0], [0])


@pytest.mark.parametrize("rows", [[], [8], [-1], [0, 0]])
def test_rows_that_are_none_are_refused(rows: list[int]) -> None:
    with pytest.raises(ModesError):
        modal_frf([0.1], modes(), rows, [0])
    with pytest.raises(ModesError):
        direct_frf([0.1], *chain(), [0], rows)


@pytest.mark.parametrize(
    ("eigenvalues", "shapes", "damping"),
    [
        ([1.0, 2.0], np.ones((3, 1)), []),
        ([1.0], np.ones((3, 1)) * 1j, []),
        ([1.0], np.ones((3, 1)), [0.1, 0.1]),
        ([1.0], np.ones((3, 1)), [-0.1]),
        ([np.nan], np.ones((3, 1)), []),
        ([-50.0, 100.0], np.ones((3, 2)), []),
        ([], np.ones((3, 0)), []),
    ],
)
def test_modes_that_cannot_be_superposed_are_refused(
    eigenvalues: Any, shapes: Any, damping: Any
) -> None:
    with pytest.raises(ModesError):
        NormalModes(np.array(eigenvalues, dtype=float), shapes, np.array(damping, dtype=float))


def test_matrices_that_do_not_fit_are_refused() -> None:
    k, m = chain()
    with pytest.raises(ModelError, match="not one model"):
        direct_frf([0.1], k, np.eye(7), [0], [0])
    with pytest.raises(ModelError, match="viscous damping is"):
        direct_frf([0.1], k, m, [0], [0], Damping(viscous=np.eye(7)))
    with pytest.raises(ModelError, match="loss factor"):
        direct_frf([0.1], k, m, [0], [0], Damping(loss_factor=-0.1))
    with pytest.raises(ModesError, match="residuals"):
        modal_frf([0.1], modes(), [0], [0], residuals=Residuals(np.eye(2), np.eye(2)))
    wrong = NormalModes(modes().eigenvalues, 2.0 * modes().mode_shapes)
    with pytest.raises(ModesError, match="not mass-normalised"):
        modally_damped_frf([0.1], k, m, wrong, [0], [0])
    with pytest.raises(ModesError, match="unknowns"):
        modally_damped_frf([0.1], k[:7][:, :7], m[:7][:, :7], wrong, [0], [0])
    with pytest.raises(ModesError, match="elastic modes"):
        residual_flexibility(k, NormalModes(np.array([0.0]), np.ones((8, 1))), [0], [0])
    with pytest.raises(ModesError, match="receptance, mobility"):
        modal_frf([0.1], modes(), [0], [0], "velocity")  # type: ignore[arg-type]  # that is it


def test_the_residual_of_a_free_structure_is_an_error() -> None:
    free = np.array([[1.0, -1.0], [-1.0, 1.0]])
    with pytest.raises(ModelError, match="singular"):
        residual_flexibility(free, NormalModes(np.array([2.0]), np.ones((2, 1))), [0], [0])
