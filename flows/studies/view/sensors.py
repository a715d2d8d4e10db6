"""Test points and the model's surface in space, and landmarks: pairs of a point and a node."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from modetune.adapters.yaml_file import Place, YamlFile
from modetune.core.errors import CampaignError
from modetune.core.measurement.measurement import TestGeometry
from modetune.core.mesh import Mesh
from modetune.core.storage.keys import Json
from modetune.core.surface import display_surface
from modetune.flows.campaign.alignment import align_test
from modetune.flows.campaign.campaign import campaign_form
from modetune.flows.campaign.mapping import tolerance_of
from modetune.flows.campaign.measured import read_test
from modetune.flows.campaign.schema import CampaignFile
from modetune.flows.campaign.solvers import bind_solver
from modetune.flows.campaign.units import METRES
from modetune.flows.report.scene import packed
from modetune.flows.studies.view.changes import Change, change_of

#: Keys of `test.sensors` that say by other means how the test lies over the model.
OTHER_MEANS = ("rotation", "translation", "align")
#: Landmarks that fix a place; beside `align: fit` one may choose among places.
ENOUGH = 3
#: A node, or a place in the model's axes and length.
Mark = int | tuple[float, float, float]


def told_sensors(source: YamlFile) -> dict[str, Json]:
    """Surface, test points on their own and laid over the model, and the landmarks there are.

    Raises CampaignError, ModelError.
    """
    file = campaign_form(source)
    geometry, mesh = _geometry(source, file), _mesh(source, file)
    surface = display_surface(mesh, file.report.nodes)
    if surface is None:
        raise CampaignError("the model has no surface to show")
    laid, said = _laid(file, geometry, mesh)
    rows = {node: row for row, node in enumerate(geometry.nodes.tolist())}
    lines = [(rows[one], rows[other]) for one, other in geometry.lines.tolist()]
    return {
        "nodes": surface.nodes.tolist(),
        "coordinates": packed(surface.coordinates, "<f4"),
        "triangles": packed(surface.triangles, "<u4"),
        "edges": packed(surface.edges, "<u4"),
        "points": geometry.nodes.tolist(),
        "places": packed(geometry.coordinates, "<f4"),
        "laid": laid,
        "lines": packed(np.array(lines, dtype=np.int64), "<u4"),
        "landmarks": {str(point): node for point, node in file.test.sensors.match.items()},
        "notes": list(said),
    }


def sensors_change(source: YamlFile, landmarks: Mapping[int, Mark]) -> Change:
    """`test.sensors.match` in place of what said before how the test lies over the model; beside
    `align: fit` it chooses among fits.

    Raises CampaignError where there are too few, or where they do not fit together.
    """
    file = campaign_form(source)
    fit = file.test.sensors.align == "fit"
    if len(landmarks) < (1 if fit else ENOUGH):
        raise CampaignError(
            f"{ENOUGH} landmarks are required, not on one line; give more, or `align: fit`, "
            "beside which one may do"
        )
    place: Place = ("test", "sensors")
    given = source.at(place)
    told = given if isinstance(given, dict) and not fit else {}
    values: dict[Place, object] = {(*place, key): None for key in OTHER_MEANS if key in told}
    match = {
        point: list(mark) if isinstance(mark, tuple) else mark
        for point, mark in sorted(landmarks.items())
    }
    change = change_of(source, {(*place, "match"): match, **values})
    changed = campaign_form(change.after)
    _, said = _laid(changed, _geometry(source, file), _mesh(source, file))
    return change.noting(*said)


def _geometry(source: YamlFile, file: CampaignFile) -> TestGeometry:
    problems: list[str] = []
    measurement = read_test(source, file, problems)
    if measurement is None:
        raise CampaignError(problems)
    if measurement.geometry is None:
        raise CampaignError(
            "the test has no coordinates: its sensors are the model's nodes of the same number"
        )
    return measurement.geometry


def _mesh(source: YamlFile, file: CampaignFile) -> Mesh:
    return bind_solver(file.model, source.path.parent / file.model.deck, ()).deck.mesh()


def _laid(file: CampaignFile, geometry: TestGeometry, mesh: Mesh) -> tuple[str | None, list[str]]:
    """The test's points in the model's axes, packed, or nothing; and what is to be known of it."""
    settings = file.test.sensors
    tolerance = tolerance_of(settings, mesh)
    try:
        laid = align_test(geometry, mesh, settings, METRES[file.model.units], tolerance)
    except CampaignError as error:
        return None, list(error.problems)
    found, said = laid.poses[0], []
    if found.residuals.size:
        said.append(
            f"fitted to {int(found.used.sum())} points; they lie {found.rms:.4g} root mean square "
            f"and {found.largest:.4g} at most from their nodes, in the model's length"
        )
    return packed(found.apply(geometry.coordinates), "<f4"), [*said, *laid.notes, *laid.doubts]
