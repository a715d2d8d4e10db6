"""How a test's points are brought into the model's axes and length, and what speaks against it."""

from __future__ import annotations

from dataclasses import replace
from math import isnan

import numpy as np

from modetune.core.errors import CampaignError, ModesError
from modetune.core.measurement.alignment import Alignment, fit_similarity
from modetune.core.measurement.closest_points import fit_nearest
from modetune.core.measurement.measurement import TestGeometry
from modetune.core.mesh import Mesh
from modetune.core.modes import Floats
from modetune.flows.campaign.sensors_section import SensorSection
from modetune.flows.campaign.units import LENGTH_METRES

#: Boxes of test and model that differ by more than this factor are hardly of one structure.
SIZES = 3.0
#: A fitted scale this near to one of units may be it.
UNIT_RANGE = 0.15


def unit_name(metres: float) -> str:
    """The name of a unit of length; "" for one without."""
    return next(
        (name for name, size in LENGTH_METRES.items() if np.isclose(size, metres, 1e-6)), ""
    )


def diagonal(coordinates: Floats) -> float:
    """Diagonal of the box around points (n, 3)."""
    return float(np.linalg.norm(np.ptp(coordinates, axis=0))) if coordinates.size else 0.0


def align_test(
    geometry: TestGeometry, mesh: Mesh, settings: SensorSection, metres: float
) -> tuple[Alignment, tuple[str, ...]]:
    """Where the test's points lie in the model, and what is to be known of it.

    metres: of the model's length. All points of the geometry take part in a fit.
    Raises CampaignError where partners are not there or the points allow no fit.
    """
    known = not isnan(geometry.metres)
    scale = settings.scale or (geometry.metres / metres if known else None)
    if settings.fits:
        found = _fitted(geometry, mesh, settings, scale, metres)
    else:
        translation = np.array(settings.translation or (0.0, 0.0, 0.0))
        found = Alignment(scale or 1.0, settings.matrix(), translation)
    notes = list(found.notes)
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
    return found, (*notes, *_size_doubts(found, geometry, mesh, metres))


def _fitted(
    geometry: TestGeometry,
    mesh: Mesh,
    settings: SensorSection,
    scale: float | None,
    metres: float,
) -> Alignment:
    try:
        if not settings.match:
            return _laid(geometry.coordinates, _targets(mesh), scale, metres)
        at = {node: row for row, node in enumerate(geometry.nodes.tolist())}
        lost = [str(node) for node in settings.match if node not in at]
        if lost:
            raise CampaignError(
                f"`match` names test point {', '.join(lost)}, which has no coordinates"
            )
        rows = [at[node] for node in settings.match]
        partners = mesh.rows(np.array(list(settings.match.values()), dtype=np.int64))
        return fit_similarity(geometry.coordinates[rows], mesh.coordinates[partners], scale)
    except ModesError as error:
        raise CampaignError(
            f"the test cannot be laid over the model: {error}; give `scale`, `rotation` and "
            "`translation` instead of a fit"
        ) from error


def _laid(points: Floats, targets: Floats, scale: float | None, metres: float) -> Alignment:
    """A fit without partners, of a scale that is one of units where one will do.

    Next nodes pull points inwards: a free scale is some percent small where nodes are coarse.
    """
    found = fit_nearest(points, targets, scale)
    if scale is not None:
        return found
    near = {
        name: size / metres
        for name, size in LENGTH_METRES.items()
        if abs(size / metres / found.scale - 1.0) < UNIT_RANGE
    }
    for name, of_units in near.items():
        fixed = fit_nearest(points, targets, of_units)
        size = diagonal(points) * of_units
        if fixed.rms <= 1.5 * found.rms + 0.005 * size and fixed.used.sum() >= found.used.sum():
            told = (
                f"the test does not tell its unit of length; taken as {name}, which fits the model"
            )
            return replace(fixed, notes=(*fixed.notes, told))
    told = (
        f"the test does not tell its unit of length and fits in none; the scale {found.scale:.6g} "
        "was fitted"
    )
    return replace(found, notes=(*found.notes, told))


def _targets(mesh: Mesh) -> Floats:
    """Nodes and middles of elements: between coarse nodes a fit would catch on the nodes."""
    middles = [mesh.coordinates[mesh.rows(cells.nodes)].mean(axis=1) for cells in mesh.cells]
    return np.concatenate([mesh.coordinates, *middles])


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
