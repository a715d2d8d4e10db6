"""A Nastran deck run by CalculiX: the Nastran model translated at each set of parameter values.

Parameters edit the user's Nastran deck; the edited deck is translated, and CalculiX runs the
translation as it runs any deck. Shapes come back in the output frames of the grid points, as
Nastran gives them, so that a test file fits either solver.
"""

from __future__ import annotations

import logging
import threading
from collections import OrderedDict
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path

import numpy as np
from scipy import sparse

from modetune.adapters.calculix.affected_elements import changed_numbers, changed_places
from modetune.adapters.calculix.model import CalculixModel, EditedCalculix
from modetune.adapters.calculix.solver import calculix_program
from modetune.adapters.calculix.structure import WITHOUT_ENERGY, understand
from modetune.adapters.damping import NOTHING, damps_only
from modetune.adapters.nastran import model as nastran_model
from modetune.adapters.nastran.bulk import Bulk, edited_bulk, read_bulk
from modetune.adapters.nastran.case_control import (
    absent_sets,
    choice_note,
    parts_note,
    range_note,
    read_case_control,
)
from modetune.adapters.nastran.deck import read_deck
from modetune.adapters.nastran.model import NastranModel
from modetune.adapters.solver import AffectedElements, ModelSummary, Solver
from modetune.adapters.translation.shells import KINDS, WrittenShells
from modetune.adapters.translation.translation import Translation, translate
from modetune.core.algebra.matrices import MatrixResult
from modetune.core.errors import ModelError
from modetune.core.expressions import degree
from modetune.core.modes import Integers
from modetune.core.parameters import Parameter, Values, driven_by
from modetune.core.updating.observation import Observation
from modetune.core.updating.static_model import LoadCase

logger = logging.getLogger(__name__)

#: Cards whose numbers are in the laws of shells.
SHELL_LAWS, MATERIALS = ("PSHELL", "PCOMP", "PCOMPG"), ("MAT1", "MAT2", "MAT8")
#: Translated models that are kept for the next look at the same values.
KEPT = 4


