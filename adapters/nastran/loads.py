"""The load cases of a Nastran deck: forces, moments, pressures and gravity of a load set.

Pressure goes to the grid points by the shape functions of the loaded face. GRAV accelerates all
mass, with forces by a lumped mass matrix.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from modetune.adapters.nastran.fields import NastranCard
from modetune.adapters.nastran.mesh import local_axes
from modetune.adapters.nastran.structure import Structure
from modetune.core.element_geometry import (
    FACES,
    OF_CELLS,
    SHAPES,
    ElementShape,
    face_nodes,
    nodal_forces,
)
from modetune.core.errors import ModelError
from modetune.core.mesh import CORNERS, CellKind, Mesh
from modetune.core.modes import Floats
from modetune.core.updating.static_model import Force, LoadCase

#: Cards whose second field is a load set, and which are not converted to forces at grid points.
OTHER_LOADS = (
    "FORCE1", "FORCE2", "MOMENT1", "MOMENT2", "PLOAD1", "PLOADX1", "ACCEL", "ACCEL1", "RFORCE",
    "SLOAD", "SPCD", "TEMP", "TEMPD", "DEFORM",
)  # fmt: skip
#: First component of each.
FIRST = {"FORCE": 1, "MOMENT": 4}
PRESSURES = ("PLOAD", "PLOAD2", "PLOAD4")
SUPPORTED = (*FIRST, *PRESSURES, "GRAV", "LOAD")
LOAD_PAIRS = 3


@dataclass(frozen=True, slots=True)
class LoadedModel:
    """A model, and its elements by number: shape, and grid points in the order of VTK."""

    structure: Structure
    mesh: Mesh
    cells: dict[int, tuple[CellKind, list[int]]]


@dataclass(frozen=True, slots=True)
class Face:
    """A loaded face: its grid points and shape, and of a solid's a place inside."""

    grids: list[int]
    shape: ElementShape
    inside: Floats | None = None


@dataclass(slots=True)
class Found:
    """What load sets have together: forces, parts of pressures, and an acceleration (3,)."""

    forces: list[Force] = field(default_factory=list)
    spread: list[Force] = field(default_factory=list)
    acceleration: Floats = field(default_factory=lambda: np.zeros(3))


def load_case(structure: Structure, mesh: Mesh, number: int) -> LoadCase:
    """The forces of a load set. Raises ModelError where the deck has none, or other loads."""
    if len(structure.deck.parts) > 1:
        raise ModelError(
            f"{structure.deck.file}: loads of superelements are not read; take the load to a deck "
            "without BEGIN SUPER"
        )
    found, cells = Found(), dict[int, tuple[CellKind, list[int]]]()
    if structure.deck.named(*PRESSURES):
        cells = {
            element: (block.kind, nodes)
            for block in mesh.cells
            for element, nodes in zip(block.elements.tolist(), block.nodes.tolist(), strict=True)
        }
    _collect(LoadedModel(structure, mesh, cells), str(number), 1.0, (), found)
    return LoadCase.of_forces(found.forces, found.spread, acceleration=found.acceleration)


def _collect(
    model: LoadedModel, number: str, factor: float, above: tuple[str, ...], found: Found
) -> None:
    """Add a load set times a factor. above: sets that name it."""
    structure, deck, there = model.structure, model.structure.deck, False
    for card in deck.named(*OTHER_LOADS, *SUPPORTED):
        if card.text(1) != number:
            continue
        there = True
        if card.name in OTHER_LOADS:
            enforced = ": enforced displacements are not supported" if card.name == "SPCD" else ""
            raise ModelError(
                f"{deck.where(card)}: {card.name} of load set {number}{enforced}; load cases here "
                f"are {', '.join(SUPPORTED[:-1])} and LOAD"
            )
        if card.name == "LOAD":
            if number in above:
                raise ModelError(f"{deck.where(card)}: LOAD {number} names itself")
            whole = structure.deck.number(card, 2) or 0.0
            for place in range(LOAD_PAIRS, len(card.fields), 2):
                if card.text(place + 1):
                    share = factor * whole * (structure.deck.number(card, place) or 0.0)
                    _collect(model, card.text(place + 1), share, (*above, number), found)
        elif card.name in FIRST:
            found.forces += _of_card(structure, card, factor)
        elif card.name == "GRAV":
            size = factor * (structure.deck.number(card, 3) or 0.0)
            found.acceleration = found.acceleration + size * _vector(structure, card, 2)
        else:
            found.spread += _pressed(model, card, factor)
    if not there:
        sets = {card.text(1) for card in deck.named(*SUPPORTED)}
        has = ", ".join(sorted(sets)) or "none"
        raise ModelError(f"{deck.file}: the deck has no load set {number}; it has {has}")


