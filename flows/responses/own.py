"""Responses that are functions of the user: from Python alone, as no campaign file holds them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from modetune.adapters.function.solver import UserFunction
from modetune.core.errors import CampaignError, ModesError
from modetune.core.modes import Floats, MeasuredModes
from modetune.core.updating.responses.own import OwnValues

KEYS = ("function", "measured", "deviation", "name", "weight")


def own_response(given: Sequence[Mapping[str, Any]], test: MeasuredModes) -> OwnValues:
    """Return what compares values of functions with measured ones.

    given: mappings with `function`, `measured` and `deviation`, and maybe `name` and `weight`.
    Raises CampaignError.
    """
    parts = [_part(item) for item in given]
    names = [
        name if len(measured) == 1 else f"{name} {place}"
        for _, name, measured, _, _ in parts
        for place in range(1, len(measured) + 1)
    ]

    def values(hz: Floats, shapes: Floats) -> Floats:
        return np.concatenate(
            [
                _values(function, name, hz, shapes, len(measured))
                for function, name, measured, *_ in parts
            ]
        )

    return OwnValues(
        tuple(names),
        np.concatenate([measured for _, _, measured, _, _ in parts]),
        np.concatenate([deviations for *_, deviations, _ in parts]),
        np.concatenate([weights for *_, weights in parts]),
        values,
        test.has_shapes,
    )


def _part(given: Mapping[str, Any]) -> tuple[UserFunction, str, Floats, Floats, Floats]:
    """Return function, name, measured values, deviations and weights of a response."""
    missing = [key for key in KEYS[:3] if key not in given]
    unknown = [str(key) for key in given if key not in KEYS]
    if missing or unknown or not callable(given["function"]):
        raise CampaignError(
            "responses: each requires `function`, `measured` and `deviation`, and may have `name` "
            f"and `weight`; found {', '.join(map(str, given)) or 'nothing'}"
        )
    function = UserFunction(given["function"])
    name = str(given.get("name", function.name))
    try:
        measured, deviation, weight = (
            np.atleast_1d(np.asarray(value, dtype=np.float64))
            for value in (given["measured"], given["deviation"], given.get("weight", 1.0))
        )
    except (TypeError, ValueError) as error:
        raise CampaignError(f"responses: {name}: {error}") from error
    if measured.ndim != 1 or not {deviation.shape, weight.shape} <= {(1,), measured.shape}:
        raise CampaignError(
            f"responses: {name}: `measured` has shape {measured.shape}; it must be a list of "
            "values, and `deviation` and `weight` have one value each, or as many as are measured"
        )
    deviations, weights = (np.broadcast_to(one, measured.shape) for one in (deviation, weight))
    sound = np.isfinite(measured).all() and (deviations > 0.0).all() and (weights >= 0.0).all()
    if not sound:
        raise CampaignError(
            f"responses: {name}: `measured` must be finite numbers, `deviation` above zero and "
            "`weight` zero or above"
        )
    return function, name, measured, deviations, weights


def _values(function: UserFunction, name: str, hz: Floats, shapes: Floats, n: int) -> Floats:
    """Return the values of a function. Raises ModesError where it fails."""
    try:
        found = np.atleast_1d(np.asarray(function.function(hz, shapes), dtype=np.float64))
    except Exception as error:  # a user's function may raise anything
        raise ModesError(
            f"response {name}: {function.failure(error)} with {hz.size} frequencies and shapes "
            f"{shapes.shape}; correct the function"
        ) from error
    if found.shape != (n,) or not np.isfinite(found).all():
        raise ModesError(
            f"response {name}: {function.place} returned {found}; expected {n} finite "
            f"number{'' if n == 1 else 's'}, as many as are measured"
        )
    return found
