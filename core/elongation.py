"""How a field strains a mesh, from displacements at nodes alone.

An element is strained where the distances between its corners change. With a segment from corner
i to corner j, of length l and direction t, its elongation is t^T (d_j - d_i) / l, and an element's
strain is the root mean square over all pairs of its corners: edges, diagonals of faces, diagonals
of the volume. Rigid motion has none (to first order), and bending of a single layer of solids is
seen as it is: edges on both faces elongate and shorten, while the diagonals across the thickness
keep their length, so the shear that a gradient at a corner would find there is not seen.

A node's strain is the root mean square of its elements', each of them counted once.
"""

from __future__ import annotations

from itertools import combinations

import numpy as np

from modetune.core.mesh import CORNERS, Mesh
from modetune.core.modes import Floats, Integers


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
