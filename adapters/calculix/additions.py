"""Masses and springs added to a CalculiX deck, before its first step or at its end."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from modetune.adapters.calculix.constraints import held_by, node_sets
from modetune.adapters.calculix.deck import KeywordCard
from modetune.adapters.calculix.mesh import read_places
from modetune.adapters.calculix.structure import CalculixStructure
from modetune.adapters.calculix.ties import card_terms
from modetune.adapters.deck_files import text_with
from modetune.adapters.solver import AddedCards, Addition
from modetune.core.errors import ModelError
from modetune.core.mesh import Fixed, Mesh
from modetune.core.modes import Floats
from modetune.core.parameters import Quantity, TargetKind

#: What names of added sets begin with.
NAME = "MODETUNE_ADDED"
ELSET: TargetKind = "elset"


def with_addition(
    structure: CalculixStructure, mesh: Mesh, addition: Addition, fixed: Fixed
) -> AddedCards:
    """Return the main file with an addition. fixed: what the deck holds. Raises ModelError."""
    deck = structure.deck
    if addition.component > 3:
        raise ModelError(f"{deck.file}: CalculiX has no springs against rotations of nodes")
    if addition.kind == "inertia":
        raise ModelError(f"{deck.file}: CalculiX has no inertias of nodes")
    steps, before = deck.named("*STEP"), 0
    if steps:
        line = deck.lines[steps[0].lines.start]
        before = line.number
        if line.file != deck.file:
            raise ModelError(
                f"{line.where}: the first *STEP is in an include, and cards are added to the main "
                "file alone"
            )
    names = {card.option("ELSET") for card in deck.cards}
    number = next(n for n in range(1, len(names) + 2) if not _taken(names, n))
    element = max(structure.mesh.elements, default=0) + 1
    lines, parts = ["** added by modetune localise"], list[tuple[Quantity, str, float]]()
    nodes = addition.nodes
    if addition.kind in ("support", "link"):
        if addition.kind == "support":
            more, numbers, comments = _springs(structure, addition, fixed, element, number)
        else:
            more, numbers, comments = _joint(structure, mesh, addition, element, number)
        text = text_with(deck.file, before, [*lines, *more], "** ", comments)
        return AddedCards(text, (*lines, *more), (numbers,))
    if addition.kind == "absorber":
        own = max(structure.summary.node_ids) + 1
        x, y, z = _place(mesh, nodes[0])
        others = [axis for axis in (1, 2, 3) if axis != addition.component]
        lines += ["*NODE", f"{own}, {x:.9g}, {y:.9g}, {z:.9g}"]
        lines += ["*BOUNDARY", *(f"{own}, {axis}, {axis}" for axis in others)]
        nodes = (nodes[0], own)
    if addition.kind != "spring":
        name = f"{NAME}_{number}_MASS"
        held = nodes if addition.kind == "mass" else nodes[1:]
        lines.append(f"*ELEMENT, TYPE=MASS, ELSET={name}")
        lines += [f"{element + place}, {node}" for place, node in enumerate(held)]
        lines += [f"*MASS, ELSET={name}", _real(addition.values[0])]
        parts.append(("mass", name, addition.values[0]))
        element += len(held)
    if addition.kind != "mass":
        name, axis = f"{NAME}_{number}_SPRING", str(addition.component)
        lines.append(f"*ELEMENT, TYPE=SPRING{len(nodes)}, ELSET={name}")
        lines.append(", ".join(map(str, (element, *nodes))))
        lines += [f"*SPRING, ELSET={name}", ", ".join([axis] * len(nodes))]
        lines.append(_real(addition.values[-1]))
        parts.append(("spring_stiffness", name, addition.values[-1]))
    text = text_with(deck.file, before, lines)
    values = [(quantity, ELSET, (name,), value) for quantity, name, value in parts]
    return AddedCards(text, tuple(lines), tuple(values))


def _springs(
    structure: CalculixStructure, addition: Addition, fixed: Fixed, element: int, number: int
) -> tuple[list[str], tuple[Quantity, TargetKind, tuple[str, ...], float], list[int]]:
    """Return springs in place of a support, their numbers, and lines of the file to comment out.

    element, number: the first free ones, of elements and of names.
    """
    nodes, value = set(addition.nodes), addition.values[0]
    axes = (addition.component,) if addition.component else (1, 2, 3)
    lines, comments = _kept_holds(structure, nodes, axes)
    names = []
    for axis in axes:
        held = [node for node in sorted(nodes) if axis in fixed.get(node, ())]
        if not held:
            continue
        name = f"{NAME}_{number}_SUPPORT_{axis}"
        names.append(name)
        lines.append(f"*ELEMENT, TYPE=SPRING1, ELSET={name}")
        lines += [f"{element + place}, {node}" for place, node in enumerate(held)]
        lines += [f"*SPRING, ELSET={name}", str(axis), _real(value)]
        element += len(held)
    if not names:
        raise ModelError(f"{structure.deck.file}: no *BOUNDARY holds these nodes")
    return lines, ("spring_stiffness", ELSET, tuple(names), value), comments


def _joint(
    structure: CalculixStructure, mesh: Mesh, addition: Addition, element: int, number: int
) -> tuple[list[str], tuple[Quantity, TargetKind, tuple[str, ...], float], list[int]]:
    """Return springs between a rigid body or a master surface and the nodes that it leads, their
    numbers, and lines to comment out.

    The leader gets nodes of its own at the same places. What does not yield stays tied by
    equations.
    """
    deck, sets = structure.deck, node_sets(structure)
    nodes, value = sorted(addition.nodes), addition.values[0]
    cards: list[tuple[KeywordCard, dict[int, dict[int, float]]]] = [
        (card, {})
        for card in deck.named("*RIGID BODY")
        if sets.get(card.option("NSET"), set()) - {_reference(card)} == set(nodes)
    ]
    places = read_places(deck)
    cards += [
        (card, terms)
        for card in deck.named("*TIE")
        if (terms := card_terms(structure, card, sets, places) or {}).keys() == set(nodes)
    ]
    if len(cards) != 1:
        raise ModelError(
            f"{deck.file}: a link that yields is replaced where one *RIGID BODY, with NSET, or one "
            f"*TIE has exactly its nodes ({len(cards)} have them)"
        )
    card, terms = cards[0]
    lines = [deck.lines[position] for position in card.lines]
    if any(line.file != deck.file for line in lines):
        raise ModelError(f"{lines[0].where}: links are replaced in the main file alone")
    first = max(structure.summary.node_ids) + 1
    name = f"{NAME}_{number}_LINK"
    twins = dict(zip(nodes, range(first, first + len(nodes)), strict=True))
    made = [f"*NODE, NSET={name}"]
    for node, twin in twins.items():
        x, y, z = _place(mesh, node)
        made.append(f"{twin}, {x:.9g}, {y:.9g}, {z:.9g}")
    if terms:
        made += ["*EQUATION", *_equations(twins, terms)]
    else:
        ends = [f"REF NODE={_reference(card)}"]
        if rotation := card.option("ROTNODE"):
            ends.append(f"ROT NODE={rotation}")
        made.append(f"*RIGID BODY, NSET={name}, {', '.join(ends)}")
    axes = (addition.component,) if addition.component else (1, 2, 3)
    names = []
    for axis in axes:
        names.append(f"{name}_{axis}")
        made.append(f"*ELEMENT, TYPE=SPRING2, ELSET={names[-1]}")
        made += [f"{element + k}, {twin}, {node}" for k, (node, twin) in enumerate(twins.items())]
        made += [f"*SPRING, ELSET={names[-1]}", f"{axis}, {axis}", _real(value)]
        element += len(twins)
    for axis in (1, 2, 3):
        if axis not in axes:
            made.append("*EQUATION")
            for node, twin in twins.items():
                made += ["2", f"{node}, {axis}, 1., {twin}, {axis}, -1."]
    comments = [line.number for line in lines]
    return made, ("spring_stiffness", ELSET, tuple(names), value), comments


def _equations(twins: dict[int, int], terms: dict[int, dict[int, float]]) -> Iterator[str]:
    """Lines of equations that make twins of slave nodes move as *TIE made these; four terms a
    line, as ccx reads them."""
    for node, twin in twins.items():
        for axis in (1, 2, 3):
            own = [f"{twin}, {axis}, -1."]
            own += [f"{other}, {axis}, {_real(f)}" for other, f in terms[node].items()]
            yield str(len(own))
            yield from (", ".join(own[place : place + 4]) for place in range(0, len(own), 4))


def _reference(card: KeywordCard) -> int:
    text = card.option("REFNODE")
    return int(text) if text.isdecimal() else 0


def _kept_holds(
    structure: CalculixStructure, nodes: set[int], axes: tuple[int, ...]
) -> tuple[list[str], list[int]]:
    """Return what *BOUNDARY still holds of the lines that hold some freedoms, and these lines."""
    deck, sets = structure.deck, node_sets(structure)
    kept, comments = list[str](), list[int]()
    for card in deck.named("*BOUNDARY"):
        held = {position: held_by(deck.fields(position), sets) for position in card.data}
        freed = {
            position
            for position, dofs in held.items()
            if any(node in nodes and axis in axes for node, axis in dofs)
        }
        if not freed:
            continue
        lines = [deck.lines[position] for position in (card.lines.start, *sorted(freed))]
        if card.options or any(line.file != deck.file for line in lines):
            raise ModelError(
                f"{lines[0].where}: supports are replaced where *BOUNDARY is in the main file and "
                "has no options"
            )
        left = lines[1:] if len(freed) < len(card.data) else lines
        comments += [line.number for line in left]
        rest = {dof for position in freed for dof in held[position]}
        kept += [
            f"{node}, {axis}, {axis}"
            for node, axis in sorted(rest)
            if not (node in nodes and axis in axes)
        ]
    return (["*BOUNDARY", *kept] if kept else []), comments


def _taken(names: set[str], number: int) -> bool:
    return any(name.startswith(f"{NAME}_{number}_") for name in names)


def _place(mesh: Mesh, node: int) -> Floats:
    return np.asarray(mesh.coordinates[mesh.rows(np.array([node]))[0]])


def _real(value: float) -> str:
    """Return a number with a point: ccx takes a number without one for a freedom."""
    digits, exponent, power = f"{value:.9g}".partition("e")
    return f"{digits}{'' if '.' in digits else '.'}{exponent}{power}"
