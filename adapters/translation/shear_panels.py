"""Shear panels (CSHEAR, PSHEAR) in CalculiX: one spring for the shear flow, four for the edges.

Garvey's panel (Garvey 1951, as in Nastran): the edges carry nothing but shear flows. Where opposite
sides meet in points P and Q, the flow at a point between them is q = q_12 l_1 l_2 / l^2, with l the
distance from the line PQ (all alike in a parallelogram) and q_12 the mean flow on side 1-2. With
phi the angle between the directions to P and to Q, the energy is

    integral of q^2 (1 + 2 cot^2 phi / (1 + nu)) / (2 G t) dA = q_12^2 Z

and with the corners' forces of a unit flow, which lie along the diagonals, d = sum f_i u_i does its
work: the stiffness is that of a spring 1 / 2 Z on d. Edges 1-2 and 3-4 are rods of the area
F1 t w / 2, w the mean width of the panel, or F1 t^2 / 2 where F1 is above 1.01; F2 is the others'.
The mass goes to the corners. A panel that is not plane counts as its projection on the plane of its
diagonals.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from modetune.adapters.translation.assembly import Assembly, Freedoms, total
from modetune.adapters.translation.springs import Deformations, add_springs
from modetune.core.element_geometry import SHAPES, integration_points
from modetune.core.modes import Floats

#: Above it F1 and F2 are areas of rods in squares of the thickness, as Nastran has it.
FULLY_EFFECTIVE = 1.01
SIDES = ((0, 1), (1, 2), (2, 3), (3, 0))


def translate_shear_panels(model: Assembly) -> None:
    """Add the stiffness of all shear panels; their masses are among the concentrated ones."""
    add_springs(model, {"CSHEAR": _panel})


def _panel(element: Any, freedoms: Freedoms) -> Deformations:
    material = element.pid_ref.mid_ref
    places = np.array([freedoms.builder.coordinates[node] for node in element.node_ids])
    if material.type != "MAT1" or not (material.e and material.g):
        raise ValueError("its material is no MAT1 with E and G above zero")
    forms = []
    for directions, stiffness in panel_springs(element.pid_ref, places):
        pairs = zip(element.node_ids, directions, strict=True)
        parts = [freedoms.along(freedoms.translations(node), axis) for node, axis in pairs]
        forms.append((total(parts), stiffness))
    return forms


def panel_springs(card: Any, places: Floats) -> list[tuple[Floats, float]]:
    """Return directions (4, 3) at the corners and the stiffness of each spring; places: (4, 3).

    Raises ValueError where an interior angle is not below 180 degrees.
    """
    material = card.mid_ref
    first, second = places[2] - places[0], places[3] - places[1]
    normal = np.cross(first, second)
    area = 0.5 * float(np.linalg.norm(normal))
    if not area > 0.0:
        raise ValueError("its diagonals are parallel")
    x = first / np.linalg.norm(first)
    axes = np.array([x, np.cross(normal / (2.0 * area), x)])
    flat = (places - places[0]) @ axes.T
    sides = np.roll(flat, -1, axis=0) - flat
    if not min(np.cross(sides, np.roll(sides, -1, axis=0))) > 0.0:
        raise ValueError("its interior angles are not all below 180 degrees")
    forces = _corner_forces(flat) @ axes
    found = [(forces, 1.0 / (2.0 * _energy(card, flat)))]
    for place, (start, stop) in enumerate(SIDES):
        factor = (card.f1, card.f2)[place % 2] or 0.0
        if not factor:
            continue
        side = places[stop] - places[start]
        length = float(np.linalg.norm(side))
        opposite = places[SIDES[place - 2][1]] - places[SIDES[place - 2][0]]
        width = 2.0 * area / (length + float(np.linalg.norm(opposite)))
        section = 0.5 * factor * card.t * (card.t if factor > FULLY_EFFECTIVE else width)
        directions = np.zeros((4, 3))
        directions[start], directions[stop] = -side / length, side / length
        found.append((directions, material.e * section / length))
    return found


def _energy(card: Any, flat: Floats) -> float:
    """Z of a unit mean flow on side 1-2; flat: (4, 2), the corners in the panel's plane."""
    # P and Q, where opposite sides meet, and the line through them, in homogeneous coordinates.
    whole = np.column_stack([flat, np.ones(4)])
    lines = [np.cross(whole[a], whole[b]) for a, b in SIDES]
    p, q = np.cross(lines[0], lines[2]), np.cross(lines[1], lines[3])
    line = np.cross(p, q)
    distances = flat @ line[:2] + line[2]
    corners = np.column_stack([flat, np.zeros(4)])[None]
    points = integration_points(SHAPES["S4"], corners)
    at = points.places[0, :, :2]
    flow = distances[0] * distances[1] / (at @ line[:2] + line[2]) ** 2
    to_p, to_q = p[:2] - p[2] * at, q[:2] - q[2] * at
    dot = np.einsum("ij,ij->i", to_p, to_q)
    cotangent = dot / (to_p[:, 0] * to_q[:, 1] - to_p[:, 1] * to_q[:, 0])
    material = card.mid_ref
    density = flow**2 * (1.0 + 2.0 * cotangent**2 / (1.0 + material.nu))
    return float(np.sum(points.measures[0] * density) / (2.0 * material.g * card.t))


def _corner_forces(flat: Floats) -> Floats:
    """(4, 2), of a unit mean flow on side 1-2: pairs along the diagonals, in equilibrium.

    Corner 1 gets half the force of side 1-2 and a force along side 4-1, corner 2 the other half and
    a force along side 2-3; both together act along the diagonal.
    """
    side = flat[1] - flat[0]
    first, second = flat[2] - flat[0], flat[3] - flat[1]
    of_first = np.linalg.solve(np.column_stack([side, flat[3] - flat[0]]), first)[0]
    of_second = np.linalg.solve(np.column_stack([side, flat[2] - flat[1]]), second)[0]
    one, two = 0.5 * first / of_first, 0.5 * second / of_second
    return np.array([one, two, -one, -two])
