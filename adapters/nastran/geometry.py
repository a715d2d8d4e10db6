"""Where the grid points of a Nastran model lie, in what axes, and what its elements look like.

Nastran numbers the nodes of plane elements, tetrahedra and pyramids as VTK does. In CHEXA and
CPENTA it has the midside nodes between the two faces before those round the second face; VTK has
them last. Rigid elements (RBE2, RBE3, RBAR ...) are relations, not parts of the structure: they
are left out, since their spiders would cover it; their grid points stay.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

from modetune.adapters.nastran.bulk import Bulk
from modetune.core.mesh import NODES, CellKind, Cells, Mesh
from modetune.core.modes import Floats


def local_axes(frame: Any, place: Floats) -> Floats:
    """Axes of a coordinate system at a place, as rows in basic coordinates (3, 3).

    frame: a cross-referenced CORD card, or None for the basic system. In a cylindrical or
    spherical one the axes are those of the place's own radius and angles; on its z axis, where
    the radius has no direction, the system's x axis stands for it.
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
#: Masses at one grid point, or between two.
MASSES = frozenset(("CONM1", "CONM2", "CMASS1", "CMASS2"))
#: Where VTK's nodes stand in Nastran's, for the shapes in which the two differ.
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
