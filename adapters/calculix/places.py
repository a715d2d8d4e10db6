"""Where a parameter stands in a CalculiX deck: the fields of data lines that hold its numbers."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass

from modetune.adapters.calculix.constants import constant_places
from modetune.adapters.calculix.deck import (
    COMMENTS,
    KeywordCard,
    canonical_name,
    format_number,
    read_number,
    replace_field,
)
from modetune.adapters.calculix.model import WITHOUT_ENERGY, CalculixModel
from modetune.adapters.deck_numbers import Number, check_moved, check_one, moved_numbers
from modetune.adapters.splitting import OF_MATERIALS
from modetune.core.errors import ModelError
from modetune.core.near_names import suggestion
from modetune.core.parameters import Parameter, Quantity


@dataclass(frozen=True, slots=True)
class KeywordField:
    """One number of the deck that a parameter scales: a field of a data line.

    item: by which a parameter picks it; 0 where there is no choice, -1 where it goes with all only.
    """

    line: int
    place: int
    value: float
    item: int = 0


def find_fields(model: CalculixModel, parameter: Parameter) -> list[KeywordField]:
    """Where the parameter stands. Raises ModelError with the first reason why it does not."""
    if parameter.quantity not in _FINDERS or parameter.by in ("property", "part"):
        raise ModelError(f"a CalculiX deck has no {parameter.quantity} by {parameter.by} to update")
    names = tuple(map(canonical_name, parameter.targets))
    if parameter.quantity in OF_MATERIALS:
        names = find_materials(model, parameter)
    found: list[KeywordField] = []
    for name in names:
        fields = _picked(_FINDERS[parameter.quantity](model, name), name, parameter)
        for first in fields[:1]:
            what = f"{model.deck.lines[first.line].where}: {parameter.quantity} of {name}"
            check_moved(parameter, what, (one.value for one in fields))
        found += fields
    return found


def find_materials(model: CalculixModel, parameter: Parameter) -> tuple[str, ...]:
    """Materials that a parameter names, or those of its elements. Raises ModelError."""
    targets = list(map(canonical_name, parameter.targets))
    if parameter.by == "material":
        return tuple(name for old in targets for name in (old, *model.copies.get(old, ())))
    found: dict[str, None] = {}
    for target in targets:
        elements = model.mesh.named(target)
        if not elements:
            what = "element set" if parameter.by == "elset" else "element"
            raise ModelError(
                f"the deck has no {what} {target}{suggestion(target, model.mesh.element_sets)}"
            )
        sections = [card for card in model.sections if model.members(card) & elements]
        names = [card.option("MATERIAL") for card in sections]
        names += [name for card in sections for name in sorted(model.layers(card))]
        if not any(names):
            raise ModelError(f"no section gives the elements of {target} a material")
        found.update(dict.fromkeys(filter(None, names)))
    return tuple(found)


def find_numbers(model: CalculixModel, parameter: Parameter) -> list[Number]:
    """What the parameter moves. Raises ModelError for why it can be nothing."""
    if parameter.quantity == "variable":
        return []
    lines = model.deck.lines
    return [
        Number((f.line, f.place), f.value, lines[f.line].where, f.item < 0)
        for f in find_fields(model, parameter)
    ]


def edited_lines(
    model: CalculixModel, parameters: Iterable[tuple[Parameter, float]]
) -> dict[int, str]:
    """New texts of the lines that these values change.

    A number that stays what it is changes nothing. Raises ModelError.
    """
    changed: dict[int, str] = {}
    factors: dict[tuple[int, int], float] = {}
    for parameter, value in parameters:
        for number, there in moved_numbers(parameter, find_numbers(model, parameter), value):
            if there != number.value:
                line, place = number.place
                there *= factors.get(number.place, 1.0)  # of a group's stiffness beside others
                factors[number.place] = there / number.value if number.value else 1.0
                text = changed.get(line, model.deck.lines[line].text)
                changed[line] = replace_field(text, place, format_number(there))
    return changed


def energy_sets(model: CalculixModel, parameter: Parameter) -> tuple[str, ...]:
    """Element sets whose strain energy is proportional to the parameter.

    None where sections overlap or a laminate uses the material among others (the energy of
    the set is then not the parameter's own), or where ccx prints no whole energy.
    """
    if parameter.item:
        return ()
    if parameter.quantity == "youngs_modulus":
        users = model.users(set(find_materials(model, parameter)))
        if any("COMPOSITE" in card.options for card in users):
            return ()
        sets = sorted({card.option("ELSET") for card in users})
    elif parameter.quantity == "spring_stiffness":
        targets = map(canonical_name, parameter.targets)
        cards = [card for name in targets for card in _section_cards(model, name, "*SPRING")]
        sets = sorted({card.option("ELSET") for card in cards})
    else:
        return ()
    members = model.mesh.element_sets
    sets = [name for name in sets if members.get(name)]
    kinds = {model.mesh.elements[number].kind for name in sets for number in members[name]}
    if any(WITHOUT_ENERGY.fullmatch(kind) for kind in kinds):
        return ()
    inside = [members[name] for name in sets]
    others = [name for name in model.section_sets() if name not in sets]
    outside = [members.get(name, frozenset()) for name in others]
    union = frozenset[int]().union(*inside)
    alone = len(union) == sum(map(len, inside)) and union.isdisjoint(set().union(*outside))
    return tuple(sets) if alone else ()


def _material_cards(model: CalculixModel, material: str, keyword: str) -> list[KeywordCard]:
    """The cards of one keyword, with data, that belong to a material. Raises ModelError."""
    cards = material_cards(model, material, keyword)
    if not any(card.data for card in cards):
        raise ModelError(f"material {material} has no {keyword} card with data")
    return cards


def material_cards(model: CalculixModel, material: str, keyword: str) -> list[KeywordCard]:
    """The cards of one keyword that belong to a material. Raises ModelError."""
    names = [card.option("NAME") for card in model.deck.named("*MATERIAL")]
    if material not in names:
        raise ModelError(f"the deck has no material {material}{suggestion(material, names)}")
    users = model.users({material})
    if not any(model.mesh.element_sets.get(card.option("ELSET")) for card in users):
        raise ModelError(f"no element uses material {material}")
    inside, cards = False, []
    for card in model.deck.cards:
        if card.keyword == "*MATERIAL":
            inside = card.option("NAME") == material
        elif inside and card.keyword == keyword:
            cards.append(card)
    return cards


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


def of_elastic(quantity: Quantity) -> Callable[[CalculixModel, str], list[KeywordField]]:
    def fields(model: CalculixModel, material: str) -> list[KeywordField]:
        found = []
        for card in _material_cards(model, material, "*ELASTIC"):
            places = constant_places(card, quantity)
            if not places:
                kind = f" of TYPE={card.option('TYPE')}" if card.option("TYPE") else ""
                raise ModelError(
                    f"{model.deck.where(card)}: an *ELASTIC card{kind} has no {quantity}"
                )
            found += [KeywordField(at, p, model.number(at, p), item) for item, at, p in places]
        return found

    return fields


def find_density(model: CalculixModel, material: str) -> list[KeywordField]:
    cards = _material_cards(model, material, "*DENSITY")
    return [KeywordField(line, 0, model.number(line, 0)) for card in cards for line in card.data]


def _section_cards(model: CalculixModel, elset: str, keyword: str) -> list[KeywordCard]:
    """The cards of one keyword for an element set that has elements, or for parts of it.

    Raises ModelError.
    """
    cards = [card for card in model.deck.named(keyword) if card.option("ELSET") == elset]
    if not cards:
        members = model.mesh.named(elset)
        parts = [card for card in model.deck.named(keyword) if model.members(card)]
        cards = [card for card in parts if model.members(card) <= members]
        if cards:
            return cards
        known = [card.option("ELSET") for card in model.deck.named(keyword)]
        raise ModelError(f"the deck has no {keyword} for {elset}{suggestion(elset, known)}")
    if not model.mesh.element_sets.get(elset):
        raise ModelError(f"{model.deck.where(cards[0])}: element set {elset} has no elements")
    return cards


def first_value(model: CalculixModel, card: KeywordCard, row: int) -> KeywordField:
    """The first number of one of a card's data lines. Raises ModelError."""
    if len(card.data) <= row:
        raise ModelError(f"{model.deck.where(card)}: the card has no value")
    return KeywordField(card.data[row], 0, model.number(card.data[row], 0))


def _thickness(model: CalculixModel, elset: str) -> list[KeywordField]:
    found = []
    for card in _section_cards(model, elset, "*SHELL SECTION"):
        if "NODALTHICKNESS" in card.options:
            raise ModelError(
                f"{model.deck.where(card)}: the section of {elset} is NODALTHICKNESS, so it has no "
                "one thickness to update"
            )
        if "COMPOSITE" not in card.options:
            found.append(first_value(model, card, 0))
        for layer, line in enumerate(card.data if "COMPOSITE" in card.options else (), start=1):
            found.append(KeywordField(line, 0, model.number(line, 0), layer))
    return found


def _ply_angle(model: CalculixModel, elset: str) -> list[KeywordField]:
    """Angles of the orientations that a laminate's layers name, by which they are turned."""
    found = []
    for card in _section_cards(model, elset, "*SHELL SECTION"):
        layered = "COMPOSITE" in card.options
        rows = [(model.deck.fields(line), line) for line in card.data] if layered else []
        names = [canonical_name(row[3]) if len(row) > 3 else "" for row, _ in rows]
        for layer, name in enumerate(names or [card.option("ORIENTATION")], start=1):
            for turned in model.deck.named("*ORIENTATION"):
                if name and turned.option("NAME") == name and len(turned.data) > 1:
                    line = turned.data[1]
                    found.append(KeywordField(line, 1, model.number(line, 1), layer))
        shared = {name for name in names if name and names.count(name) > 1}
        others = [other for other in model.sections if other is not card]
        shared |= {name for name in names for other in others if name in model.orientations(other)}
        if shared:
            raise ModelError(
                f"{model.deck.where(card)}: orientation {min(shared)} is that of several layers or "
                "sections, which turn together: give each its own *ORIENTATION"
            )
    if not found:
        raise ModelError(
            f"no layer of {elset} has an *ORIENTATION with an angle (its second line: axis, angle)"
        )
    return found


def _dimension(model: CalculixModel, elset: str) -> list[KeywordField]:
    """Dimensions of cross-sections, on the first line; the second one is their direction."""
    return [
        KeywordField(card.data[0], place, model.number(card.data[0], place), place + 1)
        for card in _section_cards(model, elset, "*BEAM SECTION")
        if card.data
        for place, text in enumerate(model.deck.fields(card.data[0]))
        if text
    ]


def _spring_stiffness(model: CalculixModel, elset: str) -> list[KeywordField]:
    """Constants stand one a line (one a temperature), after the line of directions."""
    found = []
    for card in _section_cards(model, elset, "*SPRING"):
        _check_linear(model, card)
        kinds = {model.mesh.elements[number].kind for number in model.members(card)}
        first = 0 if kinds == {"SPRINGA"} else 1
        if first == 0:
            _check_blank(model, card)
        found += [
            first_value(model, card, row) for row in range(first, max(len(card.data), first + 1))
        ]
    return found


def dashpot_field(model: CalculixModel, card: KeywordCard) -> KeywordField:
    """The constant of a *DASHPOT. Raises ModelError where it has several, by temperature."""
    _check_linear(model, card)
    _check_blank(model, card)
    if len(card.data) > 1:
        raise ModelError(f"{model.deck.where(card)}: a dashpot by temperature has no one constant")
    return first_value(model, card, 0)


def _check_linear(model: CalculixModel, card: KeywordCard) -> None:
    if "NONLINEAR" in card.options:
        what = "spring has no one stiffness" if card.keyword == "*SPRING" else "dashpot no constant"
        raise ModelError(f"{model.deck.where(card)}: a nonlinear {what} to update")


def _check_blank(model: CalculixModel, card: KeywordCard) -> None:
    """SPRINGA and DASHPOTA have no directions, but ccx skips the line after the keyword."""
    if card.data and not _blank_after(model, card):
        kind = "SPRINGA" if card.keyword == "*SPRING" else "DASHPOTA"
        raise ModelError(
            f"{model.deck.where(card)}: ccx requires a blank line before the constant of a {kind}"
        )


def _blank_after(model: CalculixModel, card: KeywordCard) -> bool:
    """Whether the first line after the keyword that is not a comment is blank."""
    texts = (model.deck.lines[position].text.strip() for position in card.lines[1:])
    return next((not text for text in texts if not text.startswith(COMMENTS)), True)


def _dashpots(model: CalculixModel, elset: str) -> list[KeywordField]:
    return [dashpot_field(model, card) for card in _section_cards(model, elset, "*DASHPOT")]


def loss_fields(model: CalculixModel, material: str) -> list[KeywordField]:
    """The loss factor of a material, none where it has no *DAMPING. Raises ModelError."""
    found = []
    for card in material_cards(model, material, "*DAMPING"):
        where, line = model.deck.where(card), card.lines.start
        others = sorted(card.options.keys() - {"STRUCTURAL"})
        if others:
            raise ModelError(
                f"{where}: {others[0]} of *DAMPING is of explicit dynamics and damps no mode here: "
                "give STRUCTURAL, the loss factor, or take the card out"
            )
        fields = [canonical_name(text) for text in model.deck.fields(line)]
        (place,) = (k for k, text in enumerate(fields) if text.startswith("STRUCTURAL="))
        try:
            value = read_number(card.option("STRUCTURAL"))
        except ValueError:
            raise ModelError(f"{where}: STRUCTURAL of *DAMPING is not a number") from None
        found.append(KeywordField(line, place, value))
    if len(found) > 1:
        raise ModelError(f"{model.deck.where(card)}: material {material} has *DAMPING twice")
    return found


def _losses(model: CalculixModel, material: str) -> list[KeywordField]:
    found = loss_fields(model, material)
    if not found:
        raise ModelError(
            f"material {material} has no loss factor: write *DAMPING, STRUCTURAL=value below its "
            "*MATERIAL"
        )
    return found


def _mass(model: CalculixModel, elset: str) -> list[KeywordField]:
    return [first_value(model, card, 0) for card in _section_cards(model, elset, "*MASS")]


_FINDERS: dict[Quantity, Callable[[CalculixModel, str], list[KeywordField]]] = {
    "youngs_modulus": of_elastic("youngs_modulus"),
    "shear_modulus": of_elastic("shear_modulus"),
    "poissons_ratio": of_elastic("poissons_ratio"),
    "density": find_density,
    "thickness": _thickness,
    "ply_angle": _ply_angle,
    "dimension": _dimension,
    "spring_stiffness": _spring_stiffness,
    "mass": _mass,
    "viscous_damping": _dashpots,
    "structural_damping": _losses,
}
