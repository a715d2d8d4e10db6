"""The numbers of a Nastran deck that a parameter scales, and what follows from their cards.

Stiffness is linear in moduli of whole elements, springs and constants of bars without shear, mass
in densities and masses (`NastranModel.is_linear`). What constraints and rigid elements eliminate
moves to the grid points that it depends on.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

from modetune.adapters.deck_numbers import FROM_ZERO, check_moved, check_one
from modetune.adapters.nastran.bulk import Cards
from modetune.adapters.nastran.cards import (
    CARDS,
    CardNumbers,
    Field,
    fields_of,
    holds,
    station_rows,
)
from modetune.adapters.nastran.fields import NastranCard
from modetune.adapters.nastran.structure import Structure
from modetune.adapters.solver import AffectedElements, Target
from modetune.adapters.splitting import OF_MATERIALS
from modetune.core.errors import ModelError
from modetune.core.parameters import Parameter, TargetKind
from modetune.core.updating.parameter_matrices import with_tied


@dataclass(frozen=True, slots=True)
class ValuePlace:
    """One number of the deck that a parameter scales.

    field: index in card.fields. ident: number of the material, property or element. symbol: its
    name in DVMREL1, DVPREL1 or DVCREL1 cards. along: whether it only keeps its ratio to the number
    before it.
    """

    card: NastranCard
    field: int
    value: float
    ident: int
    symbol: str
    along: bool = False


#: Thicknesses of an element that replace its property's: first and last field, and the flag
#: that makes them fractions of the property's (1) instead.
OWN_THICKNESS = {
    "CQUAD4": (11, 14, 10), "CQUADR": (11, 14, 10), "CQUAD8": (11, 14, 17),
    "CTRIA3": (11, 13, 10), "CTRIAR": (11, 13, 10), "CTRIA6": (11, 13, 14),
}  # fmt: skip
REMEDY = {
    "elset": "a Nastran deck has no element sets: name a property or elements instead",
    "part": "a Nastran deck has no matrix parts: name a material, a property or elements instead",
}
#: Between these relative values the powers of a plate's thickness hold.
HALF, DOUBLE = 0.5, 2.0
#: More elements of one card than this are one target.
ALONE = 12
#: A card with its number.
NUMBERED = re.compile(r"[A-Z]\w*\*?[\s,]+(\d+)", re.IGNORECASE)
#: What preprocessors write before a name in the comment above a card.
TITLE = re.compile(r"^\$[\s*$-]*(?:(?:femap|hm|patran)?\s*(?:material|property|name|mat|prop)\b"
                   r"[^:\"]*[:\"])?\s*(.*?)[\s\"*$-]*$", re.IGNORECASE)  # fmt: skip


def find_places(structure: Structure, parameter: Parameter) -> list[ValuePlace]:
    """Return the numbers that a parameter scales. Raises ModelError where there are none."""
    if parameter.by in REMEDY:
        raise ModelError(REMEDY[parameter.by])
    if parameter.quantity == "variable":
        return []
    found: list[ValuePlace] = []
    if parameter.by == "material":
        for target in parameter.targets:
            for _, card in structure.materials(target):
                found += _of_material(structure, parameter, card)
    elif parameter.by == "property":
        named = [item for target in parameter.targets for item in structure.properties(target)]
        found = _of_properties(structure, parameter, [ident for ident, _ in named])
    else:
        found = _of_elements(structure, parameter)
    if len({(place.card.lines, place.field) for place in found}) < len(found):
        raise ModelError(f"{', '.join(parameter.targets)}: one of the targets is named twice")
    return found


def _of_properties(
    structure: Structure, parameter: Parameter, idents: Iterable[int]
) -> list[ValuePlace]:
    """Numbers of property cards, or of the materials that they name. Raises ModelError."""
    found: list[ValuePlace] = []
    materials: dict[int, None] = {}
    for ident in idents:
        card = structure.property_card(str(ident))
        by_material = parameter.quantity in OF_MATERIALS and not holds(
            parameter.quantity, card.name
        )
        named = structure.materials_of[ident] if by_material else ()
        materials.update(dict.fromkeys(sorted(named)))
        if not named:
            found += _of_property(structure, parameter, card, ident)
    for ident in materials:
        found += _of_material(structure, parameter, structure.material(str(ident)))
    return found


def _of_material(structure: Structure, parameter: Parameter, card: NastranCard) -> list[ValuePlace]:
    ident = int(card.text(1))
    fields = fields_of(structure.deck, parameter.quantity, card, ident)
    if card.name == "MAT1":
        where = structure.deck.where(card)
        _check_isotropic(structure, card, where, parameter.quantity)
    return select(structure, parameter, card, ident, fields)


def _check_isotropic(structure: Structure, card: NastranCard, where: str, quantity: str) -> None:
    """Of E, G and NU two are free; the third follows, or is half ignored."""
    young, shear, poisson = (structure.deck.number(card, field) for field in (2, 3, 4))
    number = card.text(1)
    if quantity == "youngs_modulus" and young is None:
        raise ModelError(
            f"{where}: E of MAT1 {number} is blank: it follows from G and NU; update shear_modulus"
        )
    if quantity == "shear_modulus" and shear is None:
        raise ModelError(
            f"{where}: G of MAT1 {number} is blank: it follows from E and NU; update one of those"
        )
    if quantity == "poissons_ratio" and poisson is None:
        raise ModelError(f"{where}: NU of MAT1 {number} is blank: it follows from E and G")
    if quantity == "poissons_ratio" and young is not None and shear is not None:
        raise ModelError(
            f"{where}: MAT1 {number} gives E, G and NU; bars take G and ignore NU, so that NU is "
            "no one quantity: leave G blank"
        )


def _of_property(
    structure: Structure, parameter: Parameter, card: NastranCard, ident: int
) -> list[ValuePlace]:
    deck, quantity = structure.deck, parameter.quantity
    fields, where = fields_of(deck, quantity, card, ident), deck.where(card)
    law = CARDS[card.name].numbers[quantity]
    if quantity == "dimension" and parameter.item == 0:
        raise ModelError(
            f"{where}: {card.name} {ident} has several dimensions: give the parameter an item"
        )
    if quantity == "thickness" and card.name == "PSHELL":
        _check_own_thickness(structure, card, ident)
    rows = station_rows(card) if law.stations and parameter.item == 1 else []
    if rows and fields[-1][1] < rows[-1]:  # a change of end A alone, which end B would follow
        raise ModelError(
            f"{where}: end B of PBEAM {ident} is blank, so that it follows end A: write it out"
        )
    if card.name == "PBAR" and quantity == "shear_factor" and deck.number(card, 19):
        raise ModelError(f"{where}: PBAR {ident} has I12, with which K1 and K2 have no effect")
    if law.needs and card.text(law.needs[0]) in ("", "0", "-1"):
        raise ModelError(
            f"{where}: {card.name} {ident} has no {law.needs[1]}, without which {quantity} has no "
            "effect"
        )
    return select(structure, parameter, card, ident, fields)


def _check_own_thickness(structure: Structure, card: NastranCard, ident: int) -> None:
    for number in sorted(structure.elements_of[ident]):
        element = structure.owners.elements[number][0]
        first, last, flag = OWN_THICKNESS.get(element.name, (0, -1, 0))
        given = any(element.text(field) for field in range(first, last + 1))
        if given and element.text(flag) != "1":
            raise ModelError(
                f"{structure.deck.where(element)}: {element.name} {number} gives its own "
                f"thickness, which that of {card.name} {ident} does not change"
            )


def _of_elements(structure: Structure, parameter: Parameter) -> list[ValuePlace]:
    quantity = parameter.quantity
    owners = structure.owners
    kinds = {row.owner for row in CARDS.values() if quantity in row.numbers}
    family = owners.elements
    if "mass" in kinds:
        family = {**owners.elements, **owners.masses} if "element" in kinds else owners.masses
    numbers = structure.element_numbers(family, parameter.targets)
    found: list[ValuePlace] = []
    by_property: list[int] = []
    materials: dict[int, None] = {}
    for number in numbers:
        card = structure.element(family, number)
        if holds(quantity, card.name):
            fields = fields_of(structure.deck, quantity, card, number)
            found += select(structure, parameter, card, number, fields)
        elif "mass" in kinds and number in owners.masses:
            if quantity != "mass":
                raise ModelError(
                    f"{structure.deck.where(card)}: {card.name} {number} has no {quantity} that "
                    "can be updated"
                )
            raise ModelError(
                f"{structure.deck.where(card)}: {card.name} {number} contains no mass to update; "
                "CONM2, CMASS2 and CMASS4 do"
            )
        elif card.name == "CONROD" and quantity in OF_MATERIALS:
            materials[structure.bulk.elements[number].mid] = None
        else:
            by_property.append(number)
    for ident in materials:
        found += _of_material(structure, parameter, structure.material(str(ident)))
    return found + _of_properties(structure, parameter, structure.properties_of(by_property))


def select(
    structure: Structure, parameter: Parameter, card: NastranCard, ident: int, fields: list[Field]
) -> list[ValuePlace]:
    """The entries that a parameter's item picks and that hold a number. Raises ModelError."""
    where = f"{structure.deck.where(card)}: {card.name} {ident}"
    item, law = parameter.item, CARDS[card.name].numbers[parameter.quantity]
    if item == 0:
        picked = fields
    else:
        picked = [entry for entry in fields if entry[0] == item]
        items = sorted({entry[0] for entry in fields if entry[0] > 0})
        if not picked:
            choice = ", ".join(map(str, items)) or "one alone, so leave the item out"
            raise ModelError(f"{where}: no item {item} of {parameter.quantity}; it has {choice}")
    numbers = [
        (entry, law.blank if number is None else number)
        for entry in picked
        for number in [structure.deck.number(card, entry[1])]
    ]
    symbols = ", ".join(symbol for _, _, symbol in picked)
    if all(value is None for _, value in numbers):
        raise ModelError(
            f"{where}: {symbols} is blank, so there is no {parameter.quantity}; write it "
            f"out (0. for none, and {FROM_ZERO})"
        )
    relative = parameter.values == "relative"
    if not law.stations:  # all stations of a beam are of one number
        check_one(parameter, where, [entry[0] for entry, value in numbers if value is not None])
    given = [value for _, value in numbers if value is not None]
    check_moved(parameter, f"{where}: {symbols}", given)
    # A factor does not change a zero.
    return [
        ValuePlace(card, field, value, ident, symbol, at < 0)
        for (at, field, symbol), value in numbers
        if value or (value is not None and not relative and at >= 0)
    ]


