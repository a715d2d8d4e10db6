"""What two sets of sensors both see, by the directions they look along, whatever these are called.

At a point a sensor i measures y_i = d_i . u, d_i a unit vector, u the motion. Sensors with the
directions D (k, 3) of one set give the motion along d too if d = D^T w, with w the weights of least
size; then d . u = w . y. So a direction of either set that the other one spans is compared, once:
those of the first set, then what only the second set's own directions reach. Rotations go likewise.

Directions are in the axes of each test. Points in both tests, by number, give the rotation of the
axes of the second against those of the first.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from modetune.core.measurement.measurement import TestGeometry
from modetune.core.measurement.registration import ON_A_LINE, degrees_of, umeyama
from modetune.core.modes import Floats, Integers, ModeSet

Shapes = NDArray[np.float64] | NDArray[np.complex128]

#: Sine of the angle between directions that count as one: accelerometers see some 5 % of motion
#: across their axis, and are mounted no better.
ALIGNED = 0.05
#: The same of directions that are written with five digits.
SAME = 1e-5
#: Directions of which one adds less than this part of the others' extent do not span a plane: noise
#: along it would come out five times as large.
SPREAD = 0.2
#: Points of one number lie at one place within this part of the structure's diagonal: standing as
#: they are, and after a fit (hand-measured points).
STANDING, FITTED = 1e-3, 0.02


@dataclass(frozen=True, slots=True)
class CommonMotion:
    """What two mode sets both see.

    dofs: (n_common,), node and component of the sensor whose direction is compared. first, second:
    (n_common, n_dof) of each set, what makes it of their shapes. used_first, used_second: rows of
    the shapes that take part.
    """

    dofs: tuple[tuple[int, int], ...]
    first: sparse.csr_array
    second: sparse.csr_array

    def of(self, first: ModeSet, second: ModeSet) -> tuple[Shapes, Shapes]:
        """What both see of their shapes, (n_common, n_modes) each."""
        return np.asarray(self.first @ first.mode_shapes), np.asarray(
            self.second @ second.mode_shapes
        )

    @property
    def used_first(self) -> Integers:
        return np.unique(self.first.nonzero()[1]).astype(np.int64)

    @property
    def used_second(self) -> Integers:
        return np.unique(self.second.nonzero()[1]).astype(np.int64)


def directions_of(modes: ModeSet, geometry: TestGeometry | None) -> Floats:
    """Directions (n_dof, 3) of a test's sensors in its axes; the axes themselves where untold."""
    directions: Floats = np.eye(3)[(modes.components - 1) % 3]
    if geometry is None:
        return directions
    at = {node: row for row, node in enumerate(geometry.nodes.tolist())}
    rows = np.array([at.get(node, -1) for node in modes.nodes.tolist()], dtype=np.int64)
    frames = geometry.frames[rows, (modes.components - 1) % 3] if at else directions
    return np.asarray(np.where(rows[:, None] >= 0, frames, directions))


def common_motion(
    first: ModeSet, second: ModeSet, directions_first: Floats, directions_second: Floats
) -> CommonMotion:
    """What both see; directions: (n_dof, 3) of each, unit vectors in the same axes."""
    places = [_by_place(modes) for modes in (first, second)]
    dofs: list[tuple[int, int]] = []
    entries: tuple[list[tuple[int, int, float]], ...] = ([], [])

    def add(dof: tuple[int, int], left: dict[int, float], right: dict[int, float]) -> None:
        for side, weights in zip(entries, (left, right), strict=True):
            side += [(len(dofs), row, weight) for row, weight in weights.items()]
        dofs.append(dof)

    for place, rows in places[0].items():
        others = places[1].get(place, [])
        here, there = directions_first[rows], directions_second[others]
        compared = np.zeros((0, 3))
        for row, direction in zip(rows, here, strict=True):
            weights = _weights(direction, there)
            if weights is not None:
                add(_dof(first, row), {row: 1.0}, _named(others, weights))
                compared = np.vstack([compared, direction])
        for row, direction in zip(others, there, strict=True):
            weights = _weights(direction, here)
            if weights is not None and _weights(direction, compared) is None:
                add(_dof(second, row), _named(rows, weights), {row: 1.0})
                compared = np.vstack([compared, direction])
    maps = [
        _sparse(side, len(dofs), modes.n_dof) if side else sparse.csr_array((0, modes.n_dof))
        for side, modes in zip(entries, (first, second), strict=True)
    ]
    return CommonMotion(tuple(dofs), maps[0], maps[1])


