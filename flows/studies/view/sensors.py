"""Test points over the model in space: landmarks (a point and its node), or a pose by hand."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from scipy.spatial.transform import Rotation

from modetune.adapters.yaml_file import Place
from modetune.core.errors import CampaignError
from modetune.core.measurement.closest_points import SurfacePoints
from modetune.core.measurement.measurement import TestGeometry
from modetune.core.measurement.registration import Alignment, refined
from modetune.core.mesh import Mesh
from modetune.core.modes import Floats
from modetune.core.storage.keys import Json
from modetune.core.surface import display_surface, facets
from modetune.flows.campaign.alignment import align_test
from modetune.flows.campaign.mapping import tolerance_of
from modetune.flows.campaign.solvers import bind_solver
from modetune.flows.campaign.test import read_test
from modetune.flows.campaign.units import METRES
from modetune.flows.report.scene import packed
from modetune.flows.studies.view.changes import Change, Part, part_of

#: Keys of `test.sensors` that say by other means how the test lies over the model.
OTHER_MEANS = ("rotation", "translation", "align")
#: Landmarks that fix a place; beside `align: fit` one may choose among places.
ENOUGH = 3
#: A node, or a place in the model's axes and length.
Mark = int | tuple[float, float, float]


def sensors_json(part: Part) -> dict[str, Json]:
    """Surface, test points, how they lie over the model, and the landmarks there are.

    Without a known pose they are drawn next to the model's middle, to be moved by hand.
    Raises CampaignError, ModelError.
    """
    geometry, mesh = _geometry(part), _mesh(part)
    surface = display_surface(mesh, part.file.report.nodes)
    if surface is None:
        raise CampaignError("the model has no surface to show")
    pose, said = _laid(part, geometry, mesh)
    rows = {node: row for row, node in enumerate(geometry.nodes.tolist())}
    lines = [(rows[one], rows[other]) for one, other in geometry.lines.tolist()]
    landmarks = part.file.test.sensors.match
    return {
        "nodes": surface.nodes.tolist(),
        "coordinates": packed(surface.coordinates, "<f4"),
        "triangles": packed(surface.triangles, "<u4"),
        "edges": packed(surface.edges, "<u4"),
        "points": geometry.nodes.tolist(),
        "places": packed(geometry.coordinates, "<f4"),
        "pose": _told(pose or _beside(part, geometry, mesh)),
        "lines": packed(np.array(lines, dtype=np.int64), "<u4"),
        "landmarks": {str(point): node for point, node in landmarks.items()},
        "notes": said,
    }


def fitted_pose(part: Part, rotation: Floats, translation: Floats) -> dict[str, Json]:
    """The fit to the model's surface that is nearest to a pose by hand.

    rotation: (3, 3); translation: (3,), the model's length. Raises CampaignError, ModelError.
    """
    geometry, mesh = _geometry(part), _mesh(part)
    near = Alignment(_beside(part, geometry, mesh).scale, rotation, translation)
    found = refined(geometry.coordinates, SurfacePoints.of(facets(mesh)), mesh.coordinates, near)
    return {"pose": _told(found), "notes": [_left(found, "the model's surface")]}


def pose_change(part: Part, rotation: Floats, translation: Floats) -> Change:
    """`test.sensors.rotation` and `translation` in place of what said before how the test lies.

    rotation: (3, 3); translation: (3,), the model's length. Raises CampaignError, ModelError.
    """
    angles = Rotation.from_matrix(rotation).as_euler("xyz", degrees=True)
    values: dict[Place, object] = {
        ("test", "sensors", "rotation"): [round(angle, 5) + 0.0 for angle in angles.tolist()],
        ("test", "sensors", "translation"): [float(f"{shift:.8g}") for shift in translation],
    }
    for key in ("match", "align"):
        if part.at("test", "sensors", key) is not None:
            values["test", "sensors", key] = None
    return _judged(part, part.change(values))


def landmarks_change(part: Part, landmarks: Mapping[int, Mark]) -> Change:
    """`test.sensors.match` in place of what said before how the test lies over the model; beside
    `align: fit` it chooses among fits.

    Raises CampaignError where there are too few, or where they do not fit together.
    """
    fit = part.at("test", "sensors", "align") == "fit"
    if len(landmarks) < (1 if fit else ENOUGH):
        raise CampaignError(
            f"{ENOUGH} landmarks are required, not on one line; give more, or `align: fit`, "
            "beside which one may do"
        )
    values: dict[Place, object] = {
        ("test", "sensors", key): None
        for key in OTHER_MEANS
        if not fit and part.at("test", "sensors", key) is not None
    }
    match = {
        point: list(mark) if isinstance(mark, tuple) else mark
        for point, mark in sorted(landmarks.items())
    }
    return _judged(part, part.change({("test", "sensors", "match"): match, **values}))


def _judged(part: Part, change: Change) -> Change:
    """The change with what follows from it for the alignment."""
    _, said = _laid(part_of(change.after, part.name), _geometry(part), _mesh(part))
    return change.noting(*said)


def _geometry(part: Part) -> TestGeometry:
    problems: list[str] = []
    measurement = read_test(part.source, part.file, problems)
    if measurement is None:
        raise CampaignError(problems)
    if measurement.geometry is None:
        raise CampaignError(
            "the test has no coordinates: its sensors are the model's nodes of the same number"
        )
    return measurement.geometry


def _mesh(part: Part) -> Mesh:
    model = part.file.model
    return bind_solver(model, part.source.path.parent / model.deck, ()).deck.mesh()


def _laid(part: Part, geometry: TestGeometry, mesh: Mesh) -> tuple[Alignment | None, list[str]]:
    """How the test lies over the model, or nothing; and what is to be known of it."""
    settings = part.file.test.sensors
    tolerance = tolerance_of(settings, mesh)
    try:
        laid = align_test(geometry, mesh, settings, METRES[part.file.model.units], tolerance)
    except CampaignError as error:
        return None, list(error.problems)
    found = laid.poses[0]
    said = [_left(found, "their nodes")] if found.residuals.size else []
    return found, [*said, *laid.notes, *laid.doubts]


def _left(found: Alignment, what: str) -> str:
    return (
        f"fitted to {int(found.used.sum())} points; they lie {found.rms:.4g} root mean square "
        f"and {found.largest:.4g} at most from {what}, in the model's length"
    )


def _beside(part: Part, geometry: TestGeometry, mesh: Mesh) -> Alignment:
    """The test in its own axes, its middle in the model's, in the scale that is known."""
    known = part.file.test.sensors.scale or geometry.metres / METRES[part.file.model.units]
    scale = 1.0 if np.isnan(known) else known
    to, of = (
        0.5 * (at.min(axis=0) + at.max(axis=0)) for at in (mesh.coordinates, geometry.coordinates)
    )
    return Alignment(scale, np.eye(3), to - scale * of)


def _told(pose: Alignment) -> dict[str, Json]:
    return {
        "scale": pose.scale,
        "rotation": pose.rotation.tolist(),
        "translation": pose.translation.tolist(),
    }
