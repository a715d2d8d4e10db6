"""Weights and deviations of single modes and sensors: what they make of a residual."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from modetune.core.correlation.pairing import pair_by_order
from modetune.core.modes import ModeSet, mode_set
from modetune.core.updating.sensitivity import ModeDerivatives
from modetune.core.updating.weighting import Weighting, even_weighting, weighting_side_by_side
from tests.core.updating.compared import residual, residual_sensitivity

Floats = NDArray[np.float64]
EVEN = even_weighting(3, 8, 0.002, 0.02)
#: Of each mode and of each sensor something else.
UNEVEN = Weighting(
    np.array([0.001, 0.002, 0.01]),
    np.array([0.02, 0.05, 0.1]),
    np.array([10.0, 1.0, 0.0]),
    np.array([1.0, 0.0, 0.3]),
    np.array([1.0, 2.0, 0.5, 1.0, 1.0, 4.0, 1.0, 1.0]),
    np.array([1.0, 1.0, 3.0, 0.2, 1.0, 1.0, 1.0, 0.5]),
)


def modes(seed: int, rows: int = 8) -> ModeSet:
    noise = np.random.default_rng(seed)
    return mode_set(
        np.sort(noise.uniform(5.0, 50.0, 3)),
        noise.normal(size=(rows, 3)),
        np.arange(1, rows + 1),
        np.ones(rows),
        normalisation="mass",
    )


def near(model: ModeSet, size: float = 0.1) -> ModeSet:
    noise = np.random.default_rng(5)
    shapes = model.mode_shapes + size * noise.normal(size=model.mode_shapes.shape)
    return mode_set(1.03 * model.frequencies_hz, shapes, model.nodes, model.components)


def test_each_mode_has_its_own_deviation_and_weight() -> None:
    model = modes(0)
    order = pair_by_order(model, model)
    plain = replace(UNEVEN, sensor_deviations=np.ones(8), sensor_weights=np.ones(8))
    found = residual(model, model, order, plain)
    np.testing.assert_allclose(found.variances[:3], (2.0 * plain.frequency_deviations) ** 2)
    np.testing.assert_allclose(found.weights[:3] * found.variances[:3], plain.frequency_weights)
    # s / sqrt(n) of an entry of a unit shape of 8 entries
    np.testing.assert_allclose(found.variances[3:], np.repeat(plain.shape_deviations**2 / 8, 8))
    np.testing.assert_allclose(
        found.weights[3:] * found.variances[3:], np.repeat(plain.shape_weights, 8)
    )
    assert found.of_used("frequencies", np.arange(3.0)).tolist() == [0.0, 1.0]


def test_modes_in_another_order_take_their_weights_along() -> None:
    model, test = modes(0), near(modes(0))
    turned = [2, 0, 1]
    one = residual(test, model, pair_by_order(test, model), UNEVEN)
    other = residual(
        test.select(turned), model, pair_by_order(test.select(turned), model), UNEVEN.modes(turned)
    )
    assert other.misfit == pytest.approx(one.misfit)


def test_a_shape_is_scaled_by_the_least_squares_of_the_sensors_weights() -> None:
    model, test = modes(0), near(modes(0), 0.5)
    found = residual(test, model, pair_by_order(test, model), UNEVEN)
    omega = UNEVEN.sensor_weights / UNEVEN.sensor_deviations**2
    for pair in range(3):
        a, b = test.mode_shapes[:, pair], model.mode_shapes[:, pair]
        factor = (omega * a) @ b / ((omega * a) @ a)
        left = omega @ (factor * a - b) ** 2 / (omega @ b**2)
        own = found.values[3 + 8 * pair : 11 + 8 * pair]
        assert own @ own == pytest.approx(left)


def test_variances_are_those_of_noisy_sensors() -> None:
    model = modes(1)
    order = pair_by_order(model, model)
    noise = np.random.default_rng(2)
    shape = model.mode_shapes[:, 2]
    omega = UNEVEN.sensor_weights / UNEVEN.sensor_deviations**2
    rms = np.sqrt(omega @ shape**2 / omega.sum())
    size = 1e-3  # small, so that noise and scale stay apart to first order
    values = []
    for _ in range(4000):
        shapes = model.mode_shapes.copy()
        shapes[:, 2] += size * rms * UNEVEN.sensor_deviations * noise.standard_normal(8)
        test = mode_set(model.frequencies_hz, shapes, model.nodes, model.components)
        values.append(residual(test, model, order, UNEVEN).values[19:])
    told = residual(model, model, order, replace(UNEVEN, shape_deviations=np.full(3, size))).noise
    unit = np.sqrt(omega) * shape / np.sqrt(omega @ shape**2)
    # What lies along the shape is taken by the scale.
    outside = np.eye(8) - np.outer(unit, unit)
    expected = np.diag(outside @ np.diag(told[19:]) @ outside)
    np.testing.assert_allclose(np.var(values, axis=0), expected, rtol=0.1)  # 4 x sqrt(2 / 4000)


def test_a_sensor_without_weight_is_as_if_it_were_not_there() -> None:
    model, test = modes(0), near(modes(0), 0.3)
    wild = test.mode_shapes.copy()
    wild[4] *= -300.0
    wild_test = mode_set(test.frequencies_hz, wild, test.nodes, test.components)
    weights = np.ones(8)
    weights[4] = 1e-14
    one = residual(
        wild_test, model, pair_by_order(test, model), replace(EVEN, sensor_weights=weights)
    )
    kept = np.delete(np.arange(8), 4)
    other = residual(
        test.rows(kept), model, pair_by_order(test, model), even_weighting(3, 7, 0.002, 0.02)
    )
    assert one.misfit == pytest.approx(other.misfit, rel=1e-6)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_the_sensitivity_is_the_derivative_of_the_weighted_residual(sign: float) -> None:
    model, test = modes(0), near(modes(0))
    model = replace(model, mode_shapes=sign * model.mode_shapes)
    pairing = pair_by_order(test, model)
    noise = np.random.default_rng(3)
    d_lam, d_phi = noise.normal(size=(3, 2)), noise.normal(size=(8, 3, 2))
    found = residual_sensitivity(test, model, pairing, UNEVEN, ModeDerivatives(d_lam, d_phi))

    def moved(step: Floats) -> Floats:
        hz = np.sqrt(model.eigenvalues + d_lam @ step) / (2 * np.pi)
        shapes = model.mode_shapes + d_phi @ step
        return residual(
            test, mode_set(hz, shapes, model.nodes, model.components), pairing, UNEVEN
        ).values

    h = 1e-6
    for column in range(2):
        step = h * np.eye(2)[column]
        difference = -(moved(step) - moved(-step)) / (2 * h)  # z is measured minus computed
        np.testing.assert_allclose(found[:, column], difference, atol=1e-7)


def test_weightings_of_two_tests_stand_side_by_side() -> None:
    both = weighting_side_by_side([UNEVEN, even_weighting(2, 5, 0.003, 0.04)])
    assert both.frequency_deviations.tolist() == [0.001, 0.002, 0.01, 0.003, 0.003]
    assert both.sensor_weights.size == 13
