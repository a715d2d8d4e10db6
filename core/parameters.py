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
    "inertia_1", "inertia_2", "inertia_12", "torsion_constant", "dimension", "spring_stiffness",
    "mass", "rotary_inertia", "nonstructural_mass", "ply_angle", "bending_inertia_ratio",
    "shear_thickness_ratio", "shear_factor", "offset", "structural_damping", "viscous_damping",
    "matrix_factor", "number",
]  # fmt: skip

#: What the targets of a parameter name.
#: A placeholder has the parameter's own name.
TargetKind = Literal["material", "elset", "property", "element", "part", "placeholder"]

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
    "inertia_12": ("property", "element"),
    "dimension": ("elset", "property", "element"),
    "spring_stiffness": ("elset", "property", "element"),
    "mass": ("elset", "element"),
    "rotary_inertia": ("element",),
    "nonstructural_mass": ("property", "element"),
    "ply_angle": ("elset", "property", "element"),
    "bending_inertia_ratio": ("property", "element"),
    "shear_thickness_ratio": ("property", "element"),
    "shear_factor": ("property", "element"),
    "offset": ("property", "element"),
    "structural_damping": ("material", "property", "element"),
    "viscous_damping": ("property", "element"),
    "matrix_factor": ("part",),
    "number": (),
}

#: Powers of a quantity that bound how stiffness and mass grow with it; infinite where none does
#: (a ply that turns, an offset or a product of inertia that cancels another one).
POWERS: dict[Quantity, tuple[float, float]] = {
    "youngs_modulus": (1, 0),
    "shear_modulus": (1, 0),
    "poissons_ratio": (1, 0),
    "density": (0, 1),
    "thickness": (3, 1),
    "area": (1, 1),
    "inertia_1": (1, 0),
    "inertia_2": (1, 0),
    "torsion_constant": (1, 0),
    "dimension": (4, 2),
    "spring_stiffness": (1, 0),
    "mass": (0, 1),
    "rotary_inertia": (0, 1),
    "nonstructural_mass": (0, 1),
    "ply_angle": (np.inf, 0),
    "inertia_12": (np.inf, 0),
    "bending_inertia_ratio": (1, 0),
    "shear_thickness_ratio": (1, 0),
    "shear_factor": (1, 0),
    "offset": (np.inf, 0),
    "structural_damping": (0, 0),
    "viscous_damping": (0, 0),
    "matrix_factor": (1, 1),
    "number": (np.inf, np.inf),
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


def frequency_reach(parameters: ParameterSet, theta: Floats) -> tuple[float, float]:
    """The least and the largest factor of any frequency, from values theta to all in the bounds.

    By Rayleigh's quotient an eigenvalue rises at most by the largest factor of any part of the
    stiffness over the least of any part of the mass; quantities of one part multiply.
    """
    if any(np.isinf(POWERS[item.quantity]).any() for item in parameters.parameters):
        return 0.0, np.inf
    least = largest = 1.0
    ratios = {
        "lower": np.minimum(parameters.lower / theta, 1.0),
        "upper": np.maximum(parameters.upper / theta, 1.0),
    }
    for quantity in dict.fromkeys(item.quantity for item in parameters.parameters):
        own = [item.quantity == quantity for item in parameters.parameters]
        stiffness, mass = POWERS[quantity]
        low, high = float(ratios["lower"][own].min()), float(ratios["upper"][own].max())
        largest *= high**stiffness / low**mass
        least *= low**stiffness / high**mass
    return float(np.sqrt(least)), float(np.sqrt(largest))
