"""What a CalculiX deck says: nodes, element sets, sections, and where parameters stand in it."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from difflib import get_close_matches

from modetune.adapters.calculix.deck import Card, Deck, format_number, replace_field
from modetune.adapters.solver import ModelSummary
from modetune.core.errors import ModelError
from modetune.core.parameters import Parameter, Quantity

SECTIONS = (
    "*SOLID SECTION", "*SHELL SECTION", "*BEAM SECTION", "*MEMBRANE SECTION",
    "*SPRING", "*MASS", "*DASHPOT", "*GAP",
)  # fmt: skip
#: Cards that tie nodes to others: their unknowns are not in the stored matrices.
DEPENDENT = ("*EQUATION", "*RIGID BODY", "*MPC", "*TIE", "*COUPLING", "*DISTRIBUTING COUPLING")


@dataclass(frozen=True, slots=True)
class Field:
    """One number of the deck that a parameter scales: a field of a data line."""

    line: int
    place: int
    value: float


@dataclass(frozen=True, slots=True)
class CalculixModel:
    """A deck understood.

    element_sets: name to element numbers; element_types: number to type (upper case).
    """

    deck: Deck
    nodes: frozenset[int]
    element_sets: dict[str, frozenset[int]]
    element_types: dict[int, str]

    @property
    def summary(self) -> ModelSummary:
        solid = all(kind.startswith("C3D") for kind in self.element_types.values())
        return ModelSummary(
            name=self.deck.file.stem,
            node_ids=self.nodes,
            n_elements=len(self.element_types),
            solid_shapes=solid and not self.deck.named(*DEPENDENT, "*TRANSFORM"),
        )

    @property
    def sections(self) -> list[Card]:
        return self.deck.named(*SECTIONS)

    def section_sets(self) -> tuple[str, ...]:
        """Element sets of all sections: together the whole model."""
        return tuple(dict.fromkeys(card.option("ELSET") for card in self.sections))

    def point_mass(self, changed: dict[int, str]) -> float:
        """Sum of all *MASS elements, which ccx leaves out of its own total."""
        total = 0.0
        for card in self.deck.named("*MASS"):
            text = changed.get(card.data[0], self.deck.lines[card.data[0]].text)
            elements = self.element_sets.get(card.option("ELSET"), frozenset())
            total += float(text.split(",")[0]) * len(elements)
        return total

    def wave_speeds(self) -> dict[str, float]:
        """Root of E over density of each isotropic material that has both."""
        speeds = {}
        for card in self.deck.named("*MATERIAL"):
            name = card.option("NAME")
            try:
                modulus, density = _youngs_modulus(self, name)[0], _density(self, name)[0]
            except ModelError:
                continue  # not used, or no such card
            if modulus.value > 0.0 and density.value > 0.0:
                speeds[name] = (modulus.value / density.value) ** 0.5
        return speeds

    def fields(self, parameter: Parameter) -> list[Field]:
        """Where the parameter stands. Raises ModelError with the first reason why it does not."""
        found: list[Field] = []
        for target in parameter.targets:
            found += _FINDERS[parameter.quantity](self, target.upper())
        return found

    def energy_sets(self, parameter: Parameter) -> tuple[str, ...]:
        """Element sets whose strain energy is proportional to the parameter."""
        names = {target.upper() for target in parameter.targets}
        if parameter.quantity == "youngs_modulus":
            return tuple(card.option("ELSET") for card in self._users(names))
        if parameter.quantity == "spring_stiffness":
            return tuple(sorted(names))
        return ()

    def edit(self, parameters: Iterable[tuple[Parameter, float]]) -> dict[int, str]:
        """New texts of the lines that these relative values change.

        A value of exactly 1 changes nothing. Raises ModelError.
        """
        changed: dict[int, str] = {}
        for parameter, factor in parameters:
            if factor == 1.0:
                continue
            for field in self.fields(parameter):
                text = changed.get(field.line, self.deck.lines[field.line].text)
                changed[field.line] = replace_field(
                    text, field.place, format_number(field.value * factor)
                )
        return changed

    def _users(self, materials: set[str]) -> list[Card]:
        return [card for card in self.sections if card.option("MATERIAL") in materials]

    def number(self, line: int, place: int) -> float:
        """A number of the deck. Raises ModelError where there is none."""
        fields = self.deck.fields(line)
        text = fields[place] if place < len(fields) else ""
        try:
            return float(text.upper().replace("D", "E"))
        except ValueError:
            where = self.deck.lines[line].where
            raise ModelError(f"{where}: {text!r} is not a number") from None


def understand(deck: Deck) -> CalculixModel:
    """Read nodes, elements and sets of a deck. Raises ModelError with file and line."""
    nodes: set[int] = set()
    sets: dict[str, set[int]] = {}
    types: dict[int, str] = {}
    for card in deck.named("*NODE"):
        nodes.update(_integers(deck, card, lambda row: row[:1]))
    for card in deck.named("*ELEMENT"):
        numbers = _integers(deck, card, lambda row: row[:1])
        types.update(dict.fromkeys(numbers, card.option("TYPE")))
        if card.option("ELSET"):
            sets.setdefault(card.option("ELSET"), set()).update(numbers)
    for card in deck.named("*ELSET"):
        sets.setdefault(card.option("ELSET"), set()).update(_set_members(deck, card, sets))
    if not nodes or not types:
        raise ModelError(f"{deck.file} has {len(nodes)} nodes and {len(types)} elements")
    frozen = {name: frozenset(members) for name, members in sets.items()}
    return CalculixModel(deck, frozenset(nodes), frozen, types)


def _set_members(deck: Deck, card: Card, sets: dict[str, set[int]]) -> set[int]:
    members: set[int] = set()
    if "GENERATE" in card.options:
        for position in card.data:
            first, last, *step = _whole(deck, position, deck.fields(position))
            members.update(range(first, last + 1, step[0] if step else 1))
        return members
    for position in card.data:
        fields = [field for field in deck.fields(position) if field]
        members.update(*(sets.get(f.upper(), set()) for f in fields if not f.lstrip("-").isdigit()))
        members.update(int(field) for field in fields if field.lstrip("-").isdigit())
    return members


def _integers(deck: Deck, card: Card, pick: Callable[[list[str]], list[str]]) -> list[int]:
    """The picked integers of each row of a card, continued lines joined."""
    numbers: list[int] = []
    row: list[str] = []
    for position in card.data:
        fields = deck.fields(position)
        fresh = not row
        if fields[-1] == "" and card.keyword == "*ELEMENT":
            row += fields[:-1]
        else:
            row = []
        if fresh:
            numbers += _whole(deck, position, pick(fields))
    return numbers


def _whole(deck: Deck, position: int, fields: list[str]) -> list[int]:
    try:
        return [int(field) for field in fields if field]
    except ValueError:
        line = deck.lines[position]
        raise ModelError(f"{line.where}: whole numbers expected, found {line.text!r}") from None


def _material_cards(model: CalculixModel, material: str, keyword: str) -> list[Card]:
    """The cards of one keyword that belong to a material. Raises ModelError."""
    names = [card.option("NAME") for card in model.deck.named("*MATERIAL")]
    if material not in names:
        raise ModelError(f"the deck has no material {material}{_suggest(material, names)}")
    users = model._users({material})
    if not any(model.element_sets.get(card.option("ELSET")) for card in users):
        raise ModelError(f"no element uses material {material}")
    inside, cards = False, []
    for card in model.deck.cards:
        if card.keyword == "*MATERIAL":
            inside = card.option("NAME") == material
        elif inside and card.keyword == keyword:
            cards.append(card)
    if not cards:
        raise ModelError(f"material {material} has no {keyword} card")
    return cards


def _suggest(name: str, known: Iterable[str]) -> str:
    names = sorted(set(known))
    close = get_close_matches(name, names, n=1)
    if close:
        return f"; did you mean {close[0]}?"
    return f" (it has {', '.join(names) or 'none'})"


def _elastic(model: CalculixModel, material: str, place: int) -> list[Field]:
    found = []
    for card in _material_cards(model, material, "*ELASTIC"):
        if card.option("TYPE") not in ("", "ISO", "ISOTROPIC"):
            raise ModelError(
                f"{model.deck.where(card)}: material {material} is not isotropic; only isotropic "
                "*ELASTIC cards can be updated"
            )
        found += [Field(line, place, model.number(line, place)) for line in card.data]
    return found


def _youngs_modulus(model: CalculixModel, material: str) -> list[Field]:
    return _elastic(model, material, 0)


def _poissons_ratio(model: CalculixModel, material: str) -> list[Field]:
    return _elastic(model, material, 1)


def _density(model: CalculixModel, material: str) -> list[Field]:
    cards = _material_cards(model, material, "*DENSITY")
    return [Field(line, 0, model.number(line, 0)) for card in cards for line in card.data]


def _section(model: CalculixModel, elset: str, keyword: str, line: int) -> list[Field]:
    cards = [card for card in model.deck.named(keyword) if card.option("ELSET") == elset]
    if not cards:
        known = [card.option("ELSET") for card in model.deck.named(keyword)]
        raise ModelError(f"the deck has no {keyword} for {elset}{_suggest(elset, known)}")
    if not model.element_sets.get(elset):
        raise ModelError(f"element set {elset} has no elements")
    if len(cards[0].data) < 1:
        raise ModelError(f"{model.deck.where(cards[0])}: {keyword} without a value")
    position = cards[0].data[line]
    return [Field(position, 0, model.number(position, 0))]


def _thickness(model: CalculixModel, elset: str) -> list[Field]:
    for card in model.deck.named("*SHELL SECTION"):
        if card.option("ELSET") == elset and "COMPOSITE" in card.options:
            raise ModelError(f"{model.deck.where(card)}: composite shells have no one thickness")
    return _section(model, elset, "*SHELL SECTION", 0)


def _spring_stiffness(model: CalculixModel, elset: str) -> list[Field]:
    # The directions (a line that may be blank) come first, the constant is on the last line.
    return _section(model, elset, "*SPRING", -1)


def _mass(model: CalculixModel, elset: str) -> list[Field]:
    return _section(model, elset, "*MASS", 0)


_FINDERS: dict[Quantity, Callable[[CalculixModel, str], list[Field]]] = {
    "youngs_modulus": _youngs_modulus,
    "poissons_ratio": _poissons_ratio,
    "density": _density,
    "thickness": _thickness,
    "spring_stiffness": _spring_stiffness,
    "mass": _mass,
}
