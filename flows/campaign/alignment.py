"""How a test's points are brought into the model's axes and length, and what speaks against it.

The search for a pose takes seconds, so what it found is kept in the campaign's store: the same
points on the same surface give the same poses. What the store has is believed where its checksum
holds; what cannot be kept is searched again next time.
"""

from __future__ import annotations

import hashlib
import logging
import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cache
from math import isnan

import numpy as np

from modetune.core.errors import CampaignError, ModesError, StorageUnavailable
from modetune.core.measurement.alignment import Alignment, Registration, fit_similarity
from modetune.core.measurement.closest_points import SurfacePoints
from modetune.core.measurement.measurement import TestGeometry
from modetune.core.mesh import Mesh
from modetune.core.modes import Floats
from modetune.core.storage.keys import Json, canonical_json, content_key
from modetune.core.storage.store import Entry, Store
from modetune.core.surface import facets
from modetune.flows.campaign.schema import SensorSection
from modetune.flows.campaign.units import LENGTH_METRES

#: Boxes of test and model that differ by more than this factor are hardly of one structure.
SIZES = 3.0
#: A unit is tried where the test spans at least this part of the model in it.
LEAST_PART = 0.3
#: Parts of the size: what a fit in the right unit leaves; what landmarks must tell poses apart by.
GOOD_FIT, TOLD_APART = 0.02, 0.02


def unit_name(metres: float) -> str:
    """The name of a unit of length; "" for one without."""
    return next(
        (name for name, size in LENGTH_METRES.items() if np.isclose(size, metres, 1e-6)), ""
    )


def diagonal(coordinates: Floats) -> float:
    """Diagonal of the box around points (n, 3)."""
    return float(np.linalg.norm(np.ptp(coordinates, axis=0))) if coordinates.size else 0.0


@dataclass(frozen=True, slots=True)
class Laid:
    """How a test is laid over a model.

    poses: ways that cannot be told apart, the one that is taken first. misfits: (n_points,), how
    far each point of the test is from the surface, the model's length; empty where nothing was
    fitted to it. notes: what is to be known; doubts: why the alignment is not certain.
    """

    poses: tuple[Alignment, ...]
    misfits: Floats = field(default_factory=lambda: np.zeros(0))
    notes: tuple[str, ...] = ()
    doubts: tuple[str, ...] = ()


def align_test(
    geometry: TestGeometry,
    mesh: Mesh,
    settings: SensorSection,
    metres: float,
    tolerance: float,
    store: Store | None = None,
) -> Laid:
    """Where the test's points lie in the model, and what is to be known of it.

    metres: of the model's length. tolerance: the model's length, within which places count as
    found. store: keeps what was found. All points of the geometry take part in a fit.
    Raises CampaignError where landmarks are not there or the points allow no fit.
    """
    known = not isnan(geometry.metres)
    scale = settings.scale or (geometry.metres / metres if known else None)
    if settings.fits:
        laid = _fitted(geometry, mesh, settings, scale, metres, tolerance, store)
    else:
        translation = np.array(settings.translation or (0.0, 0.0, 0.0))
        laid = Laid((Alignment(scale or 1.0, settings.matrix(), translation),))
    notes = list(laid.notes)
    if scale is None and not settings.fits:
        notes.append(
            f"the test does not tell its unit of length; taken as the model's"
            f"{_in(unit_name(metres))} (`test.length` gives another)"
        )
    if settings.scale is not None and known:
        from_units = geometry.metres / metres
        if abs(settings.scale / from_units - 1.0) > 0.01:
            notes.append(
                f"`scale` is {settings.scale:.6g}, the units of test and model give "
                f"{from_units:.6g}; `scale` is taken"
            )
    notes += _size_doubts(laid.poses[0], geometry, mesh, metres)
    return replace(laid, notes=tuple(notes))


