"""Ties, couplings, rigid bodies, MPCs and equations of an assembly as CalculiX equations.

With r the vector from the reference point to a node, a kinematic coupling, a rigid body and a BEAM
MPC are u = u_ref + theta x r, to first order, of the components that they tie. The rotation theta
of a point that belongs to no shell or beam is the displacement of a node made for it, as that of
ccx's ROT NODE is. A distributing coupling is the weighted rigid motion that fits the nodes best:
with G_i the motion of node i under a rigid motion of the reference point (u_ref, theta) = (sum w_i
G_i' G_i)^-1 sum w_i G_i' u_i. Nodes at one place
that a TIE MPC makes equal become one node.

ccx gives a node of shells or beams rotations of its own only where elements of several directions
meet; elsewhere it ignores them in an equation without a word. So a node whose rotations are tied
gets a stub, a beam of no weight, that makes it such a place.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from modetune.adapters.abaqus.instances import (
    ROTATING,
    AssemblyMesh,
    Scope,
    labelled,
    refuse_options,
)
from modetune.adapters.calculix.deck import KeywordCard, canonical_name, format_number, read_number
from modetune.core.errors import ModelError
from modetune.core.modes import Floats

#: A node and a component, 1..3: what ccx has of a node.
Term = tuple[int, int, float]
#: ccx reads four terms of an equation on a line.
TERMS = 4
#: Factors below this, of an arm in the model's size, are rounding of a rotated instance.
ROUNDING = 1e-12
#: Nodes of each face of an element whose corners are all of its nodes.
FACES: dict[str, tuple[tuple[int, ...], ...]] = {
    "C3D4": ((0, 1, 2), (0, 3, 1), (1, 3, 2), (2, 3, 0)),
    "C3D6": ((0, 1, 2), (3, 5, 4), (0, 3, 4, 1), (1, 4, 5, 2), (2, 5, 3, 0)),
    "C3D8": ((0, 1, 2, 3), (4, 7, 6, 5), (0, 4, 5, 1), (1, 5, 6, 2), (2, 6, 7, 3), (3, 7, 4, 0)),
    "C3D10": ((0, 1, 2, 4, 5, 6), (0, 3, 1, 7, 8, 4), (1, 3, 2, 8, 9, 5), (2, 3, 0, 9, 7, 6)),
    "C3D20": ((0, 1, 2, 3, 8, 9, 10, 11), (4, 7, 6, 5, 15, 14, 13, 12),
              (0, 4, 5, 1, 16, 12, 17, 8), (1, 5, 6, 2, 17, 13, 18, 9),
              (2, 6, 7, 3, 18, 14, 19, 10), (3, 7, 4, 0, 19, 15, 16, 11)),
    "C3D15": ((0, 1, 2, 6, 7, 8), (3, 5, 4, 11, 10, 9), (0, 3, 4, 1, 12, 9, 13, 6),
              (1, 4, 5, 2, 13, 10, 14, 7), (2, 5, 3, 0, 14, 11, 12, 8)),
    "S3": ((0, 1, 2),), "S4": ((0, 1, 2, 3),), "S6": ((0, 1, 2, 3, 4, 5),),
    "S8R": ((0, 1, 2, 3, 4, 5, 6, 7),),
}  # fmt: skip


@dataclass(slots=True)
class Connections:
    """The equations and made nodes of an assembly, as they grow.

    equations: the author's line and the terms of each, the dependent one first. made: new nodes.
    dependent: what an equation determines, with its line.
    """

    mesh: AssemblyMesh
    rotating: frozenset[int]
    size: float
    equations: list[tuple[int, list[Term]]] = field(default_factory=list)
    made: dict[int, Floats] = field(default_factory=dict)
    dependent: dict[tuple[int, int], int] = field(default_factory=dict)
    #: The node whose displacements are the rotation of a point.
    turns: dict[int, int] = field(default_factory=dict)
    #: Nodes of shells and beams whose rotations are tied, with the author's line.
    stubs: dict[int, int] = field(default_factory=dict)
    #: The author's line, node and mass of each moment of inertia.
    inertias: list[tuple[int, int, float]] = field(default_factory=list)

    def rotation(self, node: int, line: int) -> int:
        """The node whose displacements are the rotation of a point. Raises ModelError."""
        if node in self.rotating:
            where, name = self.mesh.deck.lines[line].where, self.mesh.labels[node]
            text = "belongs to shells or beams, whose rotations CalculiX ties to a free point alone"
            raise ModelError(f"{where}: {name} {text}: refer to a reference point")
        if node not in self.turns:
            self.turns[node] = self.new_node(self.mesh.places[node])
        return self.turns[node]

    def new_node(self, place: Floats) -> int:
        number = (max(self.made) if self.made else max(self.mesh.places)) + 1
        self.made[number] = place
        return number

    def freedom(self, node: int, component: int) -> tuple[int, int] | None:
        """What ccx has for a component 1..6 of a node; None for a rotation that nothing has."""
        if component < 4:
            return node, component
        if node in self.rotating:
            return node, component
        return (self.turns[node], component - 3) if node in self.turns else None

    def tie(self, line: int, terms: Sequence[Term]) -> None:
        """Add sum(factor * u) = 0, the first term dependent. Raises ModelError for a second one."""
        first = terms[0][:2]
        if first in self.dependent:
            where = self.mesh.deck.lines[line].where
            other = self.mesh.deck.lines[self.dependent[first]].where
            name = self.mesh.labels.get(first[0], f"reference of {first[0]}")
            text = f"{where}: component {first[1]} of node {name} already follows from {other}"
            raise ModelError(text)
        self.dependent[first] = line
        small = ROUNDING * self.size
        kept = [term for term in terms[1:] if abs(term[2]) > small * 1e-3]
        self.equations.append((line, [terms[0], *kept]))

    def rigid(self, line: int, reference: int, nodes: Sequence[int], components: set[int]) -> None:
        """Tie components of nodes to the rigid motion of a reference point."""
        places = self.mesh.places
        for node in nodes:
            if node == reference:
                continue
            arm = places[node] - places[reference]
            for axis in range(3):
                if axis + 1 in components:
                    terms: list[Term] = [(node, axis + 1, 1.0), (reference, axis + 1, -1.0)]
                    # (theta x r)_a = theta_b r_c - theta_c r_b
                    after, last = (axis + 1) % 3, (axis + 2) % 3
                    for about, factor in ((after, -arm[last]), (last, arm[after])):
                        # (u_node - u_ref) - theta x r = 0
                        if abs(factor) > ROUNDING * self.size:
                            terms.append((self.rotation(reference, line), about + 1, factor))
                    self.tie(line, terms)
                own = self.freedom(node, axis + 4)
                if axis + 4 in components and own is not None:
                    if node in self.rotating:
                        self.stubs.setdefault(node, line)
                    self.tie(line, [(*own, 1.0), (self.rotation(reference, line), axis + 1, -1.0)])

    def distribute(
        self,
        line: int,
        reference: int,
        nodes: Sequence[int],
        weights: Floats,
        components: set[int],
    ) -> None:
        """Tie components of a reference point to the mean motion of nodes. Raises ModelError."""
        places = self.mesh.places
        arms = np.array([places[node] - places[reference] for node in nodes])
        motions = np.zeros((len(nodes), 3, 6))
        motions[:, :, :3] = np.eye(3)
        for axis in range(3):
            motions[:, :, 3 + axis] = np.cross(np.eye(3)[axis], arms) / self.size
        weighted = motions.transpose(0, 2, 1) * weights[:, None, None]
        normal = np.einsum("nij,njk->ik", weighted, motions) / weights.sum()
        if np.linalg.cond(normal) > 1e10:
            where, names = self.mesh.deck.lines[line].where, labelled(nodes, self.mesh.labels)
            raise ModelError(f"{where}: nodes on a line determine no rotation: {names}")
        shares = np.linalg.solve(normal, weighted / weights.sum())
        shares[:, 3:] /= self.size
        turn = self.rotation(reference, line)
        for row in (component - 1 for component in sorted(components)):
            own = (reference, row + 1) if row < 3 else (turn, row - 2)
            others = [
                (node, axis + 1, -float(shares[place, row, axis]))
                for place, node in enumerate(nodes)
                for axis in range(3)
                if abs(shares[place, row, axis]) * (self.size if row > 2 else 1.0) > ROUNDING
            ]
            self.tie(line, [(*own, 1.0), *others])

    def lines(self) -> list[tuple[str, int]]:
        """The *EQUATION cards, each line with the author's."""
        found = list[tuple[str, int]]()
        for origin, terms in self.equations:
            found += [("*EQUATION", origin), (str(len(terms)), origin)]
            words = [
                f"{node},{component},{format_number(value)}" for node, component, value in terms
            ]
            rows = [words[at : at + TERMS] for at in range(0, len(words), TERMS)]
            found += [(",".join(row), origin) for row in rows]
        return found


