"""What a CalculiX deck says: nodes, element sets, sections, and where parameters stand in it."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from difflib import get_close_matches

from modetune.adapters.calculix.constants import constant_places
from modetune.adapters.calculix.deck import (
    COMMENTS,
    KeywordCard,
    KeywordDeck,
    canonical_name,
    format_number,
    replace_field,
)
from modetune.adapters.calculix.incidence import roles_of
from modetune.adapters.calculix.mesh import CalculixMesh, read_mesh
from modetune.adapters.solver import ModelSummary, Number, check_moved, check_one, moved_numbers
from modetune.adapters.splitting import OF_MATERIALS
from modetune.core.errors import ModelError
from modetune.core.parameters import Parameter, Quantity

SECTIONS = (
    "*SOLID SECTION",
    "*SHELL SECTION",
    "*BEAM SECTION",
    "*MEMBRANE SECTION",
    "*SPRING",
    "*MASS",
    "*DASHPOT",
    "*GAP",
    "*USER SECTION",
)
#: Cards that tie nodes to others: their unknowns are not in the stored matrices.
DEPENDENT = ("*EQUATION", "*RIGID BODY", "*MPC", "*TIE", "*COUPLING", "*DISTRIBUTING COUPLING")

#: Those of them that are not followed to the unknowns they depend on.
NOT_FOLLOWED = (
    "*MPC",
    "*TIE",
    "*COUPLING",
    "*DISTRIBUTING COUPLING",
    "*CYCLIC SYMMETRY MODEL",
    "*PRE-TENSION SECTION",
)

#: Elements whose printed strain energy is zero (SPRINGA, users' own) or lacks the hourglass part.
WITHOUT_ENERGY = re.compile(r"SPRINGA|U.*|C3D8R|(S|M3D|CPS|CPE|CAX)4R")
#: Elements that leave the unknowns of the stored matrices at the nodes of the deck.
UNEXPANDED = re.compile(r"C3D.*|SPRING[12A]")


@dataclass(frozen=True, slots=True)
class KeywordField:
    """One number of the deck that a parameter scales: a field of a data line.

    item: by which a parameter picks it; 0 where there is no choice, -1 where it goes with all only.
    """

    line: int
    place: int
    value: float
    item: int = 0


@dataclass(frozen=True, slots=True, eq=False)
class CalculixModel:
    """A deck understood: its mesh, and where its numbers stand. Each is itself alone.

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
        """Whether all elements and ties are of kinds whose displacements equations tell."""
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

    def point_mass(self, changed: dict[int, str]) -> float:
        """Sum of all *MASS elements, which ccx leaves out of its own total.

        NaN beside user elements, of which ccx prints no mass.
        """
        total = math.nan if self.deck.named("*USER SECTION") else 0.0
        for card in self.deck.named("*MASS"):
            field = _value(self, card, 0)
            text = changed.get(field.line, self.deck.lines[field.line].text)
            elements = self.mesh.element_sets.get(card.option("ELSET"), frozenset())
            total += read_number(text.split(",")[0]) * len(elements)
        return total

    def preload(self) -> str:
        """The first card by which the stiffness depends on a state, with file and line, or empty.

        That is a step before a frequency step with PERTURBATION, which starts from its stresses and
        displacements (without the word ccx takes none of them), or contact. Moduli that depend on
        temperature do not: a parameter scales them all alike.
        """
        frequency, contact = self.deck.named("*FREQUENCY"), self.deck.named("*CONTACT PAIR")
        if frequency:
            first = frequency[0].lines.start
            steps = [step for step in self.deck.named("*STEP") if step.lines.start < first]
            if len(steps) > 1 and "PERTURBATION" in steps[-1].options:
                return f"{self.deck.where(steps[0])}: a step before that of the frequencies"
        return f"{self.deck.where(contact[0])}: contact" if contact else ""

    @property
    def hides_energy(self) -> bool:
        """Whether a mode may have strain energy that ccx does not print."""
        kinds = {element.kind for element in self.mesh.elements.values()}
        return bool(self.preload()) or any(WITHOUT_ENERGY.fullmatch(kind) for kind in kinds)

    def least_thickness(self) -> float:
        """The least thickness of shells and plies, and dimension of beams; infinite without."""
        shells, beams = self.deck.named("*SHELL SECTION"), self.deck.named("*BEAM SECTION")
        layered = [card for card in shells if "COMPOSITE" in card.options]
        fields = [self.deck.fields(position)[0] for card in layered for position in card.data]
        fields += [self.deck.fields(p)[0] for c in shells if c not in layered for p in c.data[:1]]
        fields += [text for c in beams for p in c.data[:1] for text in self.deck.fields(p)]
        found = [math.inf]
        for text in filter(None, fields):
            with suppress(ValueError):  # ccx says what is wrong with it
                found.append(read_number(text))
        return min(value for value in found if value > 0.0)

    def wave_speeds(self) -> dict[str, float]:
        """Root of E, the largest one, over density of each material that has both."""
        speeds = {}
        for card in self.deck.named("*MATERIAL"):
            name = card.option("NAME")
            try:
                moduli, density = _elastic("youngs_modulus")(self, name), _density(self, name)[0]
            except ModelError:
                continue  # not used, or no such card
            modulus = max(field.value for field in moduli)
            if modulus > 0.0 and density.value > 0.0:
                speeds[name] = (modulus / density.value) ** 0.5
        return speeds

    def material_masses(self, sizes: Mapping[int, float]) -> dict[str, float]:
        """About the mass of each material; sizes: length, area or volume of each element."""
        found: dict[str, float] = {}
        for card in self.deck.named("*SOLID SECTION", "*SHELL SECTION", "*BEAM SECTION"):
            members = self.mesh.element_sets.get(card.option("ELSET"), frozenset())
            size = sum(sizes.get(number, 0.0) for number in members)
            rows = [self.deck.fields(position) for position in card.data]
            layers = [(card.option("MATERIAL"), _across(card, rows))]
            if "COMPOSITE" in card.options:
                layers = [(canonical_name(row[2]), _number(row[0])) for row in rows if len(row) > 2]
            for name, across in layers:
                with suppress(ModelError):  # a material that has no density
                    mass = _density(self, name)[0].value * across * size
                    found[name] = found.get(name, 0.0) + mass
        return found

    def fields(self, parameter: Parameter) -> list[KeywordField]:
        """Where the parameter stands. Raises ModelError with the first reason why it does not."""
        if parameter.quantity not in _FINDERS or parameter.by in ("property", "part"):
            raise ModelError(
                f"a CalculiX deck has no {parameter.quantity} by {parameter.by} to update"
            )
        names = tuple(map(canonical_name, parameter.targets))
        if parameter.quantity in OF_MATERIALS:
            names = self.materials(parameter)
        found: list[KeywordField] = []
        for name in names:
            fields = _picked(_FINDERS[parameter.quantity](self, name), name, parameter)
            for first in fields[:1]:
                what = f"{self.deck.lines[first.line].where}: {parameter.quantity} of {name}"
                check_moved(parameter, what, (one.value for one in fields))
            found += fields
        return found

    def materials(self, parameter: Parameter) -> tuple[str, ...]:
        """Materials that a parameter names, or those of its elements. Raises ModelError."""
        targets = list(map(canonical_name, parameter.targets))
        if parameter.by == "material":
            return tuple(name for old in targets for name in (old, *self.copies.get(old, ())))
        found: dict[str, None] = {}
        for target in targets:
            elements = self.mesh.named(target)
            if not elements:
                what = "element set" if parameter.by == "elset" else "element"
                raise ModelError(
                    f"the deck has no {what} {target}{_suggest(target, self.mesh.element_sets)}"
                )
            sections = [card for card in self.sections if self.members(card) & elements]
            names = [card.option("MATERIAL") for card in sections]
            names += [name for card in sections for name in sorted(self.layers(card))]
            if not any(names):
                raise ModelError(f"no section gives the elements of {target} a material")
            found.update(dict.fromkeys(filter(None, names)))
        return tuple(found)

    def members(self, card: KeywordCard) -> frozenset[int]:
        """Elements of a section."""
        return self.mesh.element_sets.get(card.option("ELSET"), frozenset())

    def energy_sets(self, parameter: Parameter) -> tuple[str, ...]:
        """Element sets whose strain energy is proportional to the parameter.

        None where sections overlap or a laminate uses the material among others (the energy of
        the set is then not the parameter's own), or where ccx prints no whole energy.
        """
        if parameter.item:
            return ()
        if parameter.quantity == "youngs_modulus":
            users = self.users(set(self.materials(parameter)))
            if any("COMPOSITE" in card.options for card in users):
                return ()
            sets = sorted({card.option("ELSET") for card in users})
        elif parameter.quantity == "spring_stiffness":
            targets = map(canonical_name, parameter.targets)
            cards = [card for name in targets for card in _section_cards(self, name, "*SPRING")]
            sets = sorted({card.option("ELSET") for card in cards})
        else:
            return ()
        members = self.mesh.element_sets
        sets = [name for name in sets if members.get(name)]
        kinds = {self.mesh.elements[number].kind for name in sets for number in members[name]}
        if any(WITHOUT_ENERGY.fullmatch(kind) for kind in kinds):
            return ()
        inside = [members[name] for name in sets]
        others = [name for name in self.section_sets() if name not in sets]
        outside = [members.get(name, frozenset()) for name in others]
        union = frozenset[int]().union(*inside)
        alone = len(union) == sum(map(len, inside)) and union.isdisjoint(set().union(*outside))
        return tuple(sets) if alone else ()

    def numbers(self, parameter: Parameter) -> list[Number]:
        """What the parameter moves. Raises ModelError for why it can be nothing."""
        if parameter.quantity == "variable":
            return []
        lines = self.deck.lines
        return [
            Number((f.line, f.place), f.value, lines[f.line].where, f.item < 0)
            for f in self.fields(parameter)
        ]

    def edit(self, parameters: Iterable[tuple[Parameter, float]]) -> dict[int, str]:
        """New texts of the lines that these values change.

        A number that stays what it is changes nothing. Raises ModelError.
        """
        changed: dict[int, str] = {}
        for parameter, value in parameters:
            for number, there in moved_numbers(parameter, self.numbers(parameter), value):
                if there != number.value:
                    line, place = number.place
                    text = changed.get(line, self.deck.lines[line].text)
                    changed[line] = replace_field(text, place, format_number(there))
        return changed

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

    def orientations(self, card: KeywordCard) -> set[str]:
        """Orientations that a section and its layers name."""
        rows = [self.deck.fields(line) for line in card.data if "COMPOSITE" in card.options]
        return {card.option("ORIENTATION"), *(canonical_name(r[3]) for r in rows if len(r) > 3)}

    def number(self, line: int, place: int) -> float:
        """A number of the deck. Raises ModelError where there is none."""
        fields = self.deck.fields(line)
        text = fields[place] if place < len(fields) else ""
        try:
            return read_number(text)
        except ValueError:
            where = self.deck.lines[line].where
            raise ModelError(f"{where}: {text!r} is not a number") from None


