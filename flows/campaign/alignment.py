"""Alignment of a test's points with the model's axes and length, and doubts about it.

The search for a pose takes seconds, so the campaign's store keeps its result: the same points on
the same surface give the same poses.
"""

from __future__ import annotations

import hashlib
import logging
import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cache, partial
from math import isnan

import numpy as np

from modetune.core.errors import CampaignError, ModesError, StorageUnavailable
from modetune.core.measurement.closest_points import SurfacePoints
from modetune.core.measurement.measurement import TestGeometry
from modetune.core.measurement.registration import Alignment, Registration, fit_similarity
from modetune.core.mesh import Mesh
from modetune.core.modes import Floats
from modetune.core.storage.keys import Json, canonical_json, content_key
from modetune.core.storage.store import Entry, Store
from modetune.core.surface import facets
from modetune.flows.campaign.schema import SensorSection
from modetune.flows.campaign.units import LENGTH_METRES

logger = logging.getLogger(__name__)

#: Increase this number whenever the search may give another result.
SEARCH = 2
#: If boxes of test and model differ by more than this factor, the structures probably differ.
SIZES = 3.0
#: A unit is tried if the test in that unit spans at least this part of the model.
LEAST_PART = 0.3
#: Parts of the size: the residual of a fit in the right unit; the least difference between the
#: distances from landmarks of two poses.
GOOD_FIT, DISTINCT = 0.02, 0.02


def unit_name(metres: float) -> str:
    """Return the name of a unit of length; "" where it has none."""
    return next(
        (name for name, size in LENGTH_METRES.items() if np.isclose(size, metres, 1e-6)), ""
    )


def diagonal(coordinates: Floats) -> float:
    """Return the diagonal of the box around points (n, 3)."""
    return float(np.linalg.norm(np.ptp(coordinates, axis=0))) if coordinates.size else 0.0