def _fitted(
    geometry: TestGeometry,
    mesh: Mesh,
    settings: SensorSection,
    scale: float | None,
    metres: float,
    tolerance: float,
    store: Store | None,
) -> Laid:
    try:
        points, targets = _landmarks(geometry, mesh, settings)
        if settings.align != "fit":
            by_hand = fit_similarity(points, targets, scale)
            return Laid((by_hand,), notes=by_hand.notes)
        try:
            near = fit_similarity(points, targets, scale) if len(points) > 2 else None
        except ModesError:  # on one line: they choose among poses all the same
            near = None
        corners = facets(mesh)
        surface = cache(lambda: SurfacePoints.of(corners))
        search = PoseSearch(corners, mesh.coordinates, surface, store)
        found, notes = _registered(geometry.coordinates, search, scale, metres, near)
    except ModesError as error:
        raise CampaignError(
            f"the test cannot be laid over the model: {error}; give `scale`, `rotation` and "
            "`translation` instead of a fit"
        ) from error
    if near is not None and found.slides > tolerance:  # the surface says less than landmarks do
        away = surface().closest(near.apply(geometry.coordinates)).distances
        found = Registration(replace(near, residuals=away, used=np.ones(away.size, bool)))
    size = diagonal(found.best.apply(geometry.coordinates))
    poses = _nearest((found.best, *found.others), points, targets, settings, size)
    best = poses[0]
    if not best.used.all():
        notes.append(
            f"{int((~best.used).sum())} of {best.used.size} test points lie far from the model and "
            "took no part in the fit"
        )
    if 0.0 < found.slides <= tolerance:
        far = f"{found.slides:.3g}{_in(unit_name(metres))}"
        notes.insert(
            0, f"points may slide by up to {far} along the model's surface with as good a fit"
        )
    if len(points):
        away = np.linalg.norm(best.apply(points) - targets, axis=1)
        notes.append(f"landmarks are left {away.max():.4g}{_in(unit_name(metres))} away at most")
    doubts = _doubts(found, best, tolerance, unit_name(metres))
    return Laid(poses, best.residuals, tuple(notes), doubts)


def _landmarks(
    geometry: TestGeometry, mesh: Mesh, settings: SensorSection
) -> tuple[Floats, Floats]:
    """Test points (n, 3) with partners, and these partners (n, 3) in the model."""
    at = {node: row for row, node in enumerate(geometry.nodes.tolist())}
    lost = [str(node) for node in settings.match if node not in at]
    if lost:
        raise CampaignError(f"`match` names test point {', '.join(lost)}, which has no coordinates")
    targets = [
        mesh.coordinates[mesh.rows(np.array([to]))[0]] if isinstance(to, int) else to
        for to in settings.match.values()
    ]
    rows = [at[node] for node in settings.match]
    return geometry.coordinates[rows], np.array(targets, dtype=np.float64).reshape(-1, 3)


def _nearest(
    poses: tuple[Alignment, ...],
    points: Floats,
    targets: Floats,
    settings: SensorSection,
    size: float,
) -> tuple[Alignment, ...]:
    """Of several poses those that what the user gave is nearest to: one, but for ties."""

    def distance(pose: Alignment) -> float:
        far = float(np.sum((pose.apply(points) - targets) ** 2))
        if settings.rotation is not None:
            far += size**2 * float(np.sum((pose.rotation - settings.matrix()) ** 2))
        if settings.translation is not None:
            far += float(np.sum((pose.translation - np.array(settings.translation)) ** 2))
        return far

    far = np.sqrt([distance(pose) for pose in poses])
    # Landmarks on an axis of symmetry do not tell what turns about it.
    alike = np.flatnonzero(far <= far.min() + TOLD_APART * size)
    return tuple(poses[row] for row in alike[np.argsort(far[alike], kind="stable")])


def _registered(
    points: Floats, search: PoseSearch, scale: float | None, metres: float, near: Alignment | None
) -> tuple[Registration, list[str]]:
    """A fit without partners, of a scale that is one of units where one will do.

    Of units in which the test fits the largest is taken: a part of the model fits anything small.
    """
    if scale is not None:
        return search.register(points, scale, near), []
    told = "the test does not tell its unit of length"
    ratio = diagonal(search.nodes) / max(diagonal(points), 1e-300)
    units = {name: size / metres for name, size in LENGTH_METRES.items()}
    for name, of_units in sorted(units.items(), key=lambda item: -item[1]):
        if not LEAST_PART * ratio <= of_units <= ratio / LEAST_PART**0.25:
            continue
        fixed = search.register(points, of_units, near)
        if fixed.best.rms <= GOOD_FIT * diagonal(points) * of_units and fixed.best.used.all():
            return fixed, [f"{told}; taken as {name}, which fits the model"]
    free = search.register(points, None, near)
    return free, [f"{told} and fits in none; the scale {free.best.scale:.6g} was fitted"]


