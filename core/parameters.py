"""Updating parameters: what of the model may change, by how much, and where it stands.

A parameter's value is relative to the deck's: 1 leaves the deck as it is, 1.1 raises the quantity
by 10 %. All steps are taken in these values, so parameters of any unit are of one size and the
equations need no further normalisation (thesis, appendix, on magnitudes of E and thickness).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np

from modetune.core.modes import Floats

Quantity = Literal[
    "youngs_modulus", "shear_modulus", "poissons_ratio", "density", "thickness", "area",
    "inertia_1", "inertia_2", "torsion_constant", "dimension", "spring_stiffness", "mass",
    "matrix_factor",
]  # fmt: skip

#: What the targets of a parameter name.
TargetKind = Literal["material", "elset", "property", "element", "part"]

#: What may name the owner of each quantity; the first is what CalculiX decks use.
TARGETS: dict[Quantity, tuple[TargetKind, ...]] = {
    "youngs_modulus": ("material",),
    "shear_modulus": ("material",),
    "poissons_ratio": ("material",),
    "density": ("material",),
    "thickness": ("elset", "property", "element"),
    "area": ("property", "element"),
    "inertia_1": ("property", "element"),
    "inertia_2": ("property", "element"),
    "torsion_constant": ("property", "element"),
    "dimension": ("property", "element"),
    "spring_stiffness": ("elset", "property", "element"),
    "mass": ("elset", "element"),
    "matrix_factor": ("part",),
}

#: Values of parameters by name, relative to the deck.
Values = Mapping[str, float]


@dataclass(frozen=True, slots=True)
class Parameter:
    """One updating parameter: a quantity of one or several materials, sections or element sets.

    by: what the targets name. item: which one of a card's numbers of that quantity is meant (a
    ply, a dimension of a cross-section, a direction of a spring or of an orthotropic material);
    0 where there is one, or where all are.
    """

    name: str
    quantity: Quantity
    by: TargetKind
    targets: tuple[str, ...]
    lower: float
    upper: float
    standard_deviation: float
    initial: float = 1.0
    item: int = 0


@dataclass(frozen=True, slots=True)
class ParameterSet:
    """The parameters of a campaign in their fixed order; values travel as (n_parameters,)."""

    parameters: tuple[Parameter, ...]

    def __len__(self) -> int:
        return len(self.parameters)

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(parameter.name for parameter in self.parameters)

    @property
    def initial(self) -> Floats:
        return np.array([parameter.initial for parameter in self.parameters])

    @property
    def lower(self) -> Floats:
        return np.array([parameter.lower for parameter in self.parameters])

    @property
    def upper(self) -> Floats:
        return np.array([parameter.upper for parameter in self.parameters])

    @property
    def standard_deviations(self) -> Floats:
        return np.array([parameter.standard_deviation for parameter in self.parameters])

    def values(self, theta: Floats) -> dict[str, float]:
        """Name to value, for the adapter that edits the deck."""
        return dict(zip(self.names, theta.tolist(), strict=True))

    def at_bounds(self, theta: Floats) -> tuple[str, ...]:
        """Names of the parameters that stand on a bound."""
        on = np.isclose(theta, self.lower, atol=1e-9) | np.isclose(theta, self.upper, atol=1e-9)
        return tuple(name for name, hit in zip(self.names, on.tolist(), strict=True) if hit)
