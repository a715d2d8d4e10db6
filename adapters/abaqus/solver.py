"""A deck of parts and instances run by CalculiX: the flat deck runs, the author's own is edited.

Each number that parameters scale has the text of a line of the author's deck, which may be in the
flat deck several times, once for each instance of a part. A parameter moves all of them, or is
refused: an instance has no numbers of its own.
"""

from __future__ import annotations

import logging
from collections import defaultdict
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path

from modetune.adapters.abaqus.flattening import FlatDeck, flatten
from modetune.adapters.calculix.deck import KeywordDeck, write_edited
from modetune.adapters.calculix.job import check_frequency_step
from modetune.adapters.calculix.mesh import read_geometry
from modetune.adapters.calculix.model import CalculixModel
from modetune.adapters.calculix.places import edited_lines
from modetune.adapters.calculix.solver import calculix_program
from modetune.adapters.calculix.splitting import split_model
from modetune.adapters.calculix.steps import choice_note
from modetune.adapters.calculix.structure import understand
from modetune.adapters.deck_numbers import Number
from modetune.adapters.solver import AddedCards, Addition, Solver, Target
from modetune.core.errors import ModelError
from modetune.core.mesh import Mesh
from modetune.core.parameters import Parameter, Values

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class AssemblyModel(CalculixModel):
    """A CalculiX model whose deck was flattened."""

    flat: FlatDeck = field(repr=False)

    @cached_property
    def _copies(self) -> Mapping[int, list[int]]:
        """Positions in the flat deck of each line of the author's with the same text."""
        found, source = defaultdict[int, list[int]](list), self.flat.source.lines
        for place, (line, origin) in enumerate(
            zip(self.flat.deck.lines, self.flat.origins, strict=True)
        ):
            if line.text == source[origin].text:
                found[origin].append(place)
        return found

    @cached_property
    def _mesh(self) -> Mesh:
        mesh = read_geometry(self.structure.deck, self.structure.mesh, self.summary.node_ids)
        names = {flat: name for flat, name in self.flat.labels.items() if name != str(flat)}
        return replace(mesh, names=names)

    def numbers(self, parameter: Parameter) -> list[Number]:
        found = super().numbers(parameter)
        moved = {number.place[0] for number in found}
        for number in found:
            line = number.place[0]
            copies = self._copies.get(self.flat.origins[line], [])
            if line not in copies:
                raise ModelError(
                    f"{number.where}: {parameter.quantity} is written otherwise for CalculiX, so "
                    "no parameter can change it"
                )
            if not moved.issuperset(copies):
                names = ", ".join(self._sections_at(copies))
                raise ModelError(
                    f"{number.where}: this number is that of {names}: name all of them"
                )
        return found

    def _sections_at(self, lines: list[int]) -> list[str]:
        cards = self.structure.sections
        return [card.option("ELSET") for card in cards if not set(lines).isdisjoint(card.lines)]

    def targets(self) -> tuple[Target, ...]:
        """Materials and sections, those of all instances of a part together."""
        groups = defaultdict[int, list[Target]](list)
        starts = {card.option("ELSET"): card.lines.start for card in self.structure.sections}
        for target in super().targets():
            line = starts.get(target.names[0], -1) if target.by == "elset" else -1
            key = self.flat.origins[line] if line >= 0 else -1 - len(groups)
            groups[key].append(target)
        return tuple(
            replace(
                group[0],
                names=tuple(name for target in group for name in target.names),
                n_elements=sum(target.n_elements for target in group),
            )
            for group in groups.values()
        )

    def with_cards(self, addition: Addition) -> AddedCards:
        raise ModelError(
            f"{self.flat.source.file}: cards are not added to a deck with instances, whose nodes "
            "have other numbers in it"
        )

    def write_updated(self, values: Values, folder: Path) -> Path:
        changed = edited_lines(self.structure, self._assigned(values))
        own = {self.flat.origins[line]: text for line, text in changed.items()}
        return write_edited(self.flat.source, own, folder)


def assembly_solver(deck: KeywordDeck, parameters: tuple[Parameter, ...]) -> Solver:
    """CalculiX for a deck with parts and instances. Raises ModelError for the rest."""
    flat = flatten(deck)
    structure = understand(flat.deck)
    if split := split_model(structure, parameters).split:
        raise ModelError(
            f"a deck with instances gets no sections or materials of its own for parameters "
            f"({split[0]}): name the material, or all elements of the section"
        )
    for note in (*flat.notes, *choice_note(deck), *check_frequency_step(structure)):
        logger.warning("%s", note)
    return Solver(AssemblyModel(structure, parameters, flat), calculix_program())
