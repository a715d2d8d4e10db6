"""MAC as a response: the campaign's `residuals.mac`."""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar

from pydantic import Field

from modetune.core.updating.responses.mac import Mac, MacQuantity
from modetune.flows.responses.response import ModewiseSection, TestedModel, of_modes
from modetune.flows.responses.section import Deviations


class MacSection(ModewiseSection):
    """MAC of each pair as one number, instead of the entries of shapes or in addition to them."""

    mode_keys: ClassVar[tuple[str, ...]] = ("weight", "deviation")

    quantity: MacQuantity = "root"
    """Quantity to compare: the root of 1 - MAC, which is nearly linear in the parameters, or 1 -
    MAC."""
    deviation: Deviations = Field(default={})
    """Standard deviation of the quantity, one for all modes or by mode; without it the value that
    follows from the deviation of the shape's entries."""

    @property
    def shape_weights(self) -> Mapping[str, float]:
        return self.weight

    def response(self, given: TestedModel) -> Mac:
        numbers = given.test.numbers
        return Mac(
            self.weights(numbers), of_modes(self.deviation, numbers), self.quantity, given.e1.mac
        )
