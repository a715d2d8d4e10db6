"""Derivatives of modes against central differences, closed forms and runs of another program."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy import sparse
from scipy.linalg import eigh

from modetune.core.updating.sensitivity import (
    broyden_update,
    fox_kapoor,
    nelson,
    strain_energy_derivative,
)

Floats = NDArray[np.float64]


def chain(springs: Floats, masses: Floats) -> tuple[Floats, Floats]:
    k = np.diag(springs[:-1] + springs[1:]) - np.diag(springs[1:-1], 1) - np.diag(springs[1:-1], -1)
    return k, np.diag(masses)


def modes_of(k: Floats, m: Floats, like: Floats | None = None) -> tuple[Floats, Floats]:
    lam, phi = eigh(k, m)
    if like is not None:
        phi = phi * np.where(np.sum(phi * (m @ like), axis=0) < 0, -1.0, 1.0)
    return lam, phi


def csr(matrix: Floats) -> sparse.csr_array:
    return sparse.csr_array(matrix)


SPRINGS = np.array([3.0, 5.0, 2.0, 7.0, 4.0, 6.0, 3.5])
MASSES = np.array([1.0, 2.0, 1.5, 0.7, 1.2, 2.2])


@pytest.mark.parametrize("spring", [0, 2, 6])
def test_nelson_equals_central_differences(spring: int) -> None:
    h = 1e-5
    unit = np.zeros(7)
    unit[spring] = 1.0
    k, m = chain(SPRINGS, MASSES)
    lam, phi = modes_of(k, m)
    dk = (chain(SPRINGS + unit, MASSES)[0] - k, np.zeros((6, 6)))
    found = nelson(csr(k), csr(m), lam, phi, [(csr(dk[0]), csr(dk[1]))], [0, 3, 5], np.arange(6))
    up = modes_of(chain(SPRINGS + h * unit, MASSES)[0], m, phi)
    down = modes_of(chain(SPRINGS - h * unit, MASSES)[0], m, phi)
    # Central differences err by h^2 and by rounding over h: 1e-8 is safely above both.
    np.testing.assert_allclose(
        found.eigenvalues[:, 0], ((up[0] - down[0]) / (2 * h))[[0, 3, 5]], atol=1e-8
    )
    np.testing.assert_allclose(
        found.mode_shapes[:, :, 0], ((up[1] - down[1]) / (2 * h))[:, [0, 3, 5]], atol=1e-8
    )


def test_nelson_of_a_mass_includes_the_change_of_normalisation() -> None:
    h = 1e-5
    unit = np.eye(6)[2]
    k, m = chain(SPRINGS, MASSES)
    lam, phi = modes_of(k, m)
    found = nelson(
        csr(k), csr(m), lam, phi, [(csr(np.zeros((6, 6))), csr(np.diag(unit)))], [1], np.arange(6)
    )
    up = modes_of(k, np.diag(MASSES + h * unit), phi)
    down = modes_of(k, np.diag(MASSES - h * unit), phi)
    np.testing.assert_allclose(
        found.mode_shapes[:, 0, 0], ((up[1] - down[1]) / (2 * h))[:, 1], atol=1e-8
    )


def test_nelson_gives_the_asked_rows_only() -> None:
    k, m = chain(SPRINGS, MASSES)
    lam, phi = modes_of(k, m)
    changes = [(csr(np.diag(np.eye(6)[0])), csr(np.zeros((6, 6))))]
    every = nelson(csr(k), csr(m), lam, phi, changes, [0, 1], np.arange(6))
    some = nelson(csr(k), csr(m), lam, phi, changes, [0, 1], np.array([4, 1]))
    np.testing.assert_array_equal(some.mode_shapes, every.mode_shapes[[4, 1]])


def test_nelson_of_modes_a_millionth_apart_follows_the_modal_sum() -> None:
    # Two equal oscillators and a third, tied so weakly that the first two are 2e-6 apart.
    k = np.array([[1.0 + 1e-6, -1e-6, 0.0], [-1e-6, 1.0 + 1e-6, 0.0], [0.0, 0.0, 3.0]])
    m = np.eye(3)
    lam, phi = modes_of(k, m)
    dk = np.array([[1.0, 0.0, 0.3], [0.0, 0.0, 0.0], [0.3, 0.0, 0.0]])
    changes = [(csr(dk), csr(np.zeros((3, 3))))]
    found = nelson(csr(k), csr(m), lam, phi, changes, [0], np.arange(3))
    exact = sum(
        phi[:, j] * (phi[:, j] @ dk @ phi[:, 0]) / (lam[0] - lam[j]) for j in (1, 2)
    )  # Fox and Kapoor's modal sum over all other modes
    np.testing.assert_allclose(found.mode_shapes[:, 0, 0], exact, rtol=1e-5)


@given(scale=st.floats(0.1, 10.0), sign=st.sampled_from([-1.0, 1.0]))
@settings(max_examples=20)
def test_fox_kapoor_does_not_know_signs_and_scales_with_the_matrices(
    scale: float, sign: float
) -> None:
    k, m = chain(SPRINGS, MASSES)
    lam, phi = modes_of(k, m)
    dk, dm = csr(k), csr(np.zeros((6, 6)))
    base = fox_kapoor(lam, phi, dk, dm)
    # dK = K means p scales all stiffness: d lambda / dp = lambda (closed form).
    np.testing.assert_allclose(base, lam, rtol=1e-10)
    np.testing.assert_allclose(fox_kapoor(lam, sign * phi, scale * dk, dm), scale * base)


def test_strain_energy_is_half_the_relative_sensitivity() -> None:
    k, m = chain(SPRINGS, MASSES)
    lam, phi = modes_of(k, m)
    unit = np.eye(7)[3]
    dk = chain(SPRINGS + unit, MASSES)[0] - k
    energies = 0.5 * np.sum(phi * (SPRINGS[3] * dk @ phi), axis=0)
    np.testing.assert_allclose(
        strain_energy_derivative(energies, float(SPRINGS[3])),
        fox_kapoor(lam, phi, csr(dk), csr(np.zeros((6, 6)))),
    )


def test_broyden_explains_the_last_step_and_leaves_other_directions() -> None:
    noise = np.random.default_rng(1)
    s, step, change = noise.normal(size=(5, 3)), noise.normal(size=3), noise.normal(size=5)
    updated = broyden_update(s, step, change)
    np.testing.assert_allclose(updated @ step, change)
    across = np.cross(step, [1.0, 0.0, 0.0])
    np.testing.assert_allclose(updated @ across, s @ across)
    assert broyden_update(s, np.zeros(3), change) is s


def test_broyden_changes_frequencies_entries_by_their_own_size() -> None:
    # Rows of two frequencies and a shape; a mistake of 1.0 in each, a step of (1, 1).
    s = np.array([[2.0, 1.0], [0.0, 0.0], [2.0, 1.0]])
    change = np.array([4.0, 1.0, 4.0])
    updated = broyden_update(s, np.ones(2), change, n_frequencies=2)
    # 2 : 1 in size is 4 : 1 in squares, so 0.8 and 0.2 of the mistake; the least share that an
    # entry of zero has shifts this by less than 1e-4. The others share it evenly.
    np.testing.assert_allclose(updated, [[2.8, 1.2], [0.5, 0.5], [2.5, 1.5]], atol=1e-4)
    np.testing.assert_allclose(updated @ np.ones(2), change, rtol=1e-14)


def test_broyden_can_explain_a_step_of_a_parameter_that_a_frequency_did_not_know() -> None:
    s = np.array([[2.0, 0.0]])
    updated = broyden_update(s, np.array([0.0, 0.5]), np.array([0.1]), n_frequencies=1)
    np.testing.assert_allclose(updated, [[2.0, 0.2]])  # 0.1 over 0.5


@pytest.mark.parametrize("parameter", [0, 1, 2, 3, 4])
def test_shell_aircraft_agrees_with_differences_of_mystran_runs(
    shared_data: Path, parameter: int
) -> None:
    """refs/mystran_garteur_fd_sensitivity.npz: central differences of another program's runs."""
    data = np.load(shared_data / "refs" / "mystran_garteur_fd_sensitivity.npz")

    def matrix(name: str) -> sparse.csr_array:
        rows, columns = data[f"{name}_row"], data[f"{name}_col"]
        return sparse.csr_array(
            sparse.coo_array((data[f"{name}_data"], (rows, columns)), shape=(1932, 1932))
        )

    k, m = matrix("K"), matrix("M")
    used = np.flatnonzero(k.diagonal() > 0.0)
    lam, phi = data["lam"], data["phi"][used]
    change = (matrix(f"dK{parameter}")[used][:, used], matrix(f"dM{parameter}")[used][:, used])
    modes = list(range(6, 16))
    found = nelson(
        k[used][:, used], m[used][:, used], lam, phi, [change], modes, np.arange(used.size)
    )
    # Places 3 and 4 are a pair 0.05 % apart, where the reference's steps are too long. The rest is
    # good to 1e-4 of the largest derivative, but for the lumped mass, whose stored dM has only its
    # translations: 6e-4 there, by runs of both ways on the stored matrices.
    apart = [0, 1, 2, 5, 6, 7, 8, 9]
    expected = data[f"dlam{parameter}"][6:16][apart]
    np.testing.assert_allclose(
        found.eigenvalues[apart, 0], expected, atol=1e-3 * np.abs(expected).max()
    )
    shapes = data[f"dphi{parameter}"][used]
    if parameter == 3:  # E alone changes no shape: the reference holds rounding only
        assert np.abs(found.mode_shapes).max() < 1e-6 * np.abs(phi[:, 6:16] / 7.2e4).max()
        return
    for place in apart:
        scale = np.abs(shapes[:, place]).max()
        np.testing.assert_allclose(
            found.mode_shapes[:, place, 0], shapes[:, place], atol=1e-2 * scale
        )
