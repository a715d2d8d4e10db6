"""The mean of the first frequencies as a response: the campaign's `residuals.mean_frequency`."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from modetune.core.updating.responses.mean_frequency import MeanFrequency
from modetune.flows.responses.response import ResponseSection, TestedModel
from modetune.flows.responses.section import NotNegative, Positive


class MeanFrequencySection(ResponseSection):
    """Mean of the first frequencies."""

    n: Annotated[int, Field(ge=1)] = 3
    """How many frequencies."""
    weight: NotNegative = 1.0
    """Emphasis; 0 leaves the mean out."""
    deviation: Positive = 0.002
    """Standard deviation [of the mean]"""
    tolerance: Positive = 0.01
    """Largest error that e1 accepts [of the mean]"""

    @property
    def counts(self) -> bool:
        return self.weight > 0.0

    def response(self, given: TestedModel) -> MeanFrequency:
        return MeanFrequency(self.n, self.weight, self.deviation, self.tolerance)