def _frame(structure: Structure, card: NastranCard, place: int) -> Any:
    """The system that a field names, None for the basic one."""
    text = card.text(place) or "0"
    if not text.isdecimal() or int(text) not in structure.bulk.coords:
        where = structure.deck.where(card)
        raise ModelError(f"{where}: {card.name} names system {text}, which is not there")
    return structure.bulk.coords[int(text)]


def _vector(structure: Structure, card: NastranCard, frame_at: int) -> Floats:
    """A direction (3,) in basic axes, of the same length all over the model.

    frame_at: field of its system; its components end two fields further on for GRAV (a size is
    between) and follow for PLOAD4. Raises ModelError for a system that is not rectangular.
    """
    first = frame_at + (2 if card.name == "GRAV" else 1)
    vector = np.array([structure.deck.number(card, first + k) or 0.0 for k in range(3)])
    frame = _frame(structure, card, frame_at) if vector.any() else None
    if frame is not None and not frame.type.endswith("R"):
        where = structure.deck.where(card)
        raise ModelError(f"{where}: {card.name} in a {frame.type} system is not supported")
    return np.asarray(local_axes(frame, np.zeros(3)).T @ vector)


def _grids(structure: Structure, card: NastranCard, texts: Sequence[str]) -> list[int]:
    """Grid points that fields name. Raises ModelError."""
    for text in texts or [""]:
        if not text.isdecimal() or int(text) not in structure.bulk.nodes:
            where = structure.deck.where(card)
            raise ModelError(f"{where}: {card.name} names a grid point that is not there: {text}")
    return [int(text) for text in texts]


def _of_card(structure: Structure, card: NastranCard, factor: float) -> list[Force]:
    """What a FORCE or MOMENT is along the axes that results have at its grid point (CD)."""
    frame, (grid,) = _frame(structure, card, 3), _grids(structure, card, [card.text(2)])
    point = structure.bulk.nodes[grid]
    place = np.asarray(point.get_position(), dtype=np.float64)
    vector = np.array([structure.deck.number(card, k) or 0.0 for k in (5, 6, 7)])
    size = factor * (structure.deck.number(card, 4) or 0.0)
    values = local_axes(point.cd_ref, place) @ (local_axes(frame, place).T @ (size * vector))
    where = structure.deck.where(card)
    return [
        (grid, FIRST[card.name] + axis, value, where)
        for axis, value in enumerate(values.tolist())
        if value
    ]


