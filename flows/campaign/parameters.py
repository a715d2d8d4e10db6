"""Parameters of a campaign: the quantities of the model that may change, and their bounds.

A parameter with a field becomes one parameter per element or zone: the deck gives the elements that
the parameter scales, and its mesh gives their neighbours. Zones get their own copy of a material or
section that they share with others, as do any elements that parameters name.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Annotated, Literal

import numpy as np
from pydantic import Field, model_validator

from modetune.adapters.solver import Solver
from modetune.adapters.yaml_file import YamlFile
from modetune.core.errors import ModelError
from modetune.core.expressions import names_of
from modetune.core.modes import Integers
from modetune.core.parameters import (
    QUANTITIES,
    Parameter,
    Quantity,
    TargetKind,
    ValueKind,
    counted_from,
)
from modetune.core.updating.parameter_fields import (
    MOST_ZONES,
    Smoothing,
    element_graph,
    joined,
    zones_of,
)
from modetune.core.updating.parameter_fields import Field as ZoneField
from modetune.flows.responses.section import Finite, Name, Positive, Section

#: Keys that name the target of a parameter.
TARGET_KEYS: tuple[TargetKind, ...] = ("material", "elset", "property", "element", "part")
#: Names in upper or lower case, or the numbers that Nastran decks use.
Targets = str | int | tuple[str | int, ...]


class FieldSection(Section):
    """A field: one value for each element or zone that the parameter scales, with a prior that
    connects neighbours."""

    zones: Literal["elements"] | Annotated[int, Field(ge=2, le=MOST_ZONES)] = "elements"
    """Number of connected zones, each with its own value; `elements`: one value per element."""
    smoothing: Smoothing = "neighbours"
    """Prior assumption about the field: `neighbours`, neighbours change alike; `total_variation`,
    patches with few edges; `sparse`, few zones change."""
    length: Positive = 3.0
    """Number of zones over which values are correlated; `sparse` does not use it."""


class ParameterSection(Section):
    """One updating parameter. Bounds, deviation and initial value are relative to the deck's value
    unless `values` changes that."""

    name: Name
    """Name of the parameter in tables, in the record, in expressions and in `--at`."""
    quantity: Quantity
    """Quantity of the model that the parameter changes. `variable` changes nothing directly:
    expressions of other parameters or `residuals.frf.damping` refer to it."""
    values: ValueKind = "relative"
    """Meaning of the values: `relative`, factors on the deck's value; `absolute`, the value itself,
    in the deck's units; `additive`, an amount added to the deck's value. Absolute and additive
    values may be zero or change sign, so they need `bounds` and `deviation`, and absolute ones
    `initial`: nothing else defines their magnitude."""
    expression: Annotated[str, Field(min_length=1, max_length=500)] | None = None
    """Arithmetic expression of other parameters' values, such as `width**4 / 12`, that gives this
    parameter's value. The parameter is then not free: it has no bounds, deviation or initial
    value."""
    item: Annotated[int, Field(ge=0)] = 0
    """Which number of a card to change: a ply, a dimension, a direction; 0: the only one, or
    all."""
    material: Targets | None = None
    """Material, or a list of them tied together."""
    elset: Targets | None = None
    """Element set (CalculiX) or element (`matrices`), or a list of them tied together."""
    property: Targets | None = None
    """Number of a Nastran property, or a list of them tied together."""
    element: Targets | None = None
    """Number or range (`101-120`) of elements, or a list of them tied together. modetune gives them
    their own copy of any material, property or section that they share with others."""
    part: Targets | None = None
    """Part of a model given as matrices, or a list of them tied together."""
    bounds: tuple[Finite, Finite] = (0.5, 2.0)
    """Lowest and highest value [of the deck's value]"""
    deviation: Positive = 0.2
    """Prior standard deviation of the value, before the test [of the deck's value]"""
    initial: Finite = 1.0
    """Value from which updating starts; 0 by default if values are additive [of the deck's
    value]"""
    field: FieldSection | None = None
    """One value for each element or zone, instead of a single value."""
    configurations: Annotated[tuple[Name, ...], Field(min_length=1)] | None = None
    """Names of the configurations to which the parameter belongs; without it all whose deck
    contains what it scales."""

    @model_validator(mode="after")
    def _sound(self) -> ParameterSection:
        given = [key for key in TARGET_KEYS if getattr(self, key) is not None]
        wanted = QUANTITIES[self.quantity].targets
        if len(given) > 1 or any(key not in wanted for key in given):
            found = f"not {' and '.join(f'`{key}`' for key in given)}"
            raise ValueError(f"{self.quantity} needs {targets_of(self.quantity)}; {found}")
        if self.field is not None and (self.expression or "element" not in wanted):
            raise ValueError(
                f"a field needs a quantity of elements; {self.quantity} is none"
                if "element" not in wanted
                else "a field has its own values; leave `expression` out"
            )
        if self.expression is not None:
            self._check_expression(self.expression)
            return self
        missing = [] if self.values == "relative" else ["bounds", "deviation"]
        missing += ["initial"] if self.values == "absolute" else []
        lost = [f"`{key}`" for key in missing if key not in self.model_fields_set]
        if lost:
            raise ValueError(
                f"{self.values} values need {' and '.join(lost)}, because the deck's value may be "
                "zero and then gives no scale for steps"
            )
        lower, upper = self.bounds
        if lower >= upper:
            raise ValueError(f"bounds: the lower ({lower:g}) must be below the upper ({upper:g})")
        if self.values == "relative" and lower <= 0.0:
            raise ValueError(
                f"bounds: the lower ({lower:g}) must be above zero for factors; `values: additive` "
                "and `values: absolute` allow zero"
            )
        if not lower <= self.start() <= upper:
            raise ValueError(f"initial value {self.start():g} is outside the bounds")
        return self

    def _check_expression(self, expression: str) -> None:
        own = {"bounds", "deviation", "initial"} & self.model_fields_set
        if own:
            raise ValueError(
                f"`expression` defines the value; leave out {' and '.join(sorted(own))}"
            )
        if self.quantity == "variable":
            raise ValueError("a variable cannot have an expression; expressions refer to it")
        try:
            names_of(expression)
        except ModelError as error:
            raise ValueError(str(error)) from None

    def by(self) -> TargetKind:
        """Return the kind of the targets; `placeholder`, of the parameter's name, by default."""
        named = (key for key in TARGET_KEYS if getattr(self, key) is not None)
        return next(named, "placeholder")

    def targets(self) -> tuple[str, ...]:
        """Return the names of the targets."""
        chosen = self.name if self.by() == "placeholder" else getattr(self, self.by())
        return tuple(map(str, chosen)) if isinstance(chosen, tuple) else (str(chosen),)

    def start(self) -> float:
        """Return the value that updating starts from."""
        additive = self.values == "additive" and "initial" not in self.model_fields_set
        return 0.0 if additive else self.initial

    def parameter(self) -> Parameter:
        """Return the parameter with values scaled for updating."""
        own = (self.name, self.quantity, self.by(), self.targets())
        if self.expression is not None:
            free = (-math.inf, math.inf, math.nan, math.nan)
            return Parameter(*own, *free, self.item, self.values, expression=self.expression)
        origin, scale = counted_from(self.values, self.start(), self.bounds[0], self.deviation)
        lower, upper, initial = ((value - origin) / scale for value in (*self.bounds, self.start()))
        return Parameter(
            *own,
            lower,
            upper,
            self.deviation / scale,
            initial,
            self.item,
            self.values,
            origin,
            scale,
        )


def targets_of(quantity: Quantity) -> str:
    """Return the keys that may name the target of a quantity, for messages."""
    return " or ".join(f"`{key}`" for key in QUANTITIES[quantity].targets) or "`solver: command`"


def select_parameters(source: YamlFile, columns: Sequence[int]) -> YamlFile:
    """Return the file with only these parameters, their lines moved to their new positions."""
    lines = {key: line for key, line in source.lines.items() if key[:1] != ("parameters",)}
    lines[("parameters",)] = source.lines.get(("parameters",), 1)
    for now, column in enumerate(columns):
        then = ("parameters", column)
        lines |= {
            ("parameters", now, *key[2:]): line
            for key, line in source.lines.items()
            if key[:2] == then
        }
    return replace(source, lines=lines)


def with_fields(
    source: YamlFile, given: Sequence[ParameterSection], solver: Solver, problems: list[str]
) -> tuple[YamlFile, tuple[ParameterSection, ...], tuple[ZoneField, ...]]:
    """Return the parameters with one for each zone, the fields, and the file with their lines.

    solver: bound to the deck with the parameters as given. Problems of the deck or of the
    parameters themselves are reported where they are read.
    """
    sections: list[ParameterSection] = []
    places: list[int] = []
    fields: list[ZoneField] = []
    for place, item in enumerate(given):
        found = [item]
        if item.field is not None and not solver.deck.problems((item.parameter(),)):
            try:
                field, found = _expanded(item, item.field, solver)
            except ModelError as error:
                where = source.where(("parameters", place, "field"))
                problems.append(f"{where}: parameters.{place}.field: {item.name}: {error}")
            else:
                start = sum(section.expression is None for section in sections)
                fields.append(replace(field, columns=field.columns + start))
        sections += found
        places += [place] * len(found)
    names = [item.name for item in sections]
    problems += [
        f"{source.where(('parameters', place))}: a zone of a field has the same name {name}; "
        "rename one"
        for place, name in zip(places, names, strict=True)
        if names.count(name) > 1 and given[place].field is None
    ]
    return select_parameters(source, places), tuple(sections), tuple(fields)


def _expanded(
    item: ParameterSection, asked: FieldSection, solver: Solver
) -> tuple[ZoneField, list[ParameterSection]]:
    """Return a field, with columns from 0, and its parameters. Raises ModelError."""
    affected = solver.deck.affected_elements(item.parameter())
    if affected is None:
        raise ModelError(
            f"{solver.program.name} does not report which elements {item.quantity} scales here"
        )
    elements, centres, pairs = element_graph(solver.deck.mesh(), affected.elements)
    each = asked.zones == "elements"
    owners = np.arange(elements.size) if each else zones_of(centres, pairs, int(asked.zones))
    n = int(owners.max()) + 1
    if n > MOST_ZONES:
        raise ModelError(
            f"a field of {n:,} elements exceeds the maximum of {MOST_ZONES:,} values; use "
            "`zones: 200`"
        )
    if n < 2:
        raise ModelError("a field needs at least two zones; leave `field` out")
    field = ZoneField(
        item.name,
        np.arange(n),
        joined(pairs, owners),
        elements,
        owners,
        centres,
        asked.smoothing,
        asked.length,
    )
    nothing: dict[str, object] = dict.fromkeys(TARGET_KEYS)
    sections = [
        item.model_copy(
            update={
                **nothing,
                "name": f"{item.name}.{own[0]}" if each else f"{item.name}.zone{zone + 1}",
                "element": _ranges(own),
            }
        )
        for zone in range(n)
        for own in [np.sort(elements[owners == zone])]
    ]
    return field, sections


def _ranges(numbers: Integers) -> tuple[str, ...]:
    """Return element numbers, in ascending order, as ranges."""
    runs: Sequence[Integers] = np.split(numbers, np.flatnonzero(np.diff(numbers) > 1) + 1)
    return tuple(f"{run[0]}-{run[-1]}" if run.size > 1 else str(run[0]) for run in runs)