def read_connections(mesh: AssemblyMesh) -> Connections:
    """All that ties nodes, but for *TIE. Raises ModelError."""
    merge_nodes(mesh)
    elements = mesh.elements.values()
    rotating = {node for item in elements if ROTATING.match(item.kind) for node in item.nodes}
    places = np.array(list(mesh.places.values())).reshape(-1, 3)
    size = float(np.ptp(places, axis=0).max()) if places.size else 0.0
    ties = Connections(mesh, frozenset(rotating), size or 1.0)
    # Reference points first: whether a point has rotations decides what is tied to it.
    for scope, card, _ in _cards(mesh):
        _references(ties, scope, card)
    for scope, card, place in _cards(mesh):
        match card.keyword:
            case "*COUPLING":
                _coupling(ties, scope, card, place)
            case "*KINEMATICCOUPLING":
                _kinematic_coupling(ties, scope, card)
            case "*RIGIDBODY":
                _rigid_body(ties, scope, card)
            case "*MPC":
                _mpcs(ties, scope, card)
            case "*EQUATION":
                _equations(ties, scope, card)
            case "*ROTARYINERTIA":
                rotary_inertia(ties, scope, card)
    return ties


def _cards(mesh: AssemblyMesh) -> list[tuple[Scope, KeywordCard, int]]:
    return [
        (scope, card, place)
        for scope in mesh.scopes.values()
        for place, card in enumerate(scope.cards)
    ]


