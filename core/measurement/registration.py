"""Where the points of a test lie on a model: scale, rotation and translation.

A test has its own axes, origin and unit of length. A test point x lies in the model at

    y = s R x + t,        s > 0, R a proper rotation, t in the model's length.

**Points with known partners** (Umeyama 1991, IEEE Trans. PAMI 13, eqs. 40-42): with centred points
X and targets Y (n, 3) and the decomposition Y^T X / n = U D V^T, the minimum of the sum of
|y - s R x - t|^2 has

    R = U S V^T,  s = tr(D S) / (|X|^2 / n),  t = mean(y) - s R mean(x),  S = diag(1, 1, det U V)

S keeps R proper: a mirrored structure is another structure. Points in one plane have D[2] = 0 and
still only one R; points on one line leave a rotation about it open and are refused.

**Points somewhere on the model's surface**:

1. Starts. Rotations all over SO(3) (super-Fibonacci spirals: Alexa 2022, Proc. CVPR, 8291-8300) and
   those that place box on box, each with translations over what the two boxes leave open, so that a
   test of one wing is tried all along the model. Distances looked up in cubes rank them; the
   better ones go through iterations of closest points (Besl and McKay 1992), many poses at a time.
2. Fits. Poses that differ are refined by Gauss-Newton steps on exact distances to the surface. With
   q the foot of a point y and F the projector on the directions along which it may slide, a small
   turn w and shift v change what is left by (1 - F)(y - q + w x y + v); weights leave out points
   farther than three times the median (compare the trimmed form of Chetverikov et al. 2002).
3. Nodes. A fit that puts three in four points on nodes to 2e-3 of their spacing is exact: tests are
   often planned at nodes, and chance does not do that.
4. Ambiguity. With r the root mean square of what a fit leaves, errors of places of unknown size
   give two fits the likelihood ratio (r_2 / r_1)^n, n the points less six unknowns. Fits that are
   less likely by no more than EVIDENCE are reported as alternatives. Fits of the mirrored points
   are compared likewise, and so are motions of the best fit that leave it as likely.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from itertools import permutations, product

import numpy as np
import scipy
from numpy.typing import NDArray

from modetune.core.errors import ModesError
from modetune.core.measurement.closest_points import SurfacePoints
from modetune.core.modes import Floats, Integers

#: Points whose second extent is below this part of the first lie on a line.
ON_A_LINE = 1e-3
#: Rotations of starts, cubes along each side that distances are looked up in, samples in them.
ROTATIONS, CUBES, SAMPLES = 2400, 44, 20_000
#: Distances count up to this part of the test's size.
CUT = 0.1
#: Number of starts that are refined.
STARTED = 1500
#: Distance of tried translations, as a part of the test's size, and their number per rotation.
APART, TRANSLATIONS = 0.15, 150
#: How far, as a factor, a fitted scale may go from the ratio of the boxes.
SCALE_RANGE = 1.4
#: Points that find starts, that fit poses, and that decide.
FEW, SOME, MANY = 30, 60, 600
#: Poses that are fitted exactly, and that are compared.
FITTED, COMPARED = 60, 12
#: Poses that move points by less than this part of the test's size are one.
SAME = 0.03
#: Coordinates are written no better than this part of the test's size.
WRITTEN = 1e-4
#: Logarithm of the likelihood ratio from which the less likely fit is left out: 1000 to 1.
EVIDENCE = 7.0
#: Points are on nodes where they are this near, in spacings of the test's points, and a fit is
#: where this part of the points is.
ON_NODE = 2e-3
HIT = 0.75


@dataclass(frozen=True, slots=True)
class Alignment:
    """Where test points lie in a model: y = scale rotation x + translation.

    scale: model lengths a test length. rotation: (3, 3), proper. translation: (3,), the model's
    length. residuals: (n_points,), distances left by a fit, the model's length; empty where the
    alignment was given. used: (n_points,), which points took part in the fit.
    notes: what is to be known of it, a sentence each.
    """

    scale: float
    rotation: Floats
    translation: Floats
    residuals: Floats = field(default_factory=lambda: np.zeros(0))
    used: NDArray[np.bool_] = field(default_factory=lambda: np.zeros(0, bool))
    notes: tuple[str, ...] = ()

    def apply(self, coordinates: Floats) -> Floats:
        """Coordinates (n, 3) of the test in the model's axes and length."""
        return np.asarray(self.scale * coordinates @ self.rotation.T + self.translation)

    def turn(self, directions: Floats) -> Floats:
        """Directions (..., 3) of the test in the model's axes."""
        return np.asarray(directions @ self.rotation.T)

    @property
    def rms(self) -> float:
        """Root mean square of what the fit left at the points it used; 0 where given."""
        left = self.residuals[self.used]
        return float(np.sqrt(np.mean(left**2))) if left.size else 0.0

    @property
    def largest(self) -> float:
        """Largest of what the fit left at the points it used; 0 where given."""
        return float(self.residuals[self.used].max(initial=0.0))

    @property
    def degrees(self) -> float:
        """How far the rotation turns, 0 to 180."""
        return degrees_of(self.rotation)