@dataclass(frozen=True)
class TranslatedDeck(NastranModel):
    """A Nastran model whose translation CalculiX runs."""

    _kept: OrderedDict[tuple[tuple[int, str], ...], EditedCalculix] = field(
        default_factory=OrderedDict, repr=False, compare=False
    )
    _affected: dict[tuple[Parameter, tuple[Parameter, ...]], AffectedElements | None] = field(
        default_factory=dict, repr=False, compare=False
    )
    _lock: threading.Lock = field(default_factory=threading.Lock, repr=False, compare=False)
    _own: threading.Lock = field(default_factory=threading.Lock, repr=False, compare=False)
    _shells: list[WrittenShells] = field(default_factory=list, repr=False, compare=False)

    @cached_property
    def summary(self) -> ModelSummary:
        nominal, own = self._nominal.summary, super().summary
        return replace(
            nominal,
            name=own.name,
            node_ids=nominal.node_ids & own.node_ids,
            n_elements=own.n_elements,
            file=own.file,
        )

    @cached_property
    def _nominal(self) -> CalculixModel:
        return CalculixModel(self.edited({}).structure, ())

    def energy_sets(self, parameter: Parameter) -> tuple[str, ...]:
        """Return the deck's sets, none where CalculiX prints no whole energy of their elements."""
        names = super().energy_sets(parameter)
        mesh = self._nominal.structure.mesh
        members = [mesh.element_sets.get(name, frozenset()) for name in names]
        kinds = {mesh.elements[number].kind for numbers in members for number in numbers}
        whole = all(members) and not any(WITHOUT_ENERGY.fullmatch(kind) for kind in kinds)
        return names if whole else ()

    def affected_elements(self, parameter: Parameter) -> AffectedElements | None:
        """Return the elements by the changes of the translated deck with the parameter.

        Not every parameter that a Nastran model is linear in is so in its translation. The answer
        is kept, because it takes several translations.
        """
        known = parameter, self.parameters
        if known not in self._affected:
            self._affected[known] = self._affected_by(parameter)
        return self._affected[known]

    def _affected_by(self, parameter: Parameter) -> AffectedElements | None:
        if damps_only(parameter, self.parameters):
            return NOTHING
        driven = driven_by(parameter, self.parameters)
        moved = {item.quantity for item in (parameter, *driven)}
        if "poissons_ratio" in moved or any(degree(item.expression) > 1 for item in driven):
            return None
        if self.problems((parameter,)):
            return None
        wanted = (0.5, 0.75, 1.5, 2.0) if parameter.quantity == "thickness" else (0.5, 2.0)
        values = [self.written(parameter, value) for value in wanted]
        rest = {item.name: 1.0 for item in self.parameters if not item.expression}
        try:
            edits = [self.edited({**rest, parameter.name: value}) for value in (1.0, *values)]
        except ModelError:
            return None
        changed = changed_places(edits[0].structure, [item.texts() for item in edits], values)
        if changed is None:
            return None
        found = self._nominal.affected_elements_of(changed.places, changed.powers)
        plain = parameter.proportional and not driven
        if found is None or (found.powers != (1,) and not plain):
            return None
        whole = found.proportional and changed.proportional and plain
        return replace(found, proportional=whole, related=bool(driven))

    def observation(
        self, matrices: MatrixResult, nodes: Integers, components: Integers
    ) -> Observation:
        frames = self.edited({}).frames or {}
        if frames.keys().isdisjoint(nodes.tolist()):
            return self._nominal.observation(matrices, nodes, components)
        # The nodes' three basic displacements, then what is wanted of each.
        size = nodes.size
        basic = self._nominal.observation(
            matrices, np.repeat(nodes, 3), np.tile(np.arange(1, 4), size)
        )
        axes = [
            frames.get(node, np.eye(3))[component - 1]
            for node, component in zip(nodes.tolist(), components.tolist(), strict=True)
        ]
        turn = sparse.csr_array(
            (np.concatenate(axes), np.arange(3 * size), np.arange(0, 3 * size + 1, 3)),
            shape=(size, 3 * size),
        )
        turn.eliminate_zeros()
        return basic.turned(turn)

    def freedoms(self, matrices: MatrixResult) -> tuple[Integers, Integers]:
        nodes, components = matrices.nodes.copy(), matrices.components.copy()
        carriers = self.edited({}).carriers
        turning = np.isin(nodes, list(carriers))
        nodes[turning] = [carriers[node] for node in nodes[turning].tolist()]
        components[turning] += 3
        return nodes, components

    def load_case(self, number: int, values: Values | None = None) -> LoadCase:
        found = super().load_case(number)
        if found.acceleration.any():
            raise ModelError(
                f"{self.deck.file}: load set {number} has GRAV, whose forces on "
                "supported elements are in no matrix of CalculiX: use `solver: mystran`"
            )
        return found

    def edited(self, values: Values) -> EditedCalculix:
        """Return the translation at these values, kept for a while. Raises ModelError."""
        changed = self.changed(values)
        known = tuple(sorted(changed.items()))
        with self._lock:
            if known not in self._kept:
                self._kept[known] = self._translate(changed)
                while len(self._kept) > KEPT:
                    # The nominal translation, the first one, is always of use.
                    self._kept.pop(next(key for key in self._kept if key != ()))
            self._kept.move_to_end(known)
            return self._kept[known]

    def _translate(self, changed: dict[int, str]) -> EditedCalculix:
        """Return the translation with some lines of the deck changed. Raises ModelError.

        Where numbers alone differ from the nominal translation it is that one, edited.
        """
        nominal = self._kept.get(())
        edited = self._edited_shells(nominal, changed) if nominal else None
        if edited is not None:
            return edited
        translation = self._translation(changed)
        if nominal is None:
            self._shells.append(translation.shells)
        lines = changed_numbers(nominal.structure, translation.deck) if nominal else None
        if nominal is not None and lines is not None:
            return replace(nominal, changed=lines, frames=translation.frames)
        return EditedCalculix(
            understand(translation.deck), {}, translation.frames, translation.carriers
        )

    def _edited_shells(
        self, nominal: EditedCalculix, changed: dict[int, str]
    ) -> EditedCalculix | None:
        """Return the nominal translation with the laws of its shells edited.

        None where more changes.
        """
        if not self._of_shells(changed):
            return None
        with self._own, edited_bulk(self.deck, self._bulk, changed) as bulk:
            numbers = self._shells[0].edited(bulk)
        if numbers is None:
            return None
        deck, lines = nominal.structure.deck, dict[int, str]()
        for card in deck.named("*MATERIAL", "*MASS"):
            texts = numbers.get(card.option("NAME") or card.option("ELSET"), ())
            for place, text in enumerate(texts, card.lines.start + 1):
                if deck.lines[place].text != text:
                    lines[place] = text
        return replace(nominal, changed=lines)

    def _of_shells(self, changed: dict[int, str]) -> bool:
        """Return whether these lines belong only to properties of shells and their materials."""
        structure = self.structure
        cards = [card for card in self.deck.cards if not changed.keys().isdisjoint(card.lines)]
        if not {card.name for card in cards} <= {*SHELL_LAWS, *MATERIALS}:
            return False
        if any("\n" in text for text in changed.values()):  # cards are added
            return False
        numbers = {int(card.text(1)) for card in cards if card.name in MATERIALS}
        others = set(structure.rods_of)
        for number, materials in structure.materials_of.items():
            if structure.bulk.properties[number].type not in SHELL_LAWS:
                others |= materials
        kinds = {
            structure.bulk.elements[element].type
            for card in cards
            if card.name in SHELL_LAWS
            for element in structure.elements_of.get(int(card.text(1)), ())
        }
        return numbers.isdisjoint(others) and kinds <= set(KINDS)

    def _translation(self, changed: dict[int, str]) -> Translation:
        """Return the text with some lines of the deck changed. Raises ModelError."""
        stem = self.deck.file.stem
        case = read_case_control(self.deck)
        case = case.without(absent_sets(self.deck, case))
        own = self._bulk if changed else self.bulk
        with self._own, edited_bulk(self.deck, own, changed) as bulk:
            translation = translate(
                bulk,
                stem,
                spc=case.selected("SPC"),
                mpc=case.selected("MPC"),
                added={name: case.added(name) for name in ("K2GG", "M2GG")},
                single=self._single,
                wtmass=self.wtmass,
                weighed=not changed,  # other numbers are translated in the same way
                lumped=self.masses() == "lumped",
            )
        logger.info("%s translated: %s", stem, translation.mass_check or "numbers alone")
        return translation

    @cached_property
    def _bulk(self) -> Bulk:
        """A private model of the deck, whose numbers are edited."""
        return read_bulk(self.deck)[0]

    @cached_property
    def _single(self) -> frozenset[int]:
        """Elements with a separate set, because a parameter needs their energy."""
        names = [
            name
            for item in self.parameters
            if not self.problems((item,))
            for name in NastranModel.energy_sets(self, item)
        ]
        return frozenset(int(name[1:]) for name in names if name.startswith("E"))


def translated_solver(deck: Path, parameters: tuple[Parameter, ...], subcase: int = 0) -> Solver:
    """Return CalculiX for a Nastran deck. Raises ModelError where it cannot be translated."""
    model = nastran_model.understand(read_deck(deck, subcase), parameters)
    notes = (note(model.deck) for note in (parts_note, choice_note, range_note))
    for note in filter(None, notes):
        logger.warning("%s", note)
    model.check()
    translated = TranslatedDeck(model.structure, model.objections, model.parameters)
    translated.edited({})  # so that what cannot be translated is refused here
    program = calculix_program()
    has = replace(program.capabilities, masses=model.other_masses())
    return Solver(translated, replace(program, capabilities=has))
