"""Concentrated masses: CONM1, CONM2, CMASS, and the masses of bushes, panels and lumped elements.

A CONM2 without offset and inertia at a free grid point of shells or solids becomes a *MASS element.
ccx leaves the coupling of the node's freedoms out of the matrix of a *MASS element. So a mass whose
node depends on others, or has only beams and springs, and a body with offset or inertia, becomes a
small C3D8 that moves rigidly with its grid point and has the mass, centre and moments of the body.
With J = tr(I) / 2 - I in principal axes (J_i is the second moment along axis i), the sides of this
box are s_i = sqrt(12 J_i / m). The box is never strained, so its stiffness is irrelevant. A tensor
that no body has (J_i < 0, as where a card gives only I11), or one without mass, takes a second box
of negative mass.
"""

from __future__ import annotations

from collections.abc import Hashable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from modetune.adapters.nastran.masses import Lump, PointMass, mass_of, point_mass
from modetune.adapters.nastran.mesh import local_axes
from modetune.adapters.translation.assembly import (
    NOTHING,
    Assembly,
    Form,
    Freedoms,
    difference,
    total,
)
from modetune.adapters.translation.calculix_text import BRICK_CORNERS, number_list
from modetune.adapters.translation.springs import scalar_form
from modetune.core.element_geometry import SHAPES, nodal_measures
from modetune.core.modes import Floats

#: Sources of densities, and volume or area of each.
Shares = tuple[tuple[Hashable, float], ...]
#: Names of the sets of scalar masses, which have no place, begin with this.
SCALAR_MASS = "SCALAR_"
#: Names of the sets of bricks without extent, whose corners move with the centre, end with this.
POINT = "_POINT"


def point_masses(bulk: Any, problems: list[str]) -> list[PointMass]:
    """Return all concentrated masses of the model."""
    found = []
    for element in bulk.masses.values():
        if element.type == "CONM2":
            found.append(point_mass(element))
        elif element.type == "CONM1":
            body = _body_of(element)
            found += [body] if body else []
    for element in bulk.elements.values():
        if element.type == "CBUSH" and getattr(element.pid_ref, "mass", None):
            found += _bush_masses(element, problems)
        elif element.type == "CSHEAR":
            found += _panel_masses(element)
    return found


def _bush_masses(element: Any, problems: list[str]) -> list[PointMass]:
    """Return the mass of a PBUSH, half of it at each end."""
    if len(set(filter(None, element.node_ids))) < 2:
        problems.append(
            f"CBUSH {element.eid}: the mass of its PBUSH with one end on the ground is not "
            "translated; give it as a CONM2"
        )
        return []
    half, zero = 0.5 * element.pid_ref.mass, np.zeros((3, 3))
    places = [np.asarray(node.get_position()) for node in element.nodes_ref]
    return [
        PointMass(element.eid, node, half, place, zero)
        for node, place in zip(element.node_ids, places, strict=True)
    ]


def _panel_masses(element: Any) -> list[PointMass]:
    """Return the mass of a shear panel, at its corners as its bilinear shape functions share it."""
    places = np.array([node.get_position() for node in element.nodes_ref])
    card = element.pid_ref
    shares = nodal_measures(SHAPES["S4"], places[None])[0]
    density = card.mid_ref.rho * card.t + (card.nsm or 0.0)
    return [
        PointMass(element.eid, node, density * float(share), place, np.zeros((3, 3)))
        for node, place, share in zip(element.node_ids, places, shares, strict=True)
        if density
    ]


def _body_of(element: Any) -> PointMass | None:
    """Return the rigid body whose mass matrix a CONM1 gives, None where it gives another one.

    With m the mass, S the cross-product matrix of the centre and I the inertia about it, the matrix
    is [[m, -m S], [m S, I - m S S]].
    """
    matrix = _symmetric(element)
    mass, coupling = matrix[0, 0], matrix[3:, :3]
    skew = 0.5 * (coupling - coupling.T)
    size = NOTHING * float(np.abs(matrix[:3, :3]).max() + np.abs(coupling).max())
    same = np.abs(matrix[:3, :3] - mass * np.eye(3)).max() <= size
    if not mass or not same or np.abs(coupling - skew).max() > size:
        return None
    cross = skew / mass
    offset = np.array([cross[2, 1], cross[0, 2], cross[1, 0]])
    inertia = matrix[3:, 3:] + mass * cross @ cross
    place = np.asarray(element.nid_ref.get_position(), dtype=np.float64)
    axes = local_axes(element.cid_ref, place)
    node = element.node_ids[0]
    return PointMass(element.eid, node, mass, place + offset @ axes, axes.T @ inertia @ axes)