def _references(ties: Connections, scope: Scope, card: KeywordCard) -> None:
    """Give the points that couplings and bodies turn with a rotation."""
    if card.is_one_of("*COUPLING", "*KINEMATIC COUPLING", "*RIGID BODY"):
        ties.rotation(_reference(ties, scope, card), card.lines.start)
    elif card.is_one_of("*MPC"):
        for line in card.data:
            fields = ties.mesh.deck.fields(line)
            if canonical_name(fields[0]) == "BEAM" and len(fields) > 2:
                where = ties.mesh.deck.lines[line].where
                for node in ties.mesh.node_set(scope, fields[2], where):
                    ties.rotation(node, line)


def _reference(ties: Connections, scope: Scope, card: KeywordCard) -> int:
    where, name = ties.mesh.deck.where(card), card.option("REFNODE")
    if not name:
        raise ModelError(f"{where}: {card.keyword} needs REF NODE=")
    found = ties.mesh.node_set(scope, name, where)
    if len(found) != 1:
        raise ModelError(f"{where}: the reference {name} has {len(found)} nodes, one is expected")
    return found[0]


def _coupling(ties: Connections, scope: Scope, card: KeywordCard, place: int) -> None:
    deck, where = ties.mesh.deck, ties.mesh.deck.where(card)
    refuse_options(deck, card, {"CONSTRAINTNAME", "REFNODE", "SURFACE"})
    reference, name = _reference(ties, scope, card), card.option("SURFACE")
    kind = scope.cards[place + 1] if place + 1 < len(scope.cards) else card
    if kind.is_one_of("*KINEMATIC"):
        refuse_options(deck, kind, set())
        nodes, _ = surface_nodes(ties.mesh, scope, name, where)
        ties.rigid(card.lines.start, reference, nodes, _components(ties, kind))
    elif kind.is_one_of("*DISTRIBUTING"):
        refuse_options(deck, kind, {"WEIGHTINGMETHOD", "COUPLING"})
        for option, known in (("WEIGHTINGMETHOD", "UNIFORM"), ("COUPLING", "CONTINUUM")):
            if kind.option(option) not in ("", known):
                text = f"{option}={kind.option(option)} of {card.option('CONSTRAINTNAME')}"
                raise ModelError(f"{deck.where(kind)}: *DISTRIBUTING, {text} is not translated")
        components = _components(ties, kind)
        if not components >= {1, 2, 3}:
            raise ModelError(f"{deck.where(kind)}: *DISTRIBUTING of all translations is expected")
        nodes, weights = surface_nodes(ties.mesh, scope, name, where, areas=True)
        ties.distribute(card.lines.start, reference, nodes, weights, components)
    else:
        raise ModelError(f"{where}: *COUPLING needs *KINEMATIC or *DISTRIBUTING below it")


