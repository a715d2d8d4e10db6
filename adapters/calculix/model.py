"""A CalculiX deck with the parameters that edit it, and what they move."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path

import numpy as np

from modetune.adapters.calculix.additions import with_addition
from modetune.adapters.calculix.affected_elements import Place, affected_elements_of
from modetune.adapters.calculix.cards import ACROSS, CARDS, first_value, powers_of
from modetune.adapters.calculix.constraints import fixed_components, read_constraints
from modetune.adapters.calculix.damping import damped_materials, dampers
from modetune.adapters.calculix.deck import (
    KeywordCard,
    canonical_name,
    read_number,
    with_added,
    write_edited,
)
from modetune.adapters.calculix.loads import load_case
from modetune.adapters.calculix.mesh import read_geometry
from modetune.adapters.calculix.observation import observe
from modetune.adapters.calculix.places import edited_lines, energy_sets, fields_of, find_numbers
from modetune.adapters.calculix.stated_units import stated_units
from modetune.adapters.calculix.structure import CalculixStructure, understand
from modetune.adapters.damping import NOTHING, Dampers, damps_only
from modetune.adapters.deck_numbers import Number
from modetune.adapters.solver import (
    AddedCards,
    Addition,
    AffectedElements,
    Deck,
    ModelSummary,
    RigidLink,
    StatedUnits,
    Target,
)
from modetune.core.algebra.matrices import MatrixResult
from modetune.core.errors import ModelError
from modetune.core.expressions import degree
from modetune.core.mesh import Fixed, Mesh, cell_sizes, part_labels
from modetune.core.modes import Floats, Integers
from modetune.core.parameters import DAMPING, Parameter, TargetKind, Values, assigned, driven_by
from modetune.core.updating.damping_model import DampingModel
from modetune.core.updating.observation import Observation
from modetune.core.updating.static_model import LoadCase

#: Sections whose numbers parameters name by their element set.
BY_SET = tuple(row.name for row in CARDS.values() if row.owner == "elset" and row.numbers)
#: Items of Young's moduli of engineering constants.
DIRECTIONS = (1, 2, 3)


@dataclass(frozen=True, slots=True)
class EditedCalculix:
    """A model with some lines of its deck changed.

    frames: axes in which shapes are wanted, by node, if this deck is the translation of another;
    None if it is the user's. carriers: nodes whose translations are the rotations of others.
    """

    structure: CalculixStructure
    changed: dict[int, str]
    frames: Mapping[int, Floats] | None = None
    carriers: Mapping[int, int] = field(default_factory=dict)

    def texts(self) -> list[str]:
        """The lines of the deck as they are now."""
        lines = enumerate(self.structure.deck.lines)
        return [self.changed.get(position, line.text) for position, line in lines]


@dataclass(frozen=True)
class CalculixModel(Deck):
    """A CalculiX deck and the parameters that edit it."""

    structure: CalculixStructure
    parameters: tuple[Parameter, ...]

    @cached_property
    def summary(self) -> ModelSummary:
        found = self.structure.summary
        if not found.matrix_shapes or not self.structure.deck.named("*TIE"):
            return found
        return replace(found, matrix_shapes=read_constraints(self.structure).followed)

    @cached_property
    def _mesh(self) -> Mesh:
        return read_geometry(self.structure.deck, self.structure.mesh, self.summary.node_ids)

    def mesh(self) -> Mesh:
        return self._mesh

    def numbers(self, parameter: Parameter) -> list[Number]:
        return find_numbers(self.structure, parameter)

    def splits(self) -> tuple[str, ...]:
        return self.structure.split

    def targets(self) -> tuple[Target, ...]:
        """Materials and sections with elements, each once."""
        found: dict[tuple[str, str], Target] = {}
        for card in self.structure.deck.named("*MATERIAL", *BY_SET):
            by_set = card.is_one_of(*BY_SET)
            name = card.option("ELSET" if by_set else "NAME")
            sections = [card] if by_set else self.structure.users({name})
            count = len(frozenset[int]().union(*map(self.structure.members, sections)))
            if name and count:
                by: TargetKind = "elset" if by_set else "material"
                found.setdefault((by, name), Target(by, (name,), card.keyword, count))
        return tuple(found.values())

    def stated_units(self) -> StatedUnits | None:
        return stated_units(self.structure.deck)

    def elastic_constants(self) -> dict[str, tuple[float, float]]:
        """E, the largest one, and density (0 without) of each material that elements use."""
        found = {}
        cards = self.structure.deck.named("*MATERIAL")
        for name in dict.fromkeys(card.option("NAME") for card in cards):
            density = 0.0
            with suppress(ModelError):  # a material without density has stiffness alone
                density = fields_of(self.structure, "density", name)[0].value
            with suppress(ModelError):  # not used, or no such card
                modulus = max(
                    field.value for field in fields_of(self.structure, "youngs_modulus", name)
                )
                if modulus > 0.0:
                    found[name] = modulus, max(density, 0.0)
        return found

    def material_masses(self) -> dict[str, float]:
        """Return about the mass of each material."""
        found, sizes = dict[str, float](), cell_sizes(self.mesh())
        densities = dict[str, float]()
        for card in self.structure.deck.named("*SOLID SECTION", "*SHELL SECTION", "*BEAM SECTION"):
            members = self.structure.mesh.element_sets.get(card.option("ELSET"), frozenset())
            size = sum(sizes.get(number, 0.0) for number in members)
            rows = [self.structure.deck.fields(position) for position in card.data]
            layers = [(card.option("MATERIAL"), _across(card, rows))]
            if "COMPOSITE" in card.options:
                layers = [(canonical_name(row[2]), _number(row[0])) for row in rows if len(row) > 2]
            for name, across in layers:
                if name not in densities:
                    densities[name] = math.nan
                    with suppress(ModelError):  # a material that has no density
                        densities[name] = fields_of(self.structure, "density", name)[0].value
                if not math.isnan(densities[name]):
                    found[name] = found.get(name, 0.0) + densities[name] * across * size
        return found

    def least_length(self) -> float:
        return min(super().least_length(), least_thickness(self.structure))

    def energy_sets(self, parameter: Parameter) -> tuple[str, ...]:
        if self.preload() or not parameter.proportional or driven_by(parameter, self.parameters):
            return ()
        return energy_sets(self.structure, parameter)

    def is_linear(self, parameter: Parameter) -> bool:
        """Of engineering constants a single Young's modulus is coupled with the others."""
        return not self.preload() and all(
            (item.quantity == "variable" or powers_of(item.quantity) == (1,))
            and (item.quantity != "youngs_modulus" or item.item not in DIRECTIONS)
            and degree(item.expression or "0") < 2
            for item in (parameter, *driven_by(parameter, self.parameters))
        )

    def fixed(self) -> Fixed:
        return fixed_components(self.structure)

    def preload(self) -> str:
        return self.structure.preload()

    @cached_property
    def _affected(self) -> dict[tuple[frozenset[Place], tuple[int, ...]], AffectedElements | None]:
        """Elements by what they were asked for: several times in a campaign."""
        return {}

    def affected_elements(self, parameter: Parameter) -> AffectedElements | None:
        if damps_only(parameter, self.parameters):
            return NOTHING
        driven = driven_by(parameter, self.parameters)
        across = powers_of(parameter.quantity) == ACROSS
        plain = parameter.proportional and not driven
        if not (across and plain) and not self.is_linear(parameter):
            return None
        numbers = [n for item in (parameter, *driven) for n in find_numbers(self.structure, item)]
        found = self.affected_elements_of({number.place for number in numbers})
        return found and replace(
            found, proportional=found.proportional and plain, related=bool(driven)
        )

    def affected_elements_of(
        self, places: Collection[Place], powers: tuple[int, ...] = (1,)
    ) -> AffectedElements | None:
        """What these numbers of the deck move, as one relative value of theirs."""
        asked = frozenset(places), powers
        if asked not in self._affected:
            self._affected[asked] = affected_elements_of(
                self.structure, self.mesh(), places, powers
            )
        return self._affected[asked]

    def observation(
        self, matrices: MatrixResult, nodes: Integers, components: Integers
    ) -> Observation:
        return observe(self.structure, matrices.nodes, matrices.components, nodes, components)

    def load_case(self, number: int, values: Values | None = None) -> LoadCase:
        structure, changed = self.structure, self.edited(values or {}).changed
        if changed:
            lines = list(structure.deck.lines)
            for place, text in changed.items():
                lines[place] = lines[place]._replace(text=text)
            structure = replace(structure, deck=replace(structure.deck, lines=lines))
        return load_case(structure, self.mesh(), number)

    def undamped(self) -> str:
        try:
            found = self._dampers
        except ModelError as error:
            return str(error)
        if found.links or found.losses:
            return ""
        return f"{self.structure.deck.file}: the deck has no *DASHPOT, nor *DAMPING of a material"

    def losses(self) -> tuple[Parameter, ...]:
        return self._losses

    def damping(self, base: MatrixResult) -> DampingModel:
        return self._dampers.model(self, base)

    @cached_property
    def _losses(self) -> tuple[Parameter, ...]:
        return damped_materials(self.structure)

    @cached_property
    def _dampers(self) -> Dampers:
        return dampers(self.structure, self, self.parameters)

    def edited(self, values: Values) -> EditedCalculix:
        moving = [pair for pair in self._assigned(values) if pair[0].quantity not in DAMPING]
        return EditedCalculix(self.structure, edited_lines(self.structure, moving))

    def with_parameters(self, more: tuple[Parameter, ...]) -> Deck:
        return replace(self, parameters=(*self.parameters, *more))

    def released(self) -> tuple[Deck, tuple[RigidLink, ...]]:
        deck = self.structure.deck
        constraints = read_constraints(self.structure)
        ties = ("*TIE",) if constraints.tied else ()
        cards = [card for card in deck.named("*BOUNDARY", "*RIGID BODY", *ties)]
        changed = {line: "**" for card in cards for line in card.lines}
        bodies: dict[int, list[int]] = {}
        for node, body in constraints.bodies.items():
            bodies.setdefault(body.reference, []).append(node)
        links = [RigidLink(leader, tuple(sorted(own))) for leader, own in bodies.items()]
        mesh = self.mesh()
        tied = np.array(sorted(constraints.tied), dtype=np.int64)
        labels = part_labels(mesh, tied)
        links += [RigidLink(0, tuple(tied[labels == n].tolist())) for n in np.unique(labels)]
        structure = understand(with_added(deck, changed, {}))
        return CalculixModel(structure, self.parameters), tuple(links)

    def with_cards(self, addition: Addition) -> AddedCards:
        return with_addition(self.structure, self.mesh(), addition, self.fixed())

    def write_updated(self, values: Values, folder: Path) -> Path:
        changed = edited_lines(self.structure, self._assigned(values))
        return write_edited(self.structure.deck, changed, folder)

    def _assigned(self, values: Values) -> list[tuple[Parameter, float]]:
        """Parameters with values, those of groups' stiffness last."""
        groups = values.keys() - {item.name for item in self.parameters}
        return assigned((*self.parameters, *(self._losses if groups else ())), values)