@dataclass(frozen=True, slots=True)
class Registration:
    """Ways to lay a test over a model.

    best: the likeliest. others: those that cannot be distinguished from it, likelier ones first.
    slides: the largest motion of points that the fit leaves open, in the model's length.
    on_nodes: whether points lie on nodes. mirrored: whether the mirrored points fit far better.
    """

    best: Alignment
    others: tuple[Alignment, ...] = ()
    slides: float = 0.0
    on_nodes: bool = False
    mirrored: bool = False


def fit_similarity(points: Floats, targets: Floats, scale: float | None = None) -> Alignment:
    """The alignment that brings points nearest to their known partners.

    points, targets: (n, 3), partners in the same row. scale: model lengths a test length where it
    is known; None fits it too. Raises ModesError for fewer than three points, points on one line
    and arrays that do not fit together. Source: Umeyama (1991).
    """
    if points.shape != targets.shape:
        raise ModesError(f"{len(points)} points cannot be fitted to {len(targets)} partners")
    require_spread(points, "the test's points with known partners")
    require_spread(targets, "the model's nodes they belong to")
    found = umeyama(points, targets, scale)
    mirror = np.diag([1.0, 1.0, -1.0])
    mirrored = umeyama(points @ mirror, targets, scale)
    left, other = (
        np.linalg.norm(fit.apply(where) - targets, axis=1)
        for fit, where in ((found, points), (mirrored, points @ mirror))
    )
    size = float(np.linalg.norm(np.ptp(targets, axis=0)))
    notes: tuple[str, ...] = ()
    # In a plane the mirrored points are the points, and both fit alike.
    if np.sqrt(np.mean(left**2)) > 1e-6 * size and np.sum(other**2) < 0.25 * np.sum(left**2):
        notes = (
            "the test's points fit far better as their own mirror image: a partner may be wrong, "
            "or the test's axes are left-handed",
        )
    return Alignment(
        found.scale, found.rotation, found.translation, left, np.ones(len(points), bool), notes
    )


def umeyama(points: Floats, targets: Floats, scale: float | None) -> Alignment:
    """The fit of points (n, 3) to targets (n, 3) without residuals or checks, eqs. 40-42."""
    x, y = points - points.mean(axis=0), targets - targets.mean(axis=0)
    U, D, Vt = np.linalg.svd(y.T @ x)
    S = np.array([1.0, 1.0, np.sign(np.linalg.det(U) * np.linalg.det(Vt))])
    R = (U * S) @ Vt
    spread = float(np.sum(x**2))
    # Points all paired with one node would have scale 0, by which nothing can be divided.
    fitted = max(float(D @ S) / spread, 1e-300) if spread > 0.0 else 1.0
    s = fitted if scale is None else scale
    return Alignment(s, R, targets.mean(axis=0) - s * R @ points.mean(axis=0))


def degrees_of(rotation: Floats) -> float:
    """How far a rotation (3, 3) turns, 0 to 180."""
    return float(np.degrees(np.arccos(np.clip((np.trace(rotation) - 1.0) / 2.0, -1.0, 1.0))))


