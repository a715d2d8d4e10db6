"""Rigid elements, the interpolation element RBE3, SPC and MPC as linear equations.

Rigid elements (RBE1, RBE2, RBAR, RBAR1, RROD) and RBE3 become *EQUATION, not *RIGID BODY or
*COUPLING: equations take single components, output frames and rotations alike, and shell nodes that
carry rotations become the rigid knots of ccx.

Single-point and multi-point constraints come from SPC, SPC1, SPCADD, GRID PS, MPC, MPCADD. AUTOSPC
needs no counterpart: what it removes from Nastran's stiffness (rotations of solids, the rotation
about a shell's normal) is no unknown of the CalculiX model.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from modetune.adapters.nastran.constraints import (
    component_numbers,
    constraint_cards,
    held_components,
)
from modetune.adapters.translation.assembly import Form, Freedoms, difference, total
from modetune.adapters.translation.shells import Edges
from modetune.core.modes import Floats

#: A grid point and its component 1..6.
Component = tuple[int, int]


def translate_rigid_elements(
    bulk: Any, freedoms: Freedoms, edges: Edges, problems: list[str]
) -> None:
    """Add all rigid elements of the model."""
    for element in bulk.rigid_elements.values():
        nodes = (*element.independent_nodes, *element.dependent_nodes)
        unknown = [node for node in nodes if node not in freedoms.builder.coordinates]
        if unknown:
            problems.append(
                f"{element.type} {element.eid}: {unknown[0]} is not a GRID of the model"
            )
        elif element.type == "RBE2":
            if element.cm is None:
                problems.append(f"RBE2 {element.eid}: its components (CM) are blank")
                continue
            components = [int(digit) for digit in str(element.cm)]
            _rigid(freedoms, edges, element.gn, element.Gmi, components, f"RBE2 {element.eid}")
        elif element.type == "RBAR":
            _bar(freedoms, edges, element, problems)
        elif element.type == "RBAR1":
            components = component_numbers(element.cb)
            _rigid(freedoms, edges, element.ga, [element.gb], components, f"RBAR1 {element.eid}")
        elif element.type == "RBE1":
            _body(freedoms, element, *_components_of(element), problems)
        elif element.type == "RROD":
            _rod(freedoms, element)
        elif element.type == "RBE3":
            _interpolation(freedoms, element, problems)
        else:
            problems.append(f"{element.type} {element.eid}: not translated")


def _rigid(
    freedoms: Freedoms,
    edges: Edges,
    leader: int,
    followers: list[int],
    components: list[int],
    what: str,
) -> None:
    """Tie components, in the follower's output frame, of nodes to the body of the leader."""
    body = {leader, *followers} if set(components) >= {1, 2, 3} else set()
    middles = [
        middle
        for edge, middle in edges.middles.items()
        if middle in edges.made
        and edge[0] in body
        and edge[1] in body
        and (len(components) == 6 or edges.is_side(edge))
    ]
    for node in (*followers, *middles):
        place = freedoms.builder.coordinates[node]
        frame = freedoms.frames.get(node, np.eye(3))
        rows, turns = list[Form](), list[Form]()
        for component in components:
            axis = frame[(component - 1) % 3]
            own = freedoms.form(node, component)
            if node in (freedoms.structural if component <= 3 else freedoms.rotating):
                arm = place - freedoms.builder.coordinates[leader]
                lever = np.cross(arm, axis) if component <= 3 else freedoms.builder.size * axis
                freedoms.hold(leader, lever)
            if component <= 3:
                rows.append(difference(own, freedoms.rigid_motion(leader, place, axis)))
            elif own and freedoms.turns(leader):
                turns.append(difference(own, freedoms.along(freedoms.rotations(leader), axis)))
        freedoms.tie(rows, freedoms.translations(node), what)
        if turns:
            freedoms.tie(turns, freedoms.rotations(node), what)


def leaders(bulk: Any) -> set[int]:
    """Return the grid points whose motion rigid elements follow."""
    found = set[int]()
    for element in bulk.rigid_elements.values():
        if element.type == "RBE2":
            found.add(element.gn)
        elif element.type == "RBAR1":
            found.add(element.ga)
        elif element.type in ("RBAR", "RBE1"):
            independent, _ = _components_of(element)
            found.update(node for node, component in independent if component > 3)
    return found


def _components_of(element: Any) -> tuple[list[Component], list[Component]]:
    """Return independent and dependent components of a RBE1 or RBAR, each a grid point and 1..6."""
    if element.type == "RBE1":
        pairs = zip(element.Gni, element.Cni, strict=True)
        dependent = list(zip(element.Gmi, element.Cmi, strict=True))
    else:
        ends = (element.ga, element.gb)
        pairs = zip(ends, (element.cna, element.cnb), strict=True)
        dependent = list(zip(ends, (element.cma, element.cmb), strict=True))
        if not any(component_numbers(components) for _, components in dependent):
            given = dict(zip(ends, (element.cna, element.cnb), strict=True))
            dependent = [
                (node, "".join(c for c in "123456" if c not in str(given[node] or "")))
                for node in ends
            ]
    first = [(node, digit) for node, components in pairs for digit in component_numbers(components)]
    second = [
        (node, digit) for node, components in dependent for digit in component_numbers(components)
    ]
    return first, second


