"""Who uses what in a Nastran model: materials by properties, properties by elements."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property

from modetune.adapters.nastran.bulk import Bulk, Cards, Owners
from modetune.adapters.nastran.deck import NastranDeck
from modetune.adapters.nastran.fields import CardField, NastranCard, blank_field
from modetune.core.errors import ModelError
from modetune.core.near_names import suggestion

#: A range of element numbers in a campaign.
RANGE = re.compile(r"(\d+)\s*-\s*(\d+)")
#: pyNastran's names for a property's materials.
MATERIALS = ("mid", "mid1", "mid2", "mid3", "mid4")


@dataclass(frozen=True, slots=True)
class Copies:
    """Cards that were added for elements of parameters (`splitting.py`).

    properties, materials: numbers of the copies of each; said: a sentence for each change.
    """

    properties: Mapping[int, Sequence[int]] = field(default_factory=dict)
    materials: Mapping[int, Sequence[int]] = field(default_factory=dict)
    said: tuple[str, ...] = ()

    def with_(self, other: Copies) -> Copies:
        """These and others."""
        properties = {**self.properties, **other.properties}
        return Copies(properties, {**self.materials, **other.materials}, self.said + other.said)


@dataclass(frozen=True)
class Structure:
    """A deck, what its cards mean, and the cards by number."""

    deck: NastranDeck
    bulk: Bulk
    owners: Owners
    copies: Copies = Copies()

    @cached_property
    def elements_of(self) -> dict[int, frozenset[int]]:
        """Elements of each property that has any."""
        found: dict[int, set[int]] = {}
        for number, element in self.bulk.elements.items():
            property_id = getattr(element, "pid", None)
            # Elements without a property have none, 0, or a negative number.
            if isinstance(property_id, int) and property_id in self.bulk.properties:
                found.setdefault(property_id, set()).add(number)
        return {number: frozenset(elements) for number, elements in found.items()}

    @cached_property
    def materials_of(self) -> dict[int, frozenset[int]]:
        """Materials of each property that elements use."""
        return {number: self._materials(number) for number in self.elements_of}

    @cached_property
    def rods_of(self) -> dict[int, frozenset[int]]:
        """CONROD elements of each material: they name it without a property."""
        found: dict[int, set[int]] = {}
        for number, element in self.bulk.elements.items():
            if element.type == "CONROD":
                found.setdefault(element.mid, set()).add(number)
        return {number: frozenset(elements) for number, elements in found.items()}

    def _materials(self, number: int) -> frozenset[int]:
        item = self.bulk.properties[number]
        named = [getattr(item, name, None) for name in MATERIALS]
        layers = list(getattr(item, "mids", None) or [])
        # PSHELL's MID2 = -1 means plane strain, 0 and None mean no material.
        return frozenset(mid for mid in [*named, *layers] if isinstance(mid, int) and mid > 0)

    def field(self, card: NastranCard, number: int) -> CardField:
        """A field of a card, blank or not. Raises ModelError where the card has no such line."""
        found = card.fields[number] if number < len(card.fields) else None
        if found is None:
            found = blank_field(self.deck.lines, card, number)
        if found is None:
            raise ModelError(
                f"{self.deck.where(card)}: field {number + 1} of {card.name} {card.text(1)} is in "
                "a line that the card does not have: write it out"
            )
        return found

    def material(self, target: str) -> NastranCard:
        """The card of a material that elements use. Raises ModelError."""
        number, card = self._card("material", self.owners.materials, target)
        if number not in self.rods_of and not any(
            number in materials for materials in self.materials_of.values()
        ):
            raise ModelError(f"{self.deck.where(card)}: no element uses material {number}")
        return card

    def property_card(self, target: str) -> NastranCard:
        """The card of a property that elements use. Raises ModelError."""
        number, card = self._card("property", self.owners.properties, target)
        if number not in self.elements_of:
            raise ModelError(f"{self.deck.where(card)}: no element uses {card.name} {number}")
        return card

    def materials(self, target: str) -> list[tuple[int, NastranCard]]:
        """A material that elements use and its copies, by number. Raises ModelError."""
        first = self.material(target)
        others = self.copies.materials.get(int(target), ())
        return [(int(target), first), *((ident, self.material(str(ident))) for ident in others)]

    def properties(self, target: str) -> list[tuple[int, NastranCard]]:
        """A property that elements use and its copies, by number. Raises ModelError."""
        first = self.property_card(target)
        others = self.copies.properties.get(int(target), ())
        return [(int(target), first), *((i, self.property_card(str(i))) for i in others)]

    def element(self, family: Cards, number: int) -> NastranCard:
        """The card of an element. Raises ModelError."""
        return self._card("element", family, str(number))[1]

    def element_numbers(self, family: Cards, targets: Iterable[str]) -> tuple[int, ...]:
        """Element numbers that targets like `101-120` and `130` name. Raises ModelError."""
        found: list[int] = []
        for target in targets:
            span = RANGE.fullmatch(target.strip())
            if span is None:
                found.append(self._number("element", family, target))
                continue
            first, last = int(span.group(1)), int(span.group(2))
            inside = sorted(number for number in family if first <= number <= last)
            if not inside:
                raise ModelError(
                    f"the deck has no such element in {target}{suggestion('', map(str, family))}"
                )
            found += inside
        return tuple(dict.fromkeys(found))

    def properties_of(self, elements: Iterable[int]) -> tuple[int, ...]:
        """Properties that these elements and no others use. Raises ModelError."""
        wanted = frozenset(elements)
        found: list[int] = []
        for number in sorted(wanted):
            property_id = getattr(self.bulk.elements[number], "pid", None)
            if property_id not in self.elements_of:
                card = self.owners.elements[number][0]
                raise ModelError(f"{self.deck.where(card)}: {card.name} {number} has no property")
            found.append(property_id)
        for property_id in dict.fromkeys(found):
            others = self.elements_of[property_id] - wanted
            if others:
                card = self.owners.properties[property_id][0]
                raise ModelError(
                    f"{self.deck.where(card)}: {card.name} {property_id} is used by {len(others)} "
                    f"other elements too (such as {min(others)}); give the elements a property of "
                    "their own, or name the property"
                )
        return tuple(dict.fromkeys(found))

    def _number(self, what: str, family: Cards, target: str) -> int:
        text = target.strip()
        if text.isdecimal() and int(text) in family:
            return int(text)
        raise ModelError(f"the deck has no such {what} {text}{suggestion(text, map(str, family))}")

    def _card(self, what: str, family: Cards, target: str) -> tuple[int, NastranCard]:
        number = self._number(what, family, target)
        cards = family[number]
        if len(cards) > 1:
            places = " and ".join(self.deck.where(card) for card in cards)
            raise ModelError(f"{places}: {what} {number} is there more than once")
        return number, cards[0]
