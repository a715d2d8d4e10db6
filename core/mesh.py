"""The finite element mesh as far as pictures, sensors and files of results need it.

How a field strains it follows from displacements at nodes alone: an element is strained where the
distances between its corners change. With a segment from corner i to corner j, of length l and
direction t, its elongation is t^T (d_j - d_i) / l, and an element's strain is the root mean square
over all pairs of its corners: edges, diagonals of faces, diagonals of the volume. Rigid motion has
none (to first order), and bending of a single layer of solids is seen as it is: edges on both faces
elongate and shorten, while the diagonals across the thickness keep their length, so the shear that
a gradient at a corner would find there is not seen.

A node's strain is the root mean square of its elements', each of them counted once.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from itertools import combinations
from typing import Literal

import numpy as np

from modetune.core.errors import ModelError
from modetune.core.modes import Floats, Integers, ModeSet

#: Shapes of cells by the names of meshio; their nodes stand in the order of VTK.
CellKind = Literal[
    "vertex", "line", "line3", "triangle", "triangle6", "quad", "quad8", "tetra", "tetra10",
    "pyramid", "pyramid13", "wedge", "wedge15", "hexahedron", "hexahedron20",
]  # fmt: skip
#: How many of a cell's nodes, the first ones, are its corners.
CORNERS: dict[CellKind, int] = {
    "vertex": 1, "line": 2, "line3": 2, "triangle": 3, "triangle6": 3, "quad": 4, "quad8": 4,
    "tetra": 4, "tetra10": 4, "pyramid": 5, "pyramid13": 5, "wedge": 6, "wedge15": 6,
    "hexahedron": 8, "hexahedron20": 8,
}  # fmt: skip
#: How many nodes a cell has.
NODES: dict[CellKind, int] = {
    **CORNERS, "line3": 3, "triangle6": 6, "quad8": 8, "tetra10": 10, "pyramid13": 13,
    "wedge15": 15, "hexahedron20": 20,
}  # fmt: skip
#: Components 1..6 that cannot move, by node, in the axes of the node's results.
Fixed = Mapping[int, frozenset[int]]
NOTHING_FIXED: Fixed = {}
#: In how many directions cells extend, 3 where none is named, and what part of a box of that
#: spread those that are no boxes fill.
DIMENSIONS = {"vertex": 0, "line": 1, "triangle": 2, "quad": 2}
FILLED = {"triangle": 0.65, "tetra": 1.0 / 3.0}
#: Tetrahedra that move less than this part of a mode's largest motion say little about its mesh.
AT_REST = 0.1


@dataclass(frozen=True, slots=True)
class Cells:
    """Elements of one shape.

    elements: (n_cells,), their numbers in the deck. nodes: (n_cells, n_nodes), node numbers.
    """

    kind: CellKind
    elements: Integers
    nodes: Integers


@dataclass(frozen=True, slots=True)
class Mesh:
    """Nodes that carry results, and the elements between them.

    nodes: (n_nodes,), numbers, ascending. coordinates: (n_nodes, 3), global axes, the deck's
    length. cells: the elements, a block a shape. frames: of nodes whose results are in axes of
    their own, these axes as rows in the global ones (3, 3). names: what the deck calls nodes whose
    numbers are not its own. bars: elements of kind "line" whose ends pass on rotations.
    Raises ModelError where arrays do not fit together.
    """

    nodes: Integers
    coordinates: Floats
    cells: tuple[Cells, ...]
    frames: dict[int, Floats] = field(default_factory=dict)
    names: Mapping[int, str] = field(default_factory=dict)
    bars: frozenset[int] = frozenset()

    def __post_init__(self) -> None:
        if self.coordinates.shape != (self.nodes.size, 3):
            raise ModelError(
                f"coordinates of shape {self.coordinates.shape} for {self.nodes.size} nodes"
            )
        if (np.diff(self.nodes) <= 0).any():
            raise ModelError("the nodes of a mesh must ascend")
        if not np.isfinite(self.coordinates).all():
            raise ModelError("a coordinate of the mesh is not a finite number")

    def rows(self, nodes: Integers) -> Integers:
        """Rows of these node numbers, any shape. Raises ModelError for a node not in the mesh."""
        found = np.searchsorted(self.nodes, nodes)
        inside = np.minimum(found, max(self.nodes.size - 1, 0))
        if self.nodes.size == 0 or (self.nodes[inside] != nodes).any():
            raise ModelError("a node is asked for that is not in the mesh")
        return found.astype(np.int64)


def global_shapes(mesh: Mesh, modes: ModeSet) -> Floats:
    """Translations (n_modes, n_nodes, 3) at the mesh's nodes in global axes.

    Zero where the modes have no result. modes: real, in the frames of the mesh.
    """
    shapes = np.zeros((modes.n_modes, mesh.nodes.size, 3))
    inside = np.isin(modes.nodes, mesh.nodes) & (modes.components <= 3)
    rows: Integers = mesh.rows(modes.nodes[inside])
    shapes[:, rows, modes.components[inside] - 1] = modes.mode_shapes[inside].real.T
    for node, axes in mesh.frames.items():
        row = int(mesh.rows(np.array([node]))[0])
        shapes[:, row] = shapes[:, row] @ axes  # rows of `axes` are the node's own directions
    return shapes


def edge_differences(mesh: Mesh, modes: ModeSet, kind: CellKind) -> Floats | None:
    """Return how unlike the motions of neighbouring corners of tetrahedra are in each mode.

    The root mean square difference over edges as a part of the root mean square motion of their
    ends: about k h for edges of length h in waves with the wave number k. Corners that move less
    than AT_REST of the mode's largest motion count as moving that much. kind: of the tetrahedra.
    None where there are none, or where the modes show less than half of their edges.
    """
    corners = [cells.nodes[:, :4] for cells in mesh.cells if cells.kind == kind]
    if not corners:
        return None
    sides = [corner[:, pair] for corner in corners for pair in combinations(range(4), 2)]
    edges = np.unique(np.sort(np.concatenate(sides), axis=1), axis=0)
    seen = modes.nodes[modes.components <= 3]
    shown = edges[np.isin(edges, seen).all(axis=1)]
    if 2 * shown.shape[0] < edges.shape[0]:
        return None
    shapes = global_shapes(mesh, modes)
    ends = mesh.rows(shown)
    apart = np.sum((shapes[:, ends[:, 0]] - shapes[:, ends[:, 1]]) ** 2, axis=2).mean(axis=1)
    squares = np.sum(shapes**2, axis=2)
    motion = squares[:, np.unique(ends)].mean(axis=1)
    least = AT_REST**2 * squares.max(axis=1, initial=0.0)
    whole = np.maximum(motion, least)
    return np.asarray(np.sqrt(apart / np.where(whole > 0.0, whole, np.inf)))


def cell_sizes(mesh: Mesh) -> dict[int, float]:
    """About the length, area or volume of each element by its number, by the spread of its corners.

    With s the standard deviations of the corners along their principal axes it is the product of
    2 s, which holds for bars, parallelograms and parallelepipeds, times FILLED for others. Raises
    ModelError where an element names a node that is not in the mesh.
    """
    found: dict[int, float] = {}
    for cells in mesh.cells:
        corners = mesh.coordinates[mesh.rows(cells.nodes[:, : CORNERS[cells.kind]])]
        kind = cells.kind.rstrip("0123456789")
        across = DIMENSIONS.get(kind, 3)
        apart = corners - corners.mean(axis=1, keepdims=True)
        spread = np.linalg.svd(apart, compute_uv=False)[:, :across] / corners.shape[1] ** 0.5
        sizes = FILLED.get(kind, 1.0) * np.prod(2.0 * spread, axis=1) * (across > 0)
        found |= dict(zip(cells.elements.tolist(), sizes.tolist(), strict=True))
    return found


def part_labels(mesh: Mesh, nodes: Integers) -> Integers:
    """Return which connected part each of some nodes is in, (n_nodes,), counted from 0.

    nodes: numbers of nodes, ascending. Elements join those of their nodes that are among these.
    """
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    first, second = [np.zeros(0, dtype=np.int64)], [np.zeros(0, dtype=np.int64)]
    for cells in mesh.cells:
        inside = np.isin(cells.nodes, nodes)
        some = np.flatnonzero(inside.sum(axis=1) > 1)
        places, there = np.searchsorted(nodes, cells.nodes[some]), inside[some]
        ahead = places[np.arange(some.size), there.argmax(axis=1)]
        first.append(np.repeat(ahead, there.sum(axis=1)))
        second.append(places[there])
    a, b = np.concatenate(first), np.concatenate(second)
    joined = coo_array((np.ones(a.size), (a, b)), shape=(nodes.size,) * 2)
    return np.asarray(connected_components(joined, directed=False)[1], dtype=np.int64)


def shortest_length(mesh: Mesh) -> float:
    """The least distance of two corners of an element, infinite where there are none.

    Raises ModelError where an element names a node that is not in the mesh.
    """
    least = np.inf
    for cells in mesh.cells:
        rows = mesh.rows(cells.nodes[:, : CORNERS[cells.kind]])
        for one, other in combinations(range(rows.shape[1]), 2):
            along = mesh.coordinates[rows[:, one]] - mesh.coordinates[rows[:, other]]
            squares = np.sum(along**2, axis=1)  # springs may be between nodes at one place
            least = min(least, float(np.min(squares, initial=np.inf, where=squares > 0.0)))
    return float(np.sqrt(least))


def node_strains(mesh: Mesh, fields: Floats) -> Floats:
    """Root mean square strain over all fields at each node, (n_nodes,); 0 without elements.

    fields: (n_fields, n_nodes, 3), displacements in global axes. Raises ModelError where an
    element names a node that is not in the mesh.
    """
    squares, count = np.zeros(mesh.nodes.size), np.zeros(mesh.nodes.size)
    for cells in mesh.cells:
        n_corners = CORNERS[cells.kind]
        if n_corners < 2 or cells.nodes.size == 0:
            continue
        rows = mesh.rows(cells.nodes[:, :n_corners])
        own = np.zeros(rows.shape[0])
        pairs = list(combinations(range(n_corners), 2))
        for one, other in pairs:
            own += _elongations(mesh, fields, rows[:, one], rows[:, other])
        for corner in range(n_corners):
            np.add.at(squares, rows[:, corner], own / len(pairs))
            np.add.at(count, rows[:, corner], 1.0)
    return np.asarray(np.sqrt(squares / np.maximum(count, 1.0)))


def _elongations(mesh: Mesh, fields: Floats, start: Integers, end: Integers) -> Floats:
    """Mean square over the fields of the elongation from start to end, (n_cells,)."""
    along = mesh.coordinates[end] - mesh.coordinates[start]
    squares = np.sum(along**2, axis=1)
    # Springs between nodes at one place have no direction, and are left out.
    safe = np.where(squares > 0.0, squares, np.inf)
    change = np.einsum("fcx,cx->fc", fields[:, end] - fields[:, start], along) / safe
    return np.asarray(np.mean(change**2, axis=0))