def _pressed(model: LoadedModel, card: NastranCard, factor: float) -> list[Force]:
    """A pressure at grid points, along a shell's normal, into a solid, or along a vector."""
    structure, mesh, vector = model.structure, model.mesh, np.zeros(3)
    size = factor * (structure.deck.number(card, 3 if card.name == "PLOAD4" else 2) or 0.0)
    if card.name == "PLOAD":
        corners = _grids(structure, card, [card.text(k) for k in range(3, 7) if card.text(k)])
        faces = [Face(corners, SHAPES["S4" if len(corners) == 4 else "S3"])]
    else:
        faces = [_face(model, card, number) for number in _elements(model, card)]
    if card.name == "PLOAD4":
        _refuse_uneven(structure, card)
        vector = _vector(structure, card, 9)
        vector = vector / (np.linalg.norm(vector) or 1.0)
    found: list[Force] = []
    for face in faces:
        places = mesh.coordinates[mesh.rows(np.array(face.grids))][None]
        values = nodal_forces(face.shape, places, lambda at: at.normals)[0]
        if vector.any():
            values = (
                nodal_forces(face.shape, places, lambda at: np.ones_like(at.places))[0] * vector
            )
        elif face.inside is not None:
            values *= np.sign(values.sum(axis=0) @ (face.inside - places[0].mean(axis=0)))
        for grid, value in zip(face.grids, size * values, strict=True):
            own = mesh.frames.get(grid, np.eye(3)) @ value
            found += [
                (grid, axis + 1, part, structure.deck.where(card))
                for axis, part in enumerate(own.tolist())
                if part
            ]
    return found


def _refuse_uneven(structure: Structure, card: NastranCard) -> None:
    """Raise ModelError for a PLOAD4 that is not one pressure along one direction."""
    where = structure.deck.where(card)
    pressures = {structure.deck.number(card, k) for k in (3, 4, 5, 6)} - {None}
    if len(pressures) > 1:
        raise ModelError(f"{where}: PLOAD4 that differs from corner to corner is not supported")
    if card.text(13) not in ("", "SURF") or card.text(14) not in ("", "NORM"):
        raise ModelError(f"{where}: PLOAD4 with SORL or LDIR is not supported")


def _elements(model: LoadedModel, card: NastranCard) -> list[int]:
    """Elements that a PLOAD2 or PLOAD4 names, with THRU between two. Raises ModelError."""
    places: Sequence[int] = range(3, 9)
    if card.name == "PLOAD4":
        places = (2, 7, 8) if card.text(7) == "THRU" else (2,)
    texts = [card.text(k) for k in places if card.text(k)]
    if "THRU" in texts:
        first, last = (int(text) if text.isdecimal() else 0 for text in (texts[0], texts[-1]))
        texts = [str(n) for n in model.structure.bulk.elements if first <= n <= last]
    for text in texts or [""]:
        if not text.isdecimal() or int(text) not in model.cells:
            where = model.structure.deck.where(card)
            raise ModelError(f"{where}: {card.name} names element {text}, which is not there")
    return [int(text) for text in texts]


def _face(model: LoadedModel, card: NastranCard, number: int) -> Face:
    """A shell, or the face of a solid with G1 and, opposite of it, G3; of a tetrahedron that
    without G4, and of a wedge the triangle with G1 where G3 is left out. Raises ModelError."""
    kind, nodes = model.cells[number]
    faces = FACES.get(CORNERS[kind], ()) if kind not in ("quad", "quad8") else ()
    if not faces:
        if kind not in OF_CELLS or kind.startswith("line"):
            where = model.structure.deck.where(card)
            raise ModelError(f"{where}: {card.name} on element {number}, which has no such face")
        return Face(nodes, SHAPES[OF_CELLS[kind]])
    named = _grids(model.structure, card, [card.text(k) for k in (7, 8) if card.text(k)])
    for corners in faces:
        ring = [nodes[k] for k in corners]
        if not named or named[0] not in ring:
            continue
        other = named[1] if len(named) > 1 else None
        if CORNERS[kind] == 4:
            fits = other is not None and other not in ring
        elif other is None:
            fits = len(ring) == 3
        else:
            fits = other in ring and abs(ring.index(named[0]) - ring.index(other)) == 2
        if fits:
            places, shape = face_nodes(kind, corners)
            inside = model.mesh.coordinates[model.mesh.rows(np.array(nodes))].mean(axis=0)
            return Face([nodes[k] for k in places], shape, inside)
    where = model.structure.deck.where(card)
    raise ModelError(f"{where}: {card.name} names no face of element {number} by its G1 and G3, G4")
