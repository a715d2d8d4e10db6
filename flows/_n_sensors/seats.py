"""Which node each test point is read at, and how sure that is."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace

import numpy as np

from modetune.core.mesh import Mesh
from modetune.core.modes import Floats, Integers
from modetune.core.sensors import next_nodes

#: A second node this little farther, as a part of the distance, is as near.
AS_NEAR = 0.1
#: Test points nearer than this part of the tolerance are in one place.
ONE_PLACE = 0.05


@dataclass(frozen=True, slots=True)
class Seat:
    """Where a test point is read.

    node: 0 where nowhere, and `missing` says why. distance: the mesh's length, NaN where unknown.
    """

    node: int
    distance: float = float("nan")
    missing: str = ""
    doubts: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class Seating:
    """What seats are given by.

    match: test node to model node, decided by the user. tolerance: the mesh's length, which `unit`
    names. Seats are told by the number of their test point.
    """

    mesh: Mesh
    match: Mapping[int, int]
    tolerance: float
    unit: str

    def length(self, value: float) -> str:
        """A length as people read it."""
        return f"{value:.4g} {self.unit}".rstrip()

    def by_number(self, measured: Integers) -> dict[int, Seat]:
        """Seats at the nodes of the same number."""
        known = set(self.mesh.nodes.tolist())
        seats = {}
        for name in np.unique(measured).tolist():
            node = self.match.get(name, name)
            missing = "" if node in known else f"the model has no results at a node {node}"
            seats[name] = Seat(0, missing=missing) if missing else Seat(node, 0.0)
        return seats

    def by_position(self, measured: Integers, names: Integers, places: Floats) -> dict[int, Seat]:
        """Seats at the nodes next to places (n, 3), of the points `names` (n,), for `measured`."""
        seats = {
            name: Seat(0, missing="the test has no coordinates of it")
            for name in np.unique(measured).tolist()
        }
        at = {name: row for row, name in enumerate(names.tolist()) if name in seats}
        if not at:
            return seats
        found = next_nodes(places[list(at.values())], self.mesh)
        for row, name in enumerate(at):
            if name in self.match:
                seats[name] = self._matched(self.match[name], places[at[name]])
            else:
                seats[name] = self._nearest(found.nodes[row], found.distances[row])
        return self._shared(seats, {name: places[row] for name, row in at.items()})

    def _matched(self, node: int, place: Floats) -> Seat:
        partner = self.mesh.coordinates[self.mesh.rows(np.array([node]))[0]]
        distance = float(np.linalg.norm(place - partner))
        far = distance > self.tolerance
        return Seat(node, distance, doubts=("farther than the tolerance",) if far else ())

    def _nearest(self, nodes: Integers, distances: Floats) -> Seat:
        node, distance = int(nodes[0]), float(distances[0])
        if distance > self.tolerance:
            return Seat(0, distance, f"the next node, {node}, is {self.length(distance)} away")
        doubts = []
        if distance > self.tolerance / 2.0:
            doubts.append("more than half the tolerance away")
        gap = float(distances[1]) - distance
        if gap <= 1e-6 * self.tolerance and distance <= AS_NEAR * self.tolerance:
            doubts.append(f"node {nodes[1]} is in the same place")
        elif gap <= AS_NEAR * distance and distance > AS_NEAR * self.tolerance:
            doubts.append(f"node {nodes[1]} is as near")
        return Seat(node, distance, doubts=tuple(doubts))

    def _shared(self, seats: dict[int, Seat], places: dict[int, Floats]) -> dict[int, Seat]:
        """Seats, with a doubt where test points that are apart are read at one node."""
        sharing: dict[int, list[int]] = {}
        for name, seat in seats.items():
            sharing.setdefault(seat.node, []).append(name)
        told = dict(seats)
        for node, names in sharing.items():
            for name in names if node else []:
                apart = [
                    other
                    for other in names
                    if np.linalg.norm(places[name] - places[other]) > ONE_PLACE * self.tolerance
                ]
                if apart:
                    doubt = f"read at the same node as test point {listed(apart)}"
                    told[name] = replace(seats[name], doubts=(*seats[name].doubts, doubt))
        return told


def listed(numbers: Iterable[int]) -> str:
    """Numbers with commas."""
    return ", ".join(str(number) for number in numbers)
