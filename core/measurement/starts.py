"""Poses that a registration starts from: rotations all over, and which of them are promising.

Super-Fibonacci spirals: Alexa (2022), Proc. CVPR, pp. 8291-8300.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import permutations, product

import numpy as np
import scipy

from modetune.core.measurement.poses import Poses, diagonal, umeyamas
from modetune.core.modes import Floats

#: Rotations of starts, cubes along each side that distances are looked up in, samples in them.
ROTATIONS, CUBES, SAMPLES = 2400, 44, 20_000
#: Distances count up to this part of the test's size.
CUT = 0.1
#: Starts that go on.
STARTED = 1500
#: Translations are tried this part of the test's size apart, at most so many a rotation.
APART, TRANSLATIONS = 0.15, 150
#: How far, as a factor, a fitted scale may go from the ratio of the boxes.
SCALE_RANGE = 1.4


def starts(points: Floats, samples: Floats, scale: float | None) -> Poses:
    """Rotations all over, box on box, with translations over what the boxes leave open."""
    frames = [np.linalg.svd(x - x.mean(axis=0), full_matrices=False)[2] for x in (points, samples)]
    of_points, of_model = (axes * np.sign(np.linalg.det(axes)) for axes in frames)
    turns = _quarter_turns()
    boxes = np.concatenate([turns, of_model.T @ turns @ of_points])
    rotations = np.concatenate([boxes, _super_fibonacci(ROTATIONS)])
    turned = np.matmul(points, rotations.transpose(0, 2, 1))
    low, high = samples.min(axis=0), samples.max(axis=0)
    extents = np.ptp(turned, axis=1)
    boxed = np.linalg.norm(high - low) / np.linalg.norm(extents, axis=1)
    scales = boxed if scale is None else np.full(len(rotations), scale)
    middles = (turned.min(axis=1) + turned.max(axis=1)) / 2.0
    # A stray point makes the test's box too large: then, too, the boxes do not say where it lies.
    open_ways = np.abs((high - low) - scales[:, None] * extents) / 2.0
    steps = APART * scales * diagonal(points)
    counts = np.prod(1.0 + 2.0 * open_ways / steps[:, None], axis=1)
    counts = np.minimum(np.ceil(counts - 0.5), TRANSLATIONS).astype(np.int64)
    rows = np.repeat(np.arange(len(rotations)), counts)
    place = np.arange(rows.size) - np.repeat(np.cumsum(counts) - counts, counts)
    # Weyl sequence of the three-dimensional golden ratio, from the middle outwards.
    parts = (0.5 + place[:, None] * np.array([0.8191725134, 0.6710436067, 0.5497004779])) % 1.0
    centres = (low + high) / 2.0 + (2.0 * parts - 1.0) * open_ways[rows]
    return Poses(scales[rows], rotations[rows], centres - scales[rows, None] * middles[rows])


def promising(poses: Poses, points: Floats, samples: Floats, free: bool) -> Poses:
    """The better starts after iterations of closest points, looked up in cubes."""
    size = diagonal(points)
    margin = 0.1 * diagonal(samples)
    low = samples.min(axis=0) - margin
    cube = (np.ptp(samples, axis=0).max() + 2.0 * margin) / CUBES
    shape = np.ceil((np.ptp(samples, axis=0) + 2.0 * margin) / cube).astype(np.int64)
    few = samples[:: max(len(samples) // SAMPLES, 1)]
    grid = np.stack(np.meshgrid(*map(np.arange, shape), indexing="ij"), axis=-1).reshape(-1, 3)
    nearest = few[scipy.spatial.KDTree(few).query(low + (grid + 0.5) * cube)[1]]

    def closest(places: Floats) -> Floats:
        inside = np.clip(((places - low) / cube).astype(np.int64), 0, shape - 1)
        cubes = (inside[..., 0] * shape[1] + inside[..., 1]) * shape[2] + inside[..., 2]
        return np.asarray(nearest[cubes])

    def scores(some: Poses) -> Floats:
        found = []
        for first in range(0, len(some), 20_000):
            part = some.take(slice(first, first + 20_000))
            places = part.apply(points)
            away = np.linalg.norm(closest(places) - places, axis=2)
            found.append(
                np.mean(np.minimum(away / (part.scales * size)[:, None], CUT) ** 2, axis=1)
            )
        return np.concatenate(found)

    poses = poses.take(np.argsort(scores(poses), kind="stable")[:STARTED])
    boxed = poses.scales
    for iteration in range(14):
        places = poses.apply(points)
        targets = closest(places)
        away = np.linalg.norm(targets - places, axis=2)
        reach = np.maximum(
            3.0 * np.median(away, axis=1), CUT * 0.9**iteration * poses.scales * size
        )
        poses = umeyamas(points, targets, away <= reach[:, None], poses.scales, free)
        if free:
            held = np.clip(poses.scales, boxed / SCALE_RANGE, boxed * SCALE_RANGE)
            poses = replace(poses, scales=held)
    return poses.take(np.argsort(scores(poses), kind="stable")[: STARTED // 3])


def _quarter_turns() -> Floats:
    """The 24 proper rotations (24, 3, 3) that take axes to axes."""
    turns = [
        np.eye(3)[list(order)] * np.array(signs)
        for order in permutations(range(3))
        for signs in product((1.0, -1.0), repeat=3)
    ]
    return np.array([turn for turn in turns if np.linalg.det(turn) > 0.0])


def _super_fibonacci(count: int) -> Floats:
    """Rotations (count, 3, 3) evenly all over."""
    s = np.arange(count) + 0.5
    r, big_r = np.sqrt(s / count), np.sqrt(1.0 - s / count)
    alpha, beta = 2.0 * np.pi * s / np.sqrt(2.0), 2.0 * np.pi * s / 1.533751168755204288118041
    parts = [r * np.sin(alpha), r * np.cos(alpha), big_r * np.sin(beta), big_r * np.cos(beta)]
    quaternions = np.column_stack(parts)
    return np.asarray(scipy.spatial.transform.Rotation.from_quat(quaternions).as_matrix())
