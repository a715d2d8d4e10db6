"""Parts and instances of an assembly: placed nodes, elements, sets and surfaces in one numbering.

An instance is its part's cards and its own, moved by the data lines of *INSTANCE: a translation
first, then a rotation about the axis through two points (a, b) by an angle in degrees. Nodes and
elements of the first instance keep their numbers; each further one, and the assembly last, gets
an offset, a multiple of 1,000. Outside its instance, what is called X there is `INSTANCE.X`.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy.spatial.transform import Rotation

from modetune.adapters.calculix.deck import KeywordCard, KeywordDeck, canonical_name, read_number
from modetune.core.errors import ModelError
from modetune.core.modes import Floats
from modetune.core.near_names import suggestion

#: What the assembly's own names are called in full.
ASSEMBLY = "ASSEMBLY"
#: Offsets of numbers are multiples of it.
STEP = 1_000
#: ccx types of elements with their number of nodes, by the name that the deck has.
TYPES: dict[str, tuple[str, int]] = {
    **{name: (name, int(re.sub(r"\D+", "", name[3:]))) for name in
       ("C3D4", "C3D6", "C3D8", "C3D8R", "C3D8I", "C3D10", "C3D15", "C3D20", "C3D20R")},
    "C3D10M": ("C3D10", 10), "C3D10I": ("C3D10", 10), "C3D10HS": ("C3D10", 10),
    "S3": ("S3", 3), "S3R": ("S3", 3), "S4": ("S4", 4), "S4R": ("S4", 4), "STRI65": ("S6", 6),
    "S8R": ("S8R", 8), "B31": ("B31", 2), "B32": ("B32", 3), "T3D2": ("T3D2", 2),
    "T3D3": ("T3D3", 3), "MASS": ("MASS", 1), "SPRING1": ("SPRING1", 1),
    "SPRING2": ("SPRING2", 2), "SPRINGA": ("SPRINGA", 2), "DASHPOTA": ("DASHPOTA", 2),
    "ROTARYI": ("", 1), "R3D3": ("", 3), "R3D4": ("", 4), "RB3D2": ("", 2),
}  # fmt: skip
#: Elements whose nodes have rotations.
ROTATING = re.compile(r"S\d|S\dR|B3\d")


@dataclass(frozen=True, slots=True)
class Placed:
    """An element in the flat numbering. kind: ccx's type, empty for one that ccx lacks."""

    kind: str
    given: str
    nodes: tuple[int, ...]


@dataclass(slots=True)
class Scope:
    """An instance, or the assembly (no name, no part, not moved), and what is defined in it.

    rotation: (3, 3), shift: (3,), of x = rotation @ x_part + shift. nodes, elements: label to flat
    number. node_sets, element_sets: of flat numbers; both also have the card of each name.
    """

    name: str
    part: str
    cards: list[KeywordCard]
    rotation: Floats = field(default_factory=lambda: np.eye(3))
    shift: Floats = field(default_factory=lambda: np.zeros(3))
    nodes: dict[int, int] = field(default_factory=dict)
    elements: dict[int, int] = field(default_factory=dict)
    node_sets: dict[str, list[int]] = field(default_factory=dict)
    element_sets: dict[str, list[int]] = field(default_factory=dict)

    @property
    def turned(self) -> bool:
        return not np.array_equal(self.rotation, np.eye(3))

    def flat(self, name: str) -> str:
        """What a name of this scope is called in the flat deck."""
        return f"{self.name}.{name}" if self.name else name


