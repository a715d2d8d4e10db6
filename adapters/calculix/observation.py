"""What ccx prints as displacements of nodes, in terms of the equations of its stored matrices.

The names of equations (`.dof`) contain node and component. Of solids a name occurs once. The nodes
that a shell or beam is expanded to carry the number of the deck's node each: (bottom, top) of
linear shells and of middle nodes of quadratic ones, (bottom, middle, top) of their corners, four
of a linear beam, eight (corners of the section first) of an end of a quadratic one. ccx prints
their mean: (1, 1) / 2, (1, 4, 1) / 6, (1, 1, 1, 1) / 4 (map3dto1d2d_v.f of ccx 2.20).

Where the deck's own node has unknowns too, because a solid, spring or mass shares it or an
*EQUATION names it, they come first, and bottom + top = 2 own takes the bottom's place. A knot
(elements of different normal or thickness meet) has the node's own translations alone. A component
held by *BOUNDARY is zero, while one of the expanded nodes may keep an equation of that name. So
the number of equations of a name, with the node's roles in its elements, shows which case it is;
otherwise the degree of freedom is unknown.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from modetune.adapters.calculix.constraints import Constraints, Dof, read_constraints
from modetune.adapters.calculix.mesh import EXPANDED, Role, read_places
from modetune.adapters.calculix.structure import CalculixStructure
from modetune.core.modes import Floats, Integers
from modetune.core.updating.observation import Observation, Weights, from_rows, named_rows

#: Weights of the equations of a name, by role: of the node that is expanded alone, and of one
#: that has own unknowns too (bottom = 2 own - top).
ALONE: Mapping[Role, tuple[float, ...]] = {
    "shell": (0.5, 0.5),
    "shell corner": (1 / 6, 2 / 3, 1 / 6),
    "shell middle": (0.5, 0.5),
    "beam": (0.25,) * 4,
    "beam end": (*((0.25,) * 4), 0.0, 0.0, 0.0, 0.0),
    "beam middle": (0.25,) * 4,
}
OWN: Mapping[Role, tuple[float, ...]] = {
    "shell": (1.0, 0.0),
    "shell corner": (1 / 3, 2 / 3, 0.0),
    "shell middle": (1.0, 0.0),
    "beam": (1.0, 0.0, 0.0, 0.0),
    "beam end": (1.0, *((0.0,) * 7)),
    "beam middle": (1.0, 0.0, 0.0, 0.0),
}


def observe(
    structure: CalculixStructure,
    nodes: Integers,
    components: Integers,
    wanted_nodes: Integers,
    wanted_components: Integers,
) -> Observation:
    """Displacements in global axes, as ccx prints them, from the equations of the matrices.

    nodes, components: (n_equations,), names of the equations; wanted_nodes, wanted_components:
    (n_wanted,). Raises ModelError where the deck cannot be read.
    """
    constraints = read_constraints(structure)
    told = set(wanted_nodes.tolist())
    told |= {node for node, _ in constraints.terms}
    told |= {
        number for body in constraints.bodies.values() for number in (body.reference, body.rotation)
    }
    numbers = np.array(sorted(told), dtype=np.int64)
    rows = named_rows(nodes, components, numbers)
    bodies = bool(constraints.bodies)
    offset = any("OFFSET" in name for card in structure.sections for name in card.options)
    naming = Naming(
        rows=rows,
        roles=structure.mesh.roles(told),
        constraints=constraints,
        places=read_places(structure.deck) if bodies else {},
        offset=offset,
    )
    wanted = zip(wanted_nodes.tolist(), wanted_components.tolist(), strict=True)
    return from_rows([naming.printed(dof) for dof in wanted], nodes.size)


@dataclass(frozen=True, slots=True)
class Naming:
    """rows: equations of each name, ascending; offset: whether a section is off its nodes."""

    rows: dict[Dof, list[int]]
    roles: dict[int, set[Role]]
    constraints: Constraints
    places: Mapping[int, tuple[float, float, float]]
    offset: bool

    def printed(self, dof: Dof) -> Weights | None:
        """The displacement that ccx prints, None where it is not known."""
        node, component = dof
        roles = self.roles[node]
        if component > 3 or "other" in roles:
            return None
        expanded = roles & EXPANDED
        if not expanded:
            return self.own(dof)
        rows, role = self.rows.get(dof, []), next(iter(expanded))
        if not self.constraints.followed and not self._held(dof):
            return None
        if dof in self.constraints.dependent:
            return self._printed_dependent(dof, role if len(expanded) == 1 else None)
        if len(expanded) == 1 and len(rows) == len(ALONE[role]):
            weights = OWN[role] if self._has_own(dof) else ALONE[role]
            return {row: weight for row, weight in zip(rows, weights, strict=True) if weight}
        # Of a knot off its node ccx prints the motion of the section's middle, which rotates.
        if self._held(dof):
            return {} if rows or not self.offset else None
        return {rows[0]: 1.0} if self._is_knot(dof) and not self.offset else None

    def own(self, dof: Dof, seen: frozenset[Dof] = frozenset()) -> Weights | None:
        """The displacement of the deck's node itself, as *EQUATION and *RIGID BODY see it."""
        node, component = dof
        rows = self.rows.get(dof, [])
        expanded = self.roles.get(node, set[Role]()) & EXPANDED
        if dof in self.constraints.dependent and (expanded or not rows):
            return self._sum(dof, self.constraints.dependent[dof], seen)
        if rows and not expanded:
            return {rows[0]: 1.0}
        if rows and len(expanded) == 1 and len(rows) == len(ALONE[next(iter(expanded))]):
            return {rows[0]: 1.0} if self._has_own(dof) else None
        if self._held(dof):
            return {}
        if rows:
            return {rows[0]: 1.0} if self._is_knot(dof) else None
        if node in self.constraints.bodies and component <= 3 and not expanded:
            return self._of_body(dof, seen)
        return None

    def _has_own(self, dof: Dof) -> bool:
        """Return whether the deck's node of a shell or beam, no knot, has an unknown."""
        return bool(self.roles[dof[0]] & {"solid", "point"}) or dof in self.constraints.terms

    def _held(self, dof: Dof) -> bool:
        """Whether *BOUNDARY holds it; in turned axes only all three together do."""
        node, _ = dof
        held = self.constraints.held
        if node in self.constraints.turned:
            return all((node, component) in held for component in (1, 2, 3))
        return dof in held

    def _is_knot(self, dof: Dof) -> bool:
        """Whether an expanded node is a rigid body with the node's own translations.

        Held rotations remove equations of expanded nodes too; then, and with held turned axes, it
        is unknown.
        """
        node, _ = dof
        held = [place for place in range(1, 7) if (node, place) in self.constraints.held]
        plain = max(held, default=0) <= 3 and not (held and node in self.constraints.turned)
        return plain and len(self.rows.get(dof, [])) == 1

    def _printed_dependent(self, dof: Dof, role: Role | None) -> Weights | None:
        own, rows = self.own(dof), self.rows.get(dof, [])
        if own is None or not rows:
            return own if not self.offset else None  # a knot
        if role is None or len(rows) != len(ALONE[role]) - 1:
            return None
        if role != "shell corner":
            return own
        found = {row: value / 3.0 for row, value in own.items()}
        found[rows[0]] = found.get(rows[0], 0.0) + 2.0 / 3.0
        return found

    def _sum(self, dof: Dof, terms: dict[Dof, float], seen: frozenset[Dof]) -> Weights | None:
        if dof in seen or not {dof[0], *(node for node, _ in terms)}.isdisjoint(
            self.constraints.turned
        ):
            return None
        total: Weights = {}
        for term, factor in terms.items():
            part = self.own(term, seen | {dof})
            if part is None:
                return None
            for row, value in part.items():
                total[row] = total.get(row, 0.0) + factor * value
        return total

    def _of_body(self, dof: Dof, seen: frozenset[Dof]) -> Weights | None:
        """u = u_reference + rotation x arm."""
        node, component = dof
        body = self.constraints.bodies[node]
        if not body.rotation or not {node, body.reference} <= self.places.keys():
            return None
        arm: Floats = np.array(self.places[node]) - np.array(self.places[body.reference])
        axis = component - 1
        before, after = (axis + 1) % 3, (axis + 2) % 3
        # (r x a)_i = r_j a_k - r_k a_j, with i, j, k in cyclic order.
        terms: dict[Dof, float] = {
            (body.reference, component): 1.0,
            (body.rotation, before + 1): float(arm[after]),
            (body.rotation, after + 1): -float(arm[before]),
        }
        return self._sum(dof, terms, seen)
