"""The model during its translation: degrees of freedom of grid points, and equations between them.

A node of shells or beams has rotations 4-6 in ccx, which makes them by tying the expanded nodes to
a rigid knot. A node that has only masses and rigid elements gets a second node, whose displacements
1-3 are the rotations. A node that has only solids has no rotations: Nastran's AUTOSPC removes them,
and they are left out here. A scalar point is a node with displacement 1 free.

Equations are collected and written block by block. In each block (the translations or the rotations
of one grid point) Gauss elimination with pivots makes every equation depend on its own degree of
freedom, which ccx requires, whatever the output frame.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from modetune.adapters.nastran.mesh import output_frames
from modetune.adapters.translation.calculix_text import CalculixText
from modetune.core.modes import Floats

#: Degree of freedom of ccx: node and component.
Freedom = tuple[int, int]
#: A linear form: factor of each degree of freedom.
Form = dict[Freedom, float]
#: Factors below this share of the largest are rounding.
NOTHING = 1e-10


class Freedoms:
    """The degrees of freedom of all grid points, and what is tied or fixed so far."""

    def __init__(
        self,
        bulk: Any,
        builder: CalculixText,
        turning: frozenset[int],
        solid: frozenset[int],
        structural: frozenset[int],
        rotating: frozenset[int],
        problems: list[str],
    ) -> None:
        """Grid points by what they belong to.

        turning: shells; solid: solids, and nothing that holds or leads a rotation; structural:
        anything with stiffness; rotating: anything with stiffness against rotation.
        """
        self.frames = output_frames(bulk)
        self.points = frozenset(bulk.spoints)
        self.builder = builder
        self.turning = turning
        self.solid = solid
        self.structural = structural
        self.rotating = rotating
        self.problems = problems
        self.turn_nodes: dict[int, int] = {}
        self._dependent: dict[Freedom, str] = {}
        self._holds: dict[int, list[Floats]] = {}

    def turns(self, node: int) -> bool:
        """Return whether the node has rotations."""
        return node in self.turning or node not in self.solid | self.points

    def translations(self, node: int) -> list[Freedom]:
        if node in self.points:
            return [(node, 1)]
        return [(node, 1), (node, 2), (node, 3)]

    def rotations(self, node: int) -> list[Freedom]:
        """Return where the node's rotations about the basic axes are; empty where it has none."""
        if not self.turns(node):
            return []
        if node not in self.turn_nodes:
            self.turn_nodes[node] = self.builder.new_node(self.builder.coordinates[node])
        other = self.turn_nodes[node]
        return [(other, 1), (other, 2), (other, 3)]

    def form(self, node: int, component: int, factor: float = 1.0) -> Form:
        """Return the form of a component 1..6 in the output frame; empty for a missing rotation.

        Of a scalar point it is 0 or 1.
        """
        if node in self.points:
            return {(node, 1): factor}
        freedoms = self.translations(node) if component <= 3 else self.rotations(node)
        if not freedoms:
            return {}
        frame = self.frames.get(node)
        axis = np.eye(3)[(component - 1) % 3] if frame is None else frame[(component - 1) % 3]
        return {
            freedom: factor * float(share)
            for freedom, share in zip(freedoms, axis, strict=True)
            if abs(share) > NOTHING
        }

    def along(self, freedoms: Sequence[Freedom], axis: Floats) -> Form:
        """Return a direction in basic coordinates of three translations or rotations."""
        pairs = zip(freedoms, axis, strict=True)
        return {freedom: float(share) for freedom, share in pairs if abs(share) > NOTHING}

    def rigid_motion(self, leader: int, place: Floats, axis: Floats) -> Form:
        """Return the displacement along a basic axis of a place that is rigid with a grid point."""
        arm = place - self.builder.coordinates[leader]
        form = self.along(self.translations(leader), axis)
        turning = np.cross(arm, axis)  # axis . (theta x arm) = theta . (arm x axis)
        if np.abs(turning).max() > NOTHING * (1.0 + float(np.abs(arm).max())):
            rotations = self.rotations(leader)
            if rotations:
                form |= self.along(rotations, turning)
        return form

    def follow(self, node: int, leader: int, place: Floats, turns: bool) -> None:
        """Tie the translations of a node of our own to a grid point.

        It moves as a place (3,) of the grid point's rigid body does, or, where it does not turn,
        as the grid point itself.
        """
        seen = place if turns else self.builder.coordinates[leader]
        rows = [
            difference({(node, c + 1): 1.0}, self.rigid_motion(leader, seen, np.eye(3)[c]))
            for c in range(3)
        ]
        self.tie(rows, self.translations(node), f"node {node}")

    def hold(self, node: int, axis: Floats) -> None:
        """Note that something hinders a rotation of the node: theta . axis (3,), of any size."""
        self._holds.setdefault(node, []).append(axis)

    def holds(self, node: int) -> Floats:
        """Return all that hinders the node's rotation, (n, 3), each of the size it came with."""
        return np.array(self._holds.get(node, []), dtype=np.float64).reshape(-1, 3)

    def tie(self, rows: Iterable[Form], dependents: Sequence[Freedom], what: str) -> None:
        """Add equations (each form is zero) that make some of these freedoms dependent."""
        rows = [dict(row) for row in rows if row]
        free = [f for f in dependents if f not in self._dependent and not self._is_fixed(f)]
        done: list[tuple[Freedom, Form]] = []
        while rows:
            size, place, freedom = max(
                ((abs(row.get(f, 0.0)), i, f) for i, row in enumerate(rows) for f in free),
                default=(0.0, 0, (0, 0)),
            )
            if size <= NOTHING:
                self._refuse(rows, dependents, what)
                return
            pivot = scaled(rows.pop(place), freedom)
            rows = [row for row in (without(r, freedom, pivot) for r in rows) if row]
            done = [(f, without(r, freedom, pivot)) for f, r in done] + [(freedom, pivot)]
            free.remove(freedom)
        for freedom, row in done:
            self._dependent[freedom] = what
            if set(row) == {freedom}:
                self.builder.fixed(*freedom)
            else:
                others = [(n, c, factor) for (n, c), factor in row.items() if (n, c) != freedom]
                self.builder.equation([(*freedom, row[freedom]), *others])

    def fix(self, node: int, components: Iterable[int], what: str) -> None:
        """Fix components of a grid point in its output frame; a missing rotation is left."""
        wanted = sorted(set(components))
        axes = self.frames.get(node, np.eye(3))
        for component in wanted:
            if component > 3:
                self.hold(node, self.builder.size * axes[component - 4])
        for three in ((1, 2, 3), (4, 5, 6)):
            rows = [self.form(node, c) for c in wanted if c in three]
            if not any(rows):
                continue
            freedoms = self.translations(node) if three[0] == 1 else self.rotations(node)
            if len(rows) == 3:
                rows = [{freedom: 1.0} for freedom in freedoms]
            rows = [row for row in rows if len(row) > 1 or not self._is_fixed(next(iter(row)))]
            self.tie(rows, freedoms, what)

    def is_dependent(self, freedom: Freedom) -> bool:
        return freedom in self._dependent

    def _is_fixed(self, freedom: Freedom) -> bool:
        return self.builder.is_fixed(*freedom)

    def _refuse(self, rows: list[Form], dependents: Sequence[Freedom], what: str) -> None:
        owners = {self._dependent[f] for f in dependents if f in self._dependent}
        reason = f"; {', '.join(sorted(owners))} determine them already" if owners else ""
        self.problems.append(
            f"{what}: {len(rows)} of its equations find no free degree of freedom{reason}"
        )