def understand(deck: KeywordDeck) -> CalculixModel:
    """Read nodes, elements and sets of a deck. Raises ModelError with file and line."""
    return CalculixModel(deck, read_mesh(deck))


def _number(text: str) -> float:
    """A number of a section, 0 where it is none, of which ccx says what is wrong."""
    with suppress(ValueError):
        return read_number(text)
    return 0.0


def _across(card: KeywordCard, rows: list[list[str]]) -> float:
    """What a section's size is multiplied with: thickness, area of a beam or truss, or 1."""
    numbers = [_number(text) for text in rows[0]] if rows else []
    if card.is_one_of("*BEAM SECTION"):
        return math.prod(numbers[:2])
    return numbers[0] if numbers and numbers[0] > 0.0 else 1.0


def read_number(text: str) -> float:
    """A number as ccx reads it: 7.1E4, 7.1d4 and 7.1+4 are one. Raises ValueError."""
    plain = re.sub(r"(?<=[\d.])([+-]\d+)$", r"E\1", text.strip().upper().replace("D", "E"))
    value = float(plain)
    if not math.isfinite(value):
        raise ValueError(f"{text} is not finite")
    return value


def _material_cards(model: CalculixModel, material: str, keyword: str) -> list[KeywordCard]:
    """The cards of one keyword that belong to a material. Raises ModelError."""
    names = [card.option("NAME") for card in model.deck.named("*MATERIAL")]
    if material not in names:
        raise ModelError(f"the deck has no material {material}{_suggest(material, names)}")
    users = model.users({material})
    if not any(model.mesh.element_sets.get(card.option("ELSET")) for card in users):
        raise ModelError(f"no element uses material {material}")
    inside, cards = False, []
    for card in model.deck.cards:
        if card.keyword == "*MATERIAL":
            inside = card.option("NAME") == material
        elif inside and card.keyword == keyword:
            cards.append(card)
    if not any(card.data for card in cards):
        raise ModelError(f"material {material} has no {keyword} card with data")
    return cards


