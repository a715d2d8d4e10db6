"""What the section of each kind of response beside frequencies and shapes tells."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Iterable, Mapping
from typing import ClassVar

from pydantic import Field

from modetune.adapters.yaml_file import Place
from modetune.core.updating.responses.response import Response
from modetune.flows.campaign.section import OTHERS, Section, Weights
from modetune.flows.campaign.tested_model import TestedModel


class ResponseSection(Section):
    """A kind of response: what is measured of it, how exactly, and how much it counts."""

    mode_keys: ClassVar[tuple[str, ...]] = ()
    """Its keys whose values go by mode."""

    @property
    def shape_weights(self) -> Mapping[str, float]:
        """Its weights by mode, where it compares shapes."""
        return {}

    @property
    @abstractmethod
    def counts(self) -> bool:
        """Whether any of its weights is above zero."""

    @abstractmethod
    def response(self, given: TestedModel) -> Response:
        """The kind as a test and a model have it, without what `problems` tells of."""

    def problems(self, given: TestedModel) -> Iterable[tuple[Place, str]]:
        """Why some of it cannot be compared, each with its place below the section."""
        return ()


class ModewiseSection(ResponseSection):
    """A kind with a response of each mode."""

    mode_keys: ClassVar[tuple[str, ...]] = ("weight",)

    weight: Weights = Field(default=1.0, validate_default=True)
    """Emphasis, of all modes or by mode; 0 leaves them out."""

    @property
    def counts(self) -> bool:
        return any(self.weight.values())

    def weights(self, numbers: Iterable[int]) -> dict[int, float]:
        """Of the modes of these numbers; 1 of those that no key names."""
        return of_modes({OTHERS: 1.0} | self.weight, numbers)


def of_modes(given: Mapping[str, float], numbers: Iterable[int]) -> dict[int, float]:
    """What a key by mode says of the modes of these numbers; without those it does not tell."""
    told = ((n, given.get(str(n), given.get(OTHERS))) for n in numbers)
    return {n: value for n, value in told if value is not None}
