"""Parts of bricks, tetrahedra and plates on one lattice of lines, so that they share their nodes.

Each axis has stations, the planes in which parts begin and end, and every interval between two
stations is cut into equal pieces of about the wanted size. Points of the lattice are counted in
half pieces: corners of elements have even indices, and the midside nodes of tetrahedra have odd
ones too. A point's key is its three indices in one integer, so an element is the key of its first
corner plus constants, and parts that touch have the same keys there.

A brick is cut into six tetrahedra along the diagonal of its cell (Freudenthal 1942), each of a
path of three edges along the axes; cells cut so agree on their common faces. The midpoints of their
edges are then all points of the half lattice.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise, permutations

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]
Place = tuple[float, float, float]

#: Corners of a brick and of a plate in the order of their numbering, in pieces along the axes.
BRICK = ((0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0), (0, 0, 1), (1, 0, 1), (1, 1, 1), (0, 1, 1))
SQUARE = ((0, 0), (1, 0), (1, 1), (0, 1))
#: Ends of the edges on which nodes 5 to 10 of a tetrahedron lie.
EDGES = ((0, 1), (1, 2), (2, 0), (0, 3), (1, 3), (2, 3))


@dataclass(frozen=True, slots=True)
class LatticePart:
    """A block between two corners, or a plate where they agree along one axis; mm.

    tetrahedra: the block is cut into them. square_corner: the plate is a triangle, whose right
    angle is at this corner; the intervals along its legs must be of one length.
    """

    group: str
    low: Place
    high: Place
    tetrahedra: bool = False
    square_corner: Place | None = None


@dataclass(frozen=True, slots=True)
class Lattice:
    """Coordinates of the half lattice along each axis, (n,) each; even indices are corners."""

    axes: tuple[Floats, Floats, Floats]

    @property
    def strides(self) -> Integers:
        """What one index along each axis adds to a key."""
        return np.array([self.axes[1].size * self.axes[2].size, self.axes[2].size, 1])

    def key(self, place: Place) -> int:
        """The key of a point that lies on stations."""
        return int(np.dot([self._index(axis, place[axis]) for axis in range(3)], self.strides))

    def coordinates(self, keys: Integers) -> Floats:
        """(n, 3), mm."""
        along_x, rest = np.divmod(keys, self.strides[0])
        along_y, along_z = np.divmod(rest, self.strides[1])
        indices = (along_x, along_y, along_z)
        return np.stack([axis[i] for axis, i in zip(self.axes, indices, strict=True)], axis=1)

    def nodes(self, part: LatticePart) -> Integers:
        """Keys of the part's nodes, (n,)."""
        pace = 1 if part.tetrahedra else 2
        first, last = self._ends(part)
        ranges = [np.arange(a, b + 1, pace) for a, b in zip(first, last, strict=True)]
        keys = _sums([r * s for r, s in zip(ranges, self.strides, strict=True)])
        if part.square_corner is None:
            return keys.ravel()
        u, v, legs = self._legs(part, 1)
        return np.squeeze(keys)[u + v <= legs]

    def elements(self, part: LatticePart) -> list[Integers]:
        """Keys of the part's elements, (n, 8), (n, 10) or (n, 4); also (n, 3) of a triangle."""
        first, last = self._ends(part)
        span = np.flatnonzero(last > first)
        starts = [np.arange(a, b if b > a else a + 1, 2) for a, b in zip(first, last, strict=True)]
        cells = _sums([r * s for r, s in zip(starts, self.strides, strict=True)])
        if part.tetrahedra:
            return [np.concatenate([cells.reshape(-1, 1) + path for path in self._paths()])]
        steps = 2 * self.strides[span]
        corners = np.array(BRICK if span.size == 3 else SQUARE) @ steps
        if part.square_corner is None:
            return [cells.reshape(-1, 1) + corners]
        u, v, legs = self._legs(part, 0)
        cells = np.squeeze(cells)
        kept = [corner for corner in SQUARE if corner != self._far(part, span)]
        return [
            cells[u + v < legs].reshape(-1, 1) + corners,
            cells[u + v == legs].reshape(-1, 1) + np.array(kept) @ steps,
        ]

    def _index(self, axis: int, value: float) -> int:
        return int(np.argmin(np.abs(self.axes[axis] - value)))

    def _ends(self, part: LatticePart) -> tuple[Integers, Integers]:
        """Indices of the part's two corners, (3,) each."""
        ends = [
            [self._index(axis, place[axis]) for axis in range(3)] for place in (part.low, part.high)
        ]
        return np.array(ends[0]), np.array(ends[1])

    def _paths(self) -> Integers:
        """Nodes of the six tetrahedra of a cell, from its first corner; (6, 10)."""
        paths = []
        for order in permutations(range(3)):
            corners = np.zeros((4, 3), dtype=np.int64)
            for place, axis in enumerate(order):
                corners[place + 1 :, axis] = 2
            if np.linalg.det(np.diff(corners, axis=0)) < 0.0:
                corners[[1, 2]] = corners[[2, 1]]  # right-handed
            middles = np.array([(corners[a] + corners[b]) // 2 for a, b in EDGES])
            paths.append(np.concatenate([corners, middles]) @ self.strides)
        return np.array(paths)

    def _legs(self, part: LatticePart, more: int) -> tuple[Integers, Integers, int]:
        """Distance of each cell of a triangle's square (of each corner with `more` 1) from the
        right angle along both legs, and the greatest sum of both that belongs to the triangle."""
        first, last = self._ends(part)
        span = np.flatnonzero(last > first)
        pieces = (last - first)[span] // 2
        if pieces[0] != pieces[1]:
            raise ValueError(f"the legs of a triangle of {part.group} are cut {pieces} times")
        away = [np.arange(pieces[0] + more) for _ in span]
        far = self._far(part, span)
        away = [leg if end else leg[::-1] for leg, end in zip(away, far, strict=True)]
        u, v = np.meshgrid(*away, indexing="ij")
        return u, v, int(pieces[0]) - 1 + more

    def _far(self, part: LatticePart, span: Integers) -> tuple[int, ...]:
        """The corner of a triangle's square that it lacks."""
        assert part.square_corner is not None
        return tuple(int(part.square_corner[axis] == part.low[axis]) for axis in span)


def lattice(stations: Sequence[Sequence[float]], size: float) -> Lattice:
    """The lattice through these stations along x, y and z, in pieces of about `size`, mm."""
    x, y, z = (_halved(_divided(np.array(along), size)) for along in stations)
    return Lattice((x, y, z))


def _divided(stations: Floats, size: float) -> Floats:
    pieces = [stations[:1]]
    for low, high in pairwise(stations):
        pieces.append(np.linspace(low, high, max(1, round((high - low) / size)) + 1)[1:])
    return np.concatenate(pieces)


def _halved(lines: Floats) -> Floats:
    both = np.empty(2 * lines.size - 1)
    both[::2] = lines
    both[1::2] = (lines[1:] + lines[:-1]) / 2
    return both


def _sums(along: Sequence[Integers]) -> Integers:
    """All sums of one entry of each, (n_x, n_y, n_z)."""
    x, y, z = along
    return np.asarray(x[:, None, None] + y[None, :, None] + z[None, None, :])