def _doubts(found: Registration, best: Alignment, tolerance: float, unit: str) -> tuple[str, ...]:
    """Why an alignment that was fitted is not certain, without what other poses there are."""
    said = []
    if found.mirrored:
        said.append(
            "the test's points fit far better as their own mirror image: its axes are left-handed "
            "(one axis looks the other way), which no rotation mends"
        )
    if found.slides > tolerance:
        said.append(
            f"points may slide by up to {found.slides:.3g}{_in(unit)} along the model's surface "
            "with as good a fit: they do not say where along it they are"
        )
    if best.rms > tolerance / 2.0:
        said.append(
            f"the fit leaves its points {best.rms:.4g}{_in(unit)} (root mean square) from the "
            "model, which is much: look at the picture"
        )
    if best.used.mean() < 0.7:
        said.append(f"only {best.used.sum()} of {best.used.size} test points lie on the model")
    return tuple(said)


def _size_doubts(
    found: Alignment, geometry: TestGeometry, mesh: Mesh, metres: float
) -> tuple[str, ...]:
    """Test and model of very different size: mostly a unit taken for another."""
    test, model = diagonal(found.apply(geometry.coordinates)), diagonal(mesh.coordinates)
    if _alike(test, model):
        return ()
    as_drawn = test / found.scale
    fitting = [
        name for name, size in LENGTH_METRES.items() if _alike(as_drawn * size / metres, model)
    ]
    unit = unit_name(metres)
    hint = f"; in {' or '.join(fitting)} its size would be right" if fitting else ""
    return (
        f"the test's points span {test:.4g}{_in(unit)}, the model {model:.4g}{_in(unit)}: "
        f"is its unit of length right (`test.length`)? The scale is {found.scale:.6g}{hint}",
    )


def _alike(test: float, model: float) -> bool:
    """Whether two boxes may be of one structure."""
    return test > 0.0 and model > 0.0 and 1.0 / SIZES <= test / model <= SIZES


def _in(unit: str) -> str:
    return f" {unit}" if unit else ""


logger = logging.getLogger(__name__)

#: Grows whenever the search may answer otherwise.
SEARCH = 2


@dataclass(frozen=True, slots=True)
class PoseSearch:
    """Searches a model's surface, triangles (n, 3, 3), and nodes (n, 3) for a test.

    surface: the triangles, once they are asked for distances. store: None keeps nothing.
    """

    corners: Floats
    nodes: Floats
    surface: Callable[[], SurfacePoints]
    store: Store | None = None

    def register(
        self, points: Floats, scale: float | None, near: Alignment | None = None
    ) -> Registration:
        """All poses of points (n, 3) that cannot be told apart (`registration.register`).

        Raises ModesError where points or nodes allow no fit.
        """
        if self.store is None:
            return self._search(points, scale, near)
        asked = canonical_json(self._asked(points, scale, near))
        key, begun = content_key(asked), time.monotonic()
        entry = self.store.get(key)
        if entry is not None and isinstance(entry.result, Registration):
            return entry.result
        found = self._search(points, scale, near)
        try:
            self.store.put(Entry(key, found, "modetune", "", time.monotonic() - begun), asked)
        except StorageUnavailable as error:
            logger.info("the pose of the test is not kept: %s", error)
        return found

    def _search(self, points: Floats, scale: float | None, near: Alignment | None) -> Registration:
        from modetune.core.measurement.registration import register  # what is kept needs no search

        logger.info("laying %d test points over the model", len(points))
        return register(points, self.surface(), self.nodes, scale, near)

    def _asked(self, points: Floats, scale: float | None, near: Alignment | None) -> Json:
        return {
            "search of poses": SEARCH,
            "points": _digest(points),
            "corners": _digest(self.corners),
            "nodes": _digest(self.nodes),
            "scale": scale,
            "near": None
            if near is None
            else [near.scale, near.rotation.tolist(), near.translation.tolist()],
        }


def _digest(values: Floats) -> str:
    exact = np.ascontiguousarray(values, "<f8")
    return hashlib.sha256(repr(exact.shape).encode() + exact.tobytes()).hexdigest()
