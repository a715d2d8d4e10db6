"""Figures of where a model is wrong: groups and parameters ranked, and the error on its surface."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import colormaps
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from mpl_toolkits.mplot3d.art3d import (  # type: ignore[import-untyped]  # has no stubs
    Line3DCollection,
    Poly3DCollection,
)
from scipy.spatial import KDTree

from modetune.core.localisation import Removal
from modetune.core.mesh import Mesh
from modetune.core.modes import Floats
from modetune.core.surface import Surface
from modetune.flows.localisation.error_maps import ErrorMaps
from modetune.flows.localisation.localise import Localisation
from modetune.flows.report.figures import STYLES, _figure, plain, save

#: Bars that can be told apart on a page.
BARS = 30
COLOURS = "YlOrRd"


def write_figures(
    title: str, found: Localisation, mesh: Mesh, surface: Surface, folder: Path
) -> list[Path]:
    """Write all figures that were found out, as PNG. Raises StorageUnavailable."""
    paths = [save(removal_figure(title, found.parameters, found.singles), folder / "removals.png")]
    if found.maps is not None:
        paths.append(save(group_figure(title, found.maps), folder / "groups.png"))
        if mesh.nodes.size:
            strains = on_surface(found.maps.strains, mesh, surface)
            paths.append(save(surface_figure(title, surface, strains), folder / "map.png"))
    return paths


def group_figure(title: str, maps: ErrorMaps) -> Figure:
    """Of each group its share of the force residual and of the error's energy, worst on top."""
    order = maps.errors.ranking[:BARS][::-1]
    figure = _figure(6.4, 1.4 + 0.36 * order.size)
    axes = figure.add_subplot()
    places = np.arange(order.size)
    axes.barh(places + 0.2, 100.0 * maps.errors.force_shares[order], 0.4,
              color=STYLES["before"][0], label="explains of the force residual")  # fmt: skip
    axes.barh(places - 0.2, 100.0 * maps.errors.error_shares[order], 0.4,
              color=STYLES["after"][0], label="holds of the error's energy")  # fmt: skip
    _name_bars(axes, [maps.groups[place] for place in order.tolist()], title)
    axes.legend(loc="lower right", fontsize=8)
    return figure


def removal_figure(title: str, names: Sequence[str], singles: Sequence[Removal]) -> Figure:
    """What each parameter alone can remove of the weighted residual, the best on top."""
    shown = list(singles)[:BARS][::-1]
    figure = _figure(6.4, 1.4 + 0.3 * len(shown))
    axes = figure.add_subplot()
    axes.barh(range(len(shown)), [100.0 * item.removed for item in shown], 0.6,
              color=STYLES["before"][0], label="removes of the weighted residual")  # fmt: skip
    _name_bars(axes, [names[item.members[0]] for item in shown], title)
    axes.legend(loc="lower right", fontsize=8)
    return figure


def _name_bars(axes: Any, names: Sequence[str], title: str) -> None:
    axes.set_yticks(range(len(names)), [plain(name) for name in names], fontsize=8)
    axes.set_xlim(0.0, 100.0)
    axes.set_xlabel("%")
    axes.set_title(plain(title), fontsize=10)
    axes.grid(alpha=0.3, axis="x")


def on_surface(strains: Floats, mesh: Mesh, surface: Surface) -> Floats:
    """Strain of the error at the nodes of the surface, (n,): of the mesh's nodes next to each.

    strains: (n_mesh_nodes,). Root mean squares, so that thinning smooths and loses nothing.
    """
    _, owner = KDTree(surface.coordinates).query(mesh.coordinates)
    count = np.bincount(owner, minlength=surface.nodes.size)
    squares = np.bincount(owner, strains**2, surface.nodes.size)
    return np.asarray(np.sqrt(squares / np.maximum(count, 1)))


def surface_figure(title: str, surface: Surface, strains: Floats) -> Figure:
    """The model with colours for the strain of the error at its nodes, (n,)."""
    figure = _figure(7.2, 5.6)
    axes: Any = figure.add_subplot(projection="3d")
    shades = strains / (float(strains.max(initial=0.0)) or 1.0)
    paint = ScalarMappable(Normalize(0.0, 1.0), colormaps[COLOURS])
    if surface.triangles.size:
        colours = paint.to_rgba(shades[surface.triangles].mean(axis=1))
        axes.add_collection3d(Poly3DCollection(
            surface.coordinates[surface.triangles], facecolors=colours, edgecolors="none",
        ))  # fmt: skip
    elif surface.edges.size:
        ends = shades[surface.edges].mean(axis=1)
        axes.add_collection3d(Line3DCollection(
            surface.coordinates[surface.edges], colors=paint.to_rgba(ends), linewidths=4.0,
        ))  # fmt: skip
    else:
        axes.scatter(*surface.coordinates.T, c=paint.to_rgba(shades))
    low, high = surface.coordinates.min(axis=0), surface.coordinates.max(axis=0)
    # A flat or straight model gets some room, or its axes would have no scale.
    room = np.maximum(high - low, 0.05 * (float((high - low).max()) or 1.0))
    for name, centre, width in zip("xyz", (low + high) / 2.0, room / 2.0, strict=True):
        axes.set(**{f"{name}lim": (centre - width, centre + width)})
    axes.set_box_aspect(room, zoom=1.3)
    axes.set_axis_off()
    axes.set_title(plain(title), fontsize=10)
    figure.colorbar(paint, ax=axes, shrink=0.6, label="strain of the error, of the largest")
    return figure
