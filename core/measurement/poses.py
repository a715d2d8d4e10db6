"""Several poses of a test's points at once: fitted to known partners, or a step nearer to feet."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy
from numpy.typing import NDArray

from modetune.core.modes import Floats, Integers


@dataclass(frozen=True, slots=True)
class Poses:
    """Several poses y = s R x + t: scales (m,), rotations (m, 3, 3), translations (m, 3)."""

    scales: Floats
    rotations: Floats
    translations: Floats

    def apply(self, points: Floats) -> Floats:
        """Points (n, 3), at each pose (m, n, 3)."""
        turned = np.matmul(points, self.rotations.transpose(0, 2, 1))
        return np.asarray(self.scales[:, None, None] * turned + self.translations[:, None, :])

    def take(self, rows: Integers | NDArray[np.bool_] | list[int] | slice) -> Poses:
        """Some of them, in this order."""
        return Poses(self.scales[rows], self.rotations[rows], self.translations[rows])

    def __len__(self) -> int:
        return self.scales.size


def umeyamas(
    points: Floats, targets: Floats, kept: NDArray[np.bool_], scales: Floats, free: bool
) -> Poses:
    """Points (n, 3) fitted to targets (m, n, 3) where kept (m, n): see alignment."""
    weights = kept / np.maximum(kept.sum(axis=1, keepdims=True), 1)
    of_points, of_targets = weights @ points, np.einsum("mn,mni->mi", weights, targets)
    x = points - of_points[:, None, :]
    y = (targets - of_targets[:, None, :]) * weights[:, :, None]
    U, D, Vt = np.linalg.svd(np.matmul(y.transpose(0, 2, 1), x))
    sign = np.ones((len(U), 3))
    sign[:, 2] = np.sign(np.linalg.det(U) * np.linalg.det(Vt))
    rotations = np.matmul(U * sign[:, None, :], Vt)
    if free:
        spreads = np.sum(weights[:, :, None] * x**2, axis=(1, 2))
        scales = np.maximum(np.sum(D * sign, axis=1), 1e-300) / np.maximum(spreads, 1e-300)
    moved = np.einsum("mij,mj->mi", rotations, of_points)
    return Poses(scales, rotations, of_targets - scales[:, None] * moved)


def normal_equations(
    places: Floats, left: Floats, held: Floats, weights: NDArray[np.bool_], lengths: Floats | float
) -> tuple[Floats, Floats]:
    """Normal matrices (m, 7, 7) and right sides (m, 7) of a turn, a shift and a growth."""
    lengths = np.reshape(lengths, (-1, 1, 1))
    arms = (places - places.mean(axis=1, keepdims=True)) / lengths
    count = places.shape[:2]
    jacobian = np.zeros((*count, 3, 7))
    jacobian[..., 0, 1], jacobian[..., 0, 2] = arms[..., 2], -arms[..., 1]
    jacobian[..., 1, 0], jacobian[..., 1, 2] = -arms[..., 2], arms[..., 0]
    jacobian[..., 2, 0], jacobian[..., 2, 1] = arms[..., 1], -arms[..., 0]
    jacobian[..., 3:6] = np.eye(3)
    jacobian[..., 6] = arms
    seen = np.matmul(held, jacobian) * weights[..., None, None]
    seen = seen.reshape(len(places), -1, 7)
    right = (left / lengths).reshape(len(places), -1, 1)
    return np.matmul(seen.transpose(0, 2, 1), seen), np.matmul(seen.transpose(0, 2, 1), right)[
        ..., 0
    ]


def step(
    poses: Poses,
    places: Floats,
    left: Floats,
    held: Floats,
    weights: NDArray[np.bool_],
    lengths: Floats,
    free: bool,
) -> Poses:
    """Poses after a step of Gauss and Newton, none in directions that points do not see."""
    normal, right = normal_equations(places, left, held, weights, lengths)
    if not free:
        normal, right = normal[:, :6, :6], right[:, :6]
    trace = np.trace(normal, axis1=1, axis2=2)[:, None, None]
    unseen = np.maximum(1e-9 * trace, 1e-12) * np.eye(normal.shape[1])
    delta = -np.linalg.solve(normal + unseen, right[..., None])[..., 0]
    longest = np.linalg.norm(delta, axis=1, keepdims=True)
    delta = delta * np.minimum(1.0, 0.3 / np.maximum(longest, 1e-300))
    return nudged(poses, places, np.pad(delta, ((0, 0), (0, 7 - delta.shape[1]))), lengths)


def nudged(poses: Poses, places: Floats, delta: Floats, lengths: Floats) -> Poses:
    """Poses after a turn, a shift (in sizes of the test) and a growth (m, 7) about the middle."""
    centres = places.mean(axis=1)
    turns = np.asarray(scipy.spatial.transform.Rotation.from_rotvec(delta[:, :3]).as_matrix())
    growth = np.exp(delta[:, 6])
    arms = np.einsum("mij,mj->mi", turns, poses.translations - centres)
    return Poses(
        poses.scales * growth,
        np.matmul(turns, poses.rotations),
        centres + growth[:, None] * arms + delta[:, 3:6] * lengths[:, None],
    )


def joined(*several: Poses) -> Poses:
    return Poses(
        np.concatenate([poses.scales for poses in several]),
        np.concatenate([poses.rotations for poses in several]),
        np.concatenate([poses.translations for poses in several]),
    )


def chosen(which: NDArray[np.bool_], these: Poses, those: Poses) -> Poses:
    return Poses(
        np.where(which, these.scales, those.scales),
        np.where(which[:, None, None], these.rotations, those.rotations),
        np.where(which[:, None], these.translations, those.translations),
    )


def spread(points: Floats, at_most: int) -> Floats:
    """So many of the points, each the farthest from those before it."""
    if len(points) > 20 * at_most:  # multiples of the golden ratio miss no row of a grid
        parts = np.arange(20 * at_most) * (np.sqrt(5.0) - 1.0) / 2.0 % 1.0
        points = points[np.unique((parts * len(points)).astype(np.int64))]
    if len(points) <= at_most:
        return points
    if at_most > 500:
        return np.asarray(points[np.linspace(0, len(points) - 1, at_most).astype(np.int64)])
    rows = [int(np.argmax(np.sum((points - points.mean(axis=0)) ** 2, axis=1)))]
    away = np.sum((points - points[rows[0]]) ** 2, axis=1)
    while len(rows) < at_most:
        rows.append(int(np.argmax(away)))
        away = np.minimum(away, np.sum((points - points[rows[-1]]) ** 2, axis=1))
    return np.asarray(points[rows])


def diagonal(points: Floats) -> float:
    return float(np.linalg.norm(np.ptp(points, axis=0)))