def _symmetric(element: Any) -> Floats:
    """Return the mass matrix of a CONM1, (6, 6), of which the card has the lower triangle."""
    lower = np.tril(np.asarray(element.mass_matrix, dtype=np.float64))
    return np.asarray(lower + np.tril(lower, -1).T)


def translate_scalar_masses(model: Assembly) -> None:
    """Add all masses that are not a body's; after all equations."""
    for element in model.bulk.masses.values():
        try:
            parts = list(_scalar_masses(element, model.freedoms))
        except ValueError as reason:
            model.refuse(element, reason)
            continue
        for count, (form, mass) in enumerate(parts):
            name = f"{element.eid}_{count}"
            add_scalar_mass(model, name, form, mass * model.wtmass, model.sets_of(element))


def add_scalar_mass(
    model: Assembly, name: str, form: Form, mass: float, sets: Sequence[str] = ()
) -> None:
    """Add a mass that moves along a linear form: a brick whose corners all do."""
    builder = model.builder
    side, origin = 1e-3 * builder.size, next(iter(builder.coordinates.values()))
    nodes = [builder.new_node(origin + 0.5 * side * signs) for signs in BRICK_CORNERS]
    for node in nodes:
        own = (node, 1)
        model.freedoms.tie([difference({own: 1.0}, form)], [own], f"node {node}")
        for component in (2, 3):
            builder.fixed(node, component)
    _add_brick(model, nodes, SCALAR_MASS + name, mass / side**3, sets)


def _scalar_masses(element: Any, freedoms: Freedoms) -> Iterator[tuple[Form, float]]:
    """Linear forms and their masses. Raises ValueError."""
    if element.type.startswith("CMASS"):
        mass = element.mass if element.type in ("CMASS2", "CMASS4") else element.pid_ref.mass
        form = scalar_form(element, freedoms)
        if mass and form:
            yield form, float(mass)
    elif element.type == "CONM1" and _body_of(element) is None:
        node = element.node_ids[0]
        axes = local_axes(element.cid_ref, freedoms.builder.coordinates[node])
        known = [freedoms.translations(node), freedoms.rotations(node)]
        masses, directions = np.linalg.eigh(_symmetric(element))
        for mass, direction in zip(masses.tolist(), directions.T, strict=True):
            shares = (direction[:3] @ axes, direction[3:] @ axes)
            parts = zip(known, shares, strict=True)
            form = total(freedoms.along(three, share) for three, share in parts if three)
            if form and abs(mass) > NOTHING * float(np.abs(masses).max()):
                yield form, mass


def grouped_masses(
    lumped: Sequence[Lump], densities: Mapping[Hashable, float]
) -> tuple[list[PointMass], dict[str, Shares]]:
    """Return lumped masses, and what those of each group have of each density's source.

    Groups are of equal shares, so that they stay alike whatever the densities are.
    """
    names: dict[Shares, str] = {}
    found, zero = [], np.zeros((3, 3))
    for lump in lumped:
        alike = tuple((source, float(f"{measure:.9e}")) for source, measure in lump.shares)
        mass = mass_of(alike, densities)
        if mass:
            name = names.setdefault(alike, f"LUMP_{len(names) + 1}")
            found.append(PointMass(0, lump.node, mass, lump.place, zero, name))
    return found, {name: shares for shares, name in names.items()}