def turn_between(first: TestGeometry, second: TestGeometry) -> tuple[Floats, str]:
    """The rotation (3, 3) of the second test's axes into the first's, and what to know of it.

    By the places of at least three common points; the identity if they determine no rotation.
    """
    _, rows, others = np.intersect1d(first.nodes, second.nodes, return_indices=True)
    unturned = np.eye(3)
    if rows.size < 3:
        return unturned, ""
    points, targets = second.coordinates[others], first.coordinates[rows]
    x, y = points - points.mean(axis=0), targets - targets.mean(axis=0)
    size = float(np.linalg.norm(np.ptp(targets, axis=0)))
    lengths = float(np.linalg.norm(x)), float(np.linalg.norm(y))
    if min(lengths) == 0.0:
        return unturned, ""
    scale = second.metres / first.metres
    scale = scale if np.isfinite(scale) else lengths[1] / lengths[0]
    if _rms(scale * x - y) <= STANDING * size:
        return unturned, ""
    extents = np.linalg.svd(y, compute_uv=False)
    on_a_line = extents[1] <= ON_A_LINE * extents[0]
    rotation = _least_turn(x, y) if on_a_line else umeyama(points, targets, scale).rotation
    if _rms(scale * x @ rotation.T - y) > FITTED * size:
        return unturned, (
            "doubtful: points of one number lie at different places in both, and the axes are "
            "taken for the same; compare the numbering of the points"
        )
    turned = degrees_of(rotation)
    if np.sin(np.radians(min(turned, 90.0))) <= ALIGNED:
        return unturned, ""
    text = f"its axes are turned by {turned:.3g} degrees, as {rows.size} common points lie"
    left = "; a turn about the line of the points stays open" if on_a_line else ""
    return rotation, text + left


def _by_place(modes: ModeSet) -> dict[tuple[int, bool], list[int]]:
    """Rows of shapes by node, translations and rotations apart."""
    found: dict[tuple[int, bool], list[int]] = {}
    for row, (node, component) in enumerate(
        zip(modes.nodes.tolist(), modes.components.tolist(), strict=True)
    ):
        found.setdefault((node, component > 3), []).append(row)
    return found


def _weights(direction: Floats, others: Floats) -> Floats | None:
    """Weights (k,) that make a direction of others (k, 3); None where they do not span it."""
    if not len(others):
        return None
    cosines = others @ direction
    nearest = int(np.abs(cosines).argmax())
    single = np.zeros(len(others))
    single[nearest] = np.sign(cosines[nearest])
    apart = float(np.linalg.norm(direction - single @ others))
    if apart <= SAME:
        return single
    u, extents, axes = np.linalg.svd(others, full_matrices=False)
    kept = extents > SPREAD * extents[0]
    several = u[:, kept] @ ((axes[kept] @ direction) / extents[kept])
    left = float(np.linalg.norm(direction - several @ others))
    if min(apart, left) > ALIGNED:
        return None
    return single if apart <= left else np.asarray(several)


def _named(rows: list[int], weights: Floats) -> dict[int, float]:
    return {row: weight for row, weight in zip(rows, weights.tolist(), strict=True) if weight}


def _dof(modes: ModeSet, row: int) -> tuple[int, int]:
    return int(modes.nodes[row]), int(modes.components[row])


def _sparse(entries: list[tuple[int, int, float]], n_common: int, n_dof: int) -> sparse.csr_array:
    rows, columns, values = (np.array(part) for part in zip(*entries, strict=True))
    return sparse.csr_array((values, (rows, columns)), shape=(n_common, n_dof))


def _rms(left: Floats) -> float:
    return float(np.sqrt((left**2).sum(axis=1).mean()))


def _least_turn(x: Floats, y: Floats) -> Floats:
    """The least rotation of the line of points x (n, 3) on to that of y."""
    a, b = (np.linalg.svd(points, full_matrices=False)[2][0] for points in (x, y))
    a = a * np.sign((x @ a) @ (y @ b))
    axis, cosine = np.cross(a, b), float(a @ b)
    if cosine < -1.0 + 1e-12:  # half a turn about any axis across
        across = np.cross(a, np.eye(3)[int(np.abs(a).argmin())])
        across /= np.linalg.norm(across)
        return 2.0 * np.outer(across, across) - np.eye(3)
    skew = np.cross(np.eye(3), axis)  # times v: axis x v
    return np.asarray(np.eye(3) + skew + skew @ skew / (1.0 + cosine))
