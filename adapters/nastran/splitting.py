"""Separate materials and properties for the elements that parameters name.

A parameter of a material that names properties or elements, and one of a section that names
elements, acts on these alone. Where others share the card, the deck gets a copy of it with a free
number behind the card, and the elements or properties concerned name the copy: the model is the
same, one card more. A comment line before each copy says what it is.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

from modetune.adapters.nastran.bulk import BY_LINES
from modetune.adapters.nastran.cards import holds, idents_of, materials_named
from modetune.adapters.nastran.deck import NastranDeck, with_added
from modetune.adapters.nastran.fields import CardField, NastranCard, changed_texts, large_field
from modetune.adapters.nastran.structure import Copies, Structure
from modetune.adapters.splitting import (
    OF_MATERIALS,
    Selection,
    acting,
    cells_of,
    cut,
    elements_named,
)
from modetune.core.errors import ModelError
from modetune.core.near_names import listed
from modetune.core.parameters import Parameter

#: Materials that belong to another by its number, such as its dependence on temperature.
BESIDE = ("MATT", "MATS", "MATF", "MATTC", "CREEP")


@dataclass(slots=True)
class _Edits:
    """Changes of a deck on the way: numbers in fields, and lines behind the last line of cards."""

    structure: Structure
    numbers: dict[CardField, int]
    added: dict[int, list[str]]
    said: list[str]

    def name(self, card: NastranCard, field: int, number: int) -> None:
        """Let a field of a card name another material or property. Raises ModelError."""
        found = card.fields[field] if field < len(card.fields) else None
        if found is None:
            raise ModelError(
                f"{self.structure.deck.where(card)}: field {field + 1} of {card.name} "
                f"{card.text(1)} is blank, which means a default: write the number out"
            )
        self.numbers[found] = number

    def copy(
        self, card: NastranCard, number: int, fields: Mapping[int, int], whom: str, names: str
    ) -> None:
        """Add a card like this one with another number, and other numbers in some fields."""
        where = self.structure.deck.where(card)
        if card.name in BY_LINES or len(idents_of(card.name)) > 1:
            raise ModelError(
                f"{where}: {card.name} {card.text(1)} is shared with others and cannot be copied; "
                f"give {whom} a separate {card.name}"
            )
        texts = [card.text(field) for field in range(1, len(card.fields))]
        for field, value in {1: number, **fields}.items():
            texts[field - 1] = str(value)
        text = f"{card.name} {number}: {card.name} {card.text(1)} for {whom} ({names})"
        self.added.setdefault(max(card.lines), []).extend(
            [f"$ {text}", *large_field(card.name, texts).split("\n")]
        )
        self.said.append(f"{where}: added {text}")

    def deck(self) -> NastranDeck:
        deck = self.structure.deck
        return with_added(deck, changed_texts(deck.lines, self.numbers), self.added)


def split_properties(
    structure: Structure, parameters: Sequence[Parameter]
) -> tuple[NastranDeck, Copies] | None:
    """Return the deck with separate properties for elements of parameters, None if unchanged.

    Raises ModelError where a card cannot be copied.
    """
    chosen = [item for item in _selections(structure, parameters) if item.elements]
    edits, copies = _Edits(structure, {}, {}, []), defaultdict[int, list[int]](list)
    number = max(structure.owners.properties, default=0)
    for ident, elements in sorted(structure.elements_of.items()):
        for names, members in cut(chosen, elements)[1:]:
            number += 1
            copies[ident].append(number)
            card = structure.property_card(str(ident))
            edits.copy(card, number, {}, elements_named(members), ", ".join(names))
            for element in members:
                edits.name(structure.owners.elements[element][0], 2, number)
    return (edits.deck(), Copies(dict(copies), {}, tuple(edits.said))) if copies else None


def split_materials(
    structure: Structure, parameters: Sequence[Parameter]
) -> tuple[NastranDeck, Copies] | None:
    """As `split_properties`, for materials of properties that parameters name."""
    chosen = [item for item in _selections(structure, parameters) if item.material]
    edits, copies = _Edits(structure, {}, {}, []), defaultdict[int, list[int]](list)
    number = max(structure.owners.materials, default=0)
    used = {mid for mids in structure.materials_of.values() for mid in mids}
    for ident in sorted(used | set(structure.rods_of)):
        users = {
            ("property", pid): acting(chosen, structure.elements_of[pid])
            for pid, mids in sorted(structure.materials_of.items())
            if ident in mids
        } | {
            ("element", rod): acting(chosen, frozenset({rod}))
            for rod in sorted(structure.rods_of.get(ident, ()))
        }
        for names, members in cells_of(users)[1:]:
            number += 1
            copies[ident].append(number)
            card = structure.material(str(ident))
            _refuse_dependent(structure, ident, members)
            edits.copy(card, number, {}, _users(structure, members), ", ".join(names))
            for kind, owner in members:
                _rename(edits, kind, owner, ident, number)
    return (edits.deck(), Copies({}, dict(copies), tuple(edits.said))) if copies else None


def _rename(edits: _Edits, kind: str, owner: int, old: int, new: int) -> None:
    """Let a property, or a CONROD, name another material where it names this one."""
    structure = edits.structure
    rod = kind == "element"
    card = structure.owners.elements[owner][0] if rod else structure.property_card(str(owner))
    for field in materials_named(card):
        if card.text(field) == str(old):
            edits.name(card, field, new)


def _selections(structure: Structure, parameters: Sequence[Parameter]) -> list[Selection]:
    """Return the elements that parameters name; unknown names are refused later."""
    found = []
    for parameter in parameters:
        material = parameter.quantity in OF_MATERIALS
        elements: Iterable[int] = ()
        try:
            if parameter.by == "element" and parameter.quantity != "mass":
                elements = structure.element_numbers(structure.owners.elements, parameter.targets)
            elif parameter.by == "property" and material:
                cards = [c for target in parameter.targets for c in structure.properties(target)]
                shared = [pid for pid, card in cards if not holds(parameter.quantity, card.name)]
                elements = [e for pid in shared for e in structure.elements_of[pid]]
        except ModelError:
            continue
        found.append(Selection(parameter.name, frozenset(elements), material))
    return found


def _refuse_dependent(structure: Structure, ident: int, members: Sequence[tuple[str, int]]) -> None:
    for card in structure.deck.cards:
        if card.name.startswith(BESIDE) and card.text(1) == str(ident):
            raise ModelError(
                f"{structure.deck.where(card)}: {card.name} {ident} belongs to a material that is "
                f"shared with others; give {_users(structure, members)} a separate material"
            )


def _users(structure: Structure, members: Sequence[tuple[str, int]]) -> str:
    names = [
        f"{structure.property_card(str(number)).name} {number}"
        if kind == "property"
        else f"CONROD {number}"
        for kind, number in members
    ]
    return listed(names)
