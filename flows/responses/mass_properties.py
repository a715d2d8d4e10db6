"""Mass properties as responses: the campaign's `residuals.mass_properties`."""

from __future__ import annotations

import math
from collections.abc import Iterator

from pydantic import model_validator

from modetune.adapters.yaml_file import Place
from modetune.core.updating.responses.mass_properties import (
    MASS_QUANTITIES,
    MassResponse,
    MassTarget,
)
from modetune.flows.responses.response import ResponseSection, TestedModel
from modetune.flows.responses.section import Finite, NotNegative, Positive, Section


class MassQuantitySection(Section):
    """A mass property: its measured value and deviation, and limits that every step respects."""

    target: Finite | None = None
    """Measured value [the deck's units]"""
    deviation: Positive | None = None
    """Standard deviation of the measured value; required with `target` [the deck's units]"""
    weight: NotNegative = 1.0
    """Weight; 0 leaves the target out."""
    limits: tuple[Finite | None, Finite | None] | None = None
    """Lowest and highest value that a step may reach; null: no limit on that side [the deck's
    units]"""

    @model_validator(mode="after")
    def _sound(self) -> MassQuantitySection:
        if self.target is None and self.limits is None:
            raise ValueError("give a `target` with its `deviation`, `limits`, or both")
        if (self.target is None) != (self.deviation is None):
            raise ValueError("`target` and `deviation` belong together")
        low, high = self.ends
        if low >= high:
            raise ValueError(f"limits: the lower ({low:g}) must be below the upper ({high:g})")
        if self.target is not None and not low <= self.target <= high:
            raise ValueError(
                f"the target {self.target:g} is outside the limits ({low:g} to {high:g}); correct "
                "one of them"
            )
        return self

    @property
    def ends(self) -> tuple[float, float]:
        """The limits, infinite where none is given."""
        low, high = self.limits or (None, None)
        return -math.inf if low is None else low, math.inf if high is None else high

    def as_target(self) -> MassTarget:
        """Return the target with its limits; limits without a target have weight 0."""
        if self.target is None or self.deviation is None:
            near = next(end for end in self.ends if math.isfinite(end))
            return MassTarget(near, abs(near) or 1.0, 0.0, self.ends)
        return MassTarget(self.target, self.deviation, self.weight, self.ends)


class MassSection(ResponseSection):
    """Mass, centre of gravity and inertia of the model as targets and limits, in the deck's units
    and global axes; the inertia tensor is about the centre of gravity."""

    mass: MassQuantitySection | None = None
    """Total mass."""
    centre_x: MassQuantitySection | None = None
    """Centre of gravity along x."""
    centre_y: MassQuantitySection | None = None
    """Centre of gravity along y."""
    centre_z: MassQuantitySection | None = None
    """Centre of gravity along z."""
    inertia_xx: MassQuantitySection | None = None
    """Moment of inertia about x."""
    inertia_yy: MassQuantitySection | None = None
    """Moment of inertia about y."""
    inertia_zz: MassQuantitySection | None = None
    """Moment of inertia about z."""
    inertia_xy: MassQuantitySection | None = None
    """Entry xy of the inertia tensor, minus the integral of x y."""
    inertia_yz: MassQuantitySection | None = None
    """Entry yz of the inertia tensor, minus the integral of y z."""
    inertia_zx: MassQuantitySection | None = None
    """Entry zx of the inertia tensor, minus the integral of z x."""
    within: Positive = 2.0
    """Largest difference that e1 accepts [deviations]"""

    @model_validator(mode="after")
    def _possible(self) -> MassSection:
        targets = {name: item.value for name, item in self.targets.items() if item.weight}
        if not self.targets:
            raise ValueError("name a quantity: " + ", ".join(MASS_QUANTITIES))
        for name in ("mass", "inertia_xx", "inertia_yy", "inertia_zz"):
            if targets.get(name, 1.0) <= 0.0:
                raise ValueError(f"{name}: the target {targets[name]:g} must be above zero")
        own = [targets.get(name) for name in ("inertia_xx", "inertia_yy", "inertia_zz")]
        known = [item for item in own if item is not None]
        if len(known) == 3 and 2.0 * max(known) > sum(known):
            raise ValueError(
                f"inertia: {max(known):g} is more than the two others together, which no body has"
            )
        return self

    @property
    def targets(self) -> dict[str, MassTarget]:
        given = ((name, getattr(self, name)) for name in MASS_QUANTITIES)
        return {name: item.as_target() for name, item in given if item is not None}

    @property
    def counts(self) -> bool:
        return any(item.weight for item in self.targets.values())

    def problems(self, given: TestedModel) -> Iterator[tuple[Place, str]]:
        for name in self.targets:
            if name != "mass" and not given.deck.mesh().nodes.size:
                yield (name,), "the model has no coordinates, and so only a mass: leave this out"

    def response(self, given: TestedModel) -> MassResponse:
        targets = {name: self.targets[name] for name in MASS_QUANTITIES if name in self.targets}
        return MassResponse(targets, self.within, given.deck.observation)
