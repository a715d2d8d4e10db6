"""MAC as a response: closed forms, exact derivatives, clusters."""

from __future__ import annotations

import numpy as np
import pytest

from modetune.core.correlation.pairing import pair_by_order
from modetune.core.modes import Floats, ModeSet, mode_set
from modetune.core.updating.responses.mac import Mac, MacQuantity
from modetune.core.updating.responses.response import ModelState, StateDerivatives
from modetune.core.updating.sensitivity import ModeDerivatives
from modetune.core.updating.weighting import even_weighting
from tests.core.updating.compared import state_of

QUANTITIES: tuple[MacQuantity, ...] = ("root", "one_minus_mac")
WEIGHTS = {1: 1.0, 2: 1.0, 3: 1.0}


def modes(shapes: Floats, hz: Floats) -> ModeSet:
    rows = len(shapes)
    return mode_set(hz, shapes, np.arange(1, rows + 1), np.ones(rows), normalisation="mass")


def beside(test: ModeSet, model: ModeSet, deviation: float = 0.02) -> ModelState:
    weighting = even_weighting(test.n_modes, test.n_dof, 0.002, deviation)
    return state_of(test, model, pair_by_order(test, model), weighting)


@pytest.mark.parametrize("angle", [0.02, 0.3, 1.2])
def test_two_shapes_at_an_angle_have_its_sine(angle: float) -> None:
    test = modes(np.array([[1.0], [0.0]]), np.array([5.0]))
    model = modes(7.0 * np.array([[-np.cos(angle)], [np.sin(angle)]]), np.array([5.1]))
    found = Mac({1: 3.0}, {}).residual(beside(test, model))
    sine = np.sin(angle)
    assert found.values == pytest.approx([-sine])
    # By the shape's deviation, and what a linear model of it cannot know.
    assert found.variances == pytest.approx([0.02**2 + sine**4])
    assert found.weights == pytest.approx(3.0 / found.variances)
    assert found.labels == ("MAC of mode 1",)
    squared = Mac({1: 1.0}, {1: 0.1}, "one_minus_mac").residual(beside(test, model))
    assert squared.values == pytest.approx([-(sine**2)])
    assert squared.variances == pytest.approx([0.01])


def test_a_model_that_equals_its_test_has_no_residual_and_no_slope() -> None:
    noise = np.random.default_rng(0)
    own = modes(noise.normal(size=(6, 3)), np.array([4.0, 9.0, 20.0]))
    state = beside(own, own)
    derivatives = ModeDerivatives(np.zeros((3, 2)), noise.normal(size=(6, 3, 2)))
    assert Mac(WEIGHTS, {}).residual(state).values == pytest.approx(np.zeros(3), abs=1e-15)
    found = Mac(WEIGHTS, {}).sensitivity(state, StateDerivatives(derivatives, (0, 1)))
    assert not found.any()


@pytest.mark.parametrize("quantity", QUANTITIES)
@pytest.mark.parametrize("close", [False, True])
def test_the_sensitivity_is_the_derivative(quantity: MacQuantity, close: bool) -> None:
    noise = np.random.default_rng(1)
    hz = np.array([4.0, 4.0004 if close else 9.0, 20.0])
    model = modes(noise.normal(size=(6, 3)), hz)
    test = modes(model.mode_shapes + 0.3 * noise.normal(size=(6, 3)), 1.02 * hz)
    d_phi = noise.normal(size=(6, 3, 2))
    if close:  # what turns shapes within their own space is no change of a cluster
        space, _ = np.linalg.qr(model.mode_shapes[:, :2])
        d_phi[:, :2] -= np.einsum("sk,tk,tmp->smp", space, space, d_phi[:, :2])
    response = Mac(WEIGHTS, {}, quantity)
    derivatives = StateDerivatives(ModeDerivatives(np.zeros((3, 2)), d_phi), (0, 1))
    found = response.sensitivity(beside(test, model), derivatives)

    def moved(step: Floats) -> Floats:
        there = modes(model.mode_shapes + d_phi @ step, hz)
        return response.residual(beside(test, there)).values

    h = 1e-6
    for column in range(2):
        step = h * np.eye(2)[column]
        difference = -(moved(step) - moved(-step)) / (2 * h)  # z is measured minus computed
        np.testing.assert_allclose(found[:, column], difference, atol=1e-8)


@pytest.mark.parametrize("quantity", QUANTITIES)
def test_no_rotation_of_close_modes_changes_anything(quantity: MacQuantity) -> None:
    noise = np.random.default_rng(2)
    hz = np.array([4.0, 4.0004])
    shapes = noise.normal(size=(6, 2))
    shapes /= np.linalg.norm(shapes, axis=0)
    shapes[:, 1] -= shapes[:, 0] * (shapes[:, 0] @ shapes[:, 1])
    shapes[:, 1] /= np.linalg.norm(shapes[:, 1])
    test = modes(shapes + 0.2 * noise.normal(size=(6, 2)), hz)
    turn = np.array([[np.cos(0.7), -np.sin(0.7)], [np.sin(0.7), np.cos(0.7)]])
    response = Mac({1: 1.0, 2: 1.0}, {}, quantity)
    one, other = (
        response.residual(beside(test, modes(own, hz))).values for own in (shapes, shapes @ turn)
    )
    np.testing.assert_allclose(one, other, rtol=1e-12)


def test_e1_asks_the_used_ones_alone() -> None:
    test = modes(np.eye(3), np.array([4.0, 9.0, 20.0]))
    tilted = np.eye(3)
    tilted[:, 2] = [0.0, np.sin(0.5), np.cos(0.5)]  # MAC cos^2 0.5 = 0.77
    state = beside(test, modes(tilted, np.array([4.0, 9.0, 20.0])))
    strict = Mac(WEIGHTS, {}, tolerance=0.9)
    assert not strict.agrees(strict.residual(state))
    without = Mac({1: 1.0, 2: 1.0, 3: 0.0}, {}, tolerance=0.9)
    assert without.agrees(without.residual(state))
    assert Mac(WEIGHTS, {}, tolerance=0.76).agrees(Mac(WEIGHTS, {}).residual(state))
