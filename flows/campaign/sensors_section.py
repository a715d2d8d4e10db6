"""What a campaign says of its sensors: `test.sensors`."""

from __future__ import annotations

from typing import Annotated, Literal

import numpy as np
from pydantic import Field, model_validator

from modetune.core.modes import Floats
from modetune.flows.responses.section import Section

Number = Annotated[float, Field(allow_inf_nan=False)]
Triple = tuple[Number, Number, Number]
Node = Annotated[int, Field(ge=1)]


class SensorSection(Section):
    """How a test's points are laid over the model."""

    by: Literal["position", "number"] = "position"
    """`position` finds nodes by the test's coordinates, `number` takes the node of the same number;
    so does a test without coordinates."""
    align: Literal["none", "fit"] | None = None
    """`fit` finds rotation and translation, and the scale where no unit tells it; those given here
    choose then among fits that cannot be told apart. `none` takes those given here, and else the
    model's axes. Without it: `match` alone fixes the alignment, else `none`."""
    scale: Annotated[Number, Field(gt=0.0)] | None = None
    """Model lengths a test length; without it from the units of both."""
    rotation: Triple | tuple[Triple, Triple, Triple] | None = None
    """From the test's axes to the model's: degrees about the model's x, then y, then z; or a
    matrix, three rows."""
    translation: Triple | None = None
    """Where the test's origin lies in the model, in the model's length."""
    match: dict[Node, Node | Triple] = Field(default={})
    """Landmarks by hand: test node to model node, or to a place in the model's axes and length.
    Three or more, not on one line, fix the alignment; with `align: fit` fewer do, which choose."""
    tolerance: Annotated[Number, Field(gt=0.0)] | None = None
    """How far a sensor may be from its node, in the model's length; without it 2 % of the model's
    box diagonal, or half the mean element edge where that is more."""
    unmapped: Literal["refuse", "leave_out"] = "refuse"
    """What is done with sensors that no node is near enough to, or whose motion the model's results
    lack."""

    @model_validator(mode="after")
    def _sound(self) -> SensorSection:
        if self.by == "number" and self.places:
            raise ValueError(
                "sensors by number have no place; leave out align, scale, rotation, translation"
            )
        matrix = self.matrix()
        if np.abs(matrix @ matrix.T - np.eye(3)).max() > 1e-3 or np.linalg.det(matrix) < 0.0:
            raise ValueError(
                "`rotation` is not a rotation: its rows must be unit vectors at right angles, its "
                "determinant 1"
            )
        return self

    @property
    def fits(self) -> bool:
        """Whether the alignment is to be found."""
        given = self.rotation is not None or self.translation is not None
        return self.align == "fit" or (self.align is None and bool(self.match) and not given)

    @property
    def places(self) -> bool:
        """Whether anything here needs the test's coordinates."""
        return self.align == "fit" or any(
            item is not None for item in (self.scale, self.rotation, self.translation)
        )

    def matrix(self) -> Floats:
        """The rotation (3, 3); the identity where none is given."""
        if self.rotation is None:
            return np.eye(3)
        given = np.array(self.rotation)
        if given.shape == (3, 3):
            return given
        from scipy.spatial.transform import Rotation  # few campaigns turn their sensors

        return np.asarray(Rotation.from_euler("xyz", given, degrees=True).as_matrix())
