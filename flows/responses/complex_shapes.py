"""Complex shapes as responses: the campaign's `residuals.complex_shapes`."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Annotated

import numpy as np
from pydantic import Field

from modetune.adapters.yaml_file import Place
from modetune.core.updating.damped_pairs import DampedPairs
from modetune.core.updating.responses.complex_shapes import ComplexShapes
from modetune.flows.responses.response import (
    ModewiseSection,
    SensorObserver,
    TestedModel,
    nothing_seen,
)
from modetune.flows.responses.section import Positive


class ComplexSection(ModewiseSection):
    """Complex measured shapes, compared with those of the damped model."""

    deviation: Positive = 0.05
    """Standard deviation of the real and imaginary parts [of the shape's rms]"""
    mac: Annotated[float, Field(ge=0.0, le=1.0)] = 0.9
    """Smallest MAC of complex shapes that e1 accepts."""

    def response(self, given: TestedModel) -> ComplexShapes:
        numbers, sensors = given.test.numbers, given.sensors
        found = given.complex_shapes
        return ComplexShapes(
            np.zeros((0, len(numbers)), dtype=np.complex128) if found is None else found,
            nothing_seen
            if sensors is None
            else SensorObserver("complex shapes", sensors, given.deck),
            self.weights(numbers),
            self.deviation,
            self.mac,
            DampedPairs(given.deck.damping),
        )

    def problems(self, given: TestedModel) -> Iterator[tuple[Place, str]]:
        if given.complex_shapes is None:
            yield (), "the test's shapes are real: compare them by `shape_weight`"
        elif text := given.deck.undamped():
            yield (), text
