"""Updating parameters: what may change in the model, by how much, and its present value.

A parameter's value is relative to the deck's: 1 leaves the deck as it is, 1.1 raises the quantity
by 10 %. All steps are taken in these values, so parameters of any unit are of one size and the
equations need no further normalisation (thesis, appendix, on magnitudes of E and thickness).

Absolute and additive parameters, which may start at zero, are counted so too: what a user gives and
reads, the number itself or what is added to the deck's, is `origin + scale * value`, with a scale
that makes the start 1 and keeps all values within the bounds above zero. Numbers given by an
expression of other parameters follow from these.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from itertools import product
from typing import Literal

import numpy as np

from modetune.core.errors import ModelError
from modetune.core.expressions import evaluate, names_of
from modetune.core.modes import Floats

Quantity = Literal[
    "youngs_modulus", "shear_modulus", "poissons_ratio", "density", "thickness", "area",
    "inertia_1", "inertia_2", "inertia_12", "torsion_constant", "dimension", "spring_stiffness",
    "mass", "rotary_inertia", "nonstructural_mass", "ply_angle", "bending_inertia_ratio",
    "shear_thickness_ratio", "shear_factor", "offset", "structural_damping", "viscous_damping",
    "matrix_factor", "number", "variable",
]  # fmt: skip

#: What values mean: factors on the deck's, the numbers themselves, or what is added to the deck's.
ValueKind = Literal["relative", "absolute", "additive"]

#: What the targets of a parameter name.
#: A placeholder has the parameter's own name.
TargetKind = Literal["material", "elset", "property", "element", "part", "placeholder"]


@dataclass(frozen=True, slots=True)
class QuantityFacts:
    """What is true of a quantity whatever the solver.

    targets: what may name its owner, first what CalculiX decks use. powers: of it that bound how
    stiffness and mass grow with it; infinite where none does (a ply that turns, an offset or a
    product of inertia that cancels another one). sign: of its numbers.
    """

    targets: tuple[TargetKind, ...]
    powers: tuple[float, float]
    sign: Literal["any", "positive", "not negative"] = "any"


_OF_MATERIAL: tuple[TargetKind, ...] = ("material", "property", "element", "elset")
_OF_PROPERTY: tuple[TargetKind, ...] = ("property", "element")
_OF_SET: tuple[TargetKind, ...] = ("elset", *_OF_PROPERTY)
QUANTITIES: dict[Quantity, QuantityFacts] = {
    "youngs_modulus": QuantityFacts(_OF_MATERIAL, (1, 0), "positive"),
    "shear_modulus": QuantityFacts(_OF_MATERIAL, (1, 0), "positive"),
    "poissons_ratio": QuantityFacts(_OF_MATERIAL, (1, 0)),
    "density": QuantityFacts(_OF_MATERIAL, (0, 1), "not negative"),
    "thickness": QuantityFacts(_OF_SET, (3, 1), "positive"),
    "area": QuantityFacts(_OF_PROPERTY, (1, 1), "positive"),
    "inertia_1": QuantityFacts(_OF_PROPERTY, (1, 0), "positive"),
    "inertia_2": QuantityFacts(_OF_PROPERTY, (1, 0), "positive"),
    "torsion_constant": QuantityFacts(_OF_PROPERTY, (1, 0), "not negative"),
    "inertia_12": QuantityFacts(_OF_PROPERTY, (np.inf, 0)),
    "dimension": QuantityFacts(_OF_SET, (4, 2), "positive"),
    "spring_stiffness": QuantityFacts(_OF_SET, (1, 0), "not negative"),
    "mass": QuantityFacts(("elset", "element"), (0, 1), "not negative"),
    "rotary_inertia": QuantityFacts(("element",), (0, 1)),
    "nonstructural_mass": QuantityFacts(_OF_PROPERTY, (0, 1), "not negative"),
    "ply_angle": QuantityFacts(_OF_SET, (np.inf, 0)),
    "bending_inertia_ratio": QuantityFacts(_OF_PROPERTY, (1, 0), "not negative"),
    "shear_thickness_ratio": QuantityFacts(_OF_PROPERTY, (1, 0), "not negative"),
    "shear_factor": QuantityFacts(_OF_PROPERTY, (1, 0)),
    "offset": QuantityFacts(_OF_PROPERTY, (np.inf, 0)),
    "structural_damping": QuantityFacts(_OF_MATERIAL, (0, 0), "not negative"),
    "viscous_damping": QuantityFacts(("property", "element", "elset"), (0, 0), "not negative"),
    "matrix_factor": QuantityFacts(("part",), (1, 1)),
    "number": QuantityFacts((), (np.inf, np.inf)),
    "variable": QuantityFacts((), (0, 0)),
}
#: Quantities of damping, which undamped modes know nothing of.
DAMPING: frozenset[Quantity] = frozenset({"structural_damping", "viscous_damping"})
#: Parameters of an expression whose bounds are all looked at together.
CORNERS = 8
#: A deviation of an absolute or additive value is at most this share of its scale, as that of a
#: relative value is unless given.
DEVIATION = 0.2

#: Values of parameters by name, relative to the deck.
Values = Mapping[str, float]


@dataclass(frozen=True, slots=True)
class Parameter:
    """One updating parameter: a quantity of one or several materials, sections or element sets.

    by: what the targets name. item: which one of a card's numbers of that quantity is meant (a
    ply, a dimension of a cross-section, a direction of a spring or of an orthotropic material);
    0 where there is one, or where all are. values: what users' values mean; origin, scale: theirs
    in terms of the value. expression: of users' values of other parameters, which gives its own;
    empty for a parameter that is free.
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
    values: ValueKind = "relative"
    origin: float = 0.0
    scale: float = 1.0
    expression: str = ""

    @property
    def proportional(self) -> bool:
        """Whether the deck's numbers are proportional to the value."""
        return self.origin == 0.0 and self.values != "additive" and not self.expression

    def shown(self, value: float) -> float:
        """What users give and read of a value."""
        return self.origin + self.scale * value

    def counted(self, shown: float) -> float:
        """The value of what users give."""
        return (shown - self.origin) / self.scale

    def number(self, deck_value: float, value: float) -> float:
        """The deck's number at a value, where the deck itself has deck_value."""
        shown = self.shown(value)
        if self.values == "relative":
            return deck_value * shown
        return shown if self.values == "absolute" else deck_value + shown

    def relative_to(self, deck_value: float, number: float) -> float:
        """The value at which the deck's number is this; NaN where none is."""
        if self.values == "relative":
            shown = number / deck_value if deck_value else np.nan
        else:
            shown = number if self.values == "absolute" else number - deck_value
        return self.counted(shown)

    def refusal(self, number: float) -> str:
        """Why the deck's number cannot be this, empty where it can."""
        if not np.isfinite(number):
            return f"{self.quantity} would be {number:g}"
        sign = QUANTITIES[self.quantity].sign
        bad = sign != "any" and (number <= 0.0 if sign == "positive" else number < 0.0)
        kind = "above zero" if sign == "positive" else "not below zero"
        return f"{self.quantity} would be {number:.6g}, it is {kind}" if bad else ""


