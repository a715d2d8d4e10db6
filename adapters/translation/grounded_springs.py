"""Springs on linear forms of degrees of freedom.

A node of our own takes up to three deformations as its displacements (by *EQUATION, each a form of
any translations and rotations). It is the free corner of a C3D4 whose other corners are fixed: a
tetrahedron with edges h along x, y, z has strains u_1 / h, u_2 / h, u_3 / h (stretch, two shears)
and, of an orthotropic material without Poisson's effect, the energy
h (E_1 u_1^2 + G_12 u_2^2 + G_13 u_3^2) / 12: three springs h E_1 / 6, h G_12 / 6, h G_13 / 6. ccx
prints it as the elements' own. A SPRING1 would do, but ccx 2.20 refuses it beside composite shells;
it is left for stiffnesses below zero.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from modetune.adapters.translation.calculix_text import CalculixText, number_list
from modetune.adapters.translation.freedoms import Form, Freedoms, difference, trimmed

#: Edge of the tetrahedra as a share of the model's extent.
EDGE = 1e-2


class GroundedSprings:
    """Collects springs; those of the same three stiffnesses share a section."""

    def __init__(self, builder: CalculixText, freedoms: Freedoms) -> None:
        self._builder = builder
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
        """A name for these stiffnesses; other collections may have written to the same deck."""
        count = len(self._names) + 1
        while f"K_{count}" in self._builder.sets:
            count += 1
        self._names[stiffnesses] = f"K_{count}"
        return self._names[stiffnesses]
