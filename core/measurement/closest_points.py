"""A test laid over a model without knowing which node each point belongs to.

Iterative closest point (Besl and McKay 1992): each point is paired with the node next to it, then
all are fitted as known partners (alignment), until the pairs stay. It finds the minimum near its
start, so it is started from all 24 proper ways to lay the points' principal axes on the model's,
and test axes on model axes, boxes centred. Few points and nodes choose among these starts. Pairs
farther than three times the median distance have no partner and do not take part (compare the
trimmed form of Chetverikov et al. 2002). A free scale is held within a factor 1.4 of what the boxes
say, since all points shrunk onto one node would fit best of all. Starts are compared by the root
mean square distance per test size, each distance cut at a tenth of the size so that a stray point
counts once. Where several are about as good, the structure is symmetric as far as its points tell:
the smallest rotation is taken, and a note says so.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import permutations, product

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from modetune.core.measurement.alignment import Alignment, degrees_of, require_spread, umeyama
from modetune.core.modes import Floats, Integers

#: Points that decide between starts, and nodes that find them; all of them finish the fit.
SEARCHED, COARSE = 300, 4000
#: Distinct rotations that are compared on all nodes.
FINALISTS = 8
ITERATIONS = 40
#: All points pull at first; what they reach shrinks by this in each iteration.
NARROWING = 0.85
#: How far, as a factor, a fitted scale may go from the ratio of the boxes.
SCALE_RANGE = 1.4
#: Distances count up to this part of the test's size when starts are compared.
CUT = 0.1
#: Fits this near the best are equal: placement of sensors is no better known (part of the size).
EQUAL, SIMILAR = 1e-3, 1e-2
#: Rotations closer than this are the same fit.
SAME_DEGREES = 20.0


def fit_nearest(points: Floats, nodes: Floats, scale: float | None = None) -> Alignment:
    """The alignment that lays test points on a model without knowing which node each belongs to.

    points: (n_points, 3) of the test. nodes: (n_nodes, 3), points on the model. scale: model
    lengths a test length where the units tell; None fits it too. Points without partner are left
    out. Notes tell them, and other rotations that fit about as well.
    Raises ModesError for fewer than three points and points on one line.
    """
    require_spread(points, "the test's points")
    require_spread(nodes, "the model's nodes")
    search = _Search(points, nodes, KDTree(nodes), scale)
    few = _spread(points, SEARCHED)
    fits = [search.settled(start, few) for start in _promising(points, nodes, scale)]
    errors = np.array([search.error(fit, few) for fit in fits])
    order = _distinct([fits[place].rotation for place in np.argsort(errors)])
    places = np.argsort(errors)[order]
    equal = places[errors[places] <= 1.1 * errors.min() + EQUAL]
    chosen = int(min(equal, key=lambda place: fits[place].degrees))
    rivals = [
        fits[place].rotation
        for place in places
        if place != chosen and errors[place] <= 1.5 * errors[chosen] + SIMILAR
    ]
    best = search.settled(fits[chosen], points)
    distances, _ = search.next_to(best.apply(points))
    used = _partnered(distances, SIMILAR * best.scale * search.size)
    return Alignment(
        best.scale, best.rotation, best.translation, distances, used, _fit_notes(best, rivals, used)
    )


@dataclass(frozen=True, slots=True)
class _Search:
    points: Floats
    nodes: Floats
    tree: KDTree
    scale: float | None

    @property
    def size(self) -> float:
        """Diagonal of the points' box, the test's length."""
        return float(np.linalg.norm(np.ptp(self.points, axis=0)))

    def next_to(self, places: Floats) -> tuple[Floats, Integers]:
        """Distance (n,) to the next node of each place, and that node's row (n,)."""
        distances, rows = self.tree.query(places)
        return np.asarray(distances, np.float64), np.asarray(rows, np.int64)

    def settled(self, start: Alignment, points: Floats) -> Alignment:
        """Pair each point with its next node and fit, until the pairs stay."""
        fit, pairs = start, np.zeros((0, 2), np.int64)
        for iteration in range(ITERATIONS):
            reach = max(SIMILAR, CUT * NARROWING**iteration) * fit.scale * self.size
            distances, partners = self.next_to(fit.apply(points))
            kept = np.flatnonzero(_partnered(distances, reach))
            present = np.column_stack([kept, partners[kept]])
            if np.array_equal(present, pairs) and reach <= SIMILAR * fit.scale * self.size:
                break
            pairs, where, targets = present, points[kept], self.nodes[partners[kept]]
            if self.scale is not None:
                fit = umeyama(where, targets, self.scale)
                continue
            fit = umeyama(where, targets, None)
            low, high = _box_ratio(points, self.nodes, fit.rotation) * np.array(
                [1.0 / SCALE_RANGE, SCALE_RANGE]
            )
            if not low <= fit.scale <= high:
                fit = umeyama(where, targets, float(np.clip(fit.scale, low, high)))
        return fit

    def error(self, fit: Alignment, points: Floats) -> float:
        """Root mean square distance as a part of the test's size, each cut at CUT."""
        distances, _ = self.next_to(fit.apply(points))
        return float(np.sqrt(np.mean(np.minimum(distances / (fit.scale * self.size), CUT) ** 2)))