def _components(ties: Connections, card: KeywordCard, first: int = 0) -> set[int]:
    """Components that data lines give as first and last, all without lines. Raises ModelError."""
    found = set[int]()
    for line in card.data:
        words = [text for text in ties.mesh.deck.fields(line)[first:] if text]
        if not words:
            continue
        if not all(word in "123456" and len(word) == 1 for word in words) or len(words) > 2:
            text = ties.mesh.deck.lines[line]
            raise ModelError(f"{text.where}: components 1 to 6 expected, found {text.text!r}")
        found.update(range(int(words[0]), int(words[-1]) + 1))
    return found or set(range(1, 7))


def _kinematic_coupling(ties: Connections, scope: Scope, card: KeywordCard) -> None:
    deck = ties.mesh.deck
    refuse_options(deck, card, {"REFNODE"})
    reference = _reference(ties, scope, card)
    for line in card.data:
        only = KeywordCard(card.keyword, {}, card.lines, (line,))
        components = _components(ties, only, first=1)
        nodes = ties.mesh.node_set(scope, deck.fields(line)[0], deck.lines[line].where)
        ties.rigid(line, reference, nodes, components)


def _rigid_body(ties: Connections, scope: Scope, card: KeywordCard) -> None:
    mesh, where = ties.mesh, ties.mesh.deck.where(card)
    refuse_options(mesh.deck, card, {"REFNODE", "ELSET", "TIENSET", "PINNSET", "POSITION"})
    if card.option("POSITION") not in ("", "INPUT"):
        raise ModelError(f"{where}: *RIGID BODY, POSITION={card.option('POSITION')} is not "
                         "translated")  # fmt: skip
    reference, tied, pinned = _reference(ties, scope, card), set[int](), set[int]()
    if card.option("ELSET"):
        for element in mesh.element_set(scope, card.option("ELSET"), where):
            tied.update(mesh.elements[element].nodes)
    if card.option("TIENSET"):
        tied.update(mesh.node_set(scope, card.option("TIENSET"), where))
    if card.option("PINNSET"):
        pinned.update(mesh.node_set(scope, card.option("PINNSET"), where))
    ties.rigid(card.lines.start, reference, sorted(tied), set(range(1, 7)))
    ties.rigid(card.lines.start, reference, sorted(pinned - tied), {1, 2, 3})


def merge_nodes(mesh: AssemblyMesh) -> None:
    """Make one node of those that a TIE MPC makes equal at one place."""
    near = ROUNDING * 1e6
    for scope, card, _ in _cards(mesh):
        for line in card.data if card.is_one_of("*MPC") else ():
            fields, where = [t for t in mesh.deck.fields(line) if t], mesh.deck.lines[line].where
            if len(fields) != 3 or canonical_name(fields[0]) != "TIE":
                continue
            first, second = (mesh.node_set(scope, text, where) for text in fields[1:])
            if len(first) != len(second):
                continue
            for node, other in list(zip(first, second, strict=True)):
                gap = np.abs(mesh.places[node] - mesh.places[other]).max()
                if node != other and gap <= near * np.abs(mesh.places[node]).max():
                    mesh.merged[node] = other
    mesh.merge()


