"""Sensors page: the test points on the model, and landmarks (a test point and its node)."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from modetune.adapters.yaml_file import Place
from modetune.core.errors import CampaignError
from modetune.core.measurement.measurement import TestGeometry
from modetune.core.measurement.registration import Alignment
from modetune.core.mesh import Mesh
from modetune.core.storage.keys import Json
from modetune.core.surface import display_surface
from modetune.flows.campaign.alignment import align_test
from modetune.flows.campaign.mapping import tolerance_of
from modetune.flows.campaign.solvers import bind_solver
from modetune.flows.campaign.test import read_test
from modetune.flows.campaign.units import METRES
from modetune.flows.report.scene import packed
from modetune.flows.studies.view.campaign_changes import Change, Mark, Part, part_of

#: Other keys of `test.sensors` that set the pose of the test.
OTHER_MEANS = ("rotation", "translation", "align")
#: Landmarks that determine a pose; with `align: fit` one can be enough, to choose among poses.
ENOUGH = 3


def sensors_json(part: Part) -> dict[str, Json]:
    """Return the surface, the test points, their pose on the model, and the landmarks.

    Without a known pose the test is centred on the model. Raises CampaignError, ModelError.
    """
    geometry, mesh = _geometry(part), _mesh(part)
    surface = display_surface(mesh, part.file.report.nodes)
    if surface is None:
        raise CampaignError("the model has no surface to show")
    pose, text = _laid(part, geometry, mesh)
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
        "pose": _pose_json(pose or _centred(part, geometry, mesh)),
        "lines": packed(np.array(lines, dtype=np.int64), "<u4"),
        "landmarks": {str(point): node for point, node in landmarks.items()},
        "notes": text,
    }


def landmarks_change(part: Part, landmarks: Mapping[int, Mark]) -> Change:
    """Set `test.sensors.match` and remove the other keys of the pose.

    `align: fit` stays: the landmarks then choose among its poses. Raises CampaignError for too few
    landmarks, or for landmarks that do not fit together.
    """
    fit = part.at("test", "sensors", "align") == "fit"
    if len(landmarks) < (1 if fit else ENOUGH):
        raise CampaignError(
            f"{ENOUGH} landmarks that are not on one line are required; add some, or use "
            "`align: fit`, for which one can be enough"
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
    """Return the change with notes on the new alignment."""
    _, texts = _laid(part_of(change.after, part.name), _geometry(part), _mesh(part))
    return change.noting(*texts)


def _geometry(part: Part) -> TestGeometry:
    problems: list[str] = []
    measurement = read_test(part.source, part.file, problems)
    if measurement is None:
        raise CampaignError(problems)
    if measurement.geometry is None:
        raise CampaignError(
            "the test has no coordinates: each sensor is the node with the same number"
        )
    return measurement.geometry


def _mesh(part: Part) -> Mesh:
    model = part.file.model
    return bind_solver(model, part.source.path.parent / model.deck, ()).deck.mesh()


def _laid(part: Part, geometry: TestGeometry, mesh: Mesh) -> tuple[Alignment | None, list[str]]:
    """Return the pose of the test, None if unknown, and remarks about it."""
    settings = part.file.test.sensors
    tolerance = tolerance_of(settings, mesh)
    try:
        laid = align_test(geometry, mesh, settings, METRES[part.file.model.units], tolerance)
    except CampaignError as error:
        return None, list(error.problems)
    found = laid.poses[0]
    remarks = [_fit_remark(found)] if found.residuals.size else []
    return found, [*remarks, *laid.notes, *laid.doubts]


def _fit_remark(found: Alignment) -> str:
    return (
        f"fitted to {int(found.used.sum())} points; distance to their nodes: {found.rms:.4g} RMS, "
        f"{found.largest:.4g} maximum, in the model's unit of length"
    )


def _centred(part: Part, geometry: TestGeometry, mesh: Mesh) -> Alignment:
    """Return the test in its own axes, centred on the model, at the known scale (else 1)."""
    known = part.file.test.sensors.scale or geometry.metres / METRES[part.file.model.units]
    scale = 1.0 if np.isnan(known) else known
    to, of = (
        0.5 * (at.min(axis=0) + at.max(axis=0)) for at in (mesh.coordinates, geometry.coordinates)
    )
    return Alignment(scale, np.eye(3), to - scale * of)


def _pose_json(pose: Alignment) -> dict[str, Json]:
    return {
        "scale": pose.scale,
        "rotation": pose.rotation.tolist(),
        "translation": pose.translation.tolist(),
    }