def law_of(place: ValuePlace, parameter: Parameter) -> CardNumbers:
    """Return the facts about a number from the row of its card."""
    return CARDS[place.card.name].numbers[parameter.quantity]


def energy_sets(structure: Structure, parameter: Parameter) -> tuple[str, ...]:
    """Return groups of elements whose strain energy is proportional to the parameter's numbers.

    `P12` is all elements of property 12, `E7` element 7. Empty where the energy is not theirs
    alone: other materials share a property, or only some of its constants scale.
    """
    try:
        places = find_places(structure, parameter)
    except ModelError:
        return ()
    if not places or not all(law_of(place, parameter).energy for place in places):
        return ()
    if CARDS[places[0].card.name].owner == "material":
        return () if parameter.item else _users(structure, {place.ident for place in places})
    names: dict[str, None] = {}
    for place in places:
        if not _whole(structure, parameter, place, places):
            return ()
        kind = "P" if CARDS[place.card.name].owner == "property" else "E"
        names[f"{kind}{place.ident}"] = None
    return tuple(names)


def _users(structure: Structure, materials: set[int]) -> tuple[str, ...]:
    """Groups that these materials alone make stiff, all that use them; else none."""
    names = []
    for number, used in sorted(structure.materials_of.items()):
        if used & materials:
            # Two of the parameter's own materials in one property still scale together.
            if not used <= materials:
                return ()
            names.append(f"P{number}")
    for material in sorted(materials):
        rods = structure.rods_of.get(material, frozenset())
        names += [f"E{number}" for number in sorted(rods)]
    return tuple(names)