def _suggest(name: str, known: Iterable[str]) -> str:
    names = sorted(set(known))
    close = get_close_matches(name, names, n=1)
    if close:
        return f"; did you mean {close[0]}?"
    return f" (it has {', '.join(names) or 'none'})"


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


def _elastic(quantity: Quantity) -> Callable[[CalculixModel, str], list[KeywordField]]:
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


def _density(model: CalculixModel, material: str) -> list[KeywordField]:
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
        raise ModelError(f"the deck has no {keyword} for {elset}{_suggest(elset, known)}")
    if not model.mesh.element_sets.get(elset):
        raise ModelError(f"{model.deck.where(cards[0])}: element set {elset} has no elements")
    return cards


def _value(model: CalculixModel, card: KeywordCard, row: int) -> KeywordField:
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
            found.append(_value(model, card, 0))
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
    """Constants stand one a line (one a temperature), after the line of directions.

    SPRINGA has no directions, but ccx skips the line after the keyword all the same.
    """
    found = []
    for card in _section_cards(model, elset, "*SPRING"):
        where = model.deck.where(card)
        if "NONLINEAR" in card.options:
            raise ModelError(f"{where}: a nonlinear spring has no one stiffness to update")
        kinds = {model.mesh.elements[number].kind for number in model.members(card)}
        if kinds != {"SPRINGA"}:
            first = 1
        elif card.data and not _blank_after(model, card):
            raise ModelError(f"{where}: ccx requires a blank line before the constant of a SPRINGA")
        else:
            first = 0
        found += [_value(model, card, row) for row in range(first, max(len(card.data), first + 1))]
    return found


def _blank_after(model: CalculixModel, card: KeywordCard) -> bool:
    """Whether the first line after the keyword that is not a comment is blank."""
    texts = (model.deck.lines[position].text.strip() for position in card.lines[1:])
    return next((not text for text in texts if not text.startswith(COMMENTS)), True)


def _mass(model: CalculixModel, elset: str) -> list[KeywordField]:
    return [_value(model, card, 0) for card in _section_cards(model, elset, "*MASS")]


_FINDERS: dict[Quantity, Callable[[CalculixModel, str], list[KeywordField]]] = {
    "youngs_modulus": _elastic("youngs_modulus"),
    "shear_modulus": _elastic("shear_modulus"),
    "poissons_ratio": _elastic("poissons_ratio"),
    "density": _density,
    "thickness": _thickness,
    "ply_angle": _ply_angle,
    "dimension": _dimension,
    "spring_stiffness": _spring_stiffness,
    "mass": _mass,
}
