"""What a CalculiX deck says: nodes, element sets and sections."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from modetune.adapters.calculix.cards import SECTIONS
from modetune.adapters.calculix.deck import KeywordCard, KeywordDeck, canonical_name
from modetune.adapters.calculix.mesh import CalculixMesh, read_mesh, roles_of
from modetune.adapters.calculix.steps import modal_step, read_steps
from modetune.adapters.solver import ModelSummary

#: Cards that tie nodes to others: their unknowns are not in the stored matrices.
DEPENDENT = ("*EQUATION", "*RIGID BODY", "*MPC", "*TIE", "*COUPLING", "*DISTRIBUTING COUPLING")

#: Those of them that are not followed to the unknowns they depend on.
NOT_FOLLOWED = ("*MPC", *DEPENDENT[4:], "*CYCLIC SYMMETRY MODEL", "*PRE-TENSION SECTION")

#: Elements whose printed strain energy is zero (SPRINGA, users' own) or lacks the hourglass part.
WITHOUT_ENERGY = re.compile(r"SPRINGA|U.*|C3D8R|(S|M3D|CPS|CPE|CAX)4R")
#: Elements that leave the unknowns of the stored matrices at the nodes of the deck.
UNEXPANDED = re.compile(r"C3D.*|SPRING[12A]|MASS|DASHPOTA")


@dataclass(frozen=True, slots=True, eq=False)
class CalculixStructure:
    """A deck understood: its mesh, and its sections. Each is itself alone.

    copies: materials that were added for parameters' elements, by the one they are copies of;
    split: what was added so, a sentence each.
    """

    deck: KeywordDeck
    mesh: CalculixMesh
    copies: Mapping[str, Sequence[str]] = field(default_factory=dict)
    split: tuple[str, ...] = ()

    @property
    def summary(self) -> ModelSummary:
        elements = self.mesh.elements.values()
        solid = all(UNEXPANDED.fullmatch(element.kind) for element in elements)
        # A dependent or reference node carries results without belonging to an element.
        free = not self.deck.named(*DEPENDENT)
        return ModelSummary(
            name=self.deck.file.stem,
            node_ids=self.mesh.element_nodes if free else self.mesh.nodes,
            components=frozenset({1, 2, 3}),  # ccx prints no rotations
            n_elements=len(elements),
            solid_shapes=solid and free and not self.deck.named("*TRANSFORM"),
            matrix_shapes=self._followed(),
            file=self.deck.file,
        )

    def _followed(self) -> bool:
        """Whether equations give the displacements of all kinds of elements and ties."""
        kinds = {element.kind for element in self.mesh.elements.values()}
        return not self.deck.named(*NOT_FOLLOWED) and all(
            "other" not in roles_of(kind) for kind in kinds
        )

    @property
    def sections(self) -> list[KeywordCard]:
        return self.deck.named(*SECTIONS)

    def section_sets(self) -> tuple[str, ...]:
        """Element sets of all sections: together the whole model."""
        return tuple(dict.fromkeys(card.option("ELSET") for card in self.sections))

    def preload(self) -> str:
        """The first card by which the stiffness depends on a state, with file and line, or empty.

        That is a step before a frequency step with PERTURBATION, which starts from its stresses and
        displacements (without the word ccx takes none of them), or contact. Moduli that depend on
        temperature do not: a parameter scales them all alike.
        """
        steps, contact = read_steps(self.deck), self.deck.named("*CONTACT PAIR")
        if any(step.named("*FREQUENCY") for step in steps):
            modal = modal_step(self.deck, steps)
            before = [step for step in steps if step.number < modal.number and step.has_state]
            if before and "PERTURBATION" in modal.cards[0].options:
                where = self.deck.where(before[0].cards[0])
                return f"{where}: a step before that of the frequencies"
        return f"{self.deck.where(contact[0])}: contact" if contact else ""

    @property
    def hides_energy(self) -> bool:
        """Whether a mode may have strain energy that ccx does not print."""
        kinds = {element.kind for element in self.mesh.elements.values()}
        return bool(self.preload()) or any(WITHOUT_ENERGY.fullmatch(kind) for kind in kinds)

    def members(self, card: KeywordCard) -> frozenset[int]:
        """Elements of a section."""
        return self.mesh.element_sets.get(card.option("ELSET"), frozenset())

    def users(self, materials: set[str]) -> list[KeywordCard]:
        """Sections that use one of these materials."""
        return [
            card
            for card in self.sections
            if card.option("MATERIAL") in materials or materials & self.layers(card)
        ]

    def layers(self, card: KeywordCard) -> set[str]:
        """Materials of a laminate: the third field of each layer."""
        if "COMPOSITE" not in card.options:
            return set()
        rows = (self.deck.fields(position) for position in card.data)
        return {canonical_name(row[2]) for row in rows if len(row) > 2}


def understand(deck: KeywordDeck) -> CalculixStructure:
    """Read nodes, elements and sets of a deck. Raises ModelError with file and line."""
    return CalculixStructure(deck, read_mesh(deck))
