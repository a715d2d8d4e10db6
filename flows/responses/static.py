"""Static load cases with their measured values: the campaign's `residuals.static`."""

from __future__ import annotations

from typing import Annotated

import numpy as np
from pydantic import BeforeValidator, Field, model_validator

from modetune.adapters.solver import Deck
from modetune.adapters.yaml_file import Place
from modetune.core.errors import ModelError
from modetune.core.modes import COMPONENTS, Floats, Integers
from modetune.core.parameters import Values
from modetune.core.updating.responses.static import Static
from modetune.core.updating.static_model import LoadCase, Reading
from modetune.flows.responses.gauges import elongation, node_number
from modetune.flows.responses.response import ResponseSection, TestedModel
from modetune.flows.responses.section import Finite, NotNegative, Positive, Section, by_name

ByName = Annotated[dict[str, Finite], BeforeValidator(by_name)]


class StaticCase(Section):
    """A load case, and the displacements and strains measured under it."""

    load: Annotated[int, Field(ge=1)] | None = None
    """Number of the deck's load case: the position among the *STATIC steps of a CalculiX deck, or
    the number of a Nastran load set (FORCE, MOMENT, PLOAD, PLOAD2, PLOAD4, GRAV, LOAD)."""
    forces: ByName = Field(default={})
    """Forces and moments by `node.component`, instead of a load case of the deck, in the deck's
    units and in the axes of shapes at the node."""
    displacements: ByName = Field(default={})
    """Measured displacements and rotations by `node.component`, in the deck's units and in the axes
    of shapes at the node."""
    strains: ByName = Field(default={})
    """Measured strains by `node-node`: the elongation between the two nodes divided by their
    distance."""
    deviation: Positive = 0.02
    """Standard deviation of the measured values [of the largest displacement, or strain, of the
    case]"""
    tolerance: Positive = 0.05
    """Largest error that e1 accepts [of the largest displacement, or strain, of the case]"""
    weight: NotNegative = 1.0
    """Weight of the case; 0 leaves it out."""

    @model_validator(mode="after")
    def _whole(self) -> StaticCase:
        if (self.load is None) == (not self.forces):
            raise ValueError("give either `load` or `forces`")
        if not (self.displacements or self.strains):
            raise ValueError("give measured `displacements`, `strains` or both")
        for key, values in (("displacements", self.displacements), ("strains", self.strains)):
            if values and not any(values.values()):
                raise ValueError(f"all `{key}` are zero; give at least one nonzero value")
        return self


class StaticSection(ResponseSection):
    """Static displacements and strains under load cases."""

    cases: Annotated[tuple[StaticCase, ...], Field(min_length=1)]
    """Load cases, and what was measured under each."""

    @property
    def counts(self) -> bool:
        return any(case.weight for case in self.cases)

    def response(self, given: TestedModel) -> Static:
        def loads(theta: Floats) -> list[LoadCase]:
            values = given.parameters.values(theta)
            return [_load(case, given.deck, values) for case in self.cases]

        return Static(tuple(self._readings(given.deck, [])), loads, given.deck.observation)

    def problems(self, given: TestedModel) -> list[tuple[Place, str]]:
        problems: list[tuple[Place, str]] = []
        for position, case in enumerate(self.cases):
            try:
                _load(case, given.deck)
            except ModelError as error:
                key = "forces" if case.forces else "load"
                problems.append((("cases", position, key), str(error)))
        self._readings(given.deck, problems)
        return sorted(problems, key=lambda item: item[0][1])  # case by case

    def _readings(self, deck: Deck, problems: list[tuple[Place, str]]) -> list[Reading]:
        """Return the measured values of all cases; those that the model lacks are problems."""
        readings: list[Reading] = []
        for position, case in enumerate(self.cases):
            called = f"of load case {case.load or position + 1}"
            for key, values, terms in (
                ("displacements", case.displacements, _displacement),
                ("strains", case.strains, elongation),
            ):
                size = max(map(abs, values.values()), default=0.0)
                allowed = case.deviation * size, case.tolerance * size, case.weight
                for name, value in values.items():
                    try:
                        place = terms(name, deck)
                    except ModelError as error:
                        problems.append((("cases", position, key, name), str(error)))
                        continue
                    own = f"{key[:-1]} {name} {called}", position, *place, value
                    readings.append(Reading(*own, *allowed))
        return readings


def _load(section: StaticCase, deck: Deck, values: Values | None = None) -> LoadCase:
    if section.load is not None:
        return deck.load_case(section.load, values)
    forces = ((*_dof(name, deck), value) for name, value in section.forces.items())
    return LoadCase.of_forces([(node, c, value, "forces") for node, c, value in forces])


def _displacement(name: str, deck: Deck) -> tuple[Integers, Integers, Floats]:
    node, component = _dof(name, deck)
    return np.array([node]), np.array([component]), np.ones(1)


def _dof(name: str, deck: Deck) -> tuple[int, int]:
    node, _, component = name.partition(".")
    if component not in COMPONENTS:
        raise ModelError(
            f"{name!r} is not a node and a component (x, y, z, rx, ry, rz), such as 12.z"
        )
    number = COMPONENTS.index(component) + 1
    if number not in deck.summary.components:
        raise ModelError(f"{name}: nodes of this model have no {component}")
    return node_number(node, deck), number