def counted_from(
    kind: ValueKind, initial: float, lower: float, deviation: float
) -> tuple[float, float]:
    """Origin and scale of a parameter of this kind whose users' values are these.

    Values are those of relative parameters where they can be: proportional to a number above zero.
    Else the start is 1, the lower bound 1/2 or more, and the deviation at most `DEVIATION`.
    """
    if kind == "relative":
        return 0.0, 1.0
    if kind == "absolute" and lower > 0.0:
        return 0.0, initial
    scale = max(deviation / DEVIATION, 2.0 * (initial - lower))
    return initial - scale, scale


def assigned(parameters: Iterable[Parameter], values: Values) -> list[tuple[Parameter, float]]:
    """Parameters with their values, those of expressions with what these give.

    Without values of all names in an expression the deck's number remains.
    Raises ModelError where one has no value.
    """
    known = list(parameters)
    shown = {p.name: p.shown(values[p.name]) for p in known if p.name in values}
    found = [(p, float(values[p.name])) for p in known if p.name in values]
    for parameter in known:
        if parameter.expression and set(names_of(parameter.expression)) <= shown.keys():
            try:
                found.append((parameter, evaluate(parameter.expression, shown)))
            except ModelError as error:
                raise ModelError(f"parameter {parameter.name}: {error}") from None
    return found