def point_mass(structure: CalculixStructure, changed: dict[int, str]) -> float:
    """Sum of all *MASS elements, which ccx leaves out of its own total.

    NaN with user elements, for which ccx prints no mass.
    """
    total = math.nan if structure.deck.named("*USER SECTION") else 0.0
    for card in structure.deck.named("*MASS"):
        field = first_value(structure.deck, card, 0)
        text = changed.get(field.line, structure.deck.lines[field.line].text)
        elements = structure.mesh.element_sets.get(card.option("ELSET"), frozenset())
        total += read_number(text.split(",")[0]) * len(elements)
    return total


def least_thickness(structure: CalculixStructure) -> float:
    """The least thickness of shells and plies, and dimension of beams; infinite without."""
    shells, beams = structure.deck.named("*SHELL SECTION"), structure.deck.named("*BEAM SECTION")
    layered = [card for card in shells if "COMPOSITE" in card.options]
    fields = [structure.deck.fields(position)[0] for card in layered for position in card.data]
    fields += [structure.deck.fields(p)[0] for c in shells if c not in layered for p in c.data[:1]]
    fields += [text for c in beams for p in c.data[:1] for text in structure.deck.fields(p)]
    found = [math.inf]
    for text in filter(None, fields):
        with suppress(ValueError):  # ccx says what is wrong with it
            found.append(read_number(text))
    return min(value for value in found if value > 0.0)


def _number(text: str) -> float:
    """A number of a section, 0 where it is none, of which ccx says what is wrong."""
    with suppress(ValueError):
        return read_number(text)
    return 0.0


def _across(card: KeywordCard, rows: list[list[str]]) -> float:
    """What a section's size is multiplied with: thickness, area of a beam or truss, or 1."""
    numbers = [_number(text) for text in rows[0]] if rows else []
    if card.is_one_of("*BEAM SECTION"):
        return math.prod(numbers[:2])
    return numbers[0] if numbers and numbers[0] > 0.0 else 1.0
