"""Loads that a CalculiX deck spreads over elements, as forces at their nodes: f_i = int N_i b dV.

Gravity and rotation act on an element's mass, pressure on a face of a solid (into it) or on a shell
(along its normal). Of shells and beams, which ccx expands to solids, the forces of the expanded
nodes that stand for one of the deck add up to what the shape functions of the deck's own element
give; how they are spread over the thickness is not kept.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from modetune.adapters.calculix.deck import KeywordCard, canonical_name
from modetune.adapters.calculix.incidence import roles_of
from modetune.adapters.calculix.model import CalculixModel
from modetune.adapters.calculix.places import find_density, first_value
from modetune.core.element_geometry import FACES, OF_CELLS, SHAPES, Points, face_nodes, nodal_forces
from modetune.core.errors import ModelError
from modetune.core.mesh import CORNERS, Cells, Mesh
from modetune.core.modes import Floats

#: Loads on mass by their labels, with how many numbers each has.
ON_MASS = {"GRAV": 4, "CENTRIF": 7}
SUPPORTED = "GRAV, CENTRIF on solids and masses, P on shells and P1 to P6 on solids"
#: ccx has a circle of unit radius as a square whose sides are parabolas through its middle.
ELLIPSE = 2.0 + 8.0 / 3.0 * (math.sqrt(2.0) - 1.0)
#: Sections whose elements have no mass.
MASSLESS = ("*SPRING", "*DASHPOT", "*GAP")


@dataclass(frozen=True, slots=True)
class SpreadLoad:
    """A line of *DLOAD: elements, its label, what stands behind it, and file and line."""

    elements: frozenset[int]
    label: str
    numbers: tuple[float, ...]
    where: str


def spread_forces(
    model: CalculixModel, mesh: Mesh, loads: Iterable[SpreadLoad]
) -> list[tuple[int, int, float, str]]:
    """Node, component, force and place of each. Raises ModelError with file and line."""
    found = []
    for load in loads:
        forces = np.zeros((mesh.nodes.size, 3))
        densities = _densities(model, load) if load.label in ON_MASS else {}
        left = set(load.elements)
        for cells in mesh.cells:
            own = np.isin(cells.elements, list(load.elements))
            if not own.any():
                continue
            block = Cells(cells.kind, cells.elements[own], cells.nodes[own])
            left -= set(block.elements.tolist())
            corners = mesh.coordinates[mesh.rows(block.nodes)]
            if load.label in ON_MASS:
                there = np.array([densities[number] for number in block.elements.tolist()])
                values = _on_mass(block, corners, there, load)
                nodes = block.nodes
            else:
                nodes, values = _pressure(model, block, corners, load)
            np.add.at(forces, mesh.rows(nodes).ravel(), values.reshape(-1, 3))
        if left:
            raise ModelError(
                f"{load.where}: {load.label} on element {min(left)}, which has no shape"
            )
        rows, axes = np.nonzero(forces)
        found += [
            (int(mesh.nodes[row]), axis + 1, float(forces[row, axis]), load.where)
            for row, axis in zip(rows.tolist(), axes.tolist(), strict=True)
        ]
    return found


def _on_mass(block: Cells, corners: Floats, densities: Floats, load: SpreadLoad) -> Floats:
    """Forces (n_elements, n_nodes, 3); densities: (n_elements,), mass per what cells measure."""
    size, *rest = load.numbers
    along = np.array(rest[-3:]) / np.linalg.norm(rest[-3:])

    def acceleration(places: Floats) -> Floats:
        if load.label == "GRAV":
            return np.broadcast_to(size * along, places.shape)
        away = places - np.array(rest[:3])  # CENTRIF: omega^2, a point of the axis, its direction
        return np.asarray(size * (away - (away @ along)[..., None] * along))

    if block.kind == "vertex":
        return np.asarray(densities[:, None, None] * acceleration(corners))
    if block.kind not in OF_CELLS or not densities.any():
        return np.zeros_like(corners)

    def field(points: Points) -> Floats:
        places = points.places
        if block.kind == "tetra":  # which ccx looks at in its middle alone
            places = np.broadcast_to(corners.mean(axis=1, keepdims=True), places.shape)
        return np.asarray(densities[:, None, None] * acceleration(places))

    return nodal_forces(SHAPES[OF_CELLS[block.kind]], corners, field)


def _pressure(
    model: CalculixModel, block: Cells, corners: Floats, load: SpreadLoad
) -> tuple[np.ndarray[tuple[int, ...], np.dtype[np.int64]], Floats]:
    """Nodes (n_elements, n_nodes) that carry it, and their forces (n_elements, n_nodes, 3)."""
    size, number = load.numbers[0], load.label[1:]
    kind = model.mesh.elements[int(block.elements[0])].kind
    faces = FACES.get(CORNERS[block.kind], ()) if kind.startswith("C3D") else ()
    if not number and kind.startswith("S"):
        shape = SHAPES[OF_CELLS[block.kind]]
        return block.nodes, nodal_forces(shape, corners, lambda at: size * at.normals)
    if not 1 <= int(number or 0) <= len(faces):
        raise ModelError(
            f"{load.where}: {load.label} on element {block.elements[0]} ({kind}); supported are "
            f"{SUPPORTED}"
        )
    places, shape = face_nodes(block.kind, faces[int(number) - 1])
    middle = corners.mean(axis=1)[:, None]

    def inward(at: Points) -> Floats:
        sides = np.sum(at.normals * (middle - at.places), axis=2)
        return np.asarray(size * np.sign(sides)[..., None] * at.normals)

    own = list(places)
    return block.nodes[:, own], nodal_forces(shape, corners[:, own], inward)


def _densities(model: CalculixModel, load: SpreadLoad) -> dict[int, float]:
    """Of each loaded element its mass per volume, area or length, or the mass of a point."""
    found: dict[int, float] = {}
    for card in model.sections:
        members = model.members(card) & load.elements
        if members:
            found |= dict.fromkeys(members, _density(model, card, load))
    for number in sorted(load.elements - found.keys()):
        raise ModelError(f"{load.where}: {load.label} on element {number}, which has no section")
    return found


def _density(model: CalculixModel, card: KeywordCard, load: SpreadLoad) -> float:
    if card.is_one_of(*MASSLESS):
        return 0.0
    if card.is_one_of("*MASS"):
        return first_value(model, card, 0).value
    where = f"{load.where}: {load.label}: {model.deck.where(card)}"
    kinds = {model.mesh.elements[number].kind for number in model.members(card)}
    roles = {role for kind in kinds for role in roles_of(kind)}
    if "other" in roles or (load.label == "CENTRIF" and roles != {"solid"}):
        raise ModelError(f"{where}: {load.label} on {', '.join(sorted(kinds))} is not supported")
    if {"OFFSET", "OFFSET1", "OFFSET2", "NODALTHICKNESS"} & card.options.keys():
        raise ModelError(f"{where}: sections with OFFSET or NODAL THICKNESS are not supported")
    if "COMPOSITE" in card.options:
        layers = [(line, canonical_name(model.deck.fields(line)[2])) for line in card.data]
        return sum(model.number(line, 0) * _of(model, name) for line, name in layers)
    density = _of(model, card.option("MATERIAL"))
    if card.is_one_of("*SHELL SECTION"):
        return density * first_value(model, card, 0).value
    if not card.is_one_of("*BEAM SECTION"):
        return density
    a, b = (model.number(card.data[0], place) for place in (0, 1))
    areas = {
        "RECT": a * b,
        "CIRC": ELLIPSE * a * b / 4.0,
        "PIPE": math.pi * (2.0 * a * b - b * b),  # outer radius and thickness
    }
    section = card.option("SECTION") or "RECT"
    if section not in areas:
        raise ModelError(f"{where}: the area of a {section} beam is not known here")
    return density * areas[section]


def _of(model: CalculixModel, material: str) -> float:
    return find_density(model, material)[0].value