def _whole(
    structure: Structure, parameter: Parameter, place: ValuePlace, places: Iterable[ValuePlace]
) -> bool:
    """Return whether the parameter scales all nonzero numbers of a property or element."""
    card, ident = place.card, place.ident
    scaled = {other.field for other in places if other.card == card and other.ident == ident}
    fields = [field for _, field, _ in fields_of(structure.deck, parameter.quantity, card, ident)]
    return {field for field in fields if structure.deck.number(card, field)} <= scaled


def is_linear(structure: Structure, parameter: Parameter) -> bool:
    """Return whether stiffness and mass matrices are linear in the numbers of a parameter.

    Single constants of a material, and one of several materials of a laminate, act in series with
    others (Poisson coupling, transverse shear, condensed bubbles): these are not linear.
    """
    if parameter.quantity == "variable":
        return True
    try:
        places = find_places(structure, parameter)
        if any(_in_series(structure, place, parameter) for place in places):
            return False
    except ModelError:  # then as far as all cards with the quantity agree
        rows = [row for row in CARDS.values() if parameter.quantity in row.numbers]
        laws = [row.numbers[parameter.quantity] for row in rows]
        alone = any(row.owner == "material" for row in rows) and any(law.energy for law in laws)
        return bool(laws) and not alone and all(x.powers == (1,) and not x.series for x in laws)
    laws = [law_of(place, parameter) for place in places]
    if any(CARDS[p.card.name].owner == "material" and law_of(p, parameter).energy for p in places):
        return bool(energy_sets(structure, parameter))
    return all(law.powers == (1,) for law in laws)


def _in_series(structure: Structure, place: ValuePlace, parameter: Parameter) -> bool:
    """Return whether something acts in series with a number of a card."""
    fields = law_of(place, parameter).series
    return any(structure.deck.number(place.card, field) for field in fields)