def _body(
    freedoms: Freedoms,
    element: Any,
    independent: list[Component],
    dependent: list[Component],
    problems: list[str],
) -> None:
    """Tie components to the rigid motion that six others determine.

    With A and B the motion of the independent and dependent components under a rigid motion,
    u_m = B A^-1 u_n.
    """
    what = f"{element.type} {element.eid}"
    centre, size = independent[0][0], freedoms.builder.size
    forms = [freedoms.form(node, component) for node, component in independent]
    known = rigid_motions(freedoms, independent, centre)
    if len(forms) != 6 or not all(forms) or np.linalg.matrix_rank(known, tol=1e-9) < 6:
        problems.append(f"{what}: its independent components do not determine a rigid motion")
        return
    # Rotations are multiplied by the model's size, which makes the units alike.
    lengths = np.array([size if component > 3 else 1.0 for _, component in independent])
    shares = np.linalg.solve(known.T, rigid_motions(freedoms, dependent, centre).T).T * lengths
    for node, component in (*independent, *dependent):
        if component > 3:
            axis = freedoms.frames.get(node, np.eye(3))[component - 4]
            freedoms.hold(node, size * axis)
    rows: dict[tuple[int, bool], list[Form]] = {}
    for (node, component), row in zip(dependent, shares.tolist(), strict=True):
        own = freedoms.form(node, component, size if component > 3 else 1.0)
        if own:
            parts = [
                {freedom: share * value for freedom, value in form.items()}
                for share, form in zip(row, forms, strict=True)
            ]
            rows.setdefault((node, component > 3), []).append(difference(own, total(parts)))
    for (node, turning), ties in rows.items():
        own_freedoms = freedoms.rotations(node) if turning else freedoms.translations(node)
        freedoms.tie(ties, own_freedoms, what)


def rigid_motions(freedoms: Freedoms, components: Sequence[Component], centre: int) -> Floats:
    """Return the motion of components in six rigid motions about a point, (n, 6).

    Rotations, as motions and as components, are multiplied by the model's size.
    """
    places = freedoms.builder.coordinates
    rows = []
    for node, component in components:
        axis = freedoms.frames.get(node, np.eye(3))[(component - 1) % 3]
        arm = np.cross((places[node] - places[centre]) / freedoms.builder.size, axis)
        rows.append(np.r_[np.zeros(3), axis] if component > 3 else np.r_[axis, arm])
    return np.array(rows)


def _rod(freedoms: Freedoms, element: Any) -> None:
    """Add an RROD: the distance of its ends is constant, to first order."""
    first, second = element.nodes
    along = freedoms.builder.coordinates[second] - freedoms.builder.coordinates[first]
    along = along / np.linalg.norm(along)
    ends = [freedoms.along(freedoms.translations(node), along) for node in (first, second)]
    chosen = first if str(element.cma or "").strip("0") else second
    row = difference(ends[0], ends[1])
    freedoms.tie([row], freedoms.translations(chosen), f"RROD {element.eid}")


def _bar(freedoms: Freedoms, edges: Edges, element: Any, problems: list[str]) -> None:
    ends = [(element.ga, str(element.cna or "")), (element.gb, str(element.cnb or ""))]
    dependent = [str(element.cma or ""), str(element.cmb or "")]
    for first in (0, 1):
        leader, follower = ends[first], ends[1 - first]
        if sorted(leader[1]) == list("123456") and not follower[1].strip("0"):
            chosen = dependent[1 - first].strip("0") or "123456"
            components = [int(digit) for digit in chosen]
            what = f"RBAR {element.eid}"
            return _rigid(freedoms, edges, leader[0], [follower[0]], components, what)
    return _body(freedoms, element, *_components_of(element), problems)


def _interpolation(freedoms: Freedoms, element: Any, problems: list[str]) -> None:
    """Tie the reference point to the weighted rigid motion that fits the others best.

    With G_i the motion of point i's components under a rigid motion of the reference point and w
    the weights, u_ref = (sum G_i' w G_i)^-1 sum G_i' w u_i. Rotational components are weighted
    with the square of the mean distance, which makes the units alike.
    """
    centre = freedoms.builder.coordinates[element.refgrid]
    entries = [
        (node, int(digit), weight)
        for weight, digits, nodes in zip(element.weights, element.comps, element.Gijs, strict=True)
        for node in nodes
        for digit in str(digits)
    ]
    arms = [np.linalg.norm(freedoms.builder.coordinates[node] - centre) for node, _, _ in entries]
    square = float(np.mean(arms)) ** 2 or 1.0
    rows, weights, forms = [], [], []
    for node, component, weight in entries:
        own = freedoms.form(node, component)
        if own:
            axis = freedoms.frames.get(node, np.eye(3))[(component - 1) % 3]
            arm = freedoms.builder.coordinates[node] - centre
            turning = component > 3
            rows.append(np.r_[np.zeros(3), axis] if turning else np.r_[axis, np.cross(arm, axis)])
            weights.append(weight * (square if turning else 1.0))
            forms.append(own)
    _write_interpolation(freedoms, element, np.array(rows), np.array(weights), forms, problems)


