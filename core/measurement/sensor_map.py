"""Which degrees of freedom of the model a test's sensors look at, and how the model is seen there.

A sensor measures motion along its direction d at a test point. On the model's side it is read at
the node next to that point, as d . u with u in the model's axes. Stacked over the sensors this is a
sparse matrix T (n_sensors, n_dof) that takes computed shapes, and derivatives of shapes, to what
the test would have measured; the test's own data are never turned.

A sensor off the axis of a bar is rigidly attached to the section next to it, at the part s of the
bar's length l along its axis x. With the arm r from there to the sensor, it moves by
u(s) + theta(s) x r. Between the bar's ends a and b, motion along and rotation about x are linear;
across x they are those of the cubic with Hermite's h (Przemieniecki 1968, chapter 5):

    u(s) = h1 u_a + h3 u_b + l (h2 theta_a + h4 theta_b) x x
    theta(s) = x x (h1' u_a + h3' u_b) / l + h2' theta_a + h4' theta_b
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import scipy
from scipy import sparse

from modetune.core.errors import ModesError
from modetune.core.mesh import CORNERS, CellKind, Mesh
from modetune.core.modes import Floats, Integers, ModeSet

#: Corners of a solid's first face, around which its edges are taken.
FACE: dict[CellKind, int] = {
    "tetra": 3, "tetra10": 3, "wedge": 3, "wedge15": 3,
    "pyramid": 4, "pyramid13": 4, "hexahedron": 4, "hexahedron20": 4,
}  # fmt: skip
#: Of the motion of a mode, or of a usual one: what files print of it in single precision.
ROUNDING = 1e-6


@dataclass(frozen=True, slots=True)
class Sections:
    """Which motions of nodes move sensors that are rigidly attached to sections of bars.

    sensors: (n_terms,), rows of the sensor map, each with all its terms here. nodes, components:
    (n_terms,), of the model. factors: (n_terms, 3), the sensor's motion (its rotation where it
    measures one) by that of the node, in the axes of the results at the sensor's model node.
    """

    sensors: Integers
    nodes: Integers
    components: Integers
    factors: Floats


@dataclass(frozen=True, slots=True)
class SensorMap:
    """The sensors of a test on the nodes of a model.

    nodes, components: (n_sensors,), as the test names them. model_nodes: (n_sensors,).
    directions: (n_sensors, 3), unit vectors in the axes of the model's results at its node. turns:
    (n_sensors,), whether a rotation about the direction is measured.
    distances: (n_sensors,), from test point to node, the deck's length; 0 where given by number.
    sections: of sensors that bars carry; their model node is the nearer end of the bar.
    """

    nodes: Integers
    components: Integers
    model_nodes: Integers
    directions: Floats
    turns: np.ndarray[tuple[int], np.dtype[np.bool_]]
    distances: Floats

    sections: Sections | None = None

    @property
    def n_sensors(self) -> int:
        return self.nodes.size

    @property
    def on_bars(self) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
        """Which sensors (n_sensors,) are attached to sections of bars."""
        found = np.zeros(self.n_sensors, dtype=np.bool_)
        if self.sections is not None:
            found[self.sections.sensors] = True
        return found

    @property
    def seen_nodes(self) -> Integers:
        """Nodes of the model whose motion the sensors see, ascending."""
        return np.unique(self._terms()[1])

    def seen_components(self) -> tuple[Integers, Integers]:
        """Return nodes and components (1..6) whose motion the sensors see, ascending."""
        _, nodes, components, _, looked = self._terms()
        found = np.unique(np.stack([nodes[looked], components[looked]]), axis=1)
        return found[0], found[1]

    def _terms(self) -> tuple[Integers, Integers, Integers, Floats, Integers]:
        """Return sensor, node, component and factor of each term of the matrix, and those needed.

        A component the results lack may be left out where its part of the direction is below 1e-6.
        """
        at_nodes = np.flatnonzero(~self.on_bars)
        axes = np.arange(1, 4) + 3 * self.turns[at_nodes, None]
        sensors, nodes = np.repeat(at_nodes, 3), np.repeat(self.model_nodes[at_nodes], 3)
        components, factors = axes.ravel(), self.directions[at_nodes].ravel()
        needed = np.abs(factors) > 1e-6
        if self.sections is not None:
            more = self.sections
            along = np.sum(more.factors * self.directions[more.sensors], axis=1)
            sensors = np.append(sensors, more.sensors)
            nodes = np.append(nodes, more.nodes)
            components = np.append(components, more.components)
            factors = np.append(factors, along)
            needed = np.append(needed, along != 0.0)
        return sensors, nodes, components, factors, np.flatnonzero(needed)

    def matrix(self, nodes: Integers, components: Integers) -> sparse.csr_array:
        """T (n_sensors, n_dof) for shapes whose rows are these nodes and components (1..6).

        Raises ModesError where a component that a sensor sees is missing.
        """
        places = 7 * nodes + components  # one number a degree of freedom
        order = np.argsort(places, kind="stable")
        sensors, seen_nodes, seen_components, factors, needed = self._terms()
        wanted = 7 * seen_nodes + seen_components
        # Of rows of one name the last counts.
        last = np.searchsorted(places, wanted, side="right", sorter=order) - 1
        columns = order[np.maximum(last, 0)] if order.size else np.zeros_like(wanted)
        known = places[columns] == wanted if order.size else np.zeros(wanted.shape, bool)
        lost = needed[~known[needed]]
        if lost.size:
            raise ModesError(
                f"the model's results have no component {seen_components[lost[0]]} at node "
                f"{seen_nodes[lost[0]]}, along which the sensor at test point "
                f"{self.nodes[sensors[lost[0]]]} looks"
            )
        entries = factors[known], (sensors[known], columns[known])
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


def next_nodes(places: Floats, mesh: Mesh) -> tuple[Integers, Floats]:
    """Return the two nodes of a mesh next to each place (n, 3), nearest first, and the distances.

    Both are (n, 2); in a mesh of one node the second distance is infinite.
    """
    distances, rows = scipy.spatial.KDTree(mesh.coordinates).query(places, k=2)
    nodes = mesh.nodes[np.minimum(rows, mesh.nodes.size - 1)]
    return nodes, np.asarray(distances, np.float64)


def nodes_within(place: Floats, mesh: Mesh, distance: float) -> Integers:
    """Return the nodes of a mesh within a distance of a place (3,), nearest first."""
    away = np.linalg.norm(mesh.coordinates - place, axis=1)
    rows = np.flatnonzero(away <= distance)
    return np.asarray(mesh.nodes[rows[np.argsort(away[rows], kind="stable")]])


@dataclass(frozen=True, slots=True)
class BarSections:
    """The sections of bars next to some places.

    nodes: (n, 2), ends of the bar, the one nearer to the section first. parts: (n,), of the bar's
    length from the first end, 0 to 0.5. arms: (n, 3), from the section on the axis to the place,
    global axes. distances: (n,), their lengths.
    """

    nodes: Integers
    parts: Floats
    arms: Floats
    distances: Floats


def bar_sections(places: Floats, mesh: Mesh) -> BarSections:
    """Return the sections next to places (n, 3) of the mesh's bars, of which it has some."""
    bars = bar_ends(mesh)
    start, end = (mesh.coordinates[mesh.rows(bars[:, side])] for side in (0, 1))
    chosen, parts, arms = [], [], []
    span = end - start
    for place in places:
        part = np.clip(np.sum((place - start) * span, axis=1) / np.sum(span**2, axis=1), 0.0, 1.0)
        arm = place - start - part[:, None] * span
        nearest = int(np.argmin(np.linalg.norm(arm, axis=1)))
        chosen.append(bars[nearest])
        parts.append(part[nearest])
        arms.append(arm[nearest])
    nodes, along = np.array(chosen).reshape(-1, 2), np.array(parts)
    far = along > 0.5
    nodes[far] = nodes[far][:, ::-1]
    found = np.array(arms).reshape(-1, 3)
    return BarSections(
        nodes, np.where(far, 1.0 - along, along), found, np.linalg.norm(found, axis=1)
    )


