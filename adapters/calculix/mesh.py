"""The mesh of a CalculiX deck: nodes, elements, named sets, and the roles of nodes in elements.

ccx numbers the nodes of an element in a deck as VTK does (corners, then midside nodes round one
face, round the other, and between the two), except for beams and trusses of three nodes, whose
middle one is second. Its .frd files have another order, which does not matter here.

ccx expands shells and beams to solids: a node of the deck becomes several on the element's
normal, or a knot (a rigid body) where elements of different normals or thickness meet. What a node
is in its elements decides how many there are.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np

from modetune.adapters.calculix.deck import (
    FIELD_WIDTH,
    LARGEST_VALUE,
    KeywordCard,
    KeywordDeck,
    canonical_name,
    check_width,
    read_number,
)
from modetune.core.errors import ModelError
from modetune.core.mesh import NODES, CellKind, Cells, Mesh

#: Number of nodes of the element types whose name does not end with it.
NODES_OF = {"SPRING1": 1, "SPRING2": 2, "SPRINGA": 2, "MASS": 1, "DASHPOTA": 2, "GAPUNI": 2}
#: Elements by a number, or by the first and the last one.
RANGE = re.compile(r"(\d+)(?:-(\d+))?")


#: solid and point (springs, masses, dashpots): the node's own three translations. Of shells and
#: beams linear, and quadratic with their corners or ends and their middle nodes.
Role = Literal[
    "solid", "point", "shell", "shell corner", "shell middle", "beam", "beam end", "beam middle",
    "other",
]  # fmt: skip
#: Types of elements with the roles of their nodes; the last one holds for all further nodes.
ROLES: tuple[tuple[re.Pattern[str], tuple[Role, ...]], ...] = (
    (re.compile(r"C3D(4|6|8[IR]?|10T?|15|20R?)"), ("solid",)),
    (re.compile(r"SPRING[12A]|MASS|DASHPOTA"), ("point",)),
    (re.compile(r"S3|S4R?"), ("shell",)),
    (re.compile(r"S6"), (*(("shell corner",) * 3), "shell middle")),
    (re.compile(r"S8R?"), (*(("shell corner",) * 4), "shell middle")),
    (re.compile(r"B31R?"), ("beam",)),
    (re.compile(r"B32R?"), ("beam end", "beam middle", "beam end")),
)
#: Roles whose nodes lie on a shell or a beam.
EXPANDED: frozenset[Role] = frozenset(
    {"shell", "shell corner", "shell middle", "beam", "beam end", "beam middle"}
)


#: The largest number of a node or an element: ccx has integers of 32 bits.
LARGEST = 2**31 - 1


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

    def nodes_of(self, elements: Iterable[int]) -> frozenset[int]:
        """Return all nodes of these elements."""
        return frozenset[int]().union(*(self.elements[number].nodes for number in elements))

    def roles(self, nodes: Collection[int]) -> dict[int, set[Role]]:
        """Return what each of these nodes is in its elements, nothing where it belongs to none."""
        found: dict[int, set[Role]] = {node: set() for node in nodes}
        by_kind: dict[str, tuple[Role, ...]] = {}
        for element in self.elements.values():
            if element.kind not in by_kind:
                by_kind[element.kind] = roles_of(element.kind)
            roles = by_kind[element.kind]
            for place, node in enumerate(element.nodes):
                if node in found:
                    found[node].add(roles[min(place, len(roles) - 1)])
        return found


def read_mesh(deck: KeywordDeck) -> CalculixMesh:
    """Read nodes, elements and sets of a deck. Raises ModelError with file and line."""
    nodes = dict[int, int]()  # by number, the position of its line
    for card in deck.named("*NODE"):
        for position in card.data:
            fields = deck.lines[position].text.split(",")
            for node in _whole(deck, position, fields[:1]):
                first = nodes.setdefault(node, position)
                if first != position:
                    _check_repeated(deck, node, first, position)
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
            if is_known and not nodes.keys() >= set(corners):
                lost = next(node for node in corners if node not in nodes)
                where = deck.lines[position].where
                raise ModelError(f"{where}: element {number} has node {lost}, which is not there")
        elements |= fresh  # given twice, the last one counts
        if card.option("ELSET"):
            sets.setdefault(_set_name(deck, card), set()).update(fresh)
    for card in deck.named("*ELSET"):
        members = _set_members(deck, card, sets, elements.keys())
        sets.setdefault(_set_name(deck, card), set()).update(members)
    if not nodes or not elements:
        what = "*NODE" if not nodes else "*ELEMENT"
        where = next((deck.where(card) for card in deck.named(what)), f"{deck.file}, line 1")
        text = f"the deck has {len(nodes)} nodes and {len(elements)} elements"
        raise ModelError(f"{where}: {text}: {what} with data lines is expected")
    largest = max(max(numbers, default=0) for numbers in (nodes, elements, used))
    if largest > LARGEST:
        where = next(line.where for line in deck.lines if str(largest) in line.text)
        raise ModelError(f"{where}: the number {largest} is larger than {LARGEST}, the largest one")
    frozen = {name: frozenset(members) for name, members in sets.items()}
    return CalculixMesh(frozenset(nodes), frozenset(used & nodes.keys()), elements, frozen)


def _check_repeated(deck: KeywordDeck, node: int, first: int, again: int) -> None:
    """Raise ModelError if two lines put a node at different places, of which ccx takes the last."""
    lines = deck.lines[first], deck.lines[again]
    try:
        one, other = (
            [_number(field) for field in f"{line.text},,,".split(",")[1:4]] for line in lines
        )
    except ValueError:
        return  # `read_places` says what is wrong
    if one != other:
        raise ModelError(
            f"{lines[0].where} and {lines[1].where}: node {node} is there twice, "
            "at different places"
        )


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


def _set_members(
    deck: KeywordDeck, card: KeywordCard, sets: dict[str, set[int]], known: Collection[int]
) -> set[int]:
    members: set[int] = set()
    for position in card.data:
        fields = [field for field in deck.fields(position) if field]
        if "GENERATE" in card.options:
            members.update(generated(deck, position, fields, known))
            continue
        for field in fields:
            if field.isdecimal():
                members.add(int(field))
            else:
                members |= sets.get(canonical_name(field), set())
    return members


def generated(
    deck: KeywordDeck, position: int, fields: list[str], known: Collection[int]
) -> Iterable[int]:
    """Return the numbers of a line of a set by GENERATE, of a long range those that are known.

    Raises ModelError.
    """
    numbers = _whole(deck, position, fields)
    if len(numbers) not in (2, 3) or (len(numbers) == 3 and numbers[2] < 1):
        raise ModelError(
            f"{deck.lines[position].where}: GENERATE requires first, last and a step above zero"
        )
    span = range(numbers[0], numbers[1] + 1, numbers[2] if len(numbers) == 3 else 1)
    # A range may have no end, and so be longer than memory.
    return span if len(span) <= len(known) else (number for number in known if number in span)


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


#: Element families by what they are drawn as, with their nodes that count; first match wins.
SOLIDS: dict[str, CellKind] = {
    "4": "tetra", "6": "wedge", "8": "hexahedron", "10": "tetra10", "15": "wedge15",
    "20": "hexahedron20",
}  # fmt: skip
SURFACES: dict[str, CellKind] = {"3": "triangle", "4": "quad", "6": "triangle6", "8": "quad8"}
LINES: dict[str, CellKind] = {"1": "line", "2": "line3"}
TRUSSES: dict[str, CellKind] = {"2": "line", "3": "line3"}
#: US3 and S3 alike are shells; plane and axisymmetric elements lie in their plane as shells do.
FAMILIES: tuple[tuple[re.Pattern[str], Mapping[str, CellKind]], ...] = (
    (re.compile(r"C3D(\d+)"), SOLIDS),
    (re.compile(r"(?:U?S|M3D|CPS|CPE|CAX)(\d+)"), SURFACES),
    (re.compile(r"B[23](\d)"), LINES),
    (re.compile(r"T[23]D(\d)"), TRUSSES),
)
OTHERS: dict[str, CellKind] = {
    "SPRINGA": "line", "SPRING2": "line", "DASHPOTA": "line", "GAPUNI": "line",
    "SPRING1": "vertex", "MASS": "vertex", "DCOUP3D": "vertex",
}  # fmt: skip
#: The middle node of these is second in a deck, third in VTK.
MIDDLE_SECOND: tuple[CellKind, ...] = ("line3",)


def cell_kind(element_type: str) -> CellKind | None:
    """What an element type (upper case) is drawn as; None for those that have no shape here."""
    if element_type in OTHERS:
        return OTHERS[element_type]
    for family, kinds in FAMILIES:
        if found := family.match(element_type):
            return kinds.get(found.group(1))
    return None


def read_geometry(deck: KeywordDeck, mesh: CalculixMesh, result_nodes: frozenset[int]) -> Mesh:
    """Nodes that belong to elements or carry results, and the elements between them.

    Elements of types without a shape (fluid networks, user elements) are left out, their nodes
    stay. No node has axes of its own: results are printed in global axes (GLOBAL=YES), whatever
    *TRANSFORM says. Raises ModelError with file and line.
    """
    places = read_places(deck)
    kinds = {name: cell_kind(name) for name in {item.kind for item in mesh.elements.values()}}
    blocks: dict[CellKind, list[tuple[int, ...]]] = {}
    used = set(result_nodes)
    for number, element in mesh.elements.items():
        there = [node for node in element.nodes if node in places]
        used.update(there)
        kind = kinds[element.kind]
        if kind and len(there) == len(element.nodes) == NODES[kind]:
            blocks.setdefault(kind, []).append((number, *element.nodes))
    numbers = np.array(sorted(used), dtype=np.int64)
    return Mesh(
        nodes=numbers,
        coordinates=np.array([places[node] for node in numbers.tolist()]).reshape(-1, 3),
        cells=tuple(_cells(kind, blocks[kind]) for kind in sorted(blocks)),
    )


def _cells(kind: CellKind, rows: list[tuple[int, ...]]) -> Cells:
    table = np.array(rows, dtype=np.int64)
    nodes = table[:, 1:]
    if kind in MIDDLE_SECOND:
        nodes = nodes[:, [0, 2, 1]]
    return Cells(kind, table[:, 0], nodes)


def read_places(deck: KeywordDeck) -> dict[int, tuple[float, float, float]]:
    """Coordinates of all nodes.

    ccx knows one way to give them, x, y, z in global axes: other programs' SYSTEM option it skips
    with a warning, and so does this. A blank coordinate is zero.
    """
    places = {}
    for card in deck.named("*NODE"):
        for position in card.data:
            number, x, y, z = [*deck.lines[position].text.split(","), "", "", ""][:4]
            try:
                places[int(number)] = _number(x), _number(y), _number(z)
            except ValueError:
                line = deck.lines[position]
                raise ModelError(
                    f"{line.where}: a node's number and coordinates expected, found {line.text!r}"
                ) from None
    return places


def _number(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        return read_number(text) if text.strip() else 0.0
    if not abs(value) < LARGEST_VALUE:
        raise ValueError(f"{text} is not finite")
    return value


def roles_of(kind: str) -> tuple[Role, ...]:
    """Roles of an element type's nodes, `other` for types that are not followed."""
    return next((roles for pattern, roles in ROLES if pattern.fullmatch(kind)), ("other",))
