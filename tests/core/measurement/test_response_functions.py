"""Frequency responses: one oscillator in closed form, and modes against matrices."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import linalg, sparse

from modetune.core.errors import ModesError
from modetune.core.measurement.response_functions import NormalModes, modal_frf

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
    omega = np.array([0.0, 3.0, 10.0, 40.0])
    expected = 1.0 / (200.0 - 2.0 * omega**2 + 4.0j * omega)
    lines = omega / (2.0 * np.pi)
    # k = 200, m = 2, c = 4 = 2 zeta sqrt(k m): zeta = 4 / (2 * 20) = 0.1; the mass-normalised
    # shape is 2^-1/2.
    single = NormalModes(np.array([100.0]), np.array([[2.0**-0.5]]), np.array([0.1]))
    np.testing.assert_allclose(modal_frf(lines, single, [0], [0])[:, 0, 0], expected, rtol=1e-12)


def test_structural_damping_of_one_oscillator_is_a_complex_spring() -> None:
    omega = np.array([0.0, 10.0])
    expected = 1.0 / (200.0 * (1.0 + 0.05j) - 2.0 * omega**2)
    lines = omega / (2.0 * np.pi)
    single = NormalModes(np.array([100.0]), np.array([[2.0**-0.5]]), np.array([0.05]), "structural")
    np.testing.assert_allclose(modal_frf(lines, single, [0], [0])[:, 0, 0], expected)


def test_all_modes_with_proportional_damping_are_the_matrices() -> None:
    k, m = chain()
    a, b = 0.01, 0.02
    omega_r = np.sqrt(modes().eigenvalues)
    ratios = 0.5 * (a / omega_r + b * omega_r)  # Rayleigh damping C = a M + b K
    superposed = modal_frf(LINES, modes(damping=ratios), [0, 3, 7], [7, 2])
    omega = 2.0 * np.pi * LINES[:, None, None]
    dynamic = k.toarray() - omega**2 * m.toarray() + 1j * omega * (a * m + b * k).toarray()
    direct = np.linalg.inv(dynamic)[:, [0, 3, 7]][:, :, [7, 2]]
    np.testing.assert_allclose(superposed, direct, rtol=1e-9, atol=1e-12)


def test_mobility_and_accelerance_are_derivatives_of_receptance() -> None:
    some = modes(N, [0.01] * N)
    omega = 2.0 * np.pi * LINES[:, None, None]
    receptance = modal_frf(LINES, some, [1], [2])
    mobility = modal_frf(LINES, some, [1], [2], "mobility")
    np.testing.assert_allclose(mobility, 1j * omega * receptance)
    accelerance = modal_frf(LINES, some, [1], [2], "accelerance")
    np.testing.assert_allclose(accelerance, -(omega**2) * receptance)


@given(
    line=st.floats(0.01, 1.0), ratio=st.floats(1e-4, 0.5), pair=st.tuples(*[st.integers(0, 7)] * 2)
)
def test_responses_are_reciprocal_and_passive(
    line: float, ratio: float, pair: tuple[int, int]
) -> None:
    rows = sorted(set(pair))
    receptance = modal_frf([line], modes(N, [ratio] * N), rows, rows)[0]
    # Maxwell and Betti; and a force does work, so driving-point receptance lags.
    np.testing.assert_allclose(receptance, receptance.T, rtol=1e-8, atol=1e-12)
    assert (np.diag(receptance).imag < 0.0).all()


def test_an_undamped_resonance_is_an_error() -> None:
    exact = NormalModes(np.array([0.0]), np.ones((1, 1)))
    with pytest.raises(ModesError, match="exactly"):
        modal_frf([0.0], exact, [0], [0])


@pytest.mark.parametrize("lines", [[], [-1.0], [np.nan], 3.0])
def test_excitation_frequencies_that_are_none_are_refused(lines: Any) -> None:
    with pytest.raises(ModesError, match="excitation"):
        modal_frf(lines, modes(), [0], [0])


@pytest.mark.parametrize("rows", [[], [8], [-1], [0, 0]])
def test_rows_that_are_none_are_refused(rows: list[int]) -> None:
    with pytest.raises(ModesError):
        modal_frf([0.1], modes(), rows, [0])


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


def test_a_response_that_is_none_is_refused() -> None:
    with pytest.raises(ModesError, match="receptance, mobility"):
        modal_frf([0.1], modes(), [0], [0], "velocity")  # type: ignore[arg-type]  # that is it
