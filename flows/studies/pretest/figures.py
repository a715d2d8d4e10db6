"""A picture of where sensors, exciters and suspension of a planned test go."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pyvista as pv

from modetune.core.mesh import Mesh
from modetune.core.modes import Floats
from modetune.flows.report.mesh_picture import ARROW, LABELS, PIXELS, mesh_picture
from modetune.flows.studies.pretest.plan import Pretest

#: Colours of Okabe and Ito (2008), as in the other figures.
SENSOR, EXCITER, SUSPENSION = "#0072B2", "#D55E00", "#009E73"
#: Length of an exciter's arrow relative to a sensor's, and size of a suspension point's ball.
LONGER, BALL = 1.6, 0.25


def save_pretest_picture(path: Path, pretest: Pretest, mesh: Mesh) -> None:
    """Write a PNG of the mesh: sensors as arrows numbered in their order, exciters, suspension.

    Raises CampaignError, StorageUnavailable.
    """
    size = max(float(np.linalg.norm(np.ptp(mesh.coordinates, axis=0))), 1e-30)
    with mesh_picture(path, mesh) as plotter:
        _draw(plotter, pretest, ARROW * size)


def _draw(plotter: Any, pretest: Pretest, length: float) -> None:
    starts, ways = _arrows(pretest)
    plotter.add_arrows(starts, ways, mag=length, color=SENSOR, lighting=False)
    texts = [(f"sensors: {len(pretest.sensors)}", SENSOR)]
    if pretest.exciters:
        ends = np.array([item.place for item in pretest.exciters])
        pushes = np.array([item.direction for item in pretest.exciters])
        # An exciter's arrow ends where it pushes; a sensor's begins where it sits.
        plotter.add_arrows(
            ends - LONGER * length * pushes,
            pushes,
            mag=LONGER * length,
            color=EXCITER,
            lighting=False,
        )
        texts.append((f"exciters: {len(pretest.exciters)}", EXCITER))
    for point in pretest.suspension:
        ball = pv.Sphere(radius=BALL * length, center=point.place)
        plotter.add_mesh(ball, color=SUSPENSION, lighting=False)
    if pretest.suspension:
        texts.append((f"moves least: {len(pretest.suspension)}", SUSPENSION))
    for line, (text, colour) in enumerate(texts, start=1):
        plotter.add_text(text, position=(20, PIXELS[1] - 50 * line), color=colour, font_size=16)
    _label(plotter, pretest, length)


def _arrows(pretest: Pretest) -> tuple[Floats, Floats]:
    """Starts and directions (n, 3) of all arrows of the sensors."""
    starts = [item.place for item in pretest.sensors for _ in item.frame]
    ways = [way for item in pretest.sensors for way in item.frame]
    return np.array(starts), np.array(ways)


def _label(plotter: Any, pretest: Pretest, length: float) -> None:
    """Label the sensors, in the order of choice, at the ends of their arrows."""
    if len(pretest.sensors) > LABELS:
        return
    ends = [
        np.array(item.place) + 1.15 * length * np.array(item.frame[-1]) for item in pretest.sensors
    ]
    plotter.add_point_labels(
        np.array(ends),
        [str(number + 1) for number in range(len(ends))],
        font_size=18,
        show_points=False,
        shape=None,
        text_color="black",
        always_visible=True,
    )
