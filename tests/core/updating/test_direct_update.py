"""Direct methods on the six masses of the thesis's table 1, here as a chain held at one end."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import linalg, sparse

from modetune.core.correlation.correlation import mac
from modetune.core.errors import ModelError, ModesError
from modetune.core.updating.direct_update import (
    Filling,
    LowRankChange,
    ReferenceModes,
    direct_matrix_update,
    error_matrix_update,
)

# Thesis table 1: masses in kg, springs in N/m, of the mathematical and the experimental model.
MODEL = ([2.0, 2.5, 1.1, 1.2, 1.5, 1.0], [1100.0, 1000.0, 1250.0, 5000.0, 1400.0, 1100.0])
TEST = ([1.8, 2.4, 1.6, 1.2, 1.1, 0.9], [1500.0, 1600.0, 1400.0, 6500.0, 1300.0, 1500.0])
ALL = np.arange(6)


def chain(values: tuple[list[float], list[float]]) -> tuple[Any, Any]:
    masses, springs = values
    diagonal = np.array(springs) + np.array([*springs[1:], 0.0])
    off = -np.array(springs[1:])
    k = sparse.csr_array(sparse.diags_array([off, diagonal, off], offsets=[-1, 0, 1]))
    return k, sparse.csr_array(sparse.diags_array(masses))


def modes(k: Any, m: Any) -> tuple[Any, Any]:
    """All frequencies in Hz and mass-normalised shapes."""
    lam, phi = linalg.eigh(np.asarray(k.todense()), np.asarray(m.todense()))
    return np.sqrt(lam) / (2.0 * np.pi), phi


def measured(n_modes: int, rows: Any = ALL, filling: Filling = "kidder") -> ReferenceModes:
    frequencies, phi = modes(*chain(TEST))
    return ReferenceModes(frequencies[:n_modes], phi[rows, :n_modes], rows, "mass", filling)


@pytest.mark.parametrize("n_modes", [1, 3, 6])
def test_the_direct_matrix_method_gives_the_measured_modes_exactly(n_modes: int) -> None:
    k, m = chain(MODEL)
    test = measured(n_modes)
    update = direct_matrix_update(k, m, test)
    new_k, new_m = update.stiffness_change.added_to(k), update.mass_change.added_to(m)
    lam = (2.0 * np.pi * test.frequencies_hz) ** 2
    np.testing.assert_allclose(test.shapes.T @ new_m @ test.shapes, np.eye(n_modes), atol=1e-10)
    np.testing.assert_allclose(
        new_k @ test.shapes, new_m @ test.shapes * lam, atol=1e-8 * np.abs(new_k).max()
    )
    np.testing.assert_allclose(new_k, new_k.T, atol=1e-9)


def test_all_modes_measured_everywhere_restore_the_tests_own_matrices() -> None:
    k, m = chain(MODEL)
    true_k, true_m = chain(TEST)
    update = direct_matrix_update(k, m, measured(6))
    np.testing.assert_allclose(update.mass_change.added_to(m), true_m.toarray(), atol=1e-9)
    np.testing.assert_allclose(update.stiffness_change.added_to(k), true_k.toarray(), atol=1e-6)


def test_a_model_that_is_right_is_not_changed() -> None:
    k, m = chain(TEST)
    frequencies, phi = modes(k, m)
    for update in (
        direct_matrix_update(k, m, measured(4)),
        error_matrix_update(k, m, measured(4), frequencies[:4], phi[:, :4]),
    ):
        np.testing.assert_allclose(update.mass_change.dense(), 0.0, atol=1e-10)
        np.testing.assert_allclose(update.stiffness_change.dense(), 0.0, atol=1e-8)


@given(scale=st.floats(1e-4, 1e4), sign=st.sampled_from([-1.0, 1.0]))
def test_shapes_of_unknown_scale_are_normalised_in_the_models_mass(
    scale: float, sign: float
) -> None:
    k, m = chain(MODEL)
    test = measured(3)
    plain = ReferenceModes(test.frequencies_hz, test.shapes, ALL)
    scaled = ReferenceModes(test.frequencies_hz, sign * scale * test.shapes, ALL, "max")
    one, other = direct_matrix_update(k, m, plain), direct_matrix_update(k, m, scaled)
    np.testing.assert_allclose(
        one.stiffness_change.dense(), other.stiffness_change.dense(), rtol=1e-6, atol=1e-6
    )
    lengths = np.sum(other.mode_shapes * (m @ other.mode_shapes), axis=0)
    np.testing.assert_allclose(lengths, 1.0)


def test_fewer_sensors_make_the_direct_matrix_method_worse() -> None:
    # The thesis's cases 1 to 3: all measured, without the sixth mass, without fifth and sixth.
    k, m = chain(MODEL)
    _, true_shapes = modes(*chain(TEST))
    macs = []
    for rows in (ALL, ALL[:5], ALL[:4]):
        update = direct_matrix_update(k, m, measured(3, rows))
        new_k, new_m = update.stiffness_change.added_to(k), update.mass_change.added_to(m)
        _, phi = linalg.eigh(new_k, new_m)
        # Unmeasured modes may move in between, so each true mode looks for its nearest.
        macs.append(float(mac(phi, true_shapes[:, :3]).max(axis=0).min()))
    assert macs[0] == pytest.approx(1.0)
    assert max(macs[1:]) < 0.9


@pytest.mark.parametrize("filling", ["kidder", "static", "serep", "model"])
def test_every_filling_imposes_the_measured_frequencies(filling: Filling) -> None:
    k, m = chain(MODEL)
    _, model_shapes = modes(k, m)
    test = measured(2, ALL[:4], filling)
    update = direct_matrix_update(k, m, test, model_shapes[:, :2])
    new_k, new_m = update.stiffness_change.added_to(k), update.mass_change.added_to(m)
    found = np.sqrt(np.abs(linalg.eigh(new_k, new_m, eigvals_only=True))) / (2.0 * np.pi)
    for frequency in test.frequencies_hz:
        assert np.abs(found / frequency - 1.0).min() < 1e-8


def test_the_error_matrix_method_is_exact_to_first_order() -> None:
    k, m = chain(MODEL)
    dk, dm = chain((list(0.1 * np.array(MODEL[0]) * [1, 0, -1, 0, 1, 0]), [30.0, 0, -50, 0, 9, 0]))
    frequencies, phi = modes(k, m)
    errors = []
    for size in (1e-2, 1e-3):
        true_k, true_m = k + size * dk, m + size * dm
        true_frequencies, true_phi = modes(true_k, true_m)
        test = ReferenceModes(true_frequencies, true_phi, ALL, "mass")
        update = error_matrix_update(k, m, test, frequencies, phi)
        errors.append(
            (
                np.abs(update.stiffness_change.dense() - size * dk.toarray()).max(),
                np.abs(update.mass_change.dense() - size * dm.toarray()).max(),
            )
        )
    # What is left is of second order: a tenth of the error leaves a hundredth of it.
    np.testing.assert_allclose(np.array(errors[1]) / np.array(errors[0]), 0.01, rtol=0.05)


def test_the_error_matrix_method_is_the_formula_of_the_thesis() -> None:
    k, m = chain(MODEL)
    frequencies, phi_a = modes(k, m)
    test = measured(3)
    update = error_matrix_update(k, m, test, frequencies[:3], -2.0 * phi_a[:, :3])
    w_a, w_x = (2 * np.pi * frequencies[:3]) ** 2, (2 * np.pi * test.frequencies_hz) ** 2
    phi_a, phi_x = phi_a[:, :3], test.shapes
    # (3.11) and (3.12)
    inner = phi_a @ np.diag(1.0 / w_a) @ phi_a.T - phi_x @ np.diag(1.0 / w_x) @ phi_x.T
    np.testing.assert_allclose(update.stiffness_change.dense(), k @ inner @ k, atol=1e-8)
    inner = phi_a @ phi_a.T - phi_x @ phi_x.T
    np.testing.assert_allclose(update.mass_change.dense(), m @ inner @ m, atol=1e-12)


def test_a_low_rank_change_acts_as_its_dense_self() -> None:
    rng = np.random.default_rng(1)
    change = LowRankChange(rng.standard_normal((9, 2)), np.diag([1.0, -2.0]))
    columns = rng.standard_normal((9, 4))
    np.testing.assert_allclose(change.times(columns), change.dense() @ columns)
    np.testing.assert_allclose(change.added_to(sparse.eye_array(9)), np.eye(9) + change.dense())


def test_measured_modes_that_do_not_fit_are_refused() -> None:
    k, m = chain(MODEL)
    frequencies, phi = modes(k, m)
    good = measured(2)

    def refused(message: str, **changes: Any) -> None:
        values = {"frequencies_hz": good.frequencies_hz, "shapes": good.shapes, "rows": ALL}
        with pytest.raises(ModesError, match=message):
            direct_matrix_update(k, m, ReferenceModes(**{**values, **changes}))

    refused("above 0 Hz", frequencies_hz=np.array([0.0, 1.0]))
    refused("frequencies for", frequencies_hz=np.array([1.0]))
    refused("real shapes", shapes=good.shapes * 1j)
    refused("not finite", shapes=good.shapes * np.nan)
    refused("do not fit", shapes=good.shapes[:5])
    refused("not independent", shapes=good.shapes[:, [0, 0]])
    refused("needs model modes", filling="serep")
    refused("row 6", rows=ALL + 1)
    with pytest.raises(ModesError, match="above 0 Hz"):
        error_matrix_update(k, m, good, [0.0, 1.0], phi[:, :2])
    with pytest.raises(ModesError, match="computed shapes"):
        error_matrix_update(k, m, good, frequencies[:3], phi[:, :3])
    with pytest.raises(ModelError, match="not one model"):
        direct_matrix_update(k, sparse.eye_array(5), good)


@pytest.mark.parametrize("rows", [ALL, np.array([0, 2, 4, 5])])
def test_with_the_mass_believed_frequencies_are_exact_and_shapes_as_near_as_can_be(
    rows: Any,
) -> None:
    k, m = chain(MODEL)
    test = measured(3, rows)
    update = direct_matrix_update(k, m, test, keep_mass=True)
    assert not update.mass_change.core.any()
    phi = update.mode_shapes
    np.testing.assert_allclose(phi.T @ (m @ phi), np.eye(3), atol=1e-12)
    new_k = update.stiffness_change.added_to(k)
    lam = (2.0 * np.pi * test.frequencies_hz) ** 2
    np.testing.assert_allclose(new_k @ phi, m @ phi * lam, atol=1e-9 * np.abs(new_k).max())
    # Baruch: of all orthonormal sets none is nearer in the mass than the symmetric turn gives.
    given = direct_matrix_update(k, m, test).mode_shapes
    turn = linalg.expm(0.01 * np.array([[0, 1, -2], [-1, 0, 1], [2, -1, 0]]))
    away, farther = ((x - given).T @ (m @ (x - given)) for x in (phi, phi @ turn))
    assert np.trace(away) < np.trace(farther)