def _mpcs(ties: Connections, scope: Scope, card: KeywordCard) -> None:
    deck = ties.mesh.deck
    refuse_options(deck, card, set())
    for line in card.data:
        where, fields = deck.lines[line].where, [text for text in deck.fields(line) if text]
        kind = canonical_name(fields[0]) if fields else ""
        if kind not in ("BEAM", "TIE", "PIN") or len(fields) != 3:
            raise ModelError(f"{where}: *MPC {kind} of {len(fields) - 1} sets is not translated")
        first = ties.mesh.node_set(scope, fields[1], where)
        second = ties.mesh.node_set(scope, fields[2], where)
        if len(second) not in (1, len(first)):
            text = f"{len(first)} and {len(second)} nodes"
            raise ModelError(f"{where}: *MPC of two sets of {text}, {fields[1]} and {fields[2]}")
        for place, node in enumerate(first):
            other = second[place if len(second) > 1 else 0]
            if node == other:  # merged
                continue
            if kind == "BEAM":
                ties.rigid(line, other, [node], set(range(1, 7)))
                continue
            apart = float(np.linalg.norm(ties.mesh.places[node] - ties.mesh.places[other]))
            if kind == "TIE" and {node, other} & ties.rotating:
                text = f"{ties.mesh.labels[node]} and {ties.mesh.labels[other]}"
                text = f"{where}: *MPC TIE of {text}, {apart:g} apart"
                raise ModelError(
                    f"{text}: rotations of shells and beams are tied at one place only"
                )
            for component in (1, 2, 3):
                ties.tie(line, [(node, component, 1.0), (other, component, -1.0)])


def _equations(ties: Connections, scope: Scope, card: KeywordCard) -> None:
    deck, count, words = ties.mesh.deck, 0, list[str]()
    refuse_options(deck, card, set())
    for line in card.data:
        where, fields = deck.lines[line].where, [text for text in deck.fields(line) if text]
        try:
            if not count:
                count, words = int(fields[0]), []
                continue
            words += fields
            if len(words) < 3 * count:
                continue
            rows = [words[at : at + 3] for at in range(0, 3 * count, 3)]
            terms = [(name, int(component), read_number(value)) for name, component, value in rows]
        except (ValueError, IndexError):
            text = deck.lines[line].text[:60]
            raise ModelError(f"{where}: terms of an *EQUATION expected, found {text!r}") from None
        _equation(ties, scope, line, terms)
        count = 0
    if count:
        raise ModelError(f"{deck.where(card)}: an *EQUATION of {count} terms ends too early")


def _equation(
    ties: Connections, scope: Scope, line: int, terms: Sequence[tuple[str, int, float]]
) -> None:
    where = ties.mesh.deck.lines[line].where
    sets = [ties.mesh.node_set(scope, name, where) for name, _, _ in terms]
    length = len(sets[0])
    if any(len(members) not in (1, length) for members in sets):
        names = ", ".join(
            f"{name} has {len(s)}" for (name, _, _), s in zip(terms, sets, strict=True)
        )
        raise ModelError(f"{where}: sets of an *EQUATION need as many nodes: {names}")
    for place in range(length):
        found = list[Term]()
        for members, (name, component, value) in zip(sets, terms, strict=True):
            freedom = ties.freedom(members[place if len(members) > 1 else 0], component)
            turns = component > 3 and members[0] in ties.rotating
            if freedom is None or turns or not 1 <= component <= 6:
                reason = ", of shells or beams," if turns else ""
                raise ModelError(f"{where}: {name}{reason} has no component {component} to tie")
            found.append((*freedom, value))
        ties.tie(line, found)


