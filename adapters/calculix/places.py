"""The numbers of a CalculiX deck that a parameter scales: fields of data lines."""

from __future__ import annotations

from collections.abc import Iterable

from modetune.adapters.calculix.cards import Keyword, KeywordField, rows_with
from modetune.adapters.calculix.deck import (
    KeywordCard,
    canonical_name,
    format_number,
    replace_field,
)
from modetune.adapters.calculix.structure import WITHOUT_ENERGY, CalculixStructure
from modetune.adapters.deck_numbers import Number, check_moved, check_one, moved_numbers
from modetune.adapters.splitting import OF_MATERIALS
from modetune.core.errors import ModelError
from modetune.core.near_names import suggestion
from modetune.core.parameters import Parameter, Quantity


def find_fields(structure: CalculixStructure, parameter: Parameter) -> list[KeywordField]:
    """Return the numbers that it scales. Raises ModelError with the first reason for none."""
    if not rows_with(parameter.quantity) or parameter.by in ("property", "part"):
        raise ModelError(f"a CalculiX deck has no {parameter.quantity} by {parameter.by} to update")
    names = tuple(map(canonical_name, parameter.targets))
    if parameter.quantity in OF_MATERIALS:
        names = find_materials(structure, parameter)
    found: list[KeywordField] = []
    for name in names:
        fields = _picked(fields_of(structure, parameter.quantity, name), name, parameter)
        for first in fields[:1]:
            what = f"{structure.deck.lines[first.line].where}: {parameter.quantity} of {name}"
            check_moved(parameter, what, (one.value for one in fields))
        found += fields
    return found


def find_materials(structure: CalculixStructure, parameter: Parameter) -> tuple[str, ...]:
    """Materials that a parameter names, or those of its elements. Raises ModelError."""
    targets = list(map(canonical_name, parameter.targets))
    if parameter.by == "material":
        return tuple(name for old in targets for name in (old, *structure.copies.get(old, ())))
    found: dict[str, None] = {}
    for target in targets:
        elements = structure.mesh.named(target)
        if not elements:
            what = "element set" if parameter.by == "elset" else "element"
            raise ModelError(
                f"the deck has no {what} {target}{suggestion(target, structure.mesh.element_sets)}"
            )
        sections = [card for card in structure.sections if structure.members(card) & elements]
        names = [card.option("MATERIAL") for card in sections]
        names += [name for card in sections for name in sorted(structure.layers(card))]
        if not any(names):
            raise ModelError(f"no section gives the elements of {target} a material")
        found.update(dict.fromkeys(filter(None, names)))
    return tuple(found)


def find_numbers(structure: CalculixStructure, parameter: Parameter) -> list[Number]:
    """Return the numbers that the parameter moves. Raises ModelError with the reason for none."""
    if parameter.quantity == "variable":
        return []
    lines = structure.deck.lines
    return [
        Number((f.line, f.place), f.value, lines[f.line].where, f.item < 0)
        for f in find_fields(structure, parameter)
    ]


def edited_lines(
    structure: CalculixStructure, parameters: Iterable[tuple[Parameter, float]]
) -> dict[int, str]:
    """Return new texts of the lines that these values change.

    A number that stays what it is changes nothing. Raises ModelError.
    """
    changed: dict[int, str] = {}
    factors: dict[tuple[int, int], float] = {}
    for parameter, value in parameters:
        for number, there in moved_numbers(parameter, find_numbers(structure, parameter), value):
            if there != number.value:
                line, place = number.place
                there *= factors.get(number.place, 1.0)  # of a group's stiffness and others
                factors[number.place] = there / number.value if number.value else 1.0
                text = changed.get(line, structure.deck.lines[line].text)
                changed[line] = replace_field(text, place, format_number(there))
    return changed


def energy_sets(structure: CalculixStructure, parameter: Parameter) -> tuple[str, ...]:
    """Return the element sets whose strain energy is proportional to the parameter.

    None where sections overlap or a laminate uses the material among others (the energy of
    the set is then not the parameter's own), or where ccx prints no whole energy.
    """
    if parameter.item:
        return ()
    rows = [row for row in rows_with(parameter.quantity) if row.numbers[parameter.quantity].energy]
    if any(row.owner == "material" for row in rows):
        users = structure.users(set(find_materials(structure, parameter)))
        if any("COMPOSITE" in card.options for card in users):
            return ()
        sets = sorted({card.option("ELSET") for card in users})
    elif rows:
        names = map(canonical_name, parameter.targets)
        cards = [card for name in names for _, card in _cards(structure, parameter.quantity, name)]
        sets = sorted({card.option("ELSET") for card in cards})
    else:
        return ()
    members = structure.mesh.element_sets
    sets = [name for name in sets if members.get(name)]
    kinds = {structure.mesh.elements[number].kind for name in sets for number in members[name]}
    if any(WITHOUT_ENERGY.fullmatch(kind) for kind in kinds):
        return ()
    inside = [members[name] for name in sets]
    others = [name for name in structure.section_sets() if name not in sets]
    outside = [members.get(name, frozenset()) for name in others]
    union = frozenset[int]().union(*inside)
    alone = len(union) == sum(map(len, inside)) and union.isdisjoint(set().union(*outside))
    return tuple(sets) if alone else ()


