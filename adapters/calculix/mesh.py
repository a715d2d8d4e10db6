"""The mesh a CalculiX deck holds: nodes, elements, and named sets of elements."""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass

from modetune.adapters.calculix.deck import (
    FIELD_WIDTH,
    KeywordCard,
    KeywordDeck,
    canonical_name,
    check_width,
)
from modetune.core.errors import ModelError

#: Number of nodes of the element types whose name does not end with it.
NODES_OF = {"SPRING1": 1, "SPRING2": 2, "SPRINGA": 2, "MASS": 1, "DASHPOTA": 2, "GAPUNI": 2}
#: Elements by a number, or by the first and the last one.
RANGE = re.compile(r"(\d+)(?:-(\d+))?")


@dataclass(frozen=True, slots=True)
class Element:
    """kind: the type's name (upper case); line: position of its first line in the deck; nodes: in
    the deck's order."""

    kind: str
    line: int
    nodes: tuple[int, ...]


@dataclass(frozen=True, slots=True)
class CalculixMesh:
    """nodes: all of the deck; element_nodes: those that belong to elements, and so carry results.

    elements: by number; element_sets: name to element numbers.
    """

    nodes: frozenset[int]
    element_nodes: frozenset[int]
    elements: dict[int, Element]
    element_sets: dict[str, frozenset[int]]

    def named(self, target: str) -> frozenset[int]:
        """Elements of a set, or of a number or range such as `101-120`; none where none is so."""
        name = canonical_name(target)
        if name in self.element_sets:
            return self.element_sets[name]
        span = RANGE.fullmatch(name)
        if span is None:
            return frozenset()
        first, last = int(span.group(1)), int(span.group(2) or span.group(1))
        return frozenset(number for number in self.elements if first <= number <= last)


def read_mesh(deck: KeywordDeck) -> CalculixMesh:
    """Read nodes, elements and sets of a deck. Raises ModelError with file and line."""
    nodes = set[int]()
    for card in deck.named("*NODE"):
        for position in card.data:
            fields = deck.lines[position].text.split(",")
            nodes.update(_whole(deck, position, fields[:1]))
            if max(map(len, fields)) > FIELD_WIDTH:
                check_width(deck.lines[position], fields)
    sets: dict[str, set[int]] = {}
    elements: dict[int, Element] = {}
    used: set[int] = set()
    for card in deck.named("*ELEMENT"):
        fresh: dict[int, Element] = {}
        kind, is_known = card.option("TYPE"), _nodes_of(card) > 0
        for position, (number, *corners) in _element_rows(deck, card):
            fresh[number] = Element(kind, position, tuple(corners))
            used.update(corners)
            if is_known and not nodes.issuperset(corners):
                lost = next(node for node in corners if node not in nodes)
                where = deck.lines[position].where
                raise ModelError(f"{where}: element {number} has node {lost}, which is not there")
        elements |= fresh  # given twice, the last one counts
        if card.option("ELSET"):
            sets.setdefault(_set_name(deck, card), set()).update(fresh)
    for card in deck.named("*ELSET"):
        sets.setdefault(_set_name(deck, card), set()).update(_set_members(deck, card, sets))
    if not nodes or not elements:
        raise ModelError(f"{deck.file} has {len(nodes)} nodes and {len(elements)} elements")
    frozen = {name: frozenset(members) for name, members in sets.items()}
    return CalculixMesh(frozenset(nodes), frozenset(used & nodes), elements, frozen)


def _set_name(deck: KeywordDeck, card: KeywordCard) -> str:
    if re.search(r"ELSET\s*=\s*\"[^\"]*\s", deck.lines[card.lines.start].text, re.IGNORECASE):
        raise ModelError(f"{deck.where(card)}: element set names with blanks are not supported")
    return card.option("ELSET")


def _nodes_of(card: KeywordCard) -> int:
    """How many nodes an element of the card has, 0 where its type is not known here."""
    kind = card.option("TYPE")
    if kind in NODES_OF:
        return NODES_OF[kind]
    if beam := re.match(r"B[23](\d)", kind):
        return int(beam.group(1)) + 1
    family = re.match(r"(?:C3D|M3D|CPS|CPE|CAX|T2D|T3D|S)(\d+)", kind)
    return int(family.group(1)) if family else 0


def _element_rows(deck: KeywordDeck, card: KeywordCard) -> Iterable[tuple[int, list[int]]]:
    """Position of the first line, and number and nodes of each element of a card.

    As ccx does, lines are read on until an element has its nodes, trailing comma or not. Only
    where the type is not known the comma decides.
    """
    count = _nodes_of(card)
    start, row = 0, list[int]()
    for position in card.data:
        if not row:
            start = position
        fields = deck.lines[position].text.split(",")
        row += _whole(deck, position, fields)
        if len(row) > count if count else fields[-1].strip():
            yield start, row
            row = []
    if row and count:
        raise ModelError(
            f"{deck.lines[start].where}: element {row[0]} has {len(row) - 1} nodes, a "
            f"{card.option('TYPE')} has {count}"
        )
    if row:
        yield start, row


def _set_members(deck: KeywordDeck, card: KeywordCard, sets: dict[str, set[int]]) -> set[int]:
    members: set[int] = set()
    for position in card.data:
        fields = [field for field in deck.fields(position) if field]
        if "GENERATE" in card.options:
            first, last, step = _generated(deck, position, fields)
            members.update(range(first, last + 1, step))
            continue
        for field in fields:
            if field.isdecimal():
                members.add(int(field))
            else:
                members |= sets.get(canonical_name(field), set())
    return members


def _generated(deck: KeywordDeck, position: int, fields: list[str]) -> tuple[int, int, int]:
    numbers = _whole(deck, position, fields)
    if len(numbers) not in (2, 3) or (len(numbers) == 3 and numbers[2] < 1):
        raise ModelError(
            f"{deck.lines[position].where}: GENERATE requires first, last and a step above zero"
        )
    return numbers[0], numbers[1], numbers[2] if len(numbers) == 3 else 1


def _whole(deck: KeywordDeck, position: int, fields: list[str]) -> list[int]:
    try:
        return [*map(int, fields)]
    except ValueError:
        pass  # a field may be blank
    try:
        return [int(field) for field in fields if field and not field.isspace()]
    except ValueError:
        line = deck.lines[position]
        raise ModelError(f"{line.where}: whole numbers expected, found {line.text!r}") from None
