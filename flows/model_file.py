"""A campaign file of which the model counts and the test does not: before there is a test."""

from __future__ import annotations

from typing import Any

from pydantic import model_validator

from modetune.core.measurement import Measurement
from modetune.core.modes import MeasuredModes, mode_set
from modetune.flows.schema import CampaignFile, ParameterSection

#: What stands for the test that is not read.
NO_TEST = Measurement(MeasuredModes((), mode_set([])))


class ModelFile(CampaignFile):
    """A campaign file whose `test` and `parameters` may be missing; its test is never read."""

    parameters: tuple[ParameterSection, ...] = ()
    """What of the model may change."""

    @model_validator(mode="before")
    @classmethod
    def _without_test(cls, given: Any) -> Any:
        return {**given, "test": {"modes": "none"}} if isinstance(given, dict) else given
