"""Which node each test point is read at, and how sure that is."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace

import numpy as np

from modetune.core.measurement.sensors import next_nodes
from modetune.core.mesh import Mesh
from modetune.core.modes import Floats, Integers

#: A second node this little farther, as a part of the distance, is as near.
AS_NEAR = 0.1
#: Test points of one node that each is compared with, and that are named.
COMPARED = 8
#: Test points nearer than this part of the tolerance are in one place.
ONE_PLACE = 0.05


@dataclass(frozen=True, slots=True)
class MappedNode:
    """Where a test point is read.

    node: 0 where nowhere, and `missing` says why. distance: the mesh's length, NaN where unknown.
    """

    node: int
    distance: float = float("nan")
    missing: str = ""
    doubts: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class NodeMapping:
    """What mapped_nodes are given by.

    match: test node to model node, decided by the user. tolerance: the mesh's length, which `unit`
    names. Mapped nodes are told by the number of their test point.
    """

    mesh: Mesh
    match: Mapping[int, int]
    tolerance: float
    unit: str

    def length(self, value: float) -> str:
        """A length as people read it."""
        return f"{value:.4g} {self.unit}".rstrip()

    def by_number(self, measured: Integers) -> dict[int, MappedNode]:
        """Mapped nodes at the nodes of the same number."""
        known = set(self.mesh.nodes.tolist())
        mapped_nodes = {}
        for name in np.unique(measured).tolist():
            node = self.match.get(name, name)
            missing = "" if node in known else f"the model has no results at a node {node}"
            mapped_nodes[name] = (
                MappedNode(0, missing=missing) if missing else MappedNode(node, 0.0)
            )
        return mapped_nodes

    def by_position(
        self, measured: Integers, names: Integers, places: Floats
    ) -> dict[int, MappedNode]:
        """Mapped nodes next to places (n, 3) of the points `names` (n,), for `measured`."""
        mapped_nodes = {
            name: MappedNode(0, missing="the test has no coordinates of it")
            for name in np.unique(measured).tolist()
        }
        at = {name: row for row, name in enumerate(names.tolist()) if name in mapped_nodes}
        if not at:
            return mapped_nodes
        found = next_nodes(places[list(at.values())], self.mesh)
        for row, name in enumerate(at):
            if name in self.match:
                mapped_nodes[name] = self._matched(self.match[name], places[at[name]])
            else:
                mapped_nodes[name] = self._nearest(found.nodes[row], found.distances[row])
        return self._shared(mapped_nodes, {name: places[row] for name, row in at.items()})

    def _matched(self, node: int, place: Floats) -> MappedNode:
        partner = self.mesh.coordinates[self.mesh.rows(np.array([node]))[0]]
        distance = float(np.linalg.norm(place - partner))
        far = distance > self.tolerance
        return MappedNode(node, distance, doubts=("farther than the tolerance",) if far else ())

    def _nearest(self, nodes: Integers, distances: Floats) -> MappedNode:
        node, distance = int(nodes[0]), float(distances[0])
        if distance > self.tolerance:
            return MappedNode(
                0, distance, f"the next node, {node}, is {self.length(distance)} away"
            )
        doubts = []
        if distance > self.tolerance / 2.0:
            doubts.append("more than half the tolerance away")
        gap = float(distances[1]) - distance
        if gap <= 1e-6 * self.tolerance and distance <= AS_NEAR * self.tolerance:
            doubts.append(f"node {nodes[1]} is in the same place")
        elif gap <= AS_NEAR * distance and distance > AS_NEAR * self.tolerance:
            doubts.append(f"node {nodes[1]} is as near")
        return MappedNode(node, distance, doubts=tuple(doubts))

    def _shared(
        self, mapped_nodes: dict[int, MappedNode], places: dict[int, Floats]
    ) -> dict[int, MappedNode]:
        """Mapped nodes, with a doubt where test points that are apart are read at one node."""
        sharing: dict[int, list[int]] = {}
        for name, mapped_node in mapped_nodes.items():
            sharing.setdefault(mapped_node.node, []).append(name)
        told = dict(mapped_nodes)
        for node, names in sharing.items():
            first = names[:COMPARED]
            where = np.array([places[other] for other in first] if node else []).reshape(-1, 3)
            for name in names if node and len(names) > 1 else []:
                far = np.linalg.norm(where - places[name], axis=1) > ONE_PLACE * self.tolerance
                if far.any():
                    apart = [other for other, is_far in zip(first, far, strict=True) if is_far]
                    more = f" and {len(names) - COMPARED} more" if len(names) > COMPARED else ""
                    doubt = f"read at the same node as test point {listed(apart)}{more}"
                    told[name] = replace(
                        mapped_nodes[name], doubts=(*mapped_nodes[name].doubts, doubt)
                    )
        return told


def listed(numbers: Iterable[int]) -> str:
    """Numbers with commas."""
    return ", ".join(str(number) for number in numbers)