@dataclass(slots=True)
class AssemblyMesh:
    """Everything that instances have, in one numbering.

    scopes: by name, the assembly's as "". places: (3,) of each flat node; labels: its name, such as
    `WING-1.12`. elements: by flat number, with the position of the card that has it. others: cards
    of the model itself, materials and steps.
    """

    deck: KeywordDeck
    scopes: dict[str, Scope] = field(default_factory=dict)
    places: dict[int, Floats] = field(default_factory=dict)
    labels: dict[int, str] = field(default_factory=dict)
    elements: dict[int, Placed] = field(default_factory=dict)
    #: The card of each node and each element, to write them under.
    nodes_of: list[tuple[Scope, KeywordCard, list[int]]] = field(default_factory=list)
    elements_of: list[tuple[Scope, KeywordCard, list[int]]] = field(default_factory=list)
    others: list[KeywordCard] = field(default_factory=list)
    #: Nodes that others replace.
    merged: dict[int, int] = field(default_factory=dict)

    def merge(self) -> None:
        """Replace the merged nodes everywhere, by the last one of a chain."""
        if not self.merged:
            return
        last = dict[int, int]()
        for node in self.merged:
            other = node
            while other in self.merged and other not in last.values():
                other = self.merged[other]
                if other == node:  # a ring
                    break
            last[node] = other
        for flat, item in self.elements.items():
            if not last.keys().isdisjoint(item.nodes):
                nodes = tuple(last.get(node, node) for node in item.nodes)
                self.elements[flat] = Placed(item.kind, item.given, nodes)
        for scope in self.scopes.values():
            scope.nodes = {label: last.get(flat, flat) for label, flat in scope.nodes.items()}
            for name, members in scope.node_sets.items():
                scope.node_sets[name] = list(dict.fromkeys(last.get(n, n) for n in members))
        for node, other in last.items():
            if node != other:
                self.labels[other] += f" ({self.labels.pop(node)})"
                del self.places[node]

    def node_set(self, scope: Scope, text: str, where: str) -> list[int]:
        """The flat nodes of a number or a set, as a scope names them. Raises ModelError."""
        return self._found(scope, text, where, lambda s: (s.nodes, s.node_sets), "node")

    def element_set(self, scope: Scope, text: str, where: str) -> list[int]:
        """The flat elements of a number or a set, as a scope names them. Raises ModelError."""
        return self._found(scope, text, where, lambda s: (s.elements, s.element_sets), "element")

    def owner(self, scope: Scope, name: str) -> tuple[Scope, str]:
        """The scope that a name belongs to, and the name there: `WING-1.SKIN` is WING-1's SKIN."""
        for place in [at for at, letter in enumerate(name) if letter == "."]:
            first = name[:place]
            if not scope.name and first and first in self.scopes:
                return self.scopes[first], name[place + 1 :]
            if first == ASSEMBLY:
                return self.scopes[""], name[place + 1 :]
        return scope, name

    def _found(
        self,
        scope: Scope,
        text: str,
        where: str,
        tables: Callable[[Scope], tuple[Mapping[int, int], Mapping[str, list[int]]]],
        what: str,
    ) -> list[int]:
        own, name = self.owner(scope, canonical_name(text))
        numbers, sets = tables(own)
        if name.isdecimal() and len(name) < 12 and int(name) in numbers:
            return [numbers[int(name)]]
        if name in sets:
            return sets[name]
        place = f" of instance {own.name}" if own.name else ""
        kind = what if name.isdecimal() else f"{what} set"
        raise ModelError(f"{where}: no {kind} {name}{place}{suggestion(name, sets)}")


def read_assembly(deck: KeywordDeck) -> AssemblyMesh:
    """Place the instances of a deck. Raises ModelError with file, line and name."""
    mesh = AssemblyMesh(deck)
    _sort_cards(mesh)
    first_node = first_element = 0
    for scope in [*(s for s in mesh.scopes.values() if s.name), mesh.scopes[""]]:
        for card in scope.cards:
            if card.is_one_of("*NODE"):
                _read_nodes(mesh, scope, card, first_node)
        first_node = _next(scope.nodes, first_node)
    for scope in [*(s for s in mesh.scopes.values() if s.name), mesh.scopes[""]]:
        for card in scope.cards:
            if card.is_one_of("*ELEMENT"):
                _read_elements(mesh, scope, card, first_element)
        first_element = _next(scope.elements, first_element)
        for card in scope.cards:
            if card.is_one_of("*NSET", "*ELSET"):
                _read_set(mesh, scope, card)
    return mesh