def rotary_inertia(ties: Connections, scope: Scope, card: KeywordCard) -> None:
    """Masses that move with a point's rotation about its axes. Raises ModelError."""
    mesh, deck = ties.mesh, ties.mesh.deck
    where = deck.where(card)
    refuse_options(deck, card, {"ELSET"})
    line = card.data[0] if card.data else None
    values = (
        []
        if line is None
        else [deck.number(line, place) for place, text in enumerate(deck.fields(line)) if text]
    )
    if len(values) < 3:
        raise ModelError(f"{where}: *ROTARY INERTIA needs I11, I22 and I33")
    if any(values[3:]):
        raise ModelError(f"{where}: products of inertia (I12, I13, I23) are not translated")
    inertias, axes = np.array(values[:3]), scope.rotation
    for element in mesh.element_set(scope, card.option("ELSET"), where):
        (node,) = mesh.elements[element].nodes
        if node not in ties.turns:
            name = mesh.labels[node]
            raise ModelError(f"{where}: *ROTARY INERTIA at {name}, which is no reference point")
        for inertia, axis in zip(inertias.tolist(), axes.T.tolist(), strict=True):
            if inertia > 0.0:
                own = ties.new_node(mesh.places[node])
                turn = [(ties.turns[node], at + 1, -part) for at, part in enumerate(axis)
                        if abs(part) > ROUNDING]  # fmt: skip
                ties.tie(card.lines.start, [(own, 1, 1.0), *turn])
                ties.inertias.append((card.lines.start, own, inertia))


def surface_nodes(
    mesh: AssemblyMesh, scope: Scope, name: str, where: str, areas: bool = False
) -> tuple[list[int], Floats]:
    """Nodes of a surface and their weights: areas of faces, or those that the deck gives.

    Raises ModelError.
    """
    own, local = mesh.owner(scope, name)
    cards = [c for c in own.cards if c.is_one_of("*SURFACE") and c.option("NAME") == local]
    if not cards:
        raise ModelError(f"{where}: there is no surface {name}")
    weights = dict[int, float]()
    for card in cards:
        for line in card.data:
            first, second, *_ = [*mesh.deck.fields(line), "", ""]
            at = mesh.deck.lines[line].where
            if card.option("TYPE") == "NODE":
                for node in mesh.node_set(own, first, at):
                    weights[node] = mesh.deck.number(line, 1) if second else 1.0
                continue
            for element in mesh.element_set(own, first, at):
                for node, area in _face(mesh, element, second, at, areas).items():
                    weights[node] = weights.get(node, 0.0) + area
    return list(weights), np.array(list(weights.values()))


def _face(
    mesh: AssemblyMesh, element: int, label: str, where: str, areas: bool
) -> dict[int, float]:
    """Nodes of a face with their shares of its area. Raises ModelError."""
    item, label = mesh.elements[element], canonical_name(label)
    faces = FACES.get(item.kind.rstrip("RI") if item.kind.startswith("C3D") else item.kind, ())
    shell = item.kind.startswith("S") and label in ("SPOS", "SNEG")
    number = 1 if shell else int(label[1:]) if label[:1] == "S" and label[1:].isdecimal() else 0
    if not 0 < number <= len(faces):
        raise ModelError(f"{where}: a {item.given} has no face {label or '(blank)'} here")
    nodes = [item.nodes[place] for place in faces[number - 1]]
    if not areas:
        return dict.fromkeys(nodes, 1.0)
    if len(nodes) > 4:
        text = "a *DISTRIBUTING coupling of quadratic faces is not translated"
        raise ModelError(f"{where}: {text}: give its surface by nodes (TYPE=NODE)")
    corners = np.array([mesh.places[node] for node in nodes])
    one, other = (2, 0), (3, 1) if len(nodes) == 4 else (1, 0)
    sides = [corners[end] - corners[start] for end, start in (one, other)]
    across = np.cross(*sides)
    return dict.fromkeys(nodes, 0.5 * float(np.linalg.norm(across)) / len(nodes))
