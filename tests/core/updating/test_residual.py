"""The residual and its sensitivity: exact derivative, invariances, link to MAC."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from modetune.core.correlation.pairing import pair_by_order
from modetune.core.modes import ModeSet, mode_set
from modetune.core.updating.sensitivity import ModeDerivatives
from modetune.core.updating.weighting import even_weighting
from tests.core.updating.compared import residual, residual_sensitivity

Floats = NDArray[np.float64]
BOTH = even_weighting(3, 8, 0.002, 0.02)
FREQUENCIES = even_weighting(3, 8, 0.002, 0.02, 1.0, 0.0)


def sample(seed: int, scale: float = 1.0) -> ModeSet:
    noise = np.random.default_rng(seed)
    return mode_set(
        np.sort(noise.uniform(5.0, 50.0, 3)),
        scale * noise.normal(size=(8, 3)),
        np.repeat([1, 2, 3, 4], 2),
        np.tile([1, 3], 4),
        normalisation="mass",
    )


def near(modes: ModeSet, seed: int, size: float = 0.1) -> ModeSet:
    noise = np.random.default_rng(seed)
    shapes = modes.mode_shapes + size * noise.normal(size=modes.mode_shapes.shape)
    return mode_set(1.03 * modes.frequencies_hz, shapes, modes.nodes, modes.components)


def test_a_model_that_equals_its_test_has_no_residual() -> None:
    modes = sample(0)
    found = residual(modes, modes, pair_by_order(modes, modes), BOTH)
    np.testing.assert_allclose(found.values, 0.0, atol=1e-15)
    assert found.rows("frequencies") == slice(0, 3)
    assert found.rows("shapes") == slice(3, 27)


def test_shape_part_has_the_length_one_less_mac() -> None:
    model = sample(0)
    test = near(model, 1)
    pairing = pair_by_order(test, model)
    shapes = residual(test, model, pairing, BOTH).values[3:].reshape(3, -1)
    for pair in range(3):
        a, b = test.mode_shapes[:, pair], model.mode_shapes[:, pair]
        mac = (a @ b) ** 2 / ((a @ a) * (b @ b))
        assert np.sum(shapes[pair] ** 2) == pytest.approx(1.0 - mac)


@pytest.mark.parametrize("factor", [-1.0, 3.7, -0.002])
def test_scale_and_sign_of_the_measured_shapes_change_no_misfit(factor: float) -> None:
    model, base = sample(0), near(sample(0), 1)
    scaled = mode_set(base.frequencies_hz, factor * base.mode_shapes, base.nodes, base.components)
    pairing = pair_by_order(base, model)
    one, other = (residual(test, model, pairing, BOTH) for test in (base, scaled))
    assert other.misfit == pytest.approx(one.misfit)


def test_a_solver_that_turns_a_sign_changes_nothing() -> None:
    model, test = sample(0), near(sample(0), 1)
    turned = mode_set(model.frequencies_hz, -model.mode_shapes, model.nodes, model.components)
    pairing = pair_by_order(test, model)
    np.testing.assert_allclose(
        residual(test, turned, pairing, BOTH).values, residual(test, model, pairing, BOTH).values
    )


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_sensitivity_is_the_derivative_of_the_residual(sign: float) -> None:
    model, test = sample(0, sign), near(sample(0), 1)
    pairing = pair_by_order(test, model)
    noise = np.random.default_rng(3)
    d_lam, d_phi = noise.normal(size=(3, 2)), noise.normal(size=(8, 3, 2))
    sensitivity = residual_sensitivity(test, model, pairing, BOTH, ModeDerivatives(d_lam, d_phi))

    def moved(step: Floats) -> Floats:
        lam = model.eigenvalues + d_lam @ step
        shapes = model.mode_shapes + d_phi @ step
        there = mode_set(np.sqrt(lam) / (2 * np.pi), shapes, model.nodes, model.components)
        return residual(test, there, pairing, BOTH).values

    h = 1e-6
    for column in range(2):
        step = h * np.eye(2)[column]
        difference = -(moved(step) - moved(-step)) / (2 * h)  # z is measured minus computed
        np.testing.assert_allclose(sensitivity[:, column], difference, atol=1e-7)


def test_weights_are_emphasis_over_variance() -> None:
    model = sample(0)
    found = residual(
        model, model, pair_by_order(model, model), even_weighting(3, 8, 0.01, 0.05, 2.0, 0.5)
    )
    # An eigenvalue's relative deviation is twice the frequency's; shapes share theirs out.
    np.testing.assert_allclose(found.weights[:3], 2.0 / 0.02**2)
    np.testing.assert_allclose(found.weights[3:], 0.5 * 8 / 0.05**2)


def test_a_shape_far_from_the_test_counts_little() -> None:
    model = sample(0)
    close, far = near(model, 1, 0.01), near(model, 1, 2.0)
    weights = [
        residual(test, model, pair_by_order(test, model), BOTH).weights[3] for test in (close, far)
    ]
    assert weights[1] < 0.1 * weights[0]


def test_without_weight_shapes_are_not_there() -> None:
    model = sample(0)
    assert residual(model, model, pair_by_order(model, model), FREQUENCIES).values.size == 3