def _next(numbers: Mapping[int, int], first: int) -> int:
    return -(-max(numbers.values(), default=first) // STEP) * STEP


def _sort_cards(mesh: AssemblyMesh) -> None:
    """Give each card to its part, instance, the assembly or the model."""
    deck, parts = mesh.deck, dict[str, list[KeywordCard]]()
    assembly = Scope("", "", [])
    part: list[KeywordCard] | None = None
    instance: Scope | None = None
    inside = False
    has_parts = bool(deck.named("*PART", "*ASSEMBLY", "*INSTANCE"))
    for card in deck.cards:
        match card.keyword:
            case "*PART":
                part = parts.setdefault(_name(deck, card), [])
            case "*ENDPART":
                part = None
            case "*ASSEMBLY":
                inside = True
            case "*ENDASSEMBLY":
                inside = False
            case "*INSTANCE":
                instance = _instance(deck, card, parts)
                if instance.name in mesh.scopes:
                    raise ModelError(f"{deck.where(card)}: instance {instance.name} is there twice")
                mesh.scopes[instance.name] = instance
            case "*ENDINSTANCE":
                instance = None
            case _:
                mesh_card = card.keyword in OF_MESH and not has_parts
                own = instance.cards if instance else assembly.cards
                held = part if part is not None else own if inside or mesh_card else mesh.others
                held.append(card)
    mesh.scopes[""] = assembly


#: Cards that belong to the mesh where a deck has no parts.
OF_MESH = frozenset(
    "*NODE *ELEMENT *NSET *ELSET *SURFACE *SOLIDSECTION *SHELLSECTION *BEAMSECTION *ORIENTATION "
    "*TRANSFORM *TIE *COUPLING *KINEMATIC *DISTRIBUTING *KINEMATICCOUPLING *MPC *EQUATION "
    "*RIGIDBODY *MASS *ROTARYINERTIA *SPRING *DASHPOT".split()
)  # fmt: skip


def _name(deck: KeywordDeck, card: KeywordCard, option: str = "NAME") -> str:
    if not card.option(option):
        raise ModelError(f"{deck.where(card)}: {card.keyword} needs {option}=")
    return card.option(option)


def _instance(
    deck: KeywordDeck, card: KeywordCard, parts: Mapping[str, list[KeywordCard]]
) -> Scope:
    name, part = _name(deck, card), card.option("PART")
    if "LIBRARY" in card.options:
        raise ModelError(f"{deck.where(card)}: instance {name} comes from another analysis")
    if part and part not in parts:
        text = f"{deck.where(card)}: instance {name} has part {part}, which is not there"
        raise ModelError(text + suggestion(part, parts))
    rows = [_numbers(deck, position) for position in card.data]
    shift, turn = np.zeros(3), np.eye(3)
    if rows:
        shift = np.array([*rows[0], 0.0, 0.0, 0.0][:3])
    if len(rows) > 1:
        if len(rows[1]) != 7:
            where = deck.lines[card.data[1]].where
            raise ModelError(f"{where}: two points and an angle expected, instance {name}")
        start, end, angle = np.array(rows[1][:3]), np.array(rows[1][3:6]), rows[1][6]
        length = float(np.linalg.norm(end - start))
        if not length:
            raise ModelError(f"{deck.lines[card.data[1]].where}: the axis of {name} has no length")
        turn = Rotation.from_rotvec((end - start) / length * math.radians(angle)).as_matrix()
        shift = turn @ (shift - start) + start
    return Scope(name, part, list(parts.get(part, ())), turn, shift)


def _numbers(deck: KeywordDeck, position: int) -> list[float]:
    """The numbers of a data line, 0 where blank. Raises ModelError."""
    fields = deck.fields(position)
    while fields and not fields[-1]:
        fields.pop()
    try:
        return [read_number(text) if text else 0.0 for text in fields]
    except ValueError:
        line = deck.lines[position]
        raise ModelError(f"{line.where}: numbers expected, found {line.text[:60]!r}") from None


def _label(deck: KeywordDeck, position: int, text: str) -> int:
    if not text.isdecimal() or len(text) > 9:
        where = deck.lines[position].where
        raise ModelError(f"{where}: a whole number of up to 9 digits expected, found {text[:40]!r}")
    return int(text)


def _read_nodes(mesh: AssemblyMesh, scope: Scope, card: KeywordCard, first: int) -> None:
    deck = mesh.deck
    refuse_options(deck, card, {"NSET", "INTERNAL"})
    flats = []
    for position in card.data:
        number = deck.fields(position)[0]
        label = _label(deck, position, number)
        place = np.array([*_numbers(deck, position)[1:], 0.0, 0.0, 0.0][:3])
        flat = scope.nodes.setdefault(label, first + label)
        mesh.places[flat] = scope.rotation @ place + scope.shift if scope.name else place
        alone = len(mesh.scopes) == 1
        mesh.labels[flat] = str(label) if alone else f"{scope.name or ASSEMBLY}.{label}"
        flats.append(flat)
    mesh.nodes_of.append((scope, card, list(dict.fromkeys(flats))))
    if card.option("NSET"):
        _add(scope.node_sets, card.option("NSET"), flats)


def _read_elements(mesh: AssemblyMesh, scope: Scope, card: KeywordCard, first: int) -> None:
    deck, given = mesh.deck, card.option("TYPE")
    refuse_options(deck, card, {"TYPE", "ELSET", "INTERNAL"})
    if given not in TYPES:
        text = f"{deck.where(card)}: elements of type {given} have no counterpart in CalculiX"
        raise ModelError(f"{text} ({scope.part or scope.name or 'assembly'})")
    kind, count = TYPES[given]
    flats = list[int]()
    row, start = list[str](), 0
    for position in card.data:
        start = start if row else position
        row += [text for text in deck.fields(position) if text]
        if len(row) > count:
            number, *nodes = row
            where = deck.lines[start].where
            if len(nodes) != count:
                text = f"{where}: element {number} has {len(nodes)} nodes, a {given} has {count}"
                raise ModelError(text)
            label = _label(deck, start, number)
            flat = scope.elements.setdefault(label, first + label)
            found = [mesh.node_set(scope, node, where) for node in nodes]
            if any(len(one) != 1 for one in found):
                raise ModelError(f"{where}: element {number} needs single nodes")
            mesh.elements[flat] = Placed(kind, given, tuple(one[0] for one in found))
            flats.append(flat)
            row = []
    if row:
        text = f"{deck.lines[start].where}: element {row[0]} has {len(row) - 1} nodes, a {given}"
        raise ModelError(f"{text} has {count}")
    mesh.elements_of.append((scope, card, list(dict.fromkeys(flats))))
    if card.option("ELSET"):
        _add(scope.element_sets, card.option("ELSET"), flats)


def _read_set(mesh: AssemblyMesh, scope: Scope, card: KeywordCard) -> None:
    deck, nodal = mesh.deck, card.keyword == "*NSET"
    name = _name(deck, card, card.keyword.removeprefix("*"))
    known = {"NSET", "ELSET", "GENERATE", "INSTANCE", "INTERNAL", "UNSORTED"}
    refuse_options(deck, card, known)
    within = scope
    if card.option("INSTANCE"):
        if card.option("INSTANCE") not in mesh.scopes:
            text = f"{deck.where(card)}: set {name} is of instance {card.option('INSTANCE')}"
            raise ModelError(f"{text}, which is not there")
        within = mesh.scopes[card.option("INSTANCE")]
    numbers, find = (within.nodes, mesh.node_set) if nodal else (within.elements, mesh.element_set)
    members = list[int]()
    if nodal and card.option("ELSET"):
        for element in mesh.element_set(within, card.option("ELSET"), deck.where(card)):
            members += mesh.elements[element].nodes
    for position in card.data:
        fields, where = [text for text in deck.fields(position) if text], deck.lines[position].where
        if "GENERATE" in card.options:
            bounds = [_label(deck, position, text) for text in fields]
            first, last, step = [*bounds, 1][:3] if len(bounds) in (2, 3) else (1, 0, 0)
            if step < 1:
                raise ModelError(f"{where}: GENERATE requires first, last and a step above zero")
            # Not each number of the range need be there, which may be long.
            members += [flat for label, flat in numbers.items()
                        if first <= label <= last and (label - first) % step == 0]  # fmt: skip
        else:
            for text in fields:
                members += find(within, text, where)
    _add(
        scope.node_sets if nodal else scope.element_sets, name, members, "UNSORTED" in card.options
    )


def _add(
    sets: dict[str, list[int]], name: str, members: Iterable[int], unsorted: bool = False
) -> None:
    found = dict.fromkeys([*sets.get(name, ()), *members])
    sets[name] = list(found) if unsorted else sorted(found)


def refuse_options(deck: KeywordDeck, card: KeywordCard, known: set[str]) -> None:
    """Raise ModelError where a card has options beyond these."""
    for option in card.options:
        if option not in known:
            value = card.option(option)
            text = f"{option}={value}" if value else option
            raise ModelError(f"{deck.where(card)}: {card.keyword}, {text} is not translated")


def vectors(deck: KeywordDeck, position: int, count: int) -> Floats:
    """The first numbers of a line as vectors (count, 3). Raises ModelError."""
    numbers = _numbers(deck, position)
    return np.array([*numbers, *[0.0] * (3 * count)][: 3 * count]).reshape(count, 3)


def labelled(members: Sequence[int], labels: Mapping[int, str]) -> str:
    """The first few of these nodes by name."""
    names = [labels.get(node, str(node)) for node in members]
    return ", ".join(names[:3]) + (", ..." if len(names) > 3 else "")
