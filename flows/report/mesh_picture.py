"""Pictures of the model's mesh, without a screen: with a test's sensors, or with anything else."""

from __future__ import annotations

import ctypes
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pyvista as pv
from matplotlib.image import imsave
from vtkmodules.vtkCommonCore import vtkLogger

from modetune.core.errors import CampaignError
from modetune.core.mesh import Mesh
from modetune.core.modes import Floats
from modetune.core.storage.files import writing
from modetune.core.surface import display_surface
from modetune.flows.campaign.mapping import Mapping, Verdict

#: Nodes of the model's surface that are drawn at most.
DRAWN_NODES = 20_000
PIXELS = (1600, 1100)
#: What VTK draws with where there is no display; without any of them it ends the process.
LIBRARIES = ("libEGL.so.1", "libOSMesa.so.8", "libOSMesa.so.6")


def check_picture(path: Path, mesh: Mesh) -> None:
    """Raise CampaignError where a picture cannot be: its name, the model, or this machine."""
    if path.suffix.lower() != ".png":
        raise CampaignError(f"{path}: the picture is a PNG; give a name that ends with .png")
    if mesh.nodes.size == 0:
        raise CampaignError(f"{path}: the model has no places to draw: it is matrices alone")
    if not can_draw():
        raise CampaignError(
            f"{path}: a picture of a mesh needs OpenGL, and there is neither a display nor a "
            "library for drawing without one; on Debian: apt-get install libosmesa6"
        )


@contextmanager
def mesh_picture(path: Path, mesh: Mesh) -> Iterator[Any]:
    """The PyVista plotter that draws the mesh, pale; what was drawn on it is written at the end.

    Raises CampaignError, StorageUnavailable.
    """
    check_picture(path, mesh)
    # VTK warns on standard error that there is no display before it draws without one.
    vtkLogger.SetStderrVerbosity(vtkLogger.VERBOSITY_OFF)
    plotter: Any = pv.Plotter(off_screen=True, window_size=list(PIXELS))
    try:
        plotter.set_background("white")
        _draw_model(plotter, mesh)
        yield plotter
        plotter.add_axes()
        plotter.view_isometric()
        plotter.camera.zoom(1.4)  # the isometric view leaves a wide margin
        with writing(path) as aside:
            imsave(aside, plotter.screenshot(return_img=True), format="png")
    finally:
        plotter.close()


def can_draw() -> bool:
    """Whether VTK finds a display or a library that does without."""
    return bool(os.environ.get("DISPLAY")) or any(map(_loads, LIBRARIES))


def _loads(library: str) -> bool:
    try:
        ctypes.CDLL(library)
    except OSError:
        return False
    return True


def _draw_model(plotter: Any, mesh: Mesh) -> None:
    """The mesh's surface, pale, beneath what is drawn on it."""
    skin = display_surface(mesh, DRAWN_NODES)
    if skin.triangles.size:
        poly_data: Any = pv.PolyData  # its types know no int64
        faces = poly_data.from_regular_faces(skin.coordinates, skin.triangles)
        plotter.add_mesh(faces, color="#e4e4e4", opacity=0.6)
    if skin.edges.size:
        edges = np.insert(skin.edges, 0, 2, axis=1).ravel()
        lines = pv.PolyData(skin.coordinates, lines=edges)
        plotter.add_mesh(lines, color="#a0a0a0", line_width=1)
    if not skin.triangles.size and not skin.edges.size:
        plotter.add_mesh(pv.PolyData(mesh.coordinates), color="#808080", point_size=6)


#: Colours of Okabe and Ito (2008), as in the other figures.
COLOURS: dict[Verdict, str] = {"good": "#0072B2", "doubtful": "#E69F00", "left out": "#D55E00"}
#: Length of an arrow, of the model's box diagonal.
ARROW = 0.05
#: Test points with their numbers; more numbers would hide the model.
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