def translate_masses(model: Assembly, masses: list[PointMass]) -> None:
    """Add all concentrated masses; after all equations, which say what depends on what."""
    builder, freedoms, bulk = model.builder, model.freedoms, model.bulk
    size = builder.size
    for body in masses:
        element = bulk.masses.get(body.eid) or bulk.elements.get(body.eid)
        sets = model.sets_of(element) if element else ()
        near = 1e-9 * size
        offset = float(np.abs(body.centre - builder.coordinates[body.node]).max()) > near
        # A grid point without rotations (of solids) carries its masses along, not round.
        turns = freedoms.turns(body.node) and (offset or bool(body.inertia.any()))
        # ccx takes a *MASS for an error where nothing couples its node's displacements.
        coupled = body.node in freedoms.turning or body.node in freedoms.solid
        if (
            coupled
            and not turns
            and not any(freedoms.is_dependent(f) for f in freedoms.translations(body.node))
        ):
            if body.mass:
                if body.name not in builder.sets:
                    line = number_list((body.mass * model.wtmass,))
                    builder.section([f"*MASS, ELSET={body.name}", line])
                builder.new_element("MASS", (body.node,), (body.name, *sets))
            continue
        for mass, extent, axes in _boxes(body) if turns else [(body.mass, np.zeros(3), np.eye(3))]:
            _add_box(model, body, mass, extent, axes, turns, sets)


def _boxes(body: PointMass) -> list[tuple[float, Floats, Floats]]:
    """Return boxes that together have the mass and inertia of a body.

    Each has a mass, the sides (3,), zero for a point, and their directions as columns (3, 3).
    """
    if not body.inertia.any():
        return [(body.mass, np.zeros(3), np.eye(3))]
    moments, axes = np.linalg.eigh(body.inertia)
    axes[:, 2] = np.cross(axes[:, 0], axes[:, 1])
    second = 0.5 * float(moments.sum()) - moments
    second[np.abs(second) < 1e-9 * np.abs(second).max()] = 0.0
    taken = np.maximum(-second, 0.0)
    spare = body.mass if body.mass > 0.0 and taken.any() else 0.0
    if body.mass <= 0.0:
        spare = 1.0 - body.mass
    parts = [(body.mass + spare, np.maximum(second, 0.0))]
    parts += [(-spare, -taken)] if spare else []
    return [(mass, np.sqrt(12.0 * moment / mass), axes) for mass, moment in parts]


def _add_box(
    model: Assembly,
    body: PointMass,
    mass: float,
    extent: Floats,
    axes: Floats,
    turns: bool,
    sets: Sequence[str],
) -> None:
    """Add a C3D8 of this mass; without extent (3,) it moves as its centre does."""
    sides = np.maximum(extent, 1e-3 * float(extent.max()) or 1e-3 * model.builder.size)
    nodes = []
    for signs in BRICK_CORNERS:
        place = body.centre + axes @ (0.5 * sides * signs)
        node = model.builder.new_node(place)
        seen = place if extent.any() else body.centre
        model.freedoms.follow(node, body.node, seen, turns)
        nodes.append(node)
    name = body.name + ("" if mass > 0.0 else "_LESS") + ("" if extent.any() else POINT)
    _add_brick(model, nodes, name, mass * model.wtmass / float(np.prod(sides)), sets)


def _add_brick(
    model: Assembly, nodes: Sequence[int], name: str, density: float, sets: Sequence[str]
) -> None:
    """Add a C3D8 that is never strained, with its own set and material."""
    if name not in model.builder.sets:
        model.builder.material(name, brick_lines(density))
        model.builder.section([f"*SOLID SECTION, ELSET={name}, MATERIAL={name}"])
    model.builder.new_element("C3D8", nodes, (name, *sets))


def brick_lines(density: float) -> tuple[str, ...]:
    """Return the cards of the material of a mass's brick."""
    return ("*ELASTIC", "1., 0.", "*DENSITY", number_list((density,)))


def group_lines(name: str, mass: float, size: float) -> dict[str, tuple[str, ...]]:
    """Return the numbers of a group of masses with WTMASS: its *MASS and its brick's material."""
    volume = float(np.prod(np.full(3, 1e-3 * size)))
    return {name: (number_list((mass,)),), name + POINT: brick_lines(mass / volume)}
