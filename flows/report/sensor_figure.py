"""A picture of a test's sensors on the model: whether they sit where they should."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from modetune.core.mesh import Mesh
from modetune.core.modes import Floats
from modetune.flows.campaign.mapping import Mapping, Verdict
from modetune.flows.report.mesh_picture import PIXELS, mesh_picture

#: Colours of Okabe and Ito (2008), as in the other figures.
COLOURS: dict[Verdict, str] = {"good": "#0072B2", "doubtful": "#E69F00", "left out": "#D55E00"}
#: Length of an arrow, of the model's box diagonal.
ARROW = 0.05
#: Test points whose numbers are written beside them; more would hide the model.
LABELS = 150


def save_sensor_picture(path: Path, mapping: Mapping, mesh: Mesh) -> None:
    """Write a PNG of the mesh with an arrow a sensor, coloured by what is thought of it.

    A line joins each test point to its node. Raises CampaignError for another kind of file and
    a model without places; StorageUnavailable.
    """
    with mesh_picture(path, mesh) as plotter:
        _draw_sensors(plotter, mapping, mesh)


def _draw_sensors(plotter: Any, mapping: Mapping, mesh: Mesh) -> None:
    known = np.isfinite(mapping.places).all(axis=1)
    length = ARROW * max(float(np.linalg.norm(np.ptp(mesh.coordinates, axis=0))), 1e-30)
    shown = 0
    for verdict, colour in COLOURS.items():
        rows = [
            row for row, item in enumerate(mapping.table) if item.verdict == verdict and known[row]
        ]
        if not rows:
            continue
        directions = np.array([mapping.table[row].direction for row in rows])
        plotter.add_arrows(
            mapping.places[rows], directions, mag=length, color=colour, lighting=False
        )
        shown += 1
        height = PIXELS[1] - 50 * shown
        plotter.add_text(
            f"{verdict}: {len(rows)}", position=(20, height), color=colour, font_size=16
        )
    joins = _joins(mapping, mesh)
    if joins.size:
        plotter.add_lines(joins, color="#D55E00", width=3)
    _label(plotter, mapping, known)


def _joins(mapping: Mapping, mesh: Mesh) -> Floats:
    """Ends (2 n, 3) of the lines from test points to their nodes, where these are apart."""
    sensors, ends = mapping.sensors, []
    nodes = mesh.coordinates[mesh.rows(sensors.model_nodes)]
    for place, node in zip(mapping.places[mapping.rows], nodes, strict=True):
        if np.linalg.norm(place - node) > 1e-6 * mapping.tolerance:
            ends += [place, node]
    return np.array(ends).reshape(-1, 3)


def _label(plotter: Any, mapping: Mapping, known: np.ndarray[Any, np.dtype[np.bool_]]) -> None:
    names = {item.test_node: row for row, item in enumerate(mapping.table) if known[row]}
    if 0 < len(names) <= LABELS:
        plotter.add_point_labels(
            mapping.places[list(names.values())],
            [str(name) for name in names],
            font_size=16,
            show_points=False,
            shape=None,
            text_color="black",
            always_visible=True,
        )
