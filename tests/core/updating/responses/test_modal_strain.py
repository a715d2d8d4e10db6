"""Strains of modes: scaled by shapes or by themselves, with exact derivatives."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from modetune.core.correlation.pairing import pair_by_order
from modetune.core.modes import Floats, mode_set
from modetune.core.updating.job_results import ModalResult
from modetune.core.updating.responses.modal_strain import Gauge, ModalStrain, StrainScale
from modetune.core.updating.responses.response import ModelState, StateDerivatives
from modetune.core.updating.sensitivity import ModeDerivatives
from modetune.core.updating.weighting import even_weighting
from tests.core.updating.compared import state_of

SCALES: tuple[StrainScale, ...] = ("shapes", "own")
#: Six degrees of freedom of which the first four have sensors; a gauge between the last two.
GAUGES = tuple(
    Gauge(f"{a}-{b}", np.array([a, b]), np.array([1, 1]), np.array([-0.5, 0.5]))
    for a, b in ((5, 6), (1, 6), (2, 3))
)
HZ = np.array([4.0, 9.0, 20.0])


def response(scale: StrainScale, strains: Floats) -> ModalStrain:
    """Measured (n_gauges, 2) of the test's modes 1 and 3."""
    measured = {1: strains[:, 0], 3: strains[:, 1]}
    return ModalStrain(GAUGES, measured, scale, 1.0, 0.05, 0.1)


def state(test: Floats, model: Floats) -> ModelState:
    """Shapes (6, 3) each, of which the test has the first four rows."""
    nodes, ones = np.arange(1, 7), np.ones(6, dtype=np.int64)
    whole = ModalResult.of_shapes((2 * np.pi * HZ) ** 2, model, nodes, ones, np.zeros(3), 0)
    seen = mode_set(HZ, model[:4], nodes[:4], ones[:4], normalisation="mass")
    own = mode_set(HZ, test[:4], nodes[:4], ones[:4], normalisation="mass")
    made = state_of(own, seen, pair_by_order(own, seen), even_weighting(3, 4, 0.002, 0.02))
    return replace(made, modal=whole)


@pytest.mark.parametrize("scale", SCALES)
def test_a_model_in_any_scale_agrees_with_its_own_strains(scale: StrainScale) -> None:
    model = np.random.default_rng(0).normal(size=(6, 3))
    strains = np.array([[-0.5, 0.5] @ model[[a, b]] for a, b in ((4, 5), (0, 5), (1, 2))])
    # Of the test's scale, which no model knows: -3 times these shapes.
    found = response(scale, -3.0 * strains[:, [0, 2]])
    part = found.residual(state(-3.0 * model, model))
    np.testing.assert_allclose(part.values, 0.0, atol=1e-13)
    names = (
        ("strain 5-6 of mode 1", "strain 1-6 of mode 1")
        if scale == "shapes"
        else (("strains of mode 1",) * 2)
    )
    assert part.labels[:2] == names
    assert found.agrees(part)
    assert part.n_independent == (6 if scale == "shapes" else 4)


def test_strains_in_the_scale_of_shapes_are_told_by_their_size_too() -> None:
    model = np.random.default_rng(0).normal(size=(6, 3))
    strains = np.array([[-0.5, 0.5] @ model[[a, b]] for a, b in ((4, 5), (0, 5), (1, 2))])
    twice = 2.0 * strains[:, [0, 2]]
    assert not response("shapes", twice).agrees(
        response("shapes", twice).residual(state(model, model))
    )
    part = response("shapes", twice).residual(state(model, model))
    np.testing.assert_allclose(part.values, 0.5 * part.blocks[0].measured, atol=1e-13)
    assert response("own", twice).agrees(response("own", twice).residual(state(model, model)))


@pytest.mark.parametrize("scale", SCALES)
def test_the_sensitivity_is_the_derivative(scale: StrainScale) -> None:
    noise = np.random.default_rng(1)
    model, test = noise.normal(size=(6, 3)), noise.normal(size=(6, 3))
    d_phi = noise.normal(size=(6, 3, 2))
    found = response(scale, noise.normal(size=(3, 2)))
    whole = ModeDerivatives(np.zeros((3, 2)), d_phi)
    seen = ModeDerivatives(np.zeros((3, 2)), d_phi[:4])
    slopes = found.sensitivity(state(test, model), StateDerivatives(seen, (0, 1), whole))
    h = 1e-6
    for column in range(2):
        ends = [
            found.residual(state(test, model + side * d_phi[:, :, column])).values
            for side in (h, -h)
        ]
        # Measured minus computed: the slope's sign is the other one.
        np.testing.assert_allclose(slopes[:, column], (ends[1] - ends[0]) / (2 * h), atol=1e-8)