def _starts(points: Floats, nodes: Floats, scale: float | None) -> list[Alignment]:
    """Principal axes on principal axes and axes on axes, boxes centred; and the test as it is."""
    of_points, of_nodes = (
        np.linalg.svd(x - x.mean(axis=0), full_matrices=False)[2].T for x in (points, nodes)
    )
    of_points, of_nodes = (axes * np.sign(np.linalg.det(axes)) for axes in (of_points, of_nodes))
    found = []
    for turn in _quarter_turns():
        for rotation in (turn, of_nodes @ turn @ of_points.T):
            ratio = scale if scale is not None else _box_ratio(points, nodes, rotation)
            translation = _centre(nodes) - ratio * _centre(points @ rotation.T)
            found.append(Alignment(ratio, rotation, translation))
    ratio = scale if scale is not None else _box_ratio(points, nodes, np.eye(3))
    return [Alignment(ratio, np.eye(3), np.zeros(3)), *found]


def _promising(points: Floats, nodes: Floats, scale: float | None) -> list[Alignment]:
    """The best distinct fits of few points to few nodes, from all starts."""
    few, coarse = _spread(points, SEARCHED // 2), _spread(nodes, COARSE)
    search = _Search(points, coarse, KDTree(coarse), scale)
    fits = [search.settled(start, few) for start in _starts(few, coarse, scale)]
    order = np.argsort([search.error(fit, few) for fit in fits])
    distinct = _distinct([fits[place].rotation for place in order])[:FINALISTS]
    return [fits[order[place]] for place in distinct]


def _spread(points: Floats, at_most: int) -> Floats:
    """So many of the points, all over them: multiples of the golden ratio miss no row of a grid."""
    if len(points) <= at_most:
        return points
    rows = (np.arange(at_most) * (np.sqrt(5.0) - 1.0) / 2.0 % 1.0 * len(points)).astype(np.int64)
    return np.asarray(points[np.unique(rows)])


def _quarter_turns() -> list[Floats]:
    """The 24 proper rotations that take axes to axes."""
    turns = [
        np.eye(3)[list(order)] * np.array(signs)
        for order in permutations(range(3))
        for signs in product((1.0, -1.0), repeat=3)
    ]
    return [turn for turn in turns if np.linalg.det(turn) > 0.0]


def _partnered(distances: Floats, reach: float) -> NDArray[np.bool_]:
    # Where nearly all points lie on nodes the median is rounding; the reach keeps the rest in.
    return np.asarray(distances <= max(3.0 * float(np.median(distances)), reach))


def _distinct(rotations: list[Floats]) -> list[int]:
    """Places of rotations that none before them is the same as."""
    found: list[int] = []
    for place, rotation in enumerate(rotations):
        if all(degrees_of(rotation @ rotations[other].T) > SAME_DEGREES for other in found):
            found.append(place)
    return found


def _fit_notes(best: Alignment, rivals: list[Floats], used: NDArray[np.bool_]) -> tuple[str, ...]:
    notes = []
    if rivals:
        many = f"{len(rivals)} other rotations fit" if len(rivals) > 1 else "another rotation fits"
        turns = ", ".join(f"{degrees_of(rotation):.0f}" for rotation in rivals[:4])
        notes.append(
            f"{many} about as well as that of {best.degrees:.0f} degrees which was taken, the "
            f"smallest ({turns} degrees): the points are symmetric; give partners or a rotation "
            "if the picture shows the test turned over"
        )
    if not used.all():
        notes.append(
            f"{int((~used).sum())} of {used.size} test points lie far from the model and took no "
            "part in the fit"
        )
    return tuple(notes)


def _centre(points: Floats) -> Floats:
    return np.asarray((points.min(axis=0) + points.max(axis=0)) / 2.0)


def _box_ratio(points: Floats, nodes: Floats, rotation: Floats) -> float:
    sizes = [np.linalg.norm(np.ptp(x, axis=0)) for x in (nodes, points @ rotation.T)]
    return float(sizes[0] / sizes[1])