def powers_of(parameter: Parameter, places: Iterable[ValuePlace], linear: bool) -> tuple[int, ...]:
    """Return the powers of a parameter that make up the matrices, none where no powers do."""
    if linear:
        return (1,)
    laws = {law_of(p, parameter).powers for p in places if holds(parameter.quantity, p.card.name)}
    within = parameter.lower >= HALF and parameter.upper <= DOUBLE
    powers = laws.pop() if len(laws) == 1 and within else ()
    return () if powers == (1,) else powers


def affected_elements_of(
    structure: Structure,
    parameters: Sequence[Parameter],
    places: Sequence[Sequence[ValuePlace]],
    powers: tuple[int, ...],
    whole: bool,
) -> AffectedElements:
    """Return what a parameter, and those that follow by expressions, move in these powers.

    places: the numbers of each of them; whole: whether all stiffness of its elements is
    proportional to it.
    """
    pairs = zip(parameters, places, strict=True)
    moved = {law_of(place, item).moves for item, row in pairs for place in row}
    every = [place for row in places for place in row]
    elements = frozenset[int]().union(*(_elements_with(structure, place) for place in every))
    known = structure.bulk.elements | structure.bulk.masses
    nodes = {node for number in elements for node in known[number].node_ids if node}
    return AffectedElements(
        elements=elements,
        nodes=frozenset(with_tied(nodes, _ties(structure))),
        stiffness=any("K" in matrices for matrices in moved),
        mass=any("M" in matrices for matrices in moved),
        powers=powers,
        proportional=whole and moved <= {"K"},
        related=len(parameters) > 1,
    )


def _elements_with(structure: Structure, place: ValuePlace) -> frozenset[int]:
    """Elements that have a number, or a property or material with it."""
    if place.card in structure.owners.materials.get(place.ident, ()):
        users = (n for n, used in structure.materials_of.items() if place.ident in used)
        rods = structure.rods_of.get(place.ident, frozenset())
        return rods.union(*(structure.elements_of[number] for number in users))
    if place.card in structure.owners.properties.get(place.ident, ()):
        return structure.elements_of[place.ident]
    return frozenset({place.ident})


def _ties(structure: Structure) -> Iterable[tuple[set[int], set[int]]]:
    """Grid points of each rigid element and multi-point constraint, and those they depend on."""
    for element in structure.bulk.rigid_elements.values():
        dependent = set(element.dependent_nodes)
        every = dependent.union(element.independent_nodes)
        # Of others components of any grid point may be dependent.
        one_way = element.type == "RBE2" or (element.type == "RBE3" and not element.Gmi)
        yield (dependent if one_way else every), every
    for constraints in structure.bulk.mpcs.values():
        for item in constraints:
            yield set(item.node_ids[:1]), set(item.node_ids)


def targets(structure: Structure) -> tuple[Target, ...]:
    """Return materials and properties that elements use, then elements with own numbers."""
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
        *_element_targets(structure, owners.elements),
        *_element_targets(structure, owners.masses),
    )


def _numbered(
    structure: Structure, by: TargetKind, family: Cards, sizes: dict[int, int]
) -> Iterator[Target]:
    for number in sorted(family.keys() & sizes.keys()):
        card = family[number][0]
        yield Target(by, (str(number),), card.name, sizes[number], _title(structure, card))


def _element_targets(structure: Structure, family: Cards) -> Iterator[Target]:
    found: dict[str, list[int]] = {}
    for number, cards in sorted(family.items()):
        row = CARDS.get(cards[0].name)
        laws = row.numbers.values() if row else ()
        if any(law.moves and law.powers == (1,) for law in laws):
            found.setdefault(cards[0].name, []).append(number)
    for kind, numbers in found.items():
        if len(numbers) > ALONE:
            yield Target("element", tuple(map(str, numbers)), kind, len(numbers))
            continue
        for number in numbers:
            title = _title(structure, family[number][0])
            yield Target("element", (str(number),), kind, 1, title)


def _title(structure: Structure, card: NastranCard) -> str:
    """What the comment above a card calls it; empty where it has no words.

    A property below the material of its number has the comment of both.
    """
    first, lines = card.lines[0], structure.deck.lines
    own = NUMBERED.match(lines[first].text)
    above = lines[first - 1].text.strip() if first else ""
    other = NUMBERED.match(above)
    if own and other and own.group(1) == other.group(1) and first > 1:
        above = lines[first - 2].text.strip()
    match = TITLE.match(above)
    title = match.group(1).strip() if match else ""
    words = re.search(r"[^\W\d_]{2}", title) and "|" not in title and len(title) <= 40
    return title if words else ""
