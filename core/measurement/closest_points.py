"""The points of a surface that are closest to some places.

A surface is triangles; a beam is a triangle with two corners in one place, a node alone one with
all three. The closest point of a triangle is the foot of the perpendicular where that lies inside,
else the closest of its three sides' points. Which triangles are asked is found by samples: every
triangle is covered by samples no farther apart than its class allows (classes of size, each an
octave of four), and those whose samples are next to a place are asked, of each class.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy
from numpy.typing import NDArray

from modetune.core.modes import Floats, Integers

#: Triangles of a class that are asked for a place.
ASKED = 8
#: Largest distance between samples, as a part of the surface's extent.
COARSEST = 0.02
#: Places that are asked at a time: some 100 MB.
AT_A_TIME = 20_000


@dataclass(frozen=True, slots=True)
class Feet:
    """Closest points of a surface.

    points: (n, 3). distances: (n,). free: (n, 3, 3), projectors on the directions along which the
    foot may move: the triangle's plane, an edge, or none at a corner.
    """

    points: Floats
    distances: Floats
    free: Floats


@dataclass(frozen=True, slots=True)
class SurfacePoints:
    """A surface that finds its points closest to others.

    corners: (n, 3, 3). samples: (n_samples, 3), all over it. classes: a tree of samples and the
    triangle of each, for each class of size.
    """

    corners: Floats
    samples: Floats
    classes: tuple[tuple[scipy.spatial.KDTree, Integers], ...]

    @classmethod
    def of(cls, corners: Floats) -> SurfacePoints:
        """The surface of triangles (n, 3, 3), at least one."""
        places = corners.reshape(-1, 3)
        coarsest = COARSEST * float(np.linalg.norm(np.ptp(places, axis=0)))
        sizes = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1)
        floor = max(coarsest / 4.0**4, float(np.finfo(float).tiny))
        level = np.ceil(np.log(np.maximum(np.minimum(sizes, coarsest), floor) / floor) / np.log(4))
        classes, samples = [], []
        for this in np.unique(level):
            rows = np.flatnonzero(level == this)
            # Triangles below the coarsest are one sample each, larger ones are cut.
            points, owner = _cover(corners[rows], coarsest)
            classes.append((scipy.spatial.KDTree(points), rows[owner]))
            samples.append(points)
        return cls(corners, np.concatenate(samples), tuple(classes))

    def closest(self, places: Floats) -> Feet:
        """The closest points of places (n, 3)."""
        parts = [
            self._closest(places[first : first + AT_A_TIME])
            for first in range(0, max(len(places), 1), AT_A_TIME)
        ]
        return Feet(*(np.concatenate(found) for found in zip(*parts, strict=True)))

    def _closest(self, places: Floats) -> tuple[Floats, Floats, Floats]:
        asked = []
        for tree, owner in self.classes:
            k = min(ASKED, owner.size)
            rows = np.asarray(tree.query(places, k=k)[1], np.int64).reshape(len(places), k)
            asked.append(owner[rows])
        triangles = np.concatenate(asked, axis=1)
        corners = self.corners[triangles]
        feet, features = closest_of(corners, places[:, None, :])
        distances = np.linalg.norm(feet - places[:, None, :], axis=2)
        best = np.argmin(distances, axis=1)
        each = np.arange(len(places))
        chosen, feature = corners[each, best], features[each, best]
        return feet[each, best], distances[each, best], _free(chosen, feature)


def closest_of(corners: Floats, places: Floats) -> tuple[Floats, Integers]:
    """Closest points (..., 3) of triangles (..., 3, 3) to places (..., 3), and where they lie.

    Both have the same number of dimensions, of which some may be one.
    0, 1, 2: on the side from that corner to the next; 3: at a corner; 4: inside.
    """
    # Components first: sums over three strided numbers take most of the time else.
    a, b, c = np.ascontiguousarray(np.moveaxis(corners, (-2, -1), (0, 1)))
    place = np.ascontiguousarray(np.moveaxis(places, -1, 0))
    best = np.full(np.broadcast_shapes(a.shape, place.shape)[1:], np.inf)
    feet = np.zeros((3, *best.shape))
    feature = np.full(best.shape, 3)
    for number, (first, second) in enumerate(((a, b), (b, c), (c, a))):
        along = second - first
        length = _dot(along, along)
        part = _dot(place - first, along) / np.where(length > 0.0, length, 1.0)
        inside = (part > 0.0) & (part < 1.0)
        foot = first + np.clip(part, 0.0, 1.0) * along
        away = place - foot
        square = _dot(away, away)
        nearer = square < best
        best = np.where(nearer, square, best)
        feet = np.where(nearer, foot, feet)
        feature = np.where(nearer, np.where(inside, number, 3), feature)
    u, v, w = b - a, c - a, place - a
    uu, uv, vv, wu, wv = _dot(u, u), _dot(u, v), _dot(v, v), _dot(w, u), _dot(w, v)
    area = uu * vv - uv * uv
    flat = area <= 1e-14 * uu * vv  # sides in one line to 1e-7: rounding would decide
    area = np.where(flat, 1.0, area)
    s, t = (wu * vv - wv * uv) / area, (wv * uu - wu * uv) / area
    within = ~flat & (s >= 0.0) & (t >= 0.0) & (s + t <= 1.0)
    feet = np.where(within, a + s * u + t * v, feet)
    return np.moveaxis(feet, 0, -1), np.where(within, 4, feature)


def _dot(first: Floats, second: Floats) -> Floats:
    """Products (...) of vectors (3, ...)."""
    return np.asarray(first[0] * second[0] + first[1] * second[1] + first[2] * second[2])


def _free(corners: Floats, feature: Integers) -> Floats:
    """Projectors (n, 3, 3) on the directions in which feet may move."""
    along = np.roll(corners, -1, axis=1) - corners
    each = np.arange(len(corners))
    side = along[each, np.minimum(feature, 2)]
    normal = np.cross(along[:, 0], along[:, 1])
    direction = np.where((feature == 4)[:, None], normal, side)
    direction /= np.maximum(np.linalg.norm(direction, axis=1, keepdims=True), 1e-300)
    outer = direction[:, :, None] * direction[:, None, :]
    inside, corner = (feature == 4)[:, None, None], (feature == 3)[:, None, None]
    return np.where(inside, np.eye(3) - outer, np.where(corner, 0.0, outer))


def _cover(corners: Floats, apart: float) -> tuple[Floats, NDArray[np.int64]]:
    """Points all over triangles (n, 3, 3), none of it farther from one than about `apart`."""
    sides = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1)
    cuts = np.maximum(np.ceil(sides / max(apart, 1e-300)), 1).astype(np.int64)
    beams = (corners[:, 1] == corners[:, 2]).all(axis=1)
    points, owners = [], []
    for n, is_beam in {*zip(cuts.tolist(), beams.tolist(), strict=True)}:
        rows = np.flatnonzero((cuts == n) & (beams == is_beam))
        i, j = (grid.ravel() for grid in np.meshgrid(np.arange(n), np.arange(n), indexing="ij"))
        # Middles of the n^2 equal triangles that a triangle is cut into: upright, then turned.
        upright = (i + j < n)[:, None]
        parts = np.where(
            upright,
            np.column_stack([i, j]) + 1 / 3,
            np.column_stack([n - 1 - i, n - 1 - j]) + 2 / 3,
        )
        if is_beam:
            parts = np.column_stack([np.arange(n) + 0.5, np.zeros(n)])
        spans = corners[rows, 1:] - corners[rows, :1]
        found = corners[rows, :1] + np.einsum("ks,nsx->nkx", parts / n, spans)
        points.append(found.reshape(-1, 3))
        owners.append(np.repeat(rows, len(parts)))
    return np.concatenate(points), np.concatenate(owners)
