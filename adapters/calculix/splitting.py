"""Separate materials and sections for the elements that parameters name.

A parameter of a material that names element sets or elements, and one of a section that names some
of its elements, acts on these alone. Where others share the section, each part gets an element set
and a section; if others share the material, the sections concerned name a copy of it. A comment
line before each copy states what it is.
"""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import replace

from modetune.adapters.calculix.cards import OF_MATERIAL
from modetune.adapters.calculix.deck import (
    KeywordCard,
    KeywordDeck,
    canonical_name,
    replace_field,
    with_added,
)
from modetune.adapters.calculix.structure import CalculixStructure, understand
from modetune.adapters.splitting import (
    OF_MATERIALS,
    Selection,
    acting,
    cells_of,
    cut,
    elements_named,
)
from modetune.core.near_names import listed
from modetune.core.parameters import Parameter

#: Entries of a line of *ELSET, as many as ccx takes.
ENTRIES = 16


def split_model(structure: CalculixStructure, parameters: Sequence[Parameter]) -> CalculixStructure:
    """Return the model with separate sections and materials for the elements of parameters."""
    return _split_materials(_split_sections(structure, parameters), parameters)


def _split_sections(
    structure: CalculixStructure, parameters: Sequence[Parameter]
) -> CalculixStructure:
    deck, sets = structure.deck, structure.mesh.element_sets
    chosen = _selections(structure, parameters)
    changed: dict[int, str] = {}
    added: dict[int, list[str]] = defaultdict(list)
    messages = []
    taken = set(sets)
    for card in structure.sections:
        old = card.option("ELSET")
        (_, kept), *others = cut(chosen, sets.get(old, frozenset()))
        if not others:
            continue
        name = _free_name(old, taken)
        before, behind = added[card.lines.start - 1], added[_text_lines(deck, card)[-1]]
        before += [f"** {name}: {old} without what parameters name", *_elset(name, kept)]
        changed |= _renamed(deck, card, "ELSET", name)
        for names, members in others:
            part = _free_name(old, taken)
            text = f"{part}: {elements_named(members)} of {old} ({', '.join(names)})"
            before += [f"** {text}", *_elset(part, members)]
            texts = _renamed(deck, card, "ELSET", part)
            behind += [texts.get(line, deck.lines[line].text) for line in _text_lines(deck, card)]
            messages.append(f"{deck.where(card)}: added a {card.keyword} for {text}")
    if not messages:
        return structure
    again = understand(with_added(deck, changed, added))
    return replace(again, split=(*structure.split, *messages))


def _split_materials(
    structure: CalculixStructure, parameters: Sequence[Parameter]
) -> CalculixStructure:
    deck, sets = structure.deck, structure.mesh.element_sets
    chosen = [item for item in _selections(structure, parameters) if item.material]
    changed: dict[int, str] = {}
    added: dict[int, list[str]] = defaultdict(list)
    copies: dict[str, list[str]] = defaultdict(list)
    messages = []
    sections = {card.lines.start: card for card in structure.sections}
    materials = {card.option("NAME"): card for card in deck.named("*MATERIAL")}
    taken = set(materials)
    for old, head in materials.items():
        users = {
            start: acting(chosen, sets.get(card.option("ELSET"), frozenset()))
            for start, card in sections.items()
            if old == card.option("MATERIAL") or old in structure.layers(card)
        }
        for names, members in cells_of(users)[1:]:
            name = _free_name(old, taken)
            copies[old].append(name)
            whom = listed([sections[start].option("ELSET") for start in members])
            text = f"{name}: {old} for {whom} ({', '.join(names)})"
            block = _block(deck, head)
            texts = _renamed(deck, head, "NAME", name)
            added[block[-1]] += [
                f"** {text}",
                *(texts.get(line, deck.lines[line].text) for line in block),
            ]
            messages.append(f"{deck.where(head)}: added material {text}")
            for start in members:
                changed |= _with_material(deck, sections[start], changed, old, name)
    if not messages:
        return structure
    again = understand(with_added(deck, changed, added))
    return replace(again, copies=dict(copies), split=(*structure.split, *messages))


def _selections(structure: CalculixStructure, parameters: Sequence[Parameter]) -> list[Selection]:
    found = []
    for parameter in parameters:
        if parameter.by not in ("elset", "element"):
            continue
        material = parameter.quantity in OF_MATERIALS
        elements = [structure.mesh.named(target) for target in parameter.targets]
        found.append(Selection(parameter.name, frozenset[int]().union(*elements), material))
    return found


def _free_name(old: str, taken: set[str]) -> str:
    number = 2
    while f"{old}_{number}" in taken:
        number += 1
    taken.add(f"{old}_{number}")
    return f"{old}_{number}"


def _elset(name: str, members: Sequence[int]) -> list[str]:
    rows = [members[start : start + ENTRIES] for start in range(0, len(members), ENTRIES)]
    return [f"*ELSET, ELSET={name}", *(", ".join(map(str, row)) for row in rows)]


def _text_lines(deck: KeywordDeck, card: KeywordCard) -> list[int]:
    """A card's lines without comments, and without blank ones at its end."""
    lines = [p for p in card.lines if not deck.lines[p].text.lstrip().startswith("**")]
    while not deck.lines[lines[-1]].text.strip():
        lines.pop()
    return lines


def _block(deck: KeywordDeck, head: KeywordCard) -> list[int]:
    """Return the lines of a material: its *MATERIAL and the cards that continue it."""
    lines = _text_lines(deck, head)
    for card in deck.cards[deck.cards.index(head) + 1 :]:
        if not card.is_one_of(*OF_MATERIAL):
            break
        lines += _text_lines(deck, card)
    return lines


def _renamed(deck: KeywordDeck, card: KeywordCard, option: str, name: str) -> dict[int, str]:
    """The lines of a keyword with another value of an option."""
    value = re.compile(rf"({option}\s*=\s*)(\"[^\"]*\"|[^,\s]+)", re.IGNORECASE)
    stop = card.data[0] if card.data else card.lines.stop
    texts = {p: deck.lines[p].text for p in range(card.lines.start, stop)}
    found = {p: value.sub(rf"\g<1>{name}", text) for p, text in texts.items()}
    return {p: text for p, text in found.items() if text != texts[p]}


def _with_material(
    deck: KeywordDeck, card: KeywordCard, changed: Mapping[int, str], old: str, new: str
) -> dict[int, str]:
    """The lines in which a section names one material, naming another."""
    if "COMPOSITE" not in card.options:
        return _renamed(deck, card, "MATERIAL", new)
    texts = {p: changed.get(p, deck.lines[p].text) for p in card.data}
    rows = {p: text.split(",") for p, text in texts.items()}
    return {
        p: replace_field(texts[p], 2, new)
        for p, row in rows.items()
        if len(row) > 2 and canonical_name(row[2]) == old
    }
