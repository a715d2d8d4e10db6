"""Which degrees of freedom of the model a test's sensors look at, and how the model is seen there.

A sensor measures motion along its direction d at a test point. On the model's side it is read at
the node next to that point, as d . u with u in the model's axes. Stacked over the sensors this is a
sparse matrix T (n_sensors, n_dof) that takes computed shapes, and derivatives of shapes, to what
the test would have measured; the test's own data are never turned.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import scipy
from scipy import sparse

from modetune.core.errors import ModesError
from modetune.core.mesh import CORNERS, CellKind, Mesh
from modetune.core.modes import Floats, Integers, ModeSet, places_of

#: Corners of a solid's first face, around which its edges are taken.
FACE: dict[CellKind, int] = {
    "tetra": 3, "tetra10": 3, "wedge": 3, "wedge15": 3,
    "pyramid": 4, "pyramid13": 4, "hexahedron": 4, "hexahedron20": 4,
}  # fmt: skip
#: Of the motion of a mode, or of a usual one: what files print of it in single precision.
ROUNDING = 1e-6


@dataclass(frozen=True, slots=True)
class SensorMap:
    """The sensors of a test on the nodes of a model.

    nodes, components: (n_sensors,), as the test names them. model_nodes: (n_sensors,).
    directions: (n_sensors, 3), unit vectors in the axes of the model's results at its node. turns:
    (n_sensors,), whether a rotation about the direction is measured.
    distances: (n_sensors,), from test point to node, the deck's length; 0 where given by number.
    """

    nodes: Integers
    components: Integers
    model_nodes: Integers
    directions: Floats
    turns: np.ndarray[tuple[int], np.dtype[np.bool_]]
    distances: Floats

    @property
    def n_sensors(self) -> int:
        return self.nodes.size

    def matrix(self, nodes: Integers, components: Integers) -> sparse.csr_array:
        """T (n_sensors, n_dof) for shapes whose rows are these nodes and components (1..6).

        A component the results lack is left out where its part of the direction is below 1e-6.
        Raises ModesError where a component that a sensor looks along is missing.
        """
        places = 7 * nodes + components  # one number a degree of freedom
        axes = np.arange(1, 4) + 3 * self.turns[:, None]
        wanted = 7 * self.model_nodes[:, None] + axes
        known, columns = places_of(wanted, places)
        lost = np.argwhere(~known & (np.abs(self.directions) > 1e-6))
        if lost.size:
            sensor, axis = lost[0]
            raise ModesError(
                f"the model's results have no component {axes[sensor, axis]} at node "
                f"{self.model_nodes[sensor]}, along which the sensor at test point "
                f"{self.nodes[sensor]} looks"
            )
        starts = np.concatenate([[0], np.cumsum(known.sum(axis=1))])
        entries = self.directions[known], columns[known], starts
        return sparse.csr_array(entries, shape=(self.n_sensors, nodes.size))

    def observe(self, modes: ModeSet) -> ModeSet:
        """Computed modes as the test's sensors see them, named by the test. Raises ModesError.

        A mode that moves the sensors by rounding only is zero: it would resemble measured ones by
        chance."""
        seen = np.asarray(self.matrix(modes.nodes, modes.components) @ modes.mode_shapes)
        if seen.size:
            largest, sizes = np.abs(modes.mode_shapes).max(axis=0), np.abs(seen).max(axis=0)
            usual = np.quantile(sizes, 0.5, method="lower")
            # A mode of a part without sensors has rounding alone at all nodes kept of it.
            seen[:, sizes < ROUNDING * np.maximum(largest, usual)] = 0.0
        return replace(modes, mode_shapes=seen, nodes=self.nodes, components=self.components)


@dataclass(frozen=True, slots=True)
class NextNodes:
    """The two model nodes next to each of some places.

    nodes: (n, 2), numbers, nearest first. distances: (n, 2); infinite where the mesh has one node.
    """

    nodes: Integers
    distances: Floats


def next_nodes(places: Floats, mesh: Mesh) -> NextNodes:
    """The nodes of a mesh, with at least one, next to places (n, 3) in its axes and length."""
    distances, rows = scipy.spatial.KDTree(mesh.coordinates).query(places, k=2)
    return NextNodes(
        mesh.nodes[np.minimum(rows, mesh.nodes.size - 1)], np.asarray(distances, np.float64)
    )


def nodes_within(place: Floats, mesh: Mesh, distance: float) -> Integers:
    """Return the nodes of a mesh within a distance of a place (3,), nearest first."""
    away = np.linalg.norm(mesh.coordinates - place, axis=1)
    rows = np.flatnonzero(away <= distance)
    return np.asarray(mesh.nodes[rows[np.argsort(away[rows], kind="stable")]])


def result_directions(nodes: Integers, directions: Floats, mesh: Mesh) -> Floats:
    """Return directions (n, 3), given in global axes, in the axes of each node's results."""
    return _turned(nodes, directions, mesh, inward=True)


def global_directions(nodes: Integers, directions: Floats, mesh: Mesh) -> Floats:
    """Directions (n, 3) in the axes of the results at these nodes, turned into the global ones."""
    return _turned(nodes, directions, mesh, inward=False)


def _turned(nodes: Integers, directions: Floats, mesh: Mesh, inward: bool) -> Floats:
    turned = np.array(directions, dtype=np.float64).reshape(-1, 3)
    framed = np.isin(nodes, np.fromiter(mesh.frames, np.int64, len(mesh.frames)))
    for row in np.flatnonzero(framed):
        axes = mesh.frames[int(nodes[row])]
        turned[row] = (axes if inward else axes.T) @ turned[row]
    return turned


def mean_edge(mesh: Mesh) -> float:
    """Mean distance between neighbouring corners of the elements; 0 where all are points.

    Of a solid the edges of its first face represent all.
    """
    lengths = [np.zeros(0)]
    for cells in mesh.cells:
        n_corners = FACE.get(cells.kind, CORNERS[cells.kind])
        if n_corners < 2 or cells.nodes.size == 0:
            continue
        corners = mesh.coordinates[mesh.rows(cells.nodes[:, :n_corners])]
        edges = np.diff(corners, axis=1) if n_corners == 2 else corners - np.roll(corners, 1, 1)
        lengths.append(np.linalg.norm(edges, axis=2).ravel())
    every = np.concatenate(lengths)
    return float(every.mean()) if every.size else 0.0