def fields_of(
    structure: CalculixStructure, quantity: Quantity, name: str, needed: bool = True
) -> list[KeywordField]:
    """Return the numbers of a quantity of a material or an element set.

    Raises ModelError where they are needed and there are none.
    """
    found, rows = list[KeywordField](), rows_with(quantity)
    for row, card in _cards(structure, quantity, name):
        again = bool(found) and row.numbers[quantity].once
        found += numbers_on(structure, row, quantity, card, name)
        if again:
            raise ModelError(
                f"{structure.deck.where(card)}: {row.owner} {name} has {row.name} twice"
            )
    for row in rows:
        if needed and not found and row.numbers[quantity].absent:
            raise ModelError(row.numbers[quantity].absent.format(name=name))
    return found


def numbers_on(
    structure: CalculixStructure, row: Keyword, quantity: Quantity, card: KeywordCard, name: str
) -> list[KeywordField]:
    """Return the numbers of a quantity on one of their cards. Raises ModelError."""
    elements = structure.mesh.elements

    def kinds() -> frozenset[str]:
        return frozenset(elements[number].kind for number in structure.members(card))

    return row.numbers[quantity].find(structure.deck, card, name, kinds)


def _cards(
    structure: CalculixStructure, quantity: Quantity, name: str
) -> list[tuple[Keyword, KeywordCard]]:
    """Return the cards of a material or an element set with a quantity. Raises ModelError."""
    found, refusals = list[tuple[Keyword, KeywordCard]](), list[str]()
    for row in rows_with(quantity):
        cards = _owned(structure, row, name)
        found += [(row, card) for card in cards]
        if row.owner == "elset" and not cards:
            known = [card.option("ELSET") for card in structure.deck.named(row.name)]
            refusals.append(f"the deck has no {row.name} for {name}{suggestion(name, known)}")
        elif not row.numbers[quantity].absent and not any(card.data for card in cards):
            if row.owner == "material":
                refusals.append(f"material {name} has no {row.name} card with data")
    if refusals and not any(card.data for _, card in found):
        raise ModelError(refusals[0])
    return found


def _owned(structure: CalculixStructure, row: Keyword, name: str) -> list[KeywordCard]:
    """Return a row's cards of a material, or of a set or parts of it. Raises ModelError."""
    if row.owner == "material":
        return _of_material(structure, row, name)
    cards = [card for card in structure.deck.named(row.name) if card.option("ELSET") == name]
    if not cards:
        members = structure.mesh.named(name)
        parts = [card for card in structure.deck.named(row.name) if structure.members(card)]
        return [card for card in parts if structure.members(card) <= members]
    if not structure.mesh.element_sets.get(name):
        raise ModelError(f"{structure.deck.where(cards[0])}: element set {name} has no elements")
    return cards


def _of_material(structure: CalculixStructure, row: Keyword, name: str) -> list[KeywordCard]:
    cards = structure.deck.of_material(name)
    if cards is None:
        names = [card.option("NAME") for card in structure.deck.named("*MATERIAL")]
        raise ModelError(f"the deck has no material {name}{suggestion(name, names)}")
    users = structure.users({name})
    if not any(structure.mesh.element_sets.get(card.option("ELSET")) for card in users):
        raise ModelError(f"no element uses material {name}")
    return [card for card in cards if card.is_one_of(row.name)]


def _picked(found: list[KeywordField], name: str, parameter: Parameter) -> list[KeywordField]:
    """The fields that a parameter's item picks, without zeros among others. Raises ModelError."""
    item, quantity = parameter.item, parameter.quantity
    known = sorted({field.item for field in found if field.item > 0})
    if item and item not in known:
        choice = ", ".join(map(str, known)) or "one alone, so leave the item out"
        raise ModelError(f"{name}: no item {item} of {quantity}; it has {choice}")
    if quantity == "dimension" and not item:
        raise ModelError(f"{name}: a cross-section has several dimensions: give the item")
    picked = [field for field in found if field.item == item or not item]
    check_one(parameter, name, [field.item for field in picked])
    whole = parameter.values != "relative"
    return [f for f in picked if f.value or (whole and f.item >= 0)] or picked
