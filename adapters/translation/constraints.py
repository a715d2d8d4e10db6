"""Single-point and multi-point constraints: SPC, SPC1, SPCADD, GRID PS, MPC, MPCADD.

AUTOSPC needs no counterpart: what it takes out of Nastran's stiffness (rotations of solids, the
rotation about a shell's normal) is no unknown of the CalculiX model.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from modetune.adapters.translation.freedoms import Freedoms, total
from modetune.adapters.translation.shells import Edges


def translate_spcs(
    bulk: Any, freedoms: Freedoms, edges: Edges, spc: int, problems: list[str]
) -> None:
    """Fix what the selected SPC set and the grid points' own PS field fix.

    A midside node that the bulk data does not have is fixed as both its corners are, on the border
    of the shells; within them only where both are clamped. spc: 0 for none.
    """
    fixed = {number: set(_digits(grid.ps)) for number, grid in bulk.nodes.items() if grid.ps}
    for card in _selected(bulk, "spc", spc, problems):
        if card.type == "SPC1":
            # Nastran passes over the gaps of a THRU range; a card of no grid points is a mistake.
            there = [node for node in card.node_ids if node in freedoms.builder.coordinates]
            for node in there or card.node_ids:
                fixed.setdefault(node, set()).update(_digits(card.components))
        elif card.type == "SPC":
            for node, components in zip(card.node_ids, card.components, strict=True):
                fixed.setdefault(node, set()).update(_digits(components))
        else:
            problems.append(f"{card.type} of set {card.conid}: not translated")
    for edge, middle in edges.middles.items():
        if middle in edges.made and edge[0] in fixed and edge[1] in fixed:
            common = _common(freedoms, edge, fixed[edge[0]], fixed[edge[1]])
            if common and (edges.is_side(edge) or len(common) == 6):
                fixed[middle] = common
                if edge[0] in freedoms.frames:
                    freedoms.frames[middle] = freedoms.frames[edge[0]]
    for node, components in fixed.items():
        if node not in freedoms.builder.coordinates:
            problems.append(f"SPC set {spc}: point {node} is no GRID of the model")
            continue
        freedoms.fix(node, components, f"SPC at {node}")


def translate_mpcs(bulk: Any, freedoms: Freedoms, mpc: int, problems: list[str]) -> None:
    """Add the equations of the selected MPC set; mpc: 0 for none."""
    for card in _selected(bulk, "mpc", mpc, problems):
        if card.type != "MPC":
            problems.append(f"{card.type} of set {card.conid}: not translated")
            continue
        terms = list(zip(card.node_ids, card.components, card.coefficients, strict=True))
        what = f"MPC {card.conid} of point {terms[0][0]} component {terms[0][1]}"
        unknown = [node for node, _, _ in terms if node not in freedoms.builder.coordinates]
        if unknown or any(str(component) == "0" for _, component, _ in terms):
            problems.append(f"{what}: scalar points are not translated")
            continue
        forms = [freedoms.form(node, int(c), factor) for node, c, factor in terms]
        dependents = list(forms[0])
        if not dependents:
            problems.append(f"{what}: a point of solids has no rotation to depend")
            continue
        freedoms.tie([total(forms)], dependents, what)


def _selected(bulk: Any, kind: str, number: int, problems: list[str]) -> list[Any]:
    """Cards of a constraint set, those of an ADD card in its place."""
    if not number:
        return []
    added = getattr(bulk, f"{kind}adds").get(number, [])
    sets = [inner for card in added for inner in getattr(card, f"{kind}_ids")] or [number]
    cards = getattr(bulk, f"{kind}s")
    missing = [inner for inner in sets if inner not in cards]
    if missing and not added:
        problems.append(
            f"{kind.upper()} set {number}: the case control asks for it, it is not there"
        )
    return [card for inner in sets for card in cards.get(inner, [])]


def _digits(components: object) -> list[int]:
    return [int(digit) for digit in str(components) if digit in "123456"]


def _common(
    freedoms: Freedoms, edge: tuple[int, int], first: set[int], second: set[int]
) -> set[int]:
    """Components fixed at both ends; in unlike frames only whole triples count."""
    both = first & second
    frames = [freedoms.frames.get(node, np.eye(3)) for node in edge]
    if np.allclose(frames[0], frames[1], rtol=0.0, atol=1e-9):
        return both
    whole = [three for three in ({1, 2, 3}, {4, 5, 6}) if three <= both]
    return set().union(*whole)
