"""Components of grid points that cannot move: held by SPC sets and PS fields, or not stiff at all.

Nastran holds what has no stiffness (AUTOSPC), such as a grid point that only orients a bar.
"""

from __future__ import annotations

from typing import Any

from modetune.adapters.nastran.bulk import Bulk
from modetune.adapters.nastran.fields import NastranCard
from modetune.core.mesh import Fixed

#: Of a grid point without stiffness.
ALL = frozenset(range(1, 7))


def constraint_cards(bulk: Bulk, kind: str, number: int) -> list[Any]:
    """Return the cards of a constraint set (`spc` or `mpc`), those of an ADD card in its place.

    number: 0 for no set.
    """
    added = getattr(bulk, f"{kind}adds").get(number, [])
    sets = [inner for card in added for inner in getattr(card, f"{kind}_ids")] or [number]
    return [card for inner in sets for card in getattr(bulk, f"{kind}s").get(inner, [])]


def held_components(bulk: Bulk, spc: int) -> dict[int, set[int]]:
    """Return what PS fields and a set of SPC and SPC1 cards hold, by point.

    Points that are not there are among them, except those in the gaps of a THRU range, which
    Nastran passes over.
    """
    grids = bulk.nodes.items()
    held = {number: set(component_numbers(grid.ps)) for number, grid in grids if grid.ps}
    for card in constraint_cards(bulk, "spc", spc):
        if card.type == "SPC1":
            there = [node for node in card.node_ids if node in bulk.nodes or node in bulk.spoints]
            for node in there or card.node_ids:
                held.setdefault(node, set()).update(component_numbers(card.components))
        elif card.type == "SPC":
            for node, components in zip(card.node_ids, card.components, strict=True):
                held.setdefault(node, set()).update(component_numbers(components))
    return held


def component_numbers(text: object) -> list[int]:
    """Return the components that a field names: 1 to 6."""
    return [int(digit) for digit in str(text) if digit in "123456"]


def fixed_components(bulk: Bulk, spc: int, mpc: int, whole: bool) -> Fixed:
    """Return what cannot move, by grid point, in its output frame.

    spc, mpc: the selected sets, 0 for none. whole: whether the model has all that has stiffness.
    """
    fixed = {node: frozenset(held) for node, held in held_components(bulk, spc).items()}
    if not whole:
        return fixed
    members = [*bulk.elements.values(), *constraint_cards(bulk, "mpc", mpc)]
    stiff = {node for item in members for node in item.node_ids}
    for item in bulk.rigid_elements.values():
        stiff.update((*item.independent_nodes, *item.dependent_nodes))
    return fixed | dict.fromkeys(bulk.nodes.keys() - stiff, ALL)


def held_by(card: NastranCard, bulk: Bulk) -> set[tuple[int, int]]:
    """Return what an SPC or SPC1 card holds: points that are there, and components."""
    fields = [card.text(place) for place in range(2, len(card.fields))]
    if card.name == "SPC":
        pairs = [(fields[at], fields[at + 1]) for at in range(0, len(fields) - 1, 3)]
    else:
        words = [word for word in fields[1:] if word]
        pairs = [(word, fields[0]) for word in words]
        for place in (n for n, word in enumerate(words) if word == "THRU"):
            points = range(int(words[place - 1]), int(words[place + 1]) + 1)
            pairs += [(str(point), fields[0]) for point in points]
    return {
        (int(point), component)
        for point, components in pairs
        if point.isdigit() and int(point) in bulk.nodes
        for component in component_numbers(components)
    }
