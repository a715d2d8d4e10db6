"""Nastran springs (CELAS1 to CELAS4, CBUSH) in CalculiX.

Each stiffness is one spring on the difference of two freedoms, rotations included, so that its
strain energy is known separately. A CBUSH acts at one point of the line between its grid points,
which carry it as rigid bodies, in its own axes.

A spring on linear forms of degrees of freedom: an added node takes up to three deformations as its
displacements (by *EQUATION, each a form of any translations and rotations). It is the free
corner of a C3D4 whose other corners are fixed: a tetrahedron with edges h along x, y, z has strains
u_1 / h, u_2 / h, u_3 / h (stretch, two shears) and, of an orthotropic material without Poisson's
effect, the energy h (E_1 u_1^2 + G_12 u_2^2 + G_13 u_3^2) / 12: three springs h E_1 / 6, h G_12 /
6, h G_13 / 6. ccx prints it as the elements' own. A SPRING1 would do, but ccx 2.20 refuses it
in a deck with composite shells; it is used only for stiffnesses below zero.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from modetune.adapters.nastran.mesh import bush_axes, bush_place, local_axes
from modetune.adapters.translation.assembly import (
    Assembly,
    Form,
    Freedoms,
    difference,
    total,
    trimmed,
)
from modetune.adapters.translation.calculix_text import number_list
from modetune.core.modes import Floats

SCALAR = ("CELAS1", "CELAS2", "CELAS3", "CELAS4")

#: Linear forms and their stiffnesses.
Deformations = list[tuple[Form, float]]


def translate_springs(model: Assembly) -> None:
    """Add all springs; after the constraints, which say what is fixed. They have no mass."""
    readers = {**dict.fromkeys(SCALAR, _scalar_spring), "CBUSH": _bush, "CBUSH1D": _line_bush}
    add_springs(model, readers)


def add_springs(
    model: Assembly, readers: Mapping[str, Callable[[Any, Freedoms], Deformations]]
) -> GroundedSprings:
    """Add the springs that elements are, by kind; a ValueError of a reader refuses the element."""
    springs = GroundedSprings(model.freedoms)
    for element in model.elements(*readers):
        try:
            deformations = readers[element.type](element, model.freedoms)
            springs.add(deformations, model.sets_of(element))
        except ValueError as reason:
            model.refuse(element, reason)
    return springs


def _scalar_spring(element: Any, freedoms: Freedoms) -> Deformations:
    stiffness = element.k if element.type in ("CELAS2", "CELAS4") else element.pid_ref.k
    return [(scalar_form(element, freedoms), float(stiffness))]


def scalar_form(element: Any, freedoms: Freedoms) -> Form:
    """Return the form of a scalar element: its first end less its second one, without ground.

    Raises ValueError for a point that is not there, or an element of ground alone.
    """
    forms = []
    for place, node in enumerate(element.nodes):
        if not node:
            continue
        component = int(getattr(element, f"c{place + 1}", 0) or 0)
        if node not in freedoms.builder.coordinates:
            raise ValueError(f"point {node} is not there")
        if not component and node not in freedoms.points:
            raise ValueError(f"its component at point {node} is blank")
        form = freedoms.form(node, component)
        if not form:
            raise ValueError(f"point {node} is of solids and has no rotation {component}")
        sign = -1.0 if place else 1.0
        forms.append({freedom: sign * factor for freedom, factor in form.items()})
    if not forms:
        raise ValueError("both its ends are grounded")
    return total(forms)


def _bush(element: Any, freedoms: Freedoms) -> Deformations:
    """Return the six deformations, of the second end against the first (or the ground)."""
    if element.pid_ref.type != "PBUSH":
        raise ValueError(f"{element.pid_ref.type} is not translated")
    values = [float(value or 0.0) for value in element.pid_ref.Ki]
    values += [0.0] * (6 - len(values))
    first, second = [*element.node_ids, None][:2]
    coordinates = freedoms.builder.coordinates
    place, span = bush_place(element, coordinates)
    axes = bush_axes(element, span, coordinates, freedoms.frames, values)
    found = []
    for component, stiffness in enumerate(values):
        if stiffness == 0.0:
            continue
        ends = [
            _motion(freedoms, node, place, axes[component % 3], turns=component > 2)
            for node in (second, first)
            if node
        ]
        found.append((difference(ends[0], ends[1]) if len(ends) == 2 else ends[0], stiffness))
    return found


def _line_bush(element: Any, freedoms: Freedoms) -> Deformations:
    """Return the stretch of a CBUSH1D; its tables and equations are for nonlinear solutions."""
    if element.pid_ref.m:
        raise ValueError("the mass of its PBUSH1D: give it as CONM2")
    first, second = [*element.node_ids, None][:2]
    start = freedoms.builder.coordinates[first]
    span = freedoms.builder.coordinates[second] - start if second else np.zeros(3)
    length = float(np.linalg.norm(span))
    if element.cid is None and length <= 1e-9 * (1.0 + float(np.abs(start).max())):
        raise ValueError("its ends coincide or one is grounded: it needs a CID")
    x = span / length if element.cid is None else local_axes(element.cid_ref, start)[0]
    if np.linalg.norm(np.cross(x, span)) > 1e-6 * length:
        raise ValueError("its axis (CID) is not along the line between its grid points")
    ends = [freedoms.along(freedoms.translations(node), x) for node in (second, first) if node]
    form = difference(*ends) if len(ends) == 2 else ends[0]
    return [(form, float(element.pid_ref.k))]


def _motion(freedoms: Freedoms, node: int, place: Floats, axis: Floats, turns: bool) -> Form:
    """Return displacement or rotation along an axis, of a place that is rigid with a grid point."""
    if not turns:
        return freedoms.rigid_motion(node, place, axis)
    rotations = freedoms.rotations(node)
    if not rotations:
        raise ValueError(f"point {node} is of solids and has no rotations")
    return freedoms.along(rotations, axis)


#: Edge of the tetrahedra as a share of the model's extent.
EDGE = 1e-2


class GroundedSprings:
    """Collects springs; those of the same three stiffnesses share a section."""

    def __init__(self, freedoms: Freedoms) -> None:
        builder = self._builder = freedoms.builder
        self._freedoms = freedoms
        self._names: dict[tuple[float, ...], str] = {}
        self._ground: tuple[int, ...] = ()
        places = np.array(list(builder.coordinates.values()))
        self._edge = EDGE * (float(np.ptp(places, axis=0).max()) or 1.0)
        self._corner = places[0]

    def add(self, deformations: Sequence[tuple[Form, float]], sets: Sequence[str]) -> None:
        """Hold each form with its stiffness."""
        held = [(trimmed(form), float(k)) for form, k in deformations if k != 0.0]
        held = [(form, k) for form, k in held if form]
        for below_zero in (False, True):
            chosen = [(form, k) for form, k in held if (k < 0.0) is below_zero]
            size = 1 if below_zero else 3
            for start in range(0, len(chosen), size):
                self._hold(chosen[start : start + size], sets)

    def _hold(self, held: Sequence[tuple[Form, float]], sets: Sequence[str]) -> None:
        x = np.array([self._edge, 0.0, 0.0])
        node = self._builder.new_node(self._corner + x)
        for component, (form, _) in enumerate(held, start=1):
            own = (node, component)
            self._freedoms.tie([difference({own: 1.0}, form)], [own], f"node {node}")
        for component in range(len(held) + 1, 4):
            self._builder.fixed(node, component)
        stiffnesses = tuple(stiffness for _, stiffness in held)
        if stiffnesses[0] < 0.0:
            self._builder.new_element("SPRING1", (node,), (self._spring(stiffnesses), *sets))
            return
        name = self._tetrahedron(stiffnesses)
        origin, second, third = self._fixed_corners()
        self._builder.new_element("C3D4", (origin, node, second, third), (name, *sets))

    def _fixed_corners(self) -> tuple[int, ...]:
        if not self._ground:
            arms = self._edge * np.array([[0.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
            self._ground = tuple(self._builder.new_node(self._corner + arm) for arm in arms)
            for node in self._ground:
                for component in (1, 2, 3):
                    self._builder.fixed(node, component)
        return self._ground

    def _tetrahedron(self, stiffnesses: tuple[float, ...]) -> str:
        if stiffnesses not in self._names:
            name = self._free_name(stiffnesses)
            # Directions without a spring do not move; any stiffness is right there.
            full = (*stiffnesses, *stiffnesses[:1] * 3)[:3]
            e, g12, g13 = (6.0 * stiffness / self._edge for stiffness in full)
            first = number_list((e, e, e, 0.0, 0.0, 0.0, g12, g13))
            lines = ["*ELASTIC, TYPE=ENGINEERING CONSTANTS", first, number_list((g12,))]
            self._builder.material(name, lines)
            self._builder.section([f"*SOLID SECTION, ELSET={name}, MATERIAL={name}"])
        return self._names[stiffnesses]

    def _spring(self, stiffnesses: tuple[float, ...]) -> str:
        if stiffnesses not in self._names:
            name = self._free_name(stiffnesses)
            # ccx takes a number without a decimal point, such as 1e+16, for a direction.
            self._builder.section([f"*SPRING, ELSET={name}", "1", f"{stiffnesses[0]:.12e}"])
        return self._names[stiffnesses]

    def _free_name(self, stiffnesses: tuple[float, ...]) -> str:
        """Return a name for these stiffnesses.

        Other collections may have written to the same deck.
        """
        count = len(self._names) + 1
        while f"K_{count}" in self._builder.sets:
            count += 1
        self._names[stiffnesses] = f"K_{count}"
        return self._names[stiffnesses]
