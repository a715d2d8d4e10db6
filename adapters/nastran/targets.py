"""What of a Nastran deck parameters may name: materials, properties, springs, masses and rods."""

from __future__ import annotations

import re
from collections.abc import Iterator

from modetune.adapters.nastran.bulk import Cards
from modetune.adapters.nastran.cards import NastranCard
from modetune.adapters.nastran.places import ELEMENT_ENTRIES
from modetune.adapters.nastran.structure import Structure
from modetune.adapters.solver import Target
from modetune.core.parameters import TargetKind

#: More elements of one card than this are one target.
ALONE = 12
#: Quantities for which elements are named one by one.
OF_ELEMENTS = ("area", "spring_stiffness", "mass")
#: What preprocessors write before a name in the comment above a card.
TITLE = re.compile(r"^\$[\s*$-]*(?:(?:femap|hm|patran)?\s*(?:material|property|name|mat|prop)\b"
                   r"[^:\"]*[:\"])?\s*(.*?)[\s\"*$-]*$", re.IGNORECASE)  # fmt: skip


def targets(structure: Structure) -> tuple[Target, ...]:
    """Materials and properties that elements use, then elements with numbers of their own."""
    owners = structure.owners
    used = {number: set(rods) for number, rods in structure.rods_of.items()}
    for number, materials in structure.materials_of.items():
        for material in materials:
            used.setdefault(material, set()).update(structure.elements_of[number])
    sizes = {number: len(found) for number, found in used.items()}
    by_property = {number: len(found) for number, found in structure.elements_of.items()}
    return (
        *_numbered(structure, "material", owners.materials, sizes),
        *_numbered(structure, "property", owners.properties, by_property),
        *_elements(structure, owners.elements),
        *_elements(structure, owners.masses),
    )


def _numbered(
    structure: Structure, by: TargetKind, family: Cards, sizes: dict[int, int]
) -> Iterator[Target]:
    for number in sorted(family.keys() & sizes.keys()):
        card = family[number][0]
        yield Target(by, (str(number),), card.name, sizes[number], _title(structure, card))


def _elements(structure: Structure, family: Cards) -> Iterator[Target]:
    named = {card for quantity, card in ELEMENT_ENTRIES if quantity in OF_ELEMENTS}
    found: dict[str, list[int]] = {}
    for number, cards in sorted(family.items()):
        if cards[0].name in named:
            found.setdefault(cards[0].name, []).append(number)
    for kind, numbers in found.items():
        if len(numbers) > ALONE:
            yield Target("element", tuple(map(str, numbers)), kind, len(numbers))
            continue
        for number in numbers:
            title = _title(structure, family[number][0])
            yield Target("element", (str(number),), kind, 1, title)


def _title(structure: Structure, card: NastranCard) -> str:
    """What the comment above a card calls it; empty where it has no words."""
    first = card.lines[0]
    above = structure.deck.lines[first - 1].text.strip() if first else ""
    match = TITLE.match(above)
    title = match.group(1).strip() if match else ""
    words = re.search(r"[^\W\d_]{2}", title) and "|" not in title and len(title) <= 40
    return title if words else ""