@dataclass(frozen=True, slots=True)
class Laid:
    """The pose of a test on a model.

    poses: poses that fit equally well, the chosen one first. misfits: (n_points,), distances of the
    test's points from the surface in the model's length; empty where nothing was fitted to it.
    notes: remarks for the user; doubts: why the alignment is uncertain.
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
    """Return the pose of the test's points on the model, with notes and doubts.

    metres: of the model's unit of length. tolerance: in the model's length, within which a sensor
    finds its node. store: keeps the result of a search. All points of the geometry take part in a
    fit. Raises CampaignError where landmarks are missing or the points allow no fit.
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
            f"the test has no unit of length; assumed that of the model{_in(unit_name(metres))} "
            "(`test.length` sets another)"
        )
    if settings.scale is not None and known:
        from_units = geometry.metres / metres
        if abs(settings.scale / from_units - 1.0) > 0.01:
            notes.append(
                f"`scale` {settings.scale:.6g} is used, although the units of test and model give "
                f"{from_units:.6g}"
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
        except ModesError:  # on one line, but still able to choose among poses
            near = None
        points_of_test, nodes, corners = geometry.coordinates, mesh.coordinates, facets(mesh)
        surface = cache(lambda: SurfacePoints.of(corners))

        def search(scale: float | None, near: Alignment | None) -> Registration:
            from modetune.core.measurement.registration import register  # not for stored results

            logger.info("laying %d test points over the model", len(points_of_test))
            return register(points_of_test, surface(), nodes, scale, near)

        arrays = {"points": points_of_test, "corners": corners, "nodes": nodes}
        asked: dict[str, Json] = {name: _digest(values) for name, values in arrays.items()}
        poses_at = partial(_kept_poses, search, asked, store, near=near)
        sizes = diagonal(points_of_test), diagonal(nodes)
        found, notes = _registered(poses_at, *sizes, scale, metres)
    except ModesError as error:
        raise CampaignError(
            f"the test cannot be aligned with the model: {error}; give `scale`, `rotation` and "
            "`translation` instead of a fit"
        ) from error
    if near is not None and found.slides > tolerance:  # landmarks are safer than the surface
        away = surface().closest(near.apply(geometry.coordinates)).distances
        found = Registration(replace(near, residuals=away, used=np.ones(away.size, bool)))
    size = diagonal(found.best.apply(geometry.coordinates))
    poses = _nearest((found.best, *found.others), points, targets, settings, size)
    best = poses[0]
    if not best.used.all():
        notes.append(
            f"{int((~best.used).sum())} of {best.used.size} test points are far from the model and "
            "were left out of the fit"
        )
    if 0.0 < found.slides <= tolerance:
        far = f"{found.slides:.3g}{_in(unit_name(metres))}"
        notes.insert(0, f"the fit leaves positions along the surface uncertain by up to {far}")
    if len(points):
        away = np.linalg.norm(best.apply(points) - targets, axis=1)
        notes.append(f"maximum distance of a landmark: {away.max():.4g}{_in(unit_name(metres))}")
    doubts = _doubts(found, best, tolerance, unit_name(metres))
    return Laid(poses, best.residuals, tuple(notes), doubts)


def _landmarks(
    geometry: TestGeometry, mesh: Mesh, settings: SensorSection
) -> tuple[Floats, Floats]:
    """Return test points (n, 3) with partners, and these partners (n, 3) in the model."""
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
    """Return the pose that is nearest to the user's data, or several where they tie."""

    def distance(pose: Alignment) -> float:
        far = float(np.sum((pose.apply(points) - targets) ** 2))
        if settings.rotation is not None:
            far += size**2 * float(np.sum((pose.rotation - settings.matrix()) ** 2))
        if settings.translation is not None:
            far += float(np.sum((pose.translation - np.array(settings.translation)) ** 2))
        return far

    far = np.sqrt([distance(pose) for pose in poses])
    # Landmarks on an axis of symmetry do not determine a rotation about it.
    alike = np.flatnonzero(far <= far.min() + DISTINCT * size)
    return tuple(poses[row] for row in alike[np.argsort(far[alike], kind="stable")])


def _registered(
    poses_at: Callable[[float | None], Registration],
    test: float,
    model: float,
    scale: float | None,
    metres: float,
) -> tuple[Registration, list[str]]:
    """Return a fit without partners and notes about its scale, that of a known unit if possible.

    test, model: diagonals. The largest unit that fits is taken: a small test fits any part of the
    model.
    """
    if scale is not None:
        return poses_at(scale), []
    text = "the test has no unit of length"
    ratio = model / max(test, 1e-300)
    units = {name: size / metres for name, size in LENGTH_METRES.items()}
    for name, of_units in sorted(units.items(), key=lambda item: -item[1]):
        if not LEAST_PART * ratio <= of_units <= ratio / LEAST_PART**0.25:
            continue
        fixed = poses_at(of_units)
        if fixed.best.rms <= GOOD_FIT * test * of_units and fixed.best.used.all():
            return fixed, [f"{text}; assumed {name}, which fits the model"]
    free = poses_at(None)
    return free, [f"{text} and no known unit fits; the fitted scale is {free.best.scale:.6g}"]


def _doubts(found: Registration, best: Alignment, tolerance: float, unit: str) -> tuple[str, ...]:
    """Return why a fitted alignment is uncertain, other poses aside."""
    texts = []
    if found.mirrored:
        texts.append(
            "the mirror image of the test's points fits far better: the test's axes are "
            "left-handed; reverse one axis in the test file"
        )
    if found.slides > tolerance:
        texts.append(
            f"the fit leaves positions along the surface uncertain by up to "
            f"{found.slides:.3g}{_in(unit)}"
        )
    if best.rms > tolerance / 2.0:
        texts.append(
            f"the rms distance of the test points from the model is {best.rms:.4g}{_in(unit)}: "
            "check the picture"
        )
    if best.used.mean() < 0.7:
        texts.append(f"only {best.used.sum()} of {best.used.size} test points are on the model")
    return tuple(texts)


def _size_doubts(
    found: Alignment, geometry: TestGeometry, mesh: Mesh, metres: float
) -> tuple[str, ...]:
    """Return a doubt where test and model differ much in size: mostly a wrong unit."""
    test, model = diagonal(found.apply(geometry.coordinates)), diagonal(mesh.coordinates)
    if _alike(test, model):
        return ()
    as_drawn = test / found.scale
    fitting = [
        name for name, size in LENGTH_METRES.items() if _alike(as_drawn * size / metres, model)
    ]
    unit = unit_name(metres)
    hint = f"; {' or '.join(fitting)} would fit" if fitting else ""
    return (
        f"the test spans {test:.4g}{_in(unit)} and the model {model:.4g}{_in(unit)} at a scale of "
        f"{found.scale:.6g}: check the test's unit of length (`test.length`){hint}",
    )


def _alike(test: float, model: float) -> bool:
    """Return whether two boxes may belong to one structure."""
    return test > 0.0 and model > 0.0 and 1.0 / SIZES <= test / model <= SIZES


def _in(unit: str) -> str:
    return f" {unit}" if unit else ""


def _kept_poses(
    search: Callable[..., Registration],
    asked: dict[str, Json],
    store: Store | None,
    scale: float | None,
    near: Alignment | None,
) -> Registration:
    """Return the result of a search for poses from the store, else search and keep it.

    asked: digests of the points and the model. Raises ModesError where they allow no fit.
    """
    if store is None:
        return search(scale, near)
    asked = {**asked, "search of poses": SEARCH, "scale": scale, "near": None}
    if near is not None:
        asked["near"] = [near.scale, near.rotation.tolist(), near.translation.tolist()]
    text = canonical_json(asked)
    key, begun = content_key(text), time.monotonic()
    entry = store.get(key)
    if entry is not None and isinstance(entry.result, Registration):
        return entry.result
    found = search(scale, near)
    try:
        store.put(Entry(key, found, "modetune", "", time.monotonic() - begun), text)
    except StorageUnavailable as error:
        logger.info("the pose of the test is not kept: %s", error)
    return found


def _digest(values: Floats) -> str:
    exact = np.ascontiguousarray(values, "<f8")
    return hashlib.sha256(repr(exact.shape).encode() + exact.tobytes()).hexdigest()
