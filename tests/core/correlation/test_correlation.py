"""Correlation of mode shapes: hand cases, and what must not change the numbers."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy import linalg, sparse

from modetune.core.correlation.correlation import (
    auto_mac,
    comac,
    cross_orthogonality,
    ecomac,
    mac,
    modal_scale_factor,
    rigid_body_shapes,
    subspace_mac,
)
from modetune.core.errors import ModelError, ModesError

SHAPES = np.random.default_rng(1).standard_normal((7, 3))
OTHERS = SHAPES + 0.3 * np.random.default_rng(2).standard_normal((7, 3))
FACTORS = st.complex_numbers(min_magnitude=1e-9, max_magnitude=1e9)


def test_mac_of_two_shapes_at_sixty_degrees_is_a_quarter() -> None:
    first, second = np.array([[1.0], [0.0]]), np.array([[0.5], [np.sqrt(0.75)]])
    np.testing.assert_allclose(mac(first, second), [[0.25]])  # cos^2 60


@given(factors=st.lists(FACTORS, min_size=3, max_size=3))
def test_mac_is_one_for_scaled_copies(factors: list[complex]) -> None:
    scaled = SHAPES * np.array(factors)
    np.testing.assert_allclose(np.diag(mac(SHAPES, scaled)), 1.0)
    np.testing.assert_allclose(mac(OTHERS, scaled), mac(OTHERS, SHAPES), atol=1e-12)


@given(arrays(np.float64, (4, 3), elements=st.floats(0.5, 1e150)))
def test_mac_lies_between_zero_and_one_whatever_the_size(shapes: Any) -> None:
    values = auto_mac(shapes)
    assert ((values >= 0.0) & (values <= 1.0)).all()
    np.testing.assert_allclose(values, values.T)
    np.testing.assert_allclose(np.diag(values), 1.0)


def test_auto_mac_shows_modes_that_two_sensors_cannot_tell_apart() -> None:
    x = np.linspace(0.0, 1.0, 9)[:, None]
    sines = np.sin(np.pi * x * np.array([1.0, 3.0, 5.0]))
    assert auto_mac(sines[1:-1])[0, 1] == pytest.approx(0.0, abs=1e-15)
    # At quarter points sin(pi x) and sin(3 pi x) have equal entries.
    assert auto_mac(sines[[2, 6]])[0, 1] == pytest.approx(1.0)


@given(factor=st.floats(1e-160, 1e160), sign=st.sampled_from([-1.0, 1.0]))
def test_modal_scale_factor_undoes_a_scale(factor: float, sign: float) -> None:
    shape = SHAPES[:, 0]
    assert modal_scale_factor(sign * shape / factor, shape) == pytest.approx(sign * factor)


def test_modal_scale_factor_is_the_least_squares_one() -> None:
    measured, computed = SHAPES[:, 0], OTHERS[:, 0]
    best = np.linalg.lstsq(measured[:, None], computed, rcond=None)[0][0]
    assert modal_scale_factor(measured, computed) == pytest.approx(best)


def test_subspace_mac_does_not_change_when_close_modes_turn() -> None:
    turn = np.array([[0.6, -0.8], [0.8, 0.6]])
    plain = subspace_mac(OTHERS[:, 0], SHAPES[:, :2])
    assert subspace_mac(OTHERS[:, 0], SHAPES[:, :2] @ turn) == pytest.approx(plain)
    assert subspace_mac(SHAPES[:, 0], SHAPES[:, :2] @ turn) == pytest.approx(1.0)
    assert subspace_mac(OTHERS[:, 0], SHAPES[:, :1]) == pytest.approx(
        mac(OTHERS[:, :1], SHAPES[:, :1])[0, 0]
    )


def test_subspace_mac_of_the_same_shape_twice_is_the_mac() -> None:
    twice = SHAPES[:, [0, 0]]
    assert subspace_mac(OTHERS[:, 0], twice) == pytest.approx(mac(OTHERS, SHAPES)[0, 0])


@given(factors=st.lists(FACTORS, min_size=3, max_size=3))
def test_comac_and_ecomac_do_not_see_the_measured_scale(factors: list[complex]) -> None:
    scaled = OTHERS * np.array(factors)
    np.testing.assert_allclose(comac(scaled, SHAPES), comac(OTHERS, SHAPES), atol=1e-9)
    np.testing.assert_allclose(ecomac(scaled, SHAPES), ecomac(OTHERS, SHAPES), atol=1e-9)
    np.testing.assert_allclose(comac(SHAPES * np.array(factors), SHAPES), 1.0)
    np.testing.assert_allclose(ecomac(SHAPES * np.array(factors), SHAPES), 0.0, atol=1e-12)


def test_comac_of_shapes_of_one_length_is_the_formula() -> None:
    computed = np.array([[1.0, 0.0], [0.0, 1.0], [1.0, 1.0]])
    measured = np.array([[1.0, 0.5], [0.5, 1.0], [1.0, 1.0]])
    scale = np.sqrt(2.0) / 1.5  # length of a computed over that of a measured column
    a = measured * scale
    cross = np.sum(a * computed, axis=1) ** 2
    expected = cross / (np.sum(a**2, axis=1) * np.sum(computed**2, axis=1))
    np.testing.assert_allclose(comac(measured, computed), expected)
    np.testing.assert_allclose(expected, [0.8, 0.8, 1.0])


def test_a_sensor_mounted_upside_down_shows_in_ecomac_only() -> None:
    flipped = SHAPES.copy()
    flipped[4] *= -1.0
    assert comac(flipped, SHAPES).min() > 0.98
    values = ecomac(flipped, SHAPES)
    assert np.argmax(values) == 4
    assert values[4] > 3.0 * np.delete(values, 4).max()


def test_a_point_at_rest_in_both_sets_agrees_and_in_one_does_not() -> None:
    computed, measured = SHAPES.copy(), SHAPES.copy()
    computed[[0, 1]] = 0.0
    measured[0] = 0.0
    values = comac(measured, computed)
    assert values[0] == 1.0
    assert values[1] == 0.0


def test_modes_of_a_model_are_orthogonal_in_its_mass_whatever_their_scale() -> None:
    k, m = _cantilever_chain(8)
    _, phi = linalg.eigh(k, m)
    scaled = phi * np.array([2.0, -3.0, 1e-4, 1e6, 5.0, 1.0, 1.0, -1.0])
    signs = np.diag(np.sign([2.0, -3.0, 1.0, 1.0, 5.0, 1.0, 1.0, -1.0]))
    np.testing.assert_allclose(cross_orthogonality(phi, scaled, m), signs, atol=1e-10)


def test_cross_orthogonality_with_a_unit_mass_is_the_cosine_behind_the_mac() -> None:
    values = cross_orthogonality(SHAPES, OTHERS, sparse.eye_array(7))
    np.testing.assert_allclose(np.abs(values) ** 2, mac(SHAPES, OTHERS))


def test_rigid_body_shapes_give_mass_and_inertia_about_the_origin() -> None:
    place = np.repeat([[2.0, 0.0, 1.0]], 6, axis=0)
    rigid = rigid_body_shapes(place, np.arange(1, 7))
    inertia = rigid.T @ np.diag([3.0, 3.0, 3.0, 0.1, 0.1, 0.1]) @ rigid
    # Point mass 3 at (2, 0, 1) with own inertia 0.1: I = I_0 + m (r^2 1 - r r^T).
    expected = 0.1 * np.eye(3) + 3.0 * np.array([[1.0, 0, -2.0], [0, 5.0, 0], [-2.0, 0, 4.0]])
    np.testing.assert_allclose(inertia[:3, :3], 3.0 * np.eye(3))
    np.testing.assert_allclose(inertia[3:, 3:], expected)


def test_modes_of_an_aeroplane_are_orthogonal_with_its_mass(shared_data: Path) -> None:
    with np.load(shared_data / "garteur/mystran/gart_KM.npz") as file:
        shape = tuple(file["shape"].tolist())
        m = sparse.csr_array((file["MGG_data"], (file["MGG_row"], file["MGG_col"])), shape=shape)
        phi = file["phi"]
    np.testing.assert_allclose(cross_orthogonality(phi, phi, m), np.eye(20), atol=1e-5)


@pytest.mark.parametrize("measure", [mac, comac, ecomac])
@pytest.mark.parametrize(
    ("first", "second"),
    [
        (SHAPES, SHAPES[:5]),
        (SHAPES[:0], SHAPES[:0]),
        (SHAPES[:, 0], SHAPES[:, 0]),
        (SHAPES * np.nan, SHAPES),
        (SHAPES, SHAPES * [1.0, np.inf, 1.0]),
        (SHAPES, SHAPES * [1.0, 0.0, 1.0]),
    ],
)
def test_shapes_that_cannot_be_compared_are_refused(measure: Any, first: Any, second: Any) -> None:
    with pytest.raises(ModesError):
        measure(first, second)


def test_pairs_without_common_scale_are_refused() -> None:
    with pytest.raises(ModesError, match="orthogonal"):
        comac(np.array([[1.0], [0.0]]), np.array([[0.0], [1.0]]))
    with pytest.raises(ModesError, match="not paired"):
        ecomac(SHAPES, SHAPES[:, :2])


@pytest.mark.parametrize(
    ("measured", "computed"),
    [(np.zeros(3), np.ones(3)), (np.ones(2), np.ones(3)), (np.full(3, np.nan), np.ones(3))],
)
def test_a_scale_factor_of_nothing_is_refused(measured: Any, computed: Any) -> None:
    with pytest.raises(ModesError):
        modal_scale_factor(measured, computed)


def test_mass_matrices_that_do_not_fit_are_refused() -> None:
    with pytest.raises(ModesError, match="do not fit"):
        cross_orthogonality(SHAPES, SHAPES, np.eye(6))
    with pytest.raises(ModesError, match="no modal mass"):
        cross_orthogonality(np.eye(7)[:, :1], SHAPES, np.diag([0.0] + [1.0] * 6))
    with pytest.raises(ModelError, match="not finite"):
        cross_orthogonality(SHAPES, SHAPES, np.eye(7) * np.nan)
    with pytest.raises(ModesError, match="do not fit"):
        rigid_body_shapes(np.zeros((2, 2)), np.array([1, 2]))
    with pytest.raises(ModesError, match="numbered"):
        rigid_body_shapes(np.zeros((1, 3)), np.array([7]))
    with pytest.raises(ModesError, match="no MAC"):
        subspace_mac(SHAPES[:5, 0], SHAPES)


def _cantilever_chain(n: int) -> tuple[Any, Any]:
    diagonal = np.full(n, 2.0)
    diagonal[-1] = 1.0
    k = np.diag(diagonal) - np.diag(np.ones(n - 1), 1) - np.diag(np.ones(n - 1), -1)
    return k, np.diag(1.0 + np.arange(n) % 3)
