"""A test beside modes of a model, as the residual of frequencies and shapes has them."""

from __future__ import annotations

from modetune.core.correlation.pairing import Pairing
from modetune.core.modes import Floats, MeasuredModes, ModeSet
from modetune.core.updating import residual as of_responses
from modetune.core.updating.responses.frequencies import Frequencies
from modetune.core.updating.responses.response import (
    ModelState,
    Residual,
    Response,
    StateDerivatives,
)
from modetune.core.updating.responses.shapes import Shapes
from modetune.core.updating.sensitivity import ModeDerivatives
from modetune.core.updating.weighting import Weighting


def state_of(test: ModeSet, model: ModeSet, pairing: Pairing, weighting: Weighting) -> ModelState:
    numbers = tuple(range(1, test.n_modes + 1))
    return ModelState(MeasuredModes(numbers, test), weighting, model, pairing)


def compared_by(weighting: Weighting) -> tuple[Response, ...]:
    return (Frequencies(), Shapes()) if weighting.with_shapes else (Frequencies(),)


def residual(test: ModeSet, model: ModeSet, pairing: Pairing, weighting: Weighting) -> Residual:
    state = state_of(test, model, pairing, weighting)
    return of_responses.residual(compared_by(weighting), state)


def residual_sensitivity(
    test: ModeSet,
    model: ModeSet,
    pairing: Pairing,
    weighting: Weighting,
    derivatives: ModeDerivatives,
) -> Floats:
    state = state_of(test, model, pairing, weighting)
    columns = tuple(range(derivatives.eigenvalues.shape[1]))
    return of_responses.residual_sensitivity(
        compared_by(weighting), state, StateDerivatives(derivatives, columns)
    )
