"""MAC as a response: the campaign's `residuals.mac`."""

from __future__ import annotations

from collections.abc import Mapping

from pydantic import Field

from modetune.adapters.yaml_file import Place
from modetune.core.updating.responses.mac import Mac, MacQuantity
from modetune.flows.campaign.section import OTHERS, Deviations, Section, Weights
from modetune.flows.campaign.tested_model import TestedModel


class MacSection(Section):
    """MAC of each pair as one number, in place of the entries of shapes or beside them."""

    quantity: MacQuantity = "root"
    """What is compared: the root of 1 - MAC, which is about linear in parameters, or 1 - MAC."""
    weight: Weights = Field(default=1.0, validate_default=True)
    """Emphasis, of all modes or by mode; 0 leaves them out."""
    deviation: Deviations = Field(default={})
    """Standard deviation of the quantity, of all or by mode; without it what the deviation of the
    shape's entries makes of it."""

    @property
    def counts(self) -> bool:
        return any(self.weight.values())

    @property
    def mode_keys(self) -> tuple[str, ...]:
        return ("weight", "deviation")

    @property
    def shape_weights(self) -> Mapping[str, float]:
        return self.weight

    def response(self, given: TestedModel) -> Mac:
        """As a test has it."""
        numbers = given.test.numbers
        return Mac(
            {n: self.weight.get(str(n), self.weight.get(OTHERS, 1.0)) for n in numbers},
            {
                n: value
                for n in numbers
                if (value := self.deviation.get(str(n), self.deviation.get(OTHERS))) is not None
            },
            self.quantity,
            given.e1.mac,
        )

    def problems(self, given: TestedModel) -> list[tuple[Place, str]]:
        return []