def require_spread(points: Floats, whose: str) -> None:
    """Raise ModesError where points (n, 3) fix no rotation."""
    if len(points) < 3:
        raise ModesError(f"{whose} are {len(points)}; a fit takes three or more, not on one line")
    extents = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    if extents[1] <= ON_A_LINE * extents[0]:
        raise ModesError(
            f"{whose} lie on one line, which leaves the rotation about it open: it cannot be fitted"
        )


@dataclass(frozen=True, slots=True)
class Poses:
    """Several poses y = s R x + t: scales (m,), rotations (m, 3, 3), translations (m, 3)."""

    scales: Floats
    rotations: Floats
    translations: Floats

    def within(self, scales: Floats) -> Poses:
        """The same with scales no farther from these than SCALE_RANGE."""
        held = np.clip(self.scales, scales / SCALE_RANGE, scales * SCALE_RANGE)
        return replace(self, scales=held)

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
    """Return at most `at_most` of the points, each the farthest from those before it."""
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
            poses = poses.within(boxed)
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


def register(
    points: Floats,
    surface: SurfacePoints,
    nodes: Floats,
    scale: float | None = None,
    near: Alignment | None = None,
) -> Registration:
    """Return the best pose of test points on a surface, and those that are not worse.

    points: (n_points, 3) of the test. nodes: (n_nodes, 3), of the model. scale: model lengths a
    test length if the units are known; None fits it too, within SCALE_RANGE of the boxes' ratio.
    near: one more start. Raises ModesError for fewer than three points and points on one line.
    """
    require_spread(points, "the test's points")
    require_spread(nodes, "the model's nodes")
    search = _Search(spread(points, MANY), surface, scipy.spatial.KDTree(nodes), scale)
    fits, costs, exact = search.fits(near)
    thinness = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    mirrored = False
    # Points in a plane are their own mirror image; a fit that leaves nothing cannot be bettered.
    if thinness[2] > 1e-3 * thinness[0] and search.evidence(0.0, costs[0]) > EVIDENCE:
        image = replace(search, points=search.points * np.array([1.0, 1.0, -1.0]))
        mirrored = search.evidence(image.fits(None)[1][0], costs[0]) > EVIDENCE
    slides = 0.0 if exact else search.slides(fits.take([0]))
    found = [search.told(fits.take([row]), points) for row in range(len(fits))]
    return Registration(found[0], tuple(found[1:]), slides, exact, mirrored)


