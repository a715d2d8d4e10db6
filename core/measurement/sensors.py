"""Which degrees of freedom of the model a test's sensors look at, and how the model is seen there.

A sensor measures motion along its direction d at a test point. On the model's side it is read at
the node next to that point, as d . u with u in the model's axes. Stacked over the sensors this is a
sparse matrix T (n_sensors, n_dof) that takes computed shapes, and derivatives of shapes, to what
the test would have measured; the test's own data are never turned.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy import sparse
from scipy.spatial import KDTree

from modetune.core.errors import ModesError
from modetune.core.mesh import CORNERS, CellKind, Mesh
from modetune.core.modes import Floats, Integers, ModeSet

#: Corners of a solid's first face, around which its edges are taken.
FACE: dict[CellKind, int] = {
    "tetra": 3, "tetra10": 3, "wedge": 3, "wedge15": 3,
    "pyramid": 4, "pyramid13": 4, "hexahedron": 4, "hexahedron20": 4,
}  # fmt: skip


@dataclass(frozen=True, slots=True)
class SensorMap:
    """The sensors of a test on the nodes of a model.

    nodes, components: (n_sensors,), as the test names them. model_nodes: (n_sensors,).
    directions: (n_sensors, 3), unit vectors in the axes in which the model's results stand at
    its node. turns: (n_sensors,), whether a rotation about the direction is measured.
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
        names = zip(nodes.tolist(), components.tolist(), strict=True)
        place = {dof: row for row, dof in enumerate(names)}
        rows, columns, values = [], [], []
        for sensor in range(self.n_sensors):
            for axis in range(3):
                part = float(self.directions[sensor, axis])
                dof = int(self.model_nodes[sensor]), axis + 1 + 3 * bool(self.turns[sensor])
                if dof in place:
                    rows.append(sensor)
                    columns.append(place[dof])
                    values.append(part)
                elif abs(part) > 1e-6:
                    raise ModesError(
                        f"the model's results have no component {dof[1]} at node {dof[0]}, along "
                        f"which the sensor at test point {self.nodes[sensor]} looks"
                    )
        return sparse.csr_array((values, (rows, columns)), shape=(self.n_sensors, nodes.size))

    def observe(self, modes: ModeSet) -> ModeSet:
        """Computed modes as the test's sensors see them, named by the test. Raises ModesError."""
        seen = self.matrix(modes.nodes, modes.components) @ modes.mode_shapes
        return replace(
            modes,
            mode_shapes=np.asarray(seen),
            nodes=self.nodes,
            components=self.components,
        )


def by_number(nodes: Integers, components: Integers) -> SensorMap:
    """Sensors that are the model's own nodes, along its axes."""
    return SensorMap(
        nodes=nodes,
        components=components,
        model_nodes=nodes,
        directions=np.eye(3)[(components - 1) % 3],
        turns=components > 3,
        distances=np.zeros(nodes.size),
    )


@dataclass(frozen=True, slots=True)
class NextNodes:
    """The two model nodes next to each of some places.

    nodes: (n, 2), numbers, nearest first. distances: (n, 2); infinite where the mesh has one node.
    """

    nodes: Integers
    distances: Floats


def next_nodes(places: Floats, mesh: Mesh) -> NextNodes:
    """The nodes of a mesh, with at least one, next to places (n, 3) in its axes and length."""
    distances, rows = KDTree(mesh.coordinates).query(places, k=2)
    return NextNodes(
        mesh.nodes[np.minimum(rows, mesh.nodes.size - 1)], np.asarray(distances, np.float64)
    )


def result_directions(nodes: Integers, directions: Floats, mesh: Mesh) -> Floats:
    """Directions (n, 3) in global axes, in the axes in which each node's results stand."""
    turned = [
        mesh.frames[node] @ direction if node in mesh.frames else direction
        for node, direction in zip(nodes.tolist(), directions, strict=True)
    ]
    return np.array(turned).reshape(-1, 3)


def global_directions(nodes: Integers, directions: Floats, mesh: Mesh) -> Floats:
    """Directions (n, 3) in the axes of the results at these nodes, turned into the global ones."""
    return np.array(
        [
            direction @ mesh.frames[node] if node in mesh.frames else direction
            for node, direction in zip(nodes.tolist(), directions, strict=True)
        ]
    ).reshape(-1, 3)


def mean_edge(mesh: Mesh) -> float:
    """Mean distance between neighbouring corners of the elements; 0 where all are points.

    Of a solid the edges of its first face stand for all.
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
