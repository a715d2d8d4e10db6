"""The surface of a mesh for pictures: outer faces and lines, on few nodes where there are many.

Outer faces are those of shells, and those of solids that belong to one solid only. Where they have
more nodes than wanted they are thinned by clustering (Rossignac and Borrel 1993): a grid of cubes
is laid over the box round the mesh, as fine as the wanted number allows, and all nodes in a cube
become one of them, so that results are asked for at real nodes. Of a cube's nodes a corner of the
structure goes before an edge and an edge before other nodes, which keeps outlines; among equals the
one nearest to their mean. A plate thinner than a cube becomes one sheet, a bar a line.

Everything after the first rounding (coordinates to 2^20 steps of the longest side) is done in
integers, so that the same mesh gives the same nodes on every machine.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from modetune.core.mesh import CORNERS, CellKind, Cells, Mesh
from modetune.core.modes import Floats, Integers

#: Steps of the longest side of the box round a mesh.
STEPS = 1 << 20
#: More cubes along the longest side than any picture requires.
FINEST = 1 << 12
#: Two faces that meet at more than about 32 degrees have an edge between them.
SMOOTH = 0.85
#: Faces of solids by their corners, seen from outside anticlockwise; -1 where a face has three.
FACES: dict[CellKind, tuple[tuple[int, int, int, int], ...]] = {
    "tetra": ((0, 2, 1, -1), (0, 1, 3, -1), (1, 2, 3, -1), (2, 0, 3, -1)),
    "pyramid": ((0, 3, 2, 1), (0, 1, 4, -1), (1, 2, 4, -1), (2, 3, 4, -1), (3, 0, 4, -1)),
    "wedge": ((0, 2, 1, -1), (3, 4, 5, -1), (0, 1, 4, 3), (1, 2, 5, 4), (2, 0, 3, 5)),
    "hexahedron": (
        (0, 3, 2, 1), (4, 5, 6, 7), (0, 1, 5, 4), (1, 2, 6, 5), (2, 3, 7, 6), (3, 0, 4, 7),
    ),
    "triangle": ((0, 1, 2, -1),),
    "quad": ((0, 1, 2, 3),),
}  # fmt: skip
SHELLS = ("triangle", "quad")
#: The same shapes with midside nodes, which are not drawn.
QUADRATIC: dict[CellKind, CellKind] = {
    "tetra10": "tetra", "pyramid13": "pyramid", "wedge15": "wedge", "hexahedron20": "hexahedron",
    "triangle6": "triangle", "quad8": "quad", "line3": "line",
}  # fmt: skip
#: Corners between which their midside nodes lie, in the order of these.
SIDES: dict[CellKind, tuple[tuple[int, int], ...]] = {
    "line": ((0, 1),),
    "triangle": ((0, 1), (1, 2), (2, 0)),
    "quad": ((0, 1), (1, 2), (2, 3), (3, 0)),
    "tetra": ((0, 1), (1, 2), (2, 0), (0, 3), (1, 3), (2, 3)),
    "pyramid": ((0, 1), (1, 2), (2, 3), (3, 0), (0, 4), (1, 4), (2, 4), (3, 4)),
    "wedge": ((0, 1), (1, 2), (2, 0), (3, 4), (4, 5), (5, 3), (0, 3), (1, 4), (2, 5)),
    "hexahedron": (
        (0, 1), (1, 2), (2, 3), (3, 0), (4, 5), (5, 6), (6, 7), (7, 4),
        (0, 4), (1, 5), (2, 6), (3, 7),
    ),
}  # fmt: skip


@dataclass(frozen=True, slots=True)
class Surface:
    """What is drawn of a mesh.

    nodes: (n,), numbers, ascending; coordinates: (n, 3), global axes, the deck's length.
    triangles: (n_triangles, 3), rows into nodes, anticlockwise seen from outside a solid (in a
    plate that became one sheet, from one of its sides).
    edges: (n_edges, 2), rows into nodes: beams, springs and edges of elements, or in a thinned
    surface beams and the edges of the structure.
    """

    nodes: Integers
    coordinates: Floats
    triangles: Integers
    edges: Integers

    def mesh(self) -> Mesh:
        """Its triangles and edges as cells; one of neither is its nodes alone."""
        kinds: tuple[tuple[CellKind, Integers], ...] = (
            ("triangle", self.triangles),
            ("line", self.edges),
        )
        blocks = tuple(
            Cells(kind, np.arange(1, rows.shape[0] + 1), self.nodes[rows])
            for kind, rows in kinds
            if rows.size
        )
        return Mesh(self.nodes, self.coordinates, blocks)


def display_surface(mesh: Mesh, at_most: int = 4000) -> Surface:
    """Return the mesh's surface on at most `at_most` of its nodes.

    A mesh without faces and lines gives its nodes alone. Deterministic: see the module.
    """
    faces, lines = _outer_faces(mesh), _lines(mesh)
    used = np.unique(np.concatenate([faces.ravel(), lines.ravel()]))
    used = used[used >= 0]
    if used.size == 0:
        used = np.arange(mesh.nodes.size)
    # From here on nodes are rows of `used`.
    faces = np.where(faces < 0, -1, np.searchsorted(used, faces))
    lines, triangles = np.searchsorted(used, lines), _triangles(faces)
    if used.size > at_most:
        chosen, triangles, edges = _thinned(
            _steps(mesh.coordinates[used]), faces, triangles, lines, at_most
        )
        used = used[chosen]
    else:
        edges = _distinct(np.concatenate([lines, _sides(faces)[0]]))
    return Surface(mesh.nodes[used], mesh.coordinates[used], _distinct(triangles), edges)


def facets(mesh: Mesh) -> Floats:
    """The whole surface as triangles (n, 3, 3): corners, x y z, global axes, the deck's length.

    Faces with midside nodes are cut at these, which follows a curved surface. A beam is a triangle
    with two corners in one place, a node without elements one with all three.
    """
    middle = _middles(mesh)
    faces, lines = _outer_faces(mesh), _lines(mesh)
    alone = (
        np.setdiff1d(
            np.arange(mesh.nodes.size),
            np.concatenate([mesh.rows(c.nodes).ravel() for c in mesh.cells]),
        )
        if mesh.cells
        else np.arange(mesh.nodes.size)
    )
    pieces = [np.repeat(alone[:, None], 3, axis=1)]
    between = middle(lines)
    for ends in (np.column_stack([lines[:, 0], between]), np.column_stack([between, lines[:, 1]])):
        pieces.append(ends[:, [0, 1, 1]])
    for n in (3, 4):
        polygon = faces[(faces[:, 3] >= 0) == (n == 4)][:, :n]
        sides = middle(np.stack([polygon, np.roll(polygon, -1, axis=1)], axis=2))
        halved = (sides != polygon).any(axis=1)  # no midside nodes: the side's first corner
        pieces += [polygon[~halved][:, [0, i, i + 1]] for i in range(1, n - 1)]
        corner, side = polygon[halved], sides[halved]
        pieces += [np.column_stack([corner[:, i], side[:, i], side[:, i - 1]]) for i in range(n)]
        pieces += [side[:, [0, i, i + 1]] for i in range(1, n - 1)]
    found = np.concatenate(pieces)
    return np.asarray(mesh.coordinates[found])


def _middles(mesh: Mesh) -> Callable[[Integers], Integers]:
    """Takes sides (..., 2), rows of the mesh, to the rows of their midside nodes.

    A side without one is taken to its first end.
    """
    ends, middles = [np.zeros((0, 2), np.int64)], [np.zeros(0, np.int64)]
    for cells in mesh.cells:
        if cells.kind in QUADRATIC:
            rows, first = mesh.rows(cells.nodes), CORNERS[cells.kind]
            for place, side in enumerate(SIDES[QUADRATIC[cells.kind]], start=first):
                ends.append(rows[:, side])
                middles.append(rows[:, place])
    size = mesh.nodes.size
    key = np.sort(np.concatenate(ends), axis=1) @ np.array([size, 1])
    key, first_of = np.unique(key, return_index=True)
    at = np.concatenate(middles)[first_of]

    def of(sides: Integers) -> Integers:
        if key.size == 0:
            return np.asarray(sides[..., 0])
        wanted = np.sort(sides, axis=-1) @ np.array([size, 1])
        place = np.minimum(np.searchsorted(key, wanted), key.size - 1)
        return np.where(key[place] == wanted, at[place], sides[..., 0])

    return of


def _corner_rows(mesh: Mesh, kinds: tuple[CellKind, ...]) -> list[tuple[CellKind, Integers]]:
    """Corners (n_cells, n_corners), as rows of the mesh, of each block of these plain shapes."""
    found = []
    for cells in mesh.cells:
        plain = QUADRATIC.get(cells.kind, cells.kind)
        if plain in kinds:
            found.append((plain, mesh.rows(cells.nodes[:, : CORNERS[plain]])))
    return found


def _lines(mesh: Mesh) -> Integers:
    return np.concatenate(
        [np.zeros((0, 2), np.int64), *(rows for _, rows in _corner_rows(mesh, ("line",)))]
    )


def _outer_faces(mesh: Mesh) -> Integers:
    """Faces (n, 4) of shells, and of solids where no other solid has them too."""
    shells, solids = [np.zeros((0, 4), np.int64)], [np.zeros((0, 4), np.int64)]
    for kind, corners in _corner_rows(mesh, tuple(FACES)):
        for face in FACES[kind]:
            rows = corners[:, np.maximum(face, 0)]
            if face[3] < 0:
                rows[:, 3] = -1
            (shells if kind in SHELLS else solids).append(rows)
    inside_out = np.concatenate(solids)
    first, _, count = _groups(inside_out, mesh.nodes.size)
    return np.concatenate([*shells, inside_out[np.sort(first[count == 1])]])


def _groups(rows: Integers, size: int) -> tuple[Integers, Integers, Integers]:
    """Positions of the first and the last of rows that hold the same, and how many there are.

    rows: (n, m), entries from -1 to size - 1, whose order within a row does not count.
    """
    if rows.shape[0] == 0:
        return (np.zeros(0, np.int64),) * 3
    # Two entries in one number each: half as many columns to sort.
    wide = np.pad(np.sort(rows, axis=1) + 1, ((0, 0), (rows.shape[1] % 2, 0)))
    keys = [wide[:, i] * (size + 1) + wide[:, i + 1] for i in range(0, wide.shape[1], 2)]
    order = np.lexsort(keys)
    new = np.ones(order.size, dtype=np.bool_)
    new[1:] = np.any([key[order][1:] != key[order][:-1] for key in keys], axis=0)
    starts = np.flatnonzero(new)
    count = np.diff(np.append(starts, order.size))
    return order[starts], order[starts + count - 1], count


def _distinct(rows: Integers) -> Integers:
    """Triangles or edges whose ends differ, each once."""
    ordered = np.sort(rows, axis=1)
    good = rows[(ordered[:, 1:] != ordered[:, :-1]).all(axis=1)]
    first, _, _ = _groups(good, int(good.max(initial=0)) + 1)
    return np.asarray(good[np.sort(first)])


def _triangles(faces: Integers) -> Integers:
    """Faces as triangles (n, 3), those of four corners cut along their first diagonal."""
    return np.concatenate([faces[:, :3], faces[faces[:, 3] >= 0][:, [0, 2, 3]]])


def _sides(faces: Integers) -> tuple[Integers, Integers]:
    """Sides (n, 2) of all faces in their direction, and which face each belongs to."""
    ends = np.stack([faces, np.roll(faces, -1, axis=1)], axis=2)
    three = faces[:, 3] < 0
    ends[three, 2, 1] = faces[three, 0]
    there = np.ones(faces.shape, dtype=bool)
    there[three, 3] = False
    return ends[there], np.repeat(np.arange(faces.shape[0])[:, None], 4, axis=1)[there]


def _steps(coordinates: Floats) -> Integers:
    """Coordinates in whole steps of the longest side of the box round them."""
    low = coordinates.min(axis=0)
    side = float((coordinates - low).max())
    scaled = (coordinates - low) / side * (STEPS - 1) if side > 0.0 else coordinates - low
    return np.asarray(np.rint(scaled), dtype=np.int64)


def _outlines(faces: Integers, steps: Integers) -> Integers:
    """Sides (n, 2) that outline the structure: free ones, sharp ones, and those of three faces."""
    sides, owner = _sides(faces)
    first, last, count = _groups(sides, steps.shape[0])
    normals = _normals(faces, steps)
    cosine = _dot(normals[owner[first]], normals[owner[last]])
    # Two faces that run along their side the same way look to opposite sides of the structure.
    cosine = np.where(sides[first, 0] == sides[last, 0], -cosine, cosine)
    return np.asarray(sides[first[(count != 2) | (cosine < SMOOTH)]])


def _normals(faces: Integers, steps: Integers) -> Floats:
    """Unit normals (n, 3), zero for faces without an area."""
    three = faces[:, 3] < 0
    last = np.where(three, faces[:, 0], faces[:, 3])
    first = np.where(three, faces[:, 1], faces[:, 0])
    # Diagonals of four corners, two sides of three.
    a, b = steps[faces[:, 2]] - steps[first], steps[last] - steps[faces[:, 1]]
    normals = np.stack(
        [a[:, i] * b[:, j] - a[:, j] * b[:, i] for i, j in ((1, 2), (2, 0), (0, 1))], axis=1
    ).astype(np.float64)
    return _units(normals)


def _units(vectors: Floats) -> Floats:
    """Vectors (n, 3) of length one; zero stays zero."""
    lengths = np.sqrt(_dot(vectors, vectors))
    return np.asarray(vectors / np.where(lengths > 0.0, lengths, 1.0)[:, None])


def _dot(a: Floats, b: Floats) -> Floats:
    """Row by row, in an order of sums that no library chooses."""
    return np.asarray(a[:, 0] * b[:, 0] + a[:, 1] * b[:, 1] + a[:, 2] * b[:, 2])


def _thinned(
    steps: Integers, faces: Integers, triangles: Integers, lines: Integers, at_most: int
) -> tuple[Integers, Integers, Integers]:
    """The nodes that stay (rows, ascending), and triangles and edges between them."""
    outlines = _outlines(faces, steps)
    chosen, owner = _clusters(steps, _ranks(np.concatenate([lines, outlines]), steps), at_most)
    triangles, outlines = owner[triangles], owner[np.concatenate([lines, outlines])]
    edges = _distinct(np.concatenate([outlines, _slivers(triangles)]))
    triangles = _distinct(triangles)
    kept = np.unique(np.concatenate([triangles.ravel(), edges.ravel()]))
    if kept.size == 0:
        kept = np.arange(chosen.size)
    kept = kept[np.argsort(chosen[kept])]
    place = np.zeros(chosen.size, dtype=np.int64)
    place[kept] = np.arange(kept.size)
    return chosen[kept], place[triangles], place[edges]


def _ranks(edges: Integers, steps: Integers) -> Integers:
    """0 for corners of the structure, 1 for nodes along its edges, 2 for all others."""
    vectors: Floats = np.float64(1.0) * (steps[edges[:, 1]] - steps[edges[:, 0]])
    along = _units(vectors)
    ends, size = edges.T.ravel(), steps.shape[0]
    count = np.bincount(ends, minlength=size)
    leaving = np.concatenate([along, -along])
    total = np.stack([np.bincount(ends, leaving[:, i], size) for i in range(3)], axis=1)
    # Of two edges that leave a node in opposite directions nothing remains.
    straight = (count == 2) & (_dot(1.0 * total, 1.0 * total) < 2.0 * (1.0 - SMOOTH))
    return np.where(count == 0, 2, np.where(straight, 1, 0))


def _clusters(steps: Integers, ranks: Integers, at_most: int) -> tuple[Integers, Integers]:
    """Return at most `at_most` representative nodes, and the representative of each node."""
    fine, coarse = FINEST, 1  # cubes along the longest side: too many, and not too many
    while fine - coarse > 1:
        middle = (fine + coarse) // 2
        if np.unique(_cubes(steps, middle)).size <= at_most:
            coarse = middle
        else:
            fine = middle
    _, owner = np.unique(_cubes(steps, coarse), return_inverse=True)
    count = np.bincount(owner)
    # Sums of whole numbers, exact in floating point.
    total = np.stack([np.bincount(owner, steps[:, i]) for i in range(3)], axis=1)
    mean = total.astype(np.int64) // count[:, None]
    distance = ((steps - mean[owner]) ** 2).sum(axis=1)
    order = np.lexsort((np.arange(owner.size), distance, ranks, owner))
    starts = np.concatenate([[0], np.cumsum(count)[:-1]])
    return order[starts], np.asarray(owner, dtype=np.int64)


def _cubes(steps: Integers, along: int) -> Integers:
    """Return a number for the cube of each node, with `along` cubes along the longest side."""
    cube = steps * along // STEPS
    return np.asarray((cube[:, 0] * along + cube[:, 1]) * along + cube[:, 2])


def _slivers(triangles: Integers) -> Integers:
    """Ends of triangles that shrank to a line: what is left of bars thinner than a cube."""
    a, b, c = triangles.T
    flat = (a != b).astype(np.int64) + (b != c) + (c != a) == 2
    thin = _distinct(np.where((a == b)[:, None], triangles[:, 1:], triangles[:, :2])[flat])
    solid = _distinct(triangles)
    size = int(triangles.max(initial=0)) + 1
    sides = np.sort(np.concatenate([solid[:, [0, 1]], solid[:, [1, 2]], solid[:, [2, 0]]]), axis=1)
    thin = np.sort(thin, axis=1)
    drawn = np.isin(thin[:, 0] * size + thin[:, 1], sides[:, 0] * size + sides[:, 1])
    return thin[~drawn]