def bar_ends(mesh: Mesh) -> Integers:
    """Return the ends (n_bars, 2) of the mesh's bars of some length."""
    ends = [
        cells.nodes[np.isin(cells.elements, np.fromiter(mesh.bars, np.int64, len(mesh.bars)))]
        for cells in mesh.cells
        if cells.kind == "line"
    ]
    found = np.concatenate(ends) if ends else np.zeros((0, 2), dtype=np.int64)
    apart = mesh.coordinates[mesh.rows(found[:, 1])] - mesh.coordinates[mesh.rows(found[:, 0])]
    return np.asarray(found[np.any(apart != 0.0, axis=1)])


def section_factors(
    first: int, second: int, part: float, arm: Floats, turns: bool, mesh: Mesh
) -> tuple[Integers, Integers, Floats]:
    """Return nodes, components and factors (see Sections) of a sensor attached to a bar.

    first, second: the bar's ends. part: of its length, from the first end. arm: (3,), global axes.
    turns: whether the sensor measures a rotation.
    """
    ends = mesh.coordinates[mesh.rows(np.array([first, second]))]
    length = float(np.linalg.norm(ends[1] - ends[0]))
    x = (ends[1] - ends[0]) / length
    along = np.outer(x, x)
    across, cross = np.eye(3) - along, _cross(x)
    s = part
    h1, h2, h4 = 1 - 3 * s**2 + 2 * s**3, s - 2 * s**2 + s**3, s**3 - s**2
    d1, d2, d4 = 6 * s**2 - 6 * s, 1 - 4 * s + 3 * s**2, 3 * s**2 - 2 * s
    # (t x x) is -[x] t with [x] the matrix of x's vector product.
    motion = [
        (1 - s) * along + h1 * across,
        -length * h2 * cross,
        s * along + (1 - h1) * across,
        -length * h4 * cross,
    ]
    rotation = [
        d1 / length * cross,
        (1 - s) * along + d2 * across,
        -d1 / length * cross,
        s * along + d4 * across,
    ]
    moved = (
        rotation if turns else [m - _cross(arm) @ r for m, r in zip(motion, rotation, strict=True)]
    )
    own = mesh.frames.get(first, np.eye(3))
    nodes = np.repeat([first, second], 6)
    blocks = [
        own @ block @ mesh.frames.get(node, np.eye(3)).T
        for node, block in zip((first, first, second, second), moved, strict=True)
    ]
    factors = np.concatenate([block.T for block in blocks])
    kept = np.any(factors != 0.0, axis=1)
    return nodes[kept], np.tile(np.arange(1, 7), 2)[kept], factors[kept]


def _cross(vector: Floats) -> Floats:
    """Return the matrix (3, 3) of the vector product with a vector."""
    return np.cross(vector, np.eye(3), axisb=0, axisc=0)


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