def reached(parameter: Parameter, parameters: Iterable[Parameter]) -> list[float]:
    """Values at the ends of what a parameter may reach.

    Of a free one these are its bounds, of an expression what it is where those that it names are at
    their starts and bounds; nothing where not all of them are among the parameters. Raises
    ModelError where an expression has no value there.
    """
    if not parameter.expression:
        return [] if parameter.values == "relative" else [parameter.lower, parameter.upper]
    known = {p.name: p for p in parameters if not p.expression}
    named = [known[name] for name in names_of(parameter.expression) if name in known]
    if len(named) < len(names_of(parameter.expression)):
        return []
    starts = tuple(item.initial for item in named)
    ends: Iterable[tuple[float, ...]] = product(*((p.lower, p.upper) for p in named[:CORNERS]))
    sets = [starts, *((*corner, *starts[CORNERS:]) for corner in ends)]
    return [
        dict(assigned((*named, parameter), {p.name: v for p, v in zip(named, row, strict=True)}))[
            parameter
        ]
        for row in sets
    ]


def driven_by(parameter: Parameter, parameters: Iterable[Parameter]) -> list[Parameter]:
    """Those of the parameters whose expression names this one."""
    return [p for p in parameters if p.expression and parameter.name in names_of(p.expression)]


@dataclass(frozen=True, slots=True)
class ParameterSet:
    """The parameters of a campaign in their fixed order; values travel as (n_parameters,).

    dependents: numbers given by expressions of the parameters.
    """

    parameters: tuple[Parameter, ...]
    dependents: tuple[Parameter, ...] = ()

    def __len__(self) -> int:
        return len(self.parameters)

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(parameter.name for parameter in self.parameters)

    def only(self, columns: Iterable[int]) -> ParameterSet:
        """Some of them, with the expressions that name no others."""
        own = tuple(self.parameters[column] for column in columns)
        names = {item.name for item in own}
        return ParameterSet(
            own, tuple(d for d in self.dependents if names.issuperset(names_of(d.expression)))
        )

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

    @property
    def scales(self) -> Floats:
        """What users read of changes of values by 1, (n_parameters,)."""
        return np.array([parameter.scale for parameter in self.parameters])

    def shown(self, theta: Floats) -> Floats:
        """What users read of values, (n_parameters,)."""
        return np.array([p.shown(v) for p, v in zip(self.parameters, theta, strict=True)])

    def assigned(self, theta: Floats) -> list[tuple[Parameter, float]]:
        """All parameters with their values, then what expressions give. Raises ModelError."""
        return assigned((*self.parameters, *self.dependents), self.values(theta))

    def values(self, theta: Floats) -> dict[str, float]:
        """Name to value, for the adapter that edits the deck."""
        return dict(zip(self.names, theta.tolist(), strict=True))

    def at_bounds(self, theta: Floats) -> tuple[str, ...]:
        """Names of the parameters on a bound."""
        on = np.isclose(theta, self.lower, atol=1e-9) | np.isclose(theta, self.upper, atol=1e-9)
        return tuple(name for name, hit in zip(self.names, on.tolist(), strict=True) if hit)


def frequency_reach(parameters: ParameterSet, theta: Floats) -> tuple[float, float]:
    """The least and the largest factor of any frequency, from values theta to all in the bounds.

    By Rayleigh's quotient an eigenvalue rises at most by the largest factor of any part of the
    stiffness over the least of any part of the mass; quantities of one part multiply. What is not
    proportional to its parameter, or follows from an expression, may grow from nothing.
    """
    if (
        parameters.dependents
        or not all(p.proportional for p in parameters.parameters)
        or any(np.isinf(QUANTITIES[p.quantity].powers).any() for p in parameters.parameters)
    ):
        return 0.0, np.inf
    least = largest = 1.0
    ratios = {
        "lower": np.minimum(parameters.lower / theta, 1.0),
        "upper": np.maximum(parameters.upper / theta, 1.0),
    }
    for quantity in dict.fromkeys(item.quantity for item in parameters.parameters):
        own = [item.quantity == quantity for item in parameters.parameters]
        stiffness, mass = QUANTITIES[quantity].powers
        low, high = float(ratios["lower"][own].min()), float(ratios["upper"][own].max())
        largest *= high**stiffness / low**mass
        least *= low**stiffness / high**mass
    return float(np.sqrt(least)), float(np.sqrt(largest))