def difference(first: Form, second: Form) -> Form:
    """Return first - second, without terms that cancel."""
    form = dict(first)
    for freedom, factor in second.items():
        form[freedom] = form.get(freedom, 0.0) - factor
    return trimmed(form)


def total(forms: Iterable[Form]) -> Form:
    form: Form = {}
    for part in forms:
        for freedom, factor in part.items():
            form[freedom] = form.get(freedom, 0.0) + factor
    return trimmed(form)


def trimmed(form: Form) -> Form:
    largest = max(map(abs, form.values()), default=0.0)
    return {f: factor for f, factor in form.items() if abs(factor) > 1e-14 * largest}


def scaled(row: Form, freedom: Freedom) -> Form:
    """Return the row with factor 1 at this freedom."""
    return {other: factor / row[freedom] for other, factor in row.items()}


def without(row: Form, freedom: Freedom, pivot: Form) -> Form:
    """Return the row less the multiple of the pivot row that takes this freedom out of it."""
    factor = row.get(freedom, 0.0)
    if not factor:
        return row
    rest = difference(row, {other: factor * value for other, value in pivot.items()})
    rest.pop(freedom, None)
    return rest


@dataclass(frozen=True, slots=True)
class Assembly:
    """What all cards are translated from and into.

    bulk: a cross-referenced pyNastran BDF. single: elements with a separate set `E<eid>`.
    wtmass: the factor on all masses. lumped: whether masses are at the grid points alone, and of
    which properties of solids and shells they can be.
    """

    bulk: Any
    freedoms: Freedoms
    single: frozenset[int]
    wtmass: float
    lumped: bool
    lumped_properties: frozenset[int]

    @property
    def builder(self) -> CalculixText:
        return self.freedoms.builder

    @property
    def problems(self) -> list[str]:
        return self.freedoms.problems

    def elements(self, *kinds: str) -> Iterator[Any]:
        """Return elements of these cards, in the order of the bulk data."""
        return (element for element in self.bulk.elements.values() if element.type in kinds)

    def sets_of(self, element: Any) -> Sequence[str]:
        """Return the names of the sets that an element belongs to."""
        names = [f"P{element.pid}"] if getattr(element, "pid", None) else []
        return (*names, f"E{element.eid}") if element.eid in self.single else names

    def refuse(self, card: Any, reason: object) -> None:
        """Note why an element cannot be translated."""
        self.problems.append(f"{card.type} {card.eid}: {reason}")