@dataclass(frozen=True, slots=True)
class _Search:
    points: Floats
    surface: SurfacePoints
    nodes: scipy.spatial.KDTree
    scale: float | None

    @property
    def size(self) -> float:
        return diagonal(self.points)

    def fits(self, near: Alignment | None) -> tuple[Poses, Floats, bool]:
        """Return equally good poses, their residuals, and whether points are on nodes."""
        few, some = spread(self.points, FEW), spread(self.points, SOME)
        poses = starts(few, self.surface.samples, self.scale)
        if near is not None:
            poses = joined(poses, _poses(near))
        poses = promising(poses, few, self.surface.samples, self.scale is None)
        poses = self.different(poses, FITTED, some)
        poses = self.fitted(poses, some, 6)
        poses = self.different(poses, COMPARED, some)
        poses = self.fitted(_shaken(poses, some), some, 8)
        poses = self.different(poses, COMPARED, some)
        poses = self.different(self.fitted(poses, self.points, 30), COMPARED, self.points)
        costs = self.costs(poses, self.points)
        alike = np.array([self.evidence(costs.min(), cost) <= EVIDENCE for cost in costs])
        exact = self.on_nodes(poses.take(alike))
        poses = poses.take(alike) if exact is None else exact
        costs = self.costs(poses, self.points)
        order = np.lexsort((_degrees(poses.rotations), np.round(costs, 5)))
        poses, costs = poses.take(order), costs[order]
        return poses, costs, exact is not None

    def distances(self, poses: Poses, points: Floats) -> Floats:
        """Exact distances (m, n) to the surface, in sizes of the test."""
        places = poses.apply(points)
        found = self.surface.closest(places.reshape(-1, 3)).distances.reshape(places.shape[:2])
        return np.asarray(found / (poses.scales * self.size)[:, None])

    def costs(self, poses: Poses, points: Floats) -> Floats:
        """Root mean square distances (m,), in sizes of the test, each cut off."""
        cut = np.minimum(self.distances(poses, points), CUT)
        return np.asarray(np.sqrt(np.mean(cut**2, axis=1)))

    def evidence(self, better: float, worse: float) -> float:
        """Logarithm of the likelihood ratio of two fits by what they leave."""
        free = max(len(self.points) - 6, 1)
        return float(free * 0.5 * np.log((worse**2 + WRITTEN**2) / (better**2 + WRITTEN**2)))

    def different(self, poses: Poses, at_most: int, points: Floats) -> Poses:
        """The best poses of those that put points into different places."""
        order = np.argsort(self.costs(poses, points), kind="stable")
        poses = poses.take(order)
        return poses.take(self.distinct(poses, at_most, points))

    @property
    def spacing(self) -> float:
        """Median distance of a point from the next one, the test's length."""
        apart = np.asarray(scipy.spatial.KDTree(self.points).query(self.points, k=[2])[0])
        return float(np.median(apart)) or self.size / 100.0  # several sensors in one place

    def distinct(self, poses: Poses, at_most: int, points: Floats, same: float = SAME) -> list[int]:
        """Rows of poses that put points farther than this part of the size from those before."""
        places = poses.apply(spread(points, FEW))
        found: list[int] = []
        for row in range(len(poses)):
            apart = places[found] - places[row]
            moved = np.sqrt(np.mean(np.sum(apart**2, axis=2), axis=1))
            if (moved > same * self.size * poses.scales[row]).all():
                found.append(row)
                if len(found) == at_most:
                    break
        return found

    def fitted(self, poses: Poses, points: Floats, iterations: int) -> Poses:
        """Gauss-Newton from each pose; of each the best that it came by."""
        best, least = poses, np.full(len(poses), np.inf)
        for iteration in range(iterations + 1):
            places = poses.apply(points)
            lengths = poses.scales * self.size
            feet = self.surface.closest(places.reshape(-1, 3))
            distances = feet.distances.reshape(places.shape[:2]) / lengths[:, None]
            costs = np.sqrt(np.mean(np.minimum(distances, CUT) ** 2, axis=1))
            gained = (costs < 0.99 * least) & (least > 1e-9)
            best = chosen(costs < least, poses, best)
            least = np.minimum(costs, least)
            if iteration == iterations or (iteration > 12 and not gained.any()):
                break
            reach = np.maximum(3.0 * np.median(distances, axis=1), max(CUT * 0.8**iteration, 0.01))
            held = np.eye(3) - feet.free.reshape(*places.shape, 3)
            left = places - feet.points.reshape(places.shape)
            weights = distances <= reach[:, None]
            poses = step(poses, places, left, held, weights, lengths, self.scale is None)
        return best

    def on_nodes(self, poses: Poses) -> Poses | None:
        """The poses next to these that have points on nodes, as many as any has; None without."""
        some = spread(self.points, SOME)
        near = ON_NODE * self.spacing
        free = self.scale is None
        found, most = [], HIT
        for row in range(len(poses)):
            pose = poses.take([row])
            tried = joined(pose, self._onto_nodes(pose, some))
            for _ in range(6):
                away, to = self.nodes.query(tried.apply(some))
                kept = away <= 1.5 * np.median(away, axis=1, keepdims=True) + near * pose.scales[0]
                tried = umeyamas(some, self.nodes.data[to], kept, tried.scales, free)
                if free:  # at scale 0 all points are on one node
                    tried = tried.within(pose.scales)
            away = self.nodes.query(tried.apply(some))[0]
            hits = (away <= near * pose.scales[0]).mean(axis=1)
            if hits.max() >= most:
                most = hits.max()
                found.append((most, tried.take(hits == most)))
        if not found:
            return None
        best = joined(*(tried for hits, tried in found if hits == most))
        best = best.take(self.distinct(best, COMPARED, some, 10.0 * near / self.size))
        away, to = self.nodes.query(best.apply(self.points))
        return umeyamas(
            self.points, self.nodes.data[to], away <= near * best.scales[:, None], best.scales, free
        )

    def _onto_nodes(self, pose: Poses, points: Floats) -> Poses:
        """The pose moved so that two points far apart lie on nodes as far apart next to them."""
        places = pose.apply(points)[0]
        one = int(np.argmax(np.linalg.norm(places - places.mean(axis=0), axis=1)))
        two = int(np.argmax(np.linalg.norm(places - places[one], axis=1)))
        k = min(60, self.nodes.n)
        here, there = (
            self.nodes.data[np.ravel(self.nodes.query(places[i], k)[1])] for i in (one, two)
        )
        apart = there[None, :, :] - here[:, None, :]
        far = np.linalg.norm(apart, axis=2)
        wanted = places[two] - places[one]
        error = np.abs(far / np.linalg.norm(wanted) - 1.0)
        first, second = np.unravel_index(np.argsort(error, axis=None)[:200], error.shape)
        along = apart[first, second] / np.maximum(far[first, second], 1e-300)[:, None]
        before = wanted / np.linalg.norm(wanted)
        # Small turns: the cross product of unit vectors is the turn between them.
        vectors = np.cross(before, along)
        turns = np.asarray(scipy.spatial.transform.Rotation.from_rotvec(vectors).as_matrix())
        count = len(first)
        scales = np.repeat(pose.scales, count)
        moved = np.einsum("mij,j->mi", turns, pose.translations[0] - places[one])
        return Poses(scales, np.matmul(turns, pose.rotations), here[first] + moved)

    def slides(self, pose: Poses) -> float:
        """How far points move at most, the model's length, by motions that leave the fit alike."""
        some = spread(self.points, SOME)
        places = pose.apply(some)
        feet = self.surface.closest(places[0])
        length = float(pose.scales[0] * self.size)
        held = np.eye(3) - feet.free[None]
        normal, _ = normal_equations(
            places, places * 0.0, held, np.ones(places.shape[:2], bool), length
        )
        cost = float(self.costs(pose, some)[0])
        parts = np.geomspace(1e-5, 0.3, 24)
        motions = np.linalg.eigh(normal[0, :6, :6])[1].T
        delta = np.einsum("s,mk,p->smpk", [1.0, -1.0], motions, parts).reshape(-1, 6)
        many = pose.take(np.zeros(len(delta), np.int64))
        lengths = np.full(len(delta), length)
        moved = nudged(many, many.apply(some), np.pad(delta, ((0, 0), (0, 1))), lengths)
        # What slides turns a little on its way: fitted again, it goes as far as it can.
        moved = joined(moved, self.fitted(moved, some, 4))
        alike = [self.evidence(cost, found) <= 2.0 for found in self.costs(moved, some)]
        reached = np.logical_and.accumulate(np.reshape(alike, (-1, parts.size)), axis=1).ravel()
        apart = np.linalg.norm(moved.apply(some) - places, axis=2).max(axis=1)
        return float(apart[reached].max(initial=0.0))

    def told(self, pose: Poses, points: Floats) -> Alignment:
        """A pose with what it leaves at all points."""
        found = Alignment(float(pose.scales[0]), pose.rotations[0], pose.translations[0])
        away = self.surface.closest(found.apply(points)).distances
        reach = max(3.0 * float(np.median(away)), 0.01 * found.scale * self.size)
        return replace(found, residuals=away, used=np.asarray(away <= reach))


def _shaken(poses: Poses, points: Floats) -> Poses:
    """All poses, and the first ones moved a little: a thin wall has its other side."""
    rng = np.random.default_rng(0)
    best = poses.take(np.repeat(np.arange(min(len(poses), 4)), 8))
    delta = np.pad(rng.normal(0.0, 0.025, (len(best), 6)), ((0, 0), (0, 1)))
    lengths = best.scales * diagonal(points)
    return joined(poses, nudged(best, best.apply(points), delta, lengths))


def _poses(one: Alignment) -> Poses:
    return Poses(np.array([one.scale]), one.rotation[None], one.translation[None])


def _degrees(rotations: Floats) -> Floats:
    cosine = (np.trace(rotations, axis1=1, axis2=2) - 1.0) / 2.0
    return np.asarray(np.round(np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0)))))
