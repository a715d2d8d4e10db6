"""The load cases of a CalculiX deck: concentrated and distributed loads of its *STATIC steps.

A case has the number of its step among the static ones. Loads persist from step to step until
OP=NEW; within one step those of a degree of freedom add up, and the first one there takes the
place of an earlier step's (seen in reactions of ccx 2.20). A distributed load given twice on one
element is refused.

Distributed loads become forces at nodes, f_i = int N_i b dV. Gravity and rotation act on an
element's mass, pressure on a face of a solid (into it) or on a shell (along its normal). Of shells
and beams, which ccx expands to solids, the forces of the expanded nodes of one node of the deck
add up to what the shape functions of the deck's own element give; how they are spread over the
thickness is not kept.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np

from modetune.adapters.calculix.cards import CARDS, first_value
from modetune.adapters.calculix.constraints import node_sets, read_constraints, set_members
from modetune.adapters.calculix.deck import KeywordCard, canonical_name
from modetune.adapters.calculix.mesh import roles_of
from modetune.adapters.calculix.places import fields_of
from modetune.adapters.calculix.structure import CalculixStructure
from modetune.core.element_geometry import FACES, OF_CELLS, SHAPES, Points, face_nodes, nodal_forces
from modetune.core.errors import ModelError
from modetune.core.mesh import CORNERS, Cells, Mesh
from modetune.core.modes import Floats
from modetune.core.updating.static_model import LoadCase

#: What a load case cannot have here: other loads and supports than the matrices' own.
OTHER_LOADS = (
    "*DSLOAD", "*TEMPERATURE", "*CFLUX", "*DFLUX", "*FILM", "*RADIATE", "*MODEL CHANGE",
    "*CHANGE FRICTION",
)  # fmt: skip


def load_case(structure: CalculixStructure, mesh: Mesh, number: int) -> LoadCase:
    """The forces of a static step. Raises ModelError where the deck has none, or other loads."""
    deck = structure.deck
    steps = list(_steps(structure))
    static = [step for step in steps if any(card.is_one_of("*STATIC") for card in step)]
    if not 0 < number <= len(static):
        at = ", ".join(deck.where(step[0]) for step in static)
        has = (
            f"{len(static)} *STATIC step{'s' * (len(static) > 1)} ({at})"
            if static
            else "no *STATIC step"
        )
        raise ModelError(f"{deck.file}: the deck has no load case {number}; it has {has}")
    if structure.preload():
        raise ModelError(
            f"{structure.preload()}: the stiffness depends on a state, and static displacements "
            "are of the linear model: take it out of the deck"
        )
    sets, forces = node_sets(structure), dict[tuple[int, int], tuple[float, str]]()
    spread: list[SpreadLoad] = []
    turned = read_constraints(structure).turned
    wanted = static[number - 1]
    for step in steps[: steps.index(wanted) + 1]:
        named, before = set[tuple[int, int]](), spread
        for card in step:
            _refuse(structure, card, step is wanted)
            if card.is_one_of("*DLOAD"):
                if card.option("OP") == "NEW" and spread is before:
                    spread = []
                spread = [*spread, *(_spread(structure, line) for line in card.data)]
            if not card.is_one_of("*CLOAD"):
                continue
            if card.option("OP") == "NEW" and not named:
                forces.clear()
            for position in card.data:
                fields, where = [*deck.fields(position), "", ""], deck.lines[position].where
                members = set_members(fields[0], sets)
                if not members or not members <= structure.mesh.nodes or fields[1] not in "123456":
                    raise ModelError(f"{where}: *CLOAD needs a node or set, 1 to 6, and a force")
                if members & turned:
                    raise ModelError(f"{where}: *CLOAD at a node of *TRANSFORM is not supported")
                value = structure.deck.number(position, 2)
                for node in members:
                    dof = node, int(fields[1])
                    there = forces[dof][0] if dof in named else 0.0
                    forces[dof] = there + value, where
                    named.add(dof)
    if not forces and not spread:
        raise ModelError(
            f"{deck.where(wanted[0])}: the step of load case {number} has neither *CLOAD nor *DLOAD"
        )
    _refuse_twice(spread)
    found = [(*dof, value, at) for dof, (value, at) in sorted(forces.items())]
    by_mass = any(load.label in ON_MASS for load in spread)
    return LoadCase.of_forces(found, spread_forces(structure, mesh, spread), by_mass)


def _spread(structure: CalculixStructure, line: int) -> SpreadLoad:
    """A line of *DLOAD. Raises ModelError."""
    name, label = [*structure.deck.fields(line), ""][:2]
    where, label = structure.deck.lines[line].where, label.upper().replace(" ", "")
    elements = structure.mesh.named(name) if name else frozenset[int]()
    pressure = label == "P" or (label[:1] == "P" and label[1:] in tuple("123456"))
    if not elements or not (label in ON_MASS or pressure):
        raise ModelError(
            f"{where}: *DLOAD needs an element or set of the deck, and a load; supported are "
            f"{SUPPORTED}"
        )
    numbers = [structure.deck.number(line, 2 + place) for place in range(ON_MASS.get(label, 1))]
    if label in ON_MASS and not math.hypot(*numbers[-3:]):
        raise ModelError(f"{where}: {label} has no direction: its last three numbers are zero")
    return SpreadLoad(elements, label, tuple(numbers), where)


def _refuse_twice(spread: list[SpreadLoad]) -> None:
    """Raise ModelError if a load is given twice on an element: ccx takes one of them."""
    seen: dict[tuple[str, int], str] = {}
    for load in spread:
        for number in load.elements:
            if (load.label, number) in seen:
                raise ModelError(
                    f"{load.where}: {load.label} on element {number} is defined already "
                    f"({seen[load.label, number]}); give it once, with OP=NEW in a later step"
                )
            seen[load.label, number] = load.where


def _steps(structure: CalculixStructure) -> Iterator[list[KeywordCard]]:
    step: list[KeywordCard] = []
    for card in structure.deck.cards:
        if card.is_one_of("*STEP"):
            step = [card]
        elif step:
            step.append(card)
            if card.is_one_of("*END STEP"):
                yield step
                step = []


def _refuse(structure: CalculixStructure, card: KeywordCard, wanted: bool) -> None:
    """Raise ModelError for what makes a case other than forces on the linear model.

    wanted: whether the card is in the case's own step; supports of all steps before count too.
    """
    where = structure.deck.where(card)
    if card.is_one_of("*BOUNDARY"):
        raise ModelError(
            f"{where}: *BOUNDARY in a step; supports must be above all steps, and enforced "
            "displacements are not supported, since stored matrices have no equations there: "
            "load the structure by forces"
        )
    if card.is_one_of(*OTHER_LOADS):
        raise ModelError(
            f"{where}: {card.keyword} in a step; load cases here are *CLOAD and *DLOAD "
            f"({SUPPORTED})"
        )
    nonlinear = "NLGEOM" in card.options and card.option("NLGEOM") != "NO"
    if card.is_one_of("*STEP") and wanted and nonlinear:
        raise ModelError(f"{where}: a load case with NLGEOM is not linear")
    if card.is_one_of("*CLOAD", "*DLOAD") and set(card.options) - {"OP"}:
        more = ", ".join(sorted(set(card.options) - {"OP"}))
        raise ModelError(f"{where}: {card.keyword} with {more} is not supported")


#: Loads on mass by their labels, with how many numbers each has.
ON_MASS = {"GRAV": 4, "CENTRIF": 7}
SUPPORTED = "GRAV, CENTRIF on solids and masses, P on shells and P1 to P6 on solids"
#: ccx has a circle of unit radius as a square whose sides are parabolas through its middle.
ELLIPSE = 2.0 + 8.0 / 3.0 * (math.sqrt(2.0) - 1.0)


@dataclass(frozen=True, slots=True)
class SpreadLoad:
    """A line of *DLOAD: elements, label, numbers, and file and line."""

    elements: frozenset[int]
    label: str
    numbers: tuple[float, ...]
    where: str


def spread_forces(
    structure: CalculixStructure, mesh: Mesh, loads: Iterable[SpreadLoad]
) -> list[tuple[int, int, float, str]]:
    """Node, component, force and place of each. Raises ModelError with file and line."""
    found = []
    for load in loads:
        forces = np.zeros((mesh.nodes.size, 3))
        densities = _densities(structure, load) if load.label in ON_MASS else {}
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
                nodes, values = _pressure(structure, block, corners, load)
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
    structure: CalculixStructure, block: Cells, corners: Floats, load: SpreadLoad
) -> tuple[np.ndarray[tuple[int, ...], np.dtype[np.int64]], Floats]:
    """Nodes (n_elements, n_nodes) that carry it, and their forces (n_elements, n_nodes, 3)."""
    size, number = load.numbers[0], load.label[1:]
    kind = structure.mesh.elements[int(block.elements[0])].kind
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


def _densities(structure: CalculixStructure, load: SpreadLoad) -> dict[int, float]:
    """Of each loaded element its mass per volume, area or length, or the mass of a point."""
    found: dict[int, float] = {}
    for card in structure.sections:
        members = structure.members(card) & load.elements
        if members:
            found |= dict.fromkeys(members, _density(structure, card, load))
    for number in sorted(load.elements - found.keys()):
        raise ModelError(f"{load.where}: {load.label} on element {number}, which has no section")
    return found


def _density(structure: CalculixStructure, card: KeywordCard, load: SpreadLoad) -> float:
    if CARDS[card.keyword].massless:
        return 0.0
    if card.is_one_of("*MASS"):
        return first_value(structure.deck, card, 0).value
    where = f"{load.where}: {load.label}: {structure.deck.where(card)}"
    kinds = {structure.mesh.elements[number].kind for number in structure.members(card)}
    roles = {role for kind in kinds for role in roles_of(kind)}
    if "other" in roles or (load.label == "CENTRIF" and roles != {"solid"}):
        raise ModelError(f"{where}: {load.label} on {', '.join(sorted(kinds))} is not supported")
    if {"OFFSET", "OFFSET1", "OFFSET2", "NODALTHICKNESS"} & card.options.keys():
        raise ModelError(f"{where}: sections with OFFSET or NODAL THICKNESS are not supported")
    if "COMPOSITE" in card.options:
        layers = [(line, canonical_name(structure.deck.fields(line)[2])) for line in card.data]
        return sum(structure.deck.number(line, 0) * _of(structure, name) for line, name in layers)
    density = _of(structure, card.option("MATERIAL"))
    if card.is_one_of("*SHELL SECTION"):
        return density * first_value(structure.deck, card, 0).value
    if not card.is_one_of("*BEAM SECTION"):
        return density
    a, b = (structure.deck.number(card.data[0], place) for place in (0, 1))
    areas = {
        "RECT": a * b,
        "CIRC": ELLIPSE * a * b / 4.0,
        "PIPE": math.pi * (2.0 * a * b - b * b),  # outer radius and thickness
    }
    section = card.option("SECTION") or "RECT"
    if section not in areas:
        raise ModelError(f"{where}: the area of a {section} beam is not known here")
    return density * areas[section]


def _of(structure: CalculixStructure, material: str) -> float:
    return fields_of(structure, "density", material)[0].value
