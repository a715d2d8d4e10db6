"""Expansion: exact where the model is right, linear, and honest where nothing is known."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import linalg, sparse
from scipy.interpolate import CubicSpline

from modetune.core.condensation.expansion import (
    Places,
    kidder_expansion,
    model_shape_expansion,
    serep_expansion,
    spline_expansion,
    static_expansion,
)
from modetune.core.condensation.reduction import guyan
from modetune.core.errors import ModelError, ModesError

N = 20
ROWS = np.array([2, 7, 11, 19])


def chain() -> tuple[sparse.csr_array, sparse.csr_array]:
    """Stiffness and mass of N masses in a row on uneven springs, the first held to ground."""
    springs = 1.0 + np.arange(N) % 3
    diagonal = springs + np.append(springs[1:], 0.0)
    off = -springs[1:]
    stiffness = sparse.diags_array([off, diagonal, off], offsets=[-1, 0, 1])
    return sparse.csr_array(stiffness), sparse.csr_array(sparse.diags_array(1.0 + np.arange(N) % 2))


def modes(n_modes: int) -> tuple[Any, Any]:
    k, m = chain()
    lam, phi = linalg.eigh(k.toarray(), m.toarray())
    return np.sqrt(lam[:n_modes]) / (2.0 * np.pi), phi[:, :n_modes]


def line(x: Any, component: int = 3) -> Places:
    x = np.asarray(x, dtype=float)
    coordinates = np.column_stack([x, np.zeros_like(x), np.zeros_like(x)])
    return Places(coordinates, np.full(x.size, component))


def test_kidder_restores_the_models_own_modes() -> None:
    frequencies, phi = modes(6)
    expanded = kidder_expansion(*chain(), frequencies, phi[ROWS], ROWS)
    np.testing.assert_allclose(expanded.mode_shapes, phi, atol=1e-10)


def test_kidder_has_the_sign_of_its_own_formula(shared_data: Path) -> None:
    case = json.loads((shared_data / "refs/vibrationtesting_3dof.json").read_text())
    shifted = case["shifted_K2=K-lambda1*M"]
    psi = np.array(shifted["Psi"])[:, :1]
    k = np.array(case["K"], dtype=float) - case["omega"][0] ** 2 * np.array(case["M"])
    expanded = kidder_expansion(k, np.array(case["M"], dtype=float), [0.0], psi[[0, 2]], [0, 2])
    # The middle mass moves with the others: -0.2955, where another program's text says +0.2886.
    np.testing.assert_allclose(expanded.mode_shapes, psi, atol=1e-4)


def test_static_expansion_is_guyans_transformation() -> None:
    k, m = chain()
    _, phi = modes(3)
    expected = guyan(k, m, ROWS).transformation @ phi[ROWS]
    np.testing.assert_allclose(static_expansion(k, phi[ROWS], ROWS).mode_shapes, expected)


def test_serep_takes_out_noise_that_no_mode_can_make() -> None:
    _, phi = modes(3)
    noise = np.random.default_rng(1).standard_normal(ROWS.size)
    basis = phi[ROWS]
    outside = noise - basis @ np.linalg.lstsq(basis, noise, rcond=None)[0]
    expanded = serep_expansion(phi, basis + 0.1 * outside[:, None], ROWS)
    np.testing.assert_allclose(expanded.mode_shapes, phi, atol=1e-12)
    assert expanded.condition[0] == pytest.approx(
        np.linalg.cond(basis / np.linalg.norm(basis, axis=0))
    )


def test_serep_of_more_modes_than_sensors_fits_the_sensors() -> None:
    _, phi = modes(8)
    measured = np.random.default_rng(2).standard_normal((ROWS.size, 2))
    expanded = serep_expansion(phi, measured, ROWS)
    np.testing.assert_allclose(expanded.mode_shapes[ROWS], measured, atol=1e-10)


@given(scale=st.floats(1e-3, 1e3), sign=st.sampled_from([-1.0, 1.0, 1j]))
def test_model_shapes_take_the_measured_scale_and_phase(scale: float, sign: complex) -> None:
    _, phi = modes(3)
    measured = scale * sign * phi[ROWS]
    expanded = model_shape_expansion(phi, measured, ROWS)
    np.testing.assert_allclose(expanded.mode_shapes, scale * sign * phi, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("method", ["kidder", "static", "model"])
def test_measured_values_are_kept(method: str) -> None:
    k, m = chain()
    frequencies, phi = modes(3)
    measured = phi[ROWS] + 0.05 * np.random.default_rng(3).standard_normal((ROWS.size, 3))
    expanded = {
        "kidder": lambda: kidder_expansion(k, m, frequencies, measured, ROWS),
        "static": lambda: static_expansion(k, measured, ROWS),
        "model": lambda: model_shape_expansion(phi, measured, ROWS),
    }[method]()
    np.testing.assert_array_equal(expanded.mode_shapes[ROWS], measured)


@given(factor=st.complex_numbers(min_magnitude=1e-3, max_magnitude=1e3))
def test_kidder_is_linear_and_takes_complex_shapes(factor: complex) -> None:
    frequencies, phi = modes(2)
    expanded = kidder_expansion(*chain(), frequencies, factor * phi[ROWS], ROWS)
    np.testing.assert_allclose(
        expanded.mode_shapes, factor * phi, rtol=1e-8, atol=1e-9 * abs(factor)
    )


def test_a_frequency_close_to_one_of_the_held_model_shows_in_the_condition() -> None:
    k, m = chain()
    held = np.setdiff1d(np.arange(N), ROWS)
    inner = linalg.eigh(
        k.toarray()[np.ix_(held, held)], m.toarray()[np.ix_(held, held)], eigvals_only=True
    )
    near = np.sqrt(inner[0] * (1.0 + np.array([1e-6, 1e-2]))) / (2.0 * np.pi)
    condition = kidder_expansion(k, m, near, np.ones((4, 2)), ROWS).condition
    assert condition[0] > 1e3 * condition[1]
    with pytest.raises(ModelError, match="masters held"):
        kidder_expansion(k, m, [np.sqrt(inner[0]) / (2.0 * np.pi)], np.ones((4, 1)), ROWS)


def test_a_spline_on_a_line_is_the_natural_cubic_one() -> None:
    x = np.array([0.0, 0.7, 1.1, 2.0, 3.2])
    values = np.array([0.0, 1.0, -0.5, 0.3, 2.0])
    inside = np.linspace(0.0, 3.2, 23)
    expanded = spline_expansion(values[:, None], line(x), line(inside))
    # The curve of least bending through given points (Holladay 1957).
    natural = CubicSpline(x, values, bc_type="natural")(inside)
    np.testing.assert_allclose(expanded.mode_shapes[:, 0], natural, atol=1e-10)


@given(
    slope=st.lists(st.floats(-2.0, 2.0), min_size=3, max_size=3),
    n_axes=st.integers(1, 3),
    seed=st.integers(0, 100),
)
def test_a_spline_carries_rigid_motion_exactly(slope: list[float], n_axes: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    points, targets = np.zeros((12, 3)), np.zeros((30, 3))
    points[:, :n_axes] = rng.uniform(-1000.0, 1000.0, (12, n_axes))
    targets[:, :n_axes] = rng.uniform(-1500.0, 1500.0, (30, n_axes))
    sensors, wanted = Places(points, np.full(12, 1)), Places(targets, np.full(30, 1))
    measured = (2.0 + points @ np.array(slope))[:, None]
    expanded = spline_expansion(measured, sensors, wanted)
    expected = (2.0 + targets @ np.array(slope))[:, None]
    np.testing.assert_allclose(expanded.mode_shapes, expected, atol=1e-5)


def test_a_spline_passes_through_its_sensors_and_does_not_mix_components() -> None:
    rng = np.random.default_rng(4)
    places = Places(rng.uniform(size=(20, 3)), np.repeat([1, 3], 10))
    measured = rng.standard_normal((20, 3)) + 1j * rng.standard_normal((20, 3))
    expanded = spline_expansion(measured, places, places)
    np.testing.assert_allclose(expanded.mode_shapes, measured, atol=1e-10)
    alone = Places(places.coordinates[:10], places.components[:10])
    np.testing.assert_allclose(
        spline_expansion(measured[:10], alone, alone).mode_shapes, measured[:10], atol=1e-10
    )


def test_one_sensor_moves_everything_alike() -> None:
    expanded = spline_expansion(np.array([[3.0, -1.0]]), line([5.0]), line([0.0, 9.0]))
    np.testing.assert_array_equal(expanded.mode_shapes, [[3.0, -1.0], [3.0, -1.0]])


def test_a_spline_refuses_what_no_sensor_knows() -> None:
    values = np.ones((3, 1))
    with pytest.raises(ModesError, match="component ry"):
        spline_expansion(values, line([0.0, 1.0, 2.0]), line([0.5], component=5))
    with pytest.raises(ModesError, match="one place"):
        spline_expansion(values, line([0.0, 1.0, 1.0]), line([0.5]))
    with pytest.raises(ModesError, match="one place"):
        spline_expansion(values, line([1.0, 1.0, 1.0]), line([0.5]))
    with pytest.raises(ModesError, match="do not fit"):
        spline_expansion(values, line([0.0, 1.0]), line([0.5]))


@pytest.mark.parametrize(
    ("coordinates", "components"),
    [
        (np.zeros((2, 2)), np.array([1, 2])),
        (np.zeros((2, 3)), np.array([0, 2])),
        (np.full((1, 3), np.nan), np.array([1])),
        (np.zeros((0, 3)), np.array([], dtype=int)),
    ],
)
def test_places_that_are_none_are_refused(coordinates: Any, components: Any) -> None:
    with pytest.raises(ModesError):
        Places(coordinates, components)


@pytest.mark.parametrize("measured", [np.ones(4), np.ones((3, 1)), np.full((4, 1), np.nan)])
def test_measured_shapes_that_do_not_fit_are_refused(measured: Any) -> None:
    k, m = chain()
    _, phi = modes(1)
    with pytest.raises(ModesError):
        kidder_expansion(k, m, [1.0], measured, ROWS)
    with pytest.raises(ModesError):
        static_expansion(k, measured, ROWS)
    with pytest.raises(ModesError):
        serep_expansion(phi, measured, ROWS)
    with pytest.raises(ModesError):
        model_shape_expansion(phi, measured, ROWS)


@pytest.mark.parametrize("frequencies", [[1.0, 2.0], [-1.0], [np.nan], [np.inf]])
def test_frequencies_that_do_not_fit_are_refused(frequencies: list[float]) -> None:
    with pytest.raises(ModesError):
        kidder_expansion(*chain(), frequencies, np.ones((4, 1)), ROWS)


def test_model_modes_that_say_nothing_at_the_sensors_are_refused() -> None:
    still = np.zeros((N, 1))
    still[0] = 1.0
    with pytest.raises(ModesError, match="does not move"):
        model_shape_expansion(still, np.ones((4, 1)), ROWS)
    with pytest.raises(ModesError, match="does not move"):
        serep_expansion(still, np.ones((4, 1)), ROWS)
    with pytest.raises(ModesError, match="computed shapes"):
        model_shape_expansion(np.ones((N, 2)), np.ones((4, 1)), ROWS)
