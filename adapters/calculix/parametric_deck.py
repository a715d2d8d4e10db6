"""A CalculiX deck with the parameters that edit it, and what they move."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

from modetune.adapters.calculix.affected_elements import Place, affected_elements_of
from modetune.adapters.calculix.cards import ACROSS, powers_of
from modetune.adapters.calculix.damping import damped_materials, dampers
from modetune.adapters.calculix.deck import write_edited
from modetune.adapters.calculix.loads import load_case
from modetune.adapters.calculix.mesh import Incidence, read_geometry
from modetune.adapters.calculix.model import CalculixModel
from modetune.adapters.calculix.observation import observe
from modetune.adapters.calculix.places import edited_lines, energy_sets, find_numbers
from modetune.adapters.calculix.sections import (
    elastic_constants,
    least_thickness,
    material_masses,
    targets,
)
from modetune.adapters.damping import NOTHING, Dampers, damps_only
from modetune.adapters.deck_numbers import Number
from modetune.adapters.solver import AffectedElements, Deck, ModelSummary, Target
from modetune.core.errors import ModelError
from modetune.core.expressions import degree
from modetune.core.mesh import Mesh, cell_sizes
from modetune.core.modes import Floats, Integers
from modetune.core.parameters import DAMPING, Parameter, Values, assigned, driven_by
from modetune.core.updating.damping import DampingModel
from modetune.core.updating.observation import Observation
from modetune.core.updating.results import MatrixResult
from modetune.core.updating.static import LoadCase

#: Items of Young's moduli of engineering constants.
DIRECTIONS = (1, 2, 3)


@dataclass(frozen=True, slots=True)
class EditedCalculix:
    """A model with some lines of its deck changed.

    frames: axes in which shapes are wanted, by node, where another deck (one that was translated)
    stands behind this one; None where this one is the user's.
    """

    model: CalculixModel
    changed: dict[int, str]
    frames: Mapping[int, Floats] | None = None

    def texts(self) -> list[str]:
        """The lines of the deck as they are now."""
        lines = enumerate(self.model.deck.lines)
        return [self.changed.get(position, line.text) for position, line in lines]


@dataclass(frozen=True)
class CalculixDeck(Deck):
    """A CalculiX deck and the parameters that edit it."""

    model: CalculixModel
    parameters: tuple[Parameter, ...]

    @cached_property
    def summary(self) -> ModelSummary:
        return self.model.summary

    @cached_property
    def _mesh(self) -> Mesh:
        return read_geometry(self.model.deck, self.model.mesh, self.summary.node_ids)

    def mesh(self) -> Mesh:
        return self._mesh

    def numbers(self, parameter: Parameter) -> list[Number]:
        return find_numbers(self.model, parameter)

    def splits(self) -> tuple[str, ...]:
        return self.model.split

    def targets(self) -> tuple[Target, ...]:
        return targets(self.model)

    def elastic_constants(self) -> dict[str, tuple[float, float]]:
        return elastic_constants(self.model)

    def material_masses(self) -> dict[str, float]:
        return material_masses(self.model, cell_sizes(self.mesh()))

    def least_length(self) -> float:
        return min(super().least_length(), least_thickness(self.model))

    def energy_sets(self, parameter: Parameter) -> tuple[str, ...]:
        if self.preload() or not parameter.proportional or driven_by(parameter, self.parameters):
            return ()
        return energy_sets(self.model, parameter)

    def is_linear(self, parameter: Parameter) -> bool:
        """Of engineering constants a single Young's modulus is coupled with the others."""
        return not self.preload() and all(
            (item.quantity == "variable" or powers_of(item.quantity) == (1,))
            and (item.quantity != "youngs_modulus" or item.item not in DIRECTIONS)
            and degree(item.expression or "0") < 2
            for item in (parameter, *driven_by(parameter, self.parameters))
        )

    def preload(self) -> str:
        return self.model.preload()

    @cached_property
    def _incidence(self) -> Incidence:
        mesh = self.model.mesh
        return Incidence({number: item.nodes for number, item in mesh.elements.items()}, mesh)

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
        numbers = [n for item in (parameter, *driven) for n in find_numbers(self.model, item)]
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
                self.model, self._incidence, self.mesh(), places, powers
            )
        return self._affected[asked]

    def observation(
        self, matrices: MatrixResult, nodes: Integers, components: Integers
    ) -> Observation:
        return observe(
            self.model, self._incidence, matrices.nodes, matrices.components, nodes, components
        )

    def load_case(self, number: int, values: Values | None = None) -> LoadCase:
        model, changed = self.model, self.edited(values or {}).changed
        if changed:
            lines = list(model.deck.lines)
            for place, text in changed.items():
                lines[place] = lines[place]._replace(text=text)
            model = replace(model, deck=replace(model.deck, lines=lines))
        return load_case(model, self.mesh(), number)

    def undamped(self) -> str:
        try:
            found = self._dampers
        except ModelError as error:
            return str(error)
        if found.links or found.losses:
            return ""
        return f"{self.model.deck.file}: the deck has no *DASHPOT, nor *DAMPING of a material"

    def losses(self) -> tuple[Parameter, ...]:
        return self._losses

    def damping(self, base: MatrixResult) -> DampingModel:
        return self._dampers.model(self, base)

    @cached_property
    def _losses(self) -> tuple[Parameter, ...]:
        return damped_materials(self.model)

    @cached_property
    def _dampers(self) -> Dampers:
        return dampers(self.model, self, self.parameters)

    def edited(self, values: Values) -> EditedCalculix:
        moving = [pair for pair in self._assigned(values) if pair[0].quantity not in DAMPING]
        return EditedCalculix(self.model, edited_lines(self.model, moving))

    def write_updated(self, values: Values, folder: Path) -> Path:
        changed = edited_lines(self.model, self._assigned(values))
        return write_edited(self.model.deck, changed, folder)

    def _assigned(self, values: Values) -> list[tuple[Parameter, float]]:
        """Parameters with values, those of groups' stiffness last."""
        groups = values.keys() - {item.name for item in self.parameters}
        return assigned((*self.parameters, *(self._losses if groups else ())), values)
