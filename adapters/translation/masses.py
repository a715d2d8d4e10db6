"""Concentrated masses.

A CONM2 without offset and inertia at a free grid point is a *MASS element. ccx leaves the coupling
of a *MASS element's freedoms out of its matrices, so a mass whose node depends on others, and a
body with offset or inertia, becomes a small C3D8 that moves rigidly with its grid point and has the
body's mass, centre and moments: with J = tr(I) / 2 - I in principal axes (J_i is the second moment
along axis i), the box's sides are s_i = sqrt(12 J_i / m). It is never strained, so its stiffness is
of no matter. A tensor that no body has (J_i < 0, as where a card gives I11 alone), or one without
mass, takes a second box of negative mass.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from modetune.adapters.nastran.geometry import local_axes
from modetune.adapters.translation.calculix_text import CalculixText, number_list
from modetune.adapters.translation.freedoms import Freedoms
from modetune.adapters.translation.shells import SetsOf
from modetune.core.modes import Floats

#: Corners of a C3D8 in ccx's order, as signs of the half sides; the axes are right-handed.
CORNER_SIGNS = np.array(
    [(-1, -1, -1), (1, -1, -1), (1, 1, -1), (-1, 1, -1),
     (-1, -1, 1), (1, -1, 1), (1, 1, 1), (-1, 1, 1)], dtype=np.float64,
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class PointMass:
    """A rigid body at a grid point, in basic coordinates and the deck's own unit (no WTMASS).

    centre: (3,), of gravity; inertia: (3, 3), about the centre, as a tensor.
    """

    eid: int
    node: int
    mass: float
    centre: Floats
    inertia: Floats


def point_masses(bulk: Any, problems: list[str]) -> list[PointMass]:
    """All concentrated masses of the model."""
    found = []
    for element in bulk.masses.values():
        if element.type == "CONM2":
            found.append(_conm2(element))
        else:
            problems.append(f"{element.type} {element.eid}: concentrated masses need a CONM2")
    return found


def _conm2(element: Any) -> PointMass:
    node = element.nid_ref
    place = np.asarray(node.get_position(), dtype=np.float64)
    offset = np.asarray(element.X, dtype=np.float64)
    xx, xy, yy, xz, yz, zz = element.I
    # The card has the products of inertia as positive integrals; the tensor has them negative.
    inertia = np.array([[xx, -xy, -xz], [-xy, yy, -yz], [-xz, -yz, zz]])
    if element.cid == -1:
        return PointMass(element.eid, element.Nid(), element.mass, offset, inertia)
    axes = local_axes(element.cid_ref, place)
    centre = place + offset @ axes
    return PointMass(element.eid, element.Nid(), element.mass, centre, axes.T @ inertia @ axes)


def translate_masses(
    bulk: Any,
    masses: list[PointMass],
    builder: CalculixText,
    freedoms: Freedoms,
    wtmass: float,
    sets_of: SetsOf,
) -> None:
    """Add all concentrated masses; after all equations, which say what depends on what."""
    size = builder.size
    for body in masses:
        sets = sets_of(bulk.masses[body.eid])
        near = 1e-9 * size
        offset = float(np.abs(body.centre - builder.coordinates[body.node]).max()) > near
        # A grid point without rotations (of solids) carries its masses along, not round.
        turns = freedoms.turns(body.node) and (offset or bool(body.inertia.any()))
        if not turns and not any(
            freedoms.is_dependent(freedom) for freedom in freedoms.translations(body.node)
        ):
            if body.mass:
                name = f"CONM2_{body.eid}"
                builder.new_element("MASS", (body.node,), (name, *sets))
                builder.section([f"*MASS, ELSET={name}", number_list((body.mass * wtmass,))])
            continue
        for box in _boxes(body) if turns else [Box(body.mass, np.zeros(3), np.eye(3))]:
            _add_box(builder, freedoms, body, box, turns, 1e-3 * size, wtmass, sets)


@dataclass(frozen=True, slots=True)
class Box:
    """sides: (3,), zero for a point; axes: (3, 3), their directions as columns."""

    mass: float
    sides: Floats
    axes: Floats


def _boxes(body: PointMass) -> list[Box]:
    """Boxes whose mass and inertia together are the body's."""
    if not body.inertia.any():
        return [Box(body.mass, np.zeros(3), np.eye(3))]
    moments, axes = np.linalg.eigh(body.inertia)
    axes[:, 2] = np.cross(axes[:, 0], axes[:, 1])
    second = 0.5 * float(moments.sum()) - moments
    second[np.abs(second) < 1e-9 * np.abs(second).max()] = 0.0
    taken = np.maximum(-second, 0.0)
    spare = body.mass if body.mass > 0.0 and taken.any() else 0.0
    if body.mass <= 0.0:
        spare = 1.0 - body.mass
    boxes = [_box(body.mass + spare, np.maximum(second, 0.0), axes)]
    return [*boxes, _box(-spare, -taken, axes)] if spare else boxes


def _box(mass: float, second: Floats, axes: Floats) -> Box:
    return Box(mass, np.sqrt(12.0 * second / mass), axes)


def _add_box(
    builder: CalculixText,
    freedoms: Freedoms,
    body: PointMass,
    box: Box,
    turns: bool,
    small: float,
    wtmass: float,
    sets: Sequence[str],
) -> None:
    """A C3D8 of the box's mass; one without extent moves as its centre does."""
    least = 1e-3 * float(box.sides.max()) or small
    sides = np.maximum(box.sides, least)
    nodes = []
    for signs in CORNER_SIGNS:
        place = body.centre + box.axes @ (0.5 * sides * signs)
        node = builder.new_node(place)
        seen = place if box.sides.any() else body.centre
        freedoms.follow(node, body.node, seen, turns)
        nodes.append(node)
    name = f"CONM2_{body.eid}" + ("" if box.mass > 0.0 else "_LESS")
    density = box.mass * wtmass / float(np.prod(sides))
    builder.new_element("C3D8", nodes, (name, *sets))
    builder.material(name, ["*ELASTIC", "1., 0.", "*DENSITY", number_list((density,))])
    builder.section([f"*SOLID SECTION, ELSET={name}, MATERIAL={name}"])
