"""Where the grid points of a Nastran model lie, in what axes, and what its elements look like.

Nastran numbers the nodes of plane elements, tetrahedra and pyramids as VTK does. In CHEXA and
CPENTA it has the midside nodes between the two faces before those round the second face; VTK has
them last. Rigid elements (RBE2, RBE3, RBAR ...) are relations, not parts of the structure: they
are left out, since their spiders would cover it; their grid points stay.

Bars, beams and bushes have element coordinate systems: their axes and offsets are found here too.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from modetune.adapters.nastran.bulk import Bulk
from modetune.core.mesh import NODES, CellKind, Cells, Mesh
from modetune.core.modes import Floats


def local_axes(frame: Any, place: Floats) -> Floats:
    """Axes of a coordinate system at a place, as rows in basic coordinates (3, 3).

    frame: a cross-referenced CORD card, or None for the basic system. In a cylindrical or
    spherical one the axes are those of the place's own radius and angles; on its z axis, where
    the radius has no direction, the system's x axis replaces it.
    """
    if frame is None:
        return np.eye(3)
    axes = np.asarray(frame.beta(), dtype=np.float64)
    if frame.type.endswith("R"):
        return axes
    x, y, z = axes @ (place - np.asarray(frame.origin, dtype=np.float64))
    radius = float(np.hypot(x, y))
    on_axis = radius <= 1e-12 * (1.0 + abs(float(z)))
    cos, sin = (1.0, 0.0) if on_axis else (float(x) / radius, float(y) / radius)
    if frame.type.endswith("C"):
        return np.array([[cos, sin, 0.0], [-sin, cos, 0.0], [0.0, 0.0, 1.0]]) @ axes
    polar = float(np.arctan2(radius, z))
    up, out = float(np.cos(polar)), float(np.sin(polar))
    turn = [[out * cos, out * sin, up], [up * cos, up * sin, -out], [-sin, cos, 0.0]]
    return np.asarray(np.array(turn) @ axes)


def output_frames(bulk: Any) -> dict[int, Floats]:
    """Basic-to-CD rotation (3, 3) of each grid point whose output frame is not the basic one."""
    frames = {}
    for number, grid in bulk.nodes.items():
        if grid.cd_ref is not None and grid.Cd() != 0:
            axes = local_axes(grid.cd_ref, np.asarray(grid.get_position(), dtype=np.float64))
            if not np.allclose(axes, np.eye(3), rtol=0.0, atol=1e-12):
                frames[number] = axes
    return frames


#: What an element is drawn as with its corner nodes alone, and with all its nodes.
SHAPES: dict[str, tuple[CellKind, CellKind]] = {
    "CTRIA3": ("triangle", "triangle"), "CTRIAR": ("triangle", "triangle"),
    "CTRIA6": ("triangle", "triangle6"),
    "CQUAD4": ("quad", "quad"), "CQUADR": ("quad", "quad"), "CSHEAR": ("quad", "quad"),
    "CQUAD8": ("quad", "quad8"),
    "CTETRA": ("tetra", "tetra10"), "CPYRAM": ("pyramid", "pyramid13"),
    "CPENTA": ("wedge", "wedge15"), "CHEXA": ("hexahedron", "hexahedron20"),
}  # fmt: skip
#: Elements between two grid points, of which one may be missing or the ground.
LINKS = frozenset((
    "CBAR", "CBEAM", "CBEND", "CROD", "CONROD", "CTUBE", "CBUSH", "CBUSH1D", "CVISC", "CGAP",
    "CELAS1", "CELAS2", "CDAMP1", "CDAMP2",
))  # fmt: skip
#: Straight links with bending, whose ends pass on rotations.
BARS = frozenset(("CBAR", "CBEAM"))
#: Masses at one grid point, or between two.
MASSES = frozenset(("CONM1", "CONM2", "CMASS1", "CMASS2"))
#: Positions of VTK's nodes in Nastran's order, for the shapes in which the two differ.
ORDERS: dict[CellKind, tuple[int, ...]] = {
    "wedge15": (*range(9), 12, 13, 14, 9, 10, 11),
    "hexahedron20": (*range(12), 16, 17, 18, 19, 12, 13, 14, 15),
}


def read_geometry(bulk: Bulk) -> Mesh:
    """All grid points in basic coordinates, the elements between them, and output frames (CD).

    bulk: pyNastran's model, cross-referenced. Elements with some of their midside nodes are drawn
    by their corners; scalar points have no place and are not part of it.
    """
    numbers = np.array(sorted(bulk.nodes), dtype=np.int64)
    blocks: dict[CellKind, list[list[int]]] = {}
    for number, item in [*bulk.elements.items(), *bulk.masses.items()]:
        kind, nodes = _cell(item, bulk)
        if kind:
            blocks.setdefault(kind, []).append([number, *nodes])
    return Mesh(
        nodes=numbers,
        coordinates=np.array([_place(bulk.nodes[n]) for n in numbers.tolist()]).reshape(-1, 3),
        cells=tuple(_cells(kind, blocks[kind]) for kind in sorted(blocks)),
        frames=output_frames(bulk),
        bars=frozenset(number for number, item in bulk.elements.items() if item.type in BARS),
    )


def _cell(item: Any, bulk: Bulk) -> tuple[CellKind | None, Sequence[int]]:
    """The shape of an element and its grid points; no shape where it has no place."""
    nodes = [node or 0 for node in item.node_ids]
    if item.type in SHAPES:
        plain, full = SHAPES[item.type]
        count = NODES[full]
        kind = full if len(nodes) >= count and all(nodes[:count]) else plain
        return kind, nodes[: NODES[kind]]
    if item.type in LINKS | MASSES:
        ends = list(dict.fromkeys(node for node in nodes if node in bulk.nodes))
        if ends:
            return ("line" if len(ends) > 1 else "vertex"), ends[:2]
    return None, ()


def _cells(kind: CellKind, rows: Iterable[Sequence[int]]) -> Cells:
    table = np.array(list(rows), dtype=np.int64)
    nodes = table[:, 1:]
    if kind in ORDERS:
        nodes = nodes[:, ORDERS[kind]]
    return Cells(kind, table[:, 0], nodes)


def _place(grid: Any) -> Floats:
    return np.asarray(grid.xyz if grid.Cp() == 0 else grid.get_position(), dtype=np.float64)


#: What OFFT may be: of the orientation vector, of the offset at end A, at end B.
OFFSET_TYPES = frozenset(first + a + b for first in "GB" for a in "GO" for b in "GO")

#: In the place of OFFT old decks say how the orientation is given, by components or a grid point.
OLD_VECTOR, OLD_GRID = "1", "2"


@dataclass(frozen=True, slots=True)
class BeamAxes:
    """offsets: (2, 3), from the grid points to the axis' ends; ends: (2, 3), of the axis; axes:
    (3, 3), x, y, z of the element as rows. Basic coordinates.
    """

    offsets: Floats
    ends: Floats
    axes: Floats

    @property
    def length(self) -> float:
        return float(np.linalg.norm(self.ends[1] - self.ends[0]))


def beam_axes(element: Any, places: Mapping[int, Floats], frames: Mapping[int, Floats]) -> BeamAxes:
    """Of a bar, beam or rod. Raises ValueError with what is wrong with it.

    places: (3,) of each grid point; frames: (3, 3) of those whose output frame is not the basic
    one. OFFT says what the orientation vector and the offsets are parallel to: the output frame of
    their grid point (G), the basic system (B), or x from grid point to grid point with y and z by
    the orientation vector (O).
    """
    nodes = element.node_ids[:2]
    grids = np.array([places[node] for node in nodes])
    if getattr(element, "wa", None) is None:
        x = _unit(grids[1] - grids[0])
        return BeamAxes(np.zeros((2, 3)), grids, _element_axes(x, _any_direction(x)))
    kind = str(getattr(element, "offt", None) or "GGG").upper()
    if kind == (OLD_GRID if element.g0 else OLD_VECTOR):
        kind = "GGG"
    if kind not in OFFSET_TYPES:
        raise ValueError(f"OFFT={kind} is not one of {', '.join(sorted(OFFSET_TYPES))}")
    towards = _orientation(element, kind, places, frames)
    offsets = np.zeros((2, 3))
    for end, (given, node, system) in enumerate(
        zip((element.wa, element.wb), nodes, kind[1:], strict=True)
    ):
        if np.any(given):
            frame = frames.get(node, np.eye(3))
            if system == "O":
                frame = _element_axes(_unit(grids[1] - grids[0]), towards)
            offsets[end] = np.asarray(given, dtype=np.float64) @ frame
    ends = grids + offsets
    return BeamAxes(offsets, ends, _element_axes(_unit(ends[1] - ends[0]), towards))


def _unit(span: Floats) -> Floats:
    length = float(np.linalg.norm(span))
    if not length > 0.0:
        raise ValueError("its ends coincide")
    return span / length


def _any_direction(x: Floats) -> Floats:
    """The basic axis that is farthest from x, where nothing depends on the orientation."""
    return np.asarray(np.eye(3)[int(np.argmin(np.abs(x)))])


def _element_axes(x: Floats, towards: Floats) -> Floats:
    z = np.cross(x, towards)
    size = float(np.linalg.norm(z))
    if not size > 1e-6 * float(np.linalg.norm(towards)):
        raise ValueError("its orientation vector is along its axis")
    z = z / size
    return np.array([x, np.cross(z, x), z])


def _orientation(
    element: Any, kind: str, places: Mapping[int, Floats], frames: Mapping[int, Floats]
) -> Floats:
    """The orientation vector, basic coordinates."""
    if element.g0:
        return np.asarray(places[element.g0] - places[element.node_ids[0]])
    if element.x is None or any(value is None for value in element.x):
        raise ValueError("it has no orientation vector")
    frame = frames.get(element.node_ids[0], np.eye(3)) if kind[0] == "G" else np.eye(3)
    return np.asarray(np.asarray(element.x, dtype=np.float64) @ frame)


def bush_place(element: Any, coordinates: Mapping[int, Floats]) -> tuple[Floats, Floats]:
    """The point at which it acts, and the way from its first end to its second one (or none)."""
    first, second = [*element.node_ids, None][:2]
    start = np.asarray(coordinates[first])
    span = coordinates[second] - start if second else np.zeros(3)
    place = start + (0.5 if element.s is None else element.s) * span
    if element.ocid is not None and element.ocid >= 0:
        place = np.asarray(element.ocid_ref.transform_node_to_global(np.array(element.si)))
    return place, span


def bush_axes(
    element: Any,
    span: Floats,
    coordinates: Mapping[int, Floats],
    frames: Mapping[int, Floats],
    values: Sequence[float],
) -> Floats:
    """x, y, z of the bush as rows in basic coordinates.

    frames: output frames of grid points that are not basic; values: (6,), what it has in each
    direction. Raises ValueError where the deck does not tell.
    """
    place = coordinates[element.node_ids[0]]
    if element.cid is not None:
        return local_axes(element.cid_ref, place)
    length = float(np.linalg.norm(span))
    size = 1e-9 * (1.0 + float(np.abs(place).max()))
    if length <= size:
        raise ValueError("its ends coincide or one is grounded: it needs a CID")
    x = span / length
    if element.g0:
        towards = coordinates[element.g0] - place
    elif element.x is not None and element.x[0] is not None:
        frame = frames.get(element.node_ids[0], np.eye(3))
        towards = np.asarray(element.x, dtype=np.float64) @ frame
    elif any(values[1:3]) or any(values[4:6]):
        raise ValueError("it has no orientation vector, and stiffness across its axis")
    else:
        towards = _any_direction(x)
    return _element_axes(x, np.asarray(towards))
