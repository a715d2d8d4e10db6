"""A test laid over a model without knowing where on its surface each point belongs.

1. Starts. Rotations all over SO(3) (super-Fibonacci spirals, Alexa 2022) and those that lay box on
   box, each with translations over what the two boxes leave open, so that a test of one wing is
   tried all along the model. They are compared by distances looked up in cubes; the better ones
   go through iterations of closest points (Besl and McKay 1992), many poses at a time.
2. Fits. Of poses that differ, Gauss-Newton steps on exact distances to the surface. With q the
   foot of a point y and F the projector on the directions along which it may slide, a small turn
   w and shift v change what is left by (1 - F)(y - q + w x y + v); weights leave out points
   farther than three times the median (compare the trimmed form of Chetverikov et al. 2002).
3. Nodes. A fit that lays three in four points on nodes to 2e-3 of their spacing is exact: tests are
   often planned at nodes, and chance does not do that.
4. What cannot be told apart. With r the root mean square of what a fit leaves, errors of places of
   unknown size give two fits the likelihood ratio (r_2 / r_1)^n, n the points less six unknowns.
   Fits that are not EVIDENCE less likely are told as others. Fits of the mirrored points are
   compared likewise, and motions of the best fit that leave it as likely.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import scipy

from modetune.core.measurement.alignment import Alignment, Registration, require_spread
from modetune.core.measurement.closest_points import SurfacePoints
from modetune.core.measurement.poses import (
    Poses,
    chosen,
    diagonal,
    joined,
    normal_equations,
    nudged,
    spread,
    step,
    umeyamas,
)
from modetune.core.measurement.starts import CUT, promising, starts
from modetune.core.modes import Floats

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
#: Steps from a pose by hand at most: from afar they are short.
REFINED = 60


def register(
    points: Floats,
    surface: SurfacePoints,
    nodes: Floats,
    scale: float | None = None,
    near: Alignment | None = None,
) -> Registration:
    """All ways to lay test points on a surface that cannot be told from the best one.

    points: (n_points, 3) of the test. nodes: (n_nodes, 3), of the model. scale: model lengths a
    test length where the units tell; None fits it too, within SCALE_RANGE of what the boxes say.
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


def refined(points: Floats, surface: SurfacePoints, nodes: Floats, near: Alignment) -> Alignment:
    """The fit that a pose by hand leads to, of its scale; on nodes where points are on nodes there.

    points: (n_points, 3) of the test. nodes: (n_nodes, 3), of the model.
    """
    search = _Search(spread(points, MANY), surface, scipy.spatial.KDTree(nodes), near.scale)
    fitted = search.fitted(_poses(near), search.points, REFINED)
    exact = search.on_nodes(fitted)
    return search.told((fitted if exact is None else exact).take([0]), points)


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
        """Poses that cannot be told apart, what they leave, and whether points are on nodes."""
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
