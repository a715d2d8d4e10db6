"""Strains of modes at gauges: the campaign's `residuals.modal_strain`."""

from __future__ import annotations

from typing import Annotated, ClassVar

import numpy as np
from pydantic import BeforeValidator, Field, model_validator

from modetune.adapters.solver import Deck
from modetune.adapters.yaml_file import Place
from modetune.core.errors import ModelError
from modetune.core.updating.responses.modal_strain import Gauge, ModalStrain, StrainScale
from modetune.flows.responses.gauges import elongation
from modetune.flows.responses.response import ResponseSection, TestedModel
from modetune.flows.responses.section import Finite, NotNegative, Positive, by_name


class ModalStrainSection(ResponseSection):
    """Strains of modes at gauges."""

    shape_changes: ClassVar[bool] = True
    mode_keys: ClassVar[tuple[str, ...]] = ("modes",)

    gauges: Annotated[tuple[str, ...], Field(min_length=1)]
    """Gauges, each as `node-node`; the strain is the elongation between the two nodes divided by
    their distance."""
    modes: Annotated[dict[str, tuple[Finite, ...]], BeforeValidator(by_name), Field(min_length=1)]
    """Measured strains by the test's mode number, one per gauge."""
    scale: StrainScale = "shapes"
    """What defines the scale of a mode: `shapes`, its displacement shape in the test, with strains
    measured in the same scale; `own`, the strains themselves."""
    weight: NotNegative = 1.0
    """Weight; 0 leaves strains out."""
    deviation: Positive = 0.05
    """Standard deviation of measured strains [of the root mean square of the mode's strains]"""
    tolerance: Positive = 0.1
    """Largest error that e1 accepts [of the root mean square of the mode's strains]"""

    @model_validator(mode="after")
    def _whole(self) -> ModalStrainSection:
        for number, values in self.modes.items():
            if not number.isdecimal():
                raise ValueError(f"{number!r} is not the number of a mode of the test")
            if len(values) != len(self.gauges):
                raise ValueError(
                    f"mode {number} has {len(values)} strains for {len(self.gauges)} gauges; give "
                    "one per gauge"
                )
            if not any(values):
                raise ValueError(f"mode {number}: all strains are zero; leave the mode out")
        if self.scale == "own" and len(self.gauges) < 2:
            raise ValueError("`scale: own` requires two gauges or more; one defines only a scale")
        return self

    @property
    def counts(self) -> bool:
        return self.weight > 0.0

    def nodes(self, deck: Deck) -> set[int]:
        return {node for gauge in self._gauges(deck, []) for node in gauge.nodes.tolist()}

    def problems(self, given: TestedModel) -> list[tuple[Place, str]]:
        found: list[tuple[Place, str]] = []
        self._gauges(given.deck, found)
        if self.scale == "shapes" and not given.test.has_shapes:
            found.append((("scale",), "the test has no shapes to define the scale; use `own`"))
        return found

    def response(self, given: TestedModel) -> ModalStrain:
        return ModalStrain(
            tuple(self._gauges(given.deck, [])),
            {int(n): np.array(values) for n, values in self.modes.items()},
            self.scale,
            self.weight,
            self.deviation,
            self.tolerance,
        )

    def _gauges(self, deck: Deck, problems: list[tuple[Place, str]]) -> list[Gauge]:
        """Return the gauges on the model; those whose nodes it lacks are problems."""
        gauges: list[Gauge] = []
        for place, name in enumerate(self.gauges):
            try:
                gauges.append(Gauge(name, *elongation(name, deck)))
            except ModelError as error:
                problems.append((("gauges", place), str(error)))
        return gauges