def _write_interpolation(
    freedoms: Freedoms,
    element: Any,
    motion: Floats,
    weights: Floats,
    forms: list[Form],
    problems: list[str],
) -> None:
    """Write the equations; motion: (n, 6), weights: (n,), of the n independent components."""
    what = f"RBE3 {element.eid}"
    weighted = motion.T * weights
    normal = weighted @ motion
    size = np.sqrt(np.diag(normal))
    size[size == 0.0] = 1.0
    if np.linalg.matrix_rank(normal / np.outer(size, size), tol=1e-9) < 6:
        problems.append(
            f"{what}: its points do not determine all rotations of point {element.refgrid}"
        )
        return
    shares = np.linalg.solve(normal, weighted)
    rows: list[Form] = []
    node, frame = element.refgrid, freedoms.frames.get(element.refgrid, np.eye(3))
    for three, freedom in (((1, 2, 3), freedoms.translations), ((4, 5, 6), freedoms.rotations)):
        ties = []
        for component in (int(digit) for digit in str(element.refc)):
            own = freedoms.form(node, component) if component in three else {}
            if own:
                axis = frame[(component - 1) % 3]
                factors = axis @ shares[three[0] - 1 : three[0] + 2]
                parts = [
                    {f: factor * value for f, value in form.items()}
                    for factor, form in zip(factors.tolist(), forms, strict=True)
                ]
                ties.append(difference(own, total(parts)))
        if element.Gmi:
            rows += ties
        elif ties:
            freedoms.tie(ties, freedom(node), what)
    # The same equations with UM, but what depends is elsewhere.
    elsewhere = [
        freedom
        for other, components in zip(element.Gmi, element.Cmi, strict=True)
        for component in component_numbers(components)
        for freedom in freedoms.form(other, component)
    ]
    if rows:
        freedoms.tie(rows, list(dict.fromkeys(elsewhere)), what)


def translate_spcs(
    bulk: Any, freedoms: Freedoms, edges: Edges, spc: int, problems: list[str]
) -> None:
    """Fix what the selected SPC set and the grid points' own PS field fix.

    A midside node that the bulk data does not have is fixed as both its corners are, on the border
    of the shells; within them only where both are clamped. spc: 0 for none.
    """
    fixed = held_components(bulk, spc)
    for card in _selected(bulk, "spc", spc, problems):
        if card.type not in ("SPC", "SPC1"):
            problems.append(f"{card.type} of set {card.conid}: not translated")
    for edge, middle in edges.middles.items():
        if middle in edges.made and edge[0] in fixed and edge[1] in fixed:
            common = _common(freedoms, edge, fixed[edge[0]], fixed[edge[1]])
            if common and (edges.is_side(edge) or len(common) == 6):
                fixed[middle] = common
                if edge[0] in freedoms.frames:
                    freedoms.frames[middle] = freedoms.frames[edge[0]]
    for node in fixed.keys() & freedoms.points:
        fixed[node] = {1}
    for node, components in fixed.items():
        if node not in freedoms.builder.coordinates:
            problems.append(f"SPC set {spc}: point {node} is not a point of the model")
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
        if unknown:
            problems.append(f"{what}: point {unknown[0]} is not there")
            continue
        forms = [freedoms.form(node, int(c), factor) for node, c, factor in terms]
        dependents = list(forms[0])
        if not dependents:
            problems.append(f"{what}: a point of solids has no rotation to depend")
            continue
        freedoms.tie([total(forms)], dependents, what)


def _selected(bulk: Any, kind: str, number: int, problems: list[str]) -> list[Any]:
    """Return cards of a constraint set, those of an ADD card in its place."""
    cards = constraint_cards(bulk, kind, number)
    if number and not cards and number not in getattr(bulk, f"{kind}adds"):
        problems.append(
            f"{kind.upper()} set {number}: the case control asks for it, it is not there"
        )
    return cards


def _common(
    freedoms: Freedoms, edge: tuple[int, int], first: set[int], second: set[int]
) -> set[int]:
    """Return components fixed at both ends; in unlike frames only whole triples count."""
    both = first & second
    frames = [freedoms.frames.get(node, np.eye(3)) for node in edge]
    if np.allclose(frames[0], frames[1], rtol=0.0, atol=1e-9):
        return both
    whole = [three for three in ({1, 2, 3}, {4, 5, 6}) if three <= both]
    return set().union(*whole)
