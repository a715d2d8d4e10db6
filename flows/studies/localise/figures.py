"""Figures of where a model is wrong: groups and parameters ranked, and the error on its surface."""

from __future__ import annotations

from collections.abc import Sequence
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

from modetune.core.mesh import Mesh
from modetune.core.modes import Floats
from modetune.core.surface import Surface
from modetune.core.updating.localisation import Removal
from modetune.flows.report.chart import AFTER, BEFORE, Axis, Bars, Chart, Panel
from modetune.flows.report.matplotlib_charts import new_figure, plain
from modetune.flows.studies.localise.error_maps import ErrorMaps
from modetune.flows.studies.localise.localisation import Localisation
from modetune.flows.studies.localise.proposals import Proposal

#: Bars that fit on a page.
BARS = 30
#: Proposed changes that are drawn.
PROPOSED = 10
COLOURS = "YlOrRd"


def localisation_figures(
    title: str, found: Localisation, mesh: Mesh, surface: Surface
) -> dict[str, Figure | Chart]:
    """All figures of what was found out, by name."""
    figures: dict[str, Figure | Chart] = {
        "removals": removal_chart(title, found.parameters, found.singles)
    }
    if found.maps is not None:
        figures["groups"] = group_chart(title, found.maps)
        if mesh.nodes.size:
            strains = on_surface(found.maps.strains, mesh, surface)
            figures["map"] = surface_figure(title, surface, strains)
    if found.proposals is not None and found.proposals.found:
        best = found.proposals.found[:PROPOSED]
        figures["proposals"] = proposal_chart(title, best)
        if mesh.nodes.size:
            figures["places"] = places_figure(title, surface, mesh, best)
    return figures


def proposal_chart(title: str, found: Sequence[Proposal]) -> Chart:
    """What each proposed change removes of the residual, the most probable on top."""
    values = np.array([100.0 * max(item.removed, 0.0) for item in found])
    names = [f"{number}: {item.change.label}" for number, item in enumerate(found, start=1)]
    return _shares(title, (Bars("", values, AFTER),), names, "removes of the residual, %")


def group_chart(title: str, maps: ErrorMaps) -> Chart:
    """Of each group its share of the force residual and of the error's energy, worst on top."""
    order = maps.errors.ranking[:BARS]
    bars = (
        Bars("explains of the force residual", 100.0 * maps.errors.force_shares[order], BEFORE),
        Bars("holds of the error's energy", 100.0 * maps.errors.error_shares[order], AFTER),
    )
    return _shares(title, bars, [maps.groups[place] for place in order.tolist()])


def removal_chart(title: str, names: Sequence[str], singles: Sequence[Removal]) -> Chart:
    """What each parameter alone can remove of the weighted residual, the best on top."""
    shown = list(singles)[:BARS]
    values = np.array([100.0 * item.removed for item in shown])
    bars = (Bars("", values, BEFORE),)
    return _shares(
        title,
        bars,
        [names[item.members[0]] for item in shown],
        "removes of the weighted residual, %",
    )


def _shares(title: str, bars: tuple[Bars, ...], names: Sequence[str], label: str = "%") -> Chart:
    panel = Panel(
        bars, Axis(label, span=(0.0, 100.0)), Axis(names=tuple(names), turned=True), sideways=True
    )
    return Chart(title, title, (panel,), size=(5.8, 1.2 + 0.36 * len(names)))


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
    shades = strains / (float(strains.max(initial=0.0)) or 1.0)
    paint = ScalarMappable(Normalize(0.0, 1.0), colormaps[COLOURS])
    figure, axes = _space(title, surface, np.asarray(paint.to_rgba(shades)))
    figure.colorbar(paint, ax=axes, shrink=0.6, label="strain of the error, of the largest")
    return figure


def places_figure(title: str, surface: Surface, mesh: Mesh, found: Sequence[Proposal]) -> Figure:
    """The model in grey, and the places of changes by their numbers in the table."""
    grey = np.tile([0.8, 0.8, 0.8, 0.4], (surface.nodes.size, 1))
    figure, axes = _space(title, surface, grey)
    axes.computed_zorder = False  # numbers on the far side are seen too
    labels: dict[int, list[int]] = {}
    for number, item in enumerate(found, start=1):
        for node in item.change.nodes[:1]:
            labels.setdefault(node, []).append(number)
    for number, item in reversed(list(enumerate(found, start=1))):
        nodes = np.array(item.change.nodes, dtype=np.int64)
        places = mesh.coordinates[mesh.rows(nodes[np.isin(nodes, mesh.nodes)])]
        best = number == 1
        axes.scatter(
            *places.T,
            s=60 if best else 24,
            c=AFTER if best else BEFORE,
            depthshade=False,
            zorder=10,
        )
        own = labels.get(item.change.nodes[0], []) if item.change.nodes else []
        for place in places[: own[:1] == [number]]:  # a node has one label
            text = f"  {', '.join(map(str, own))}"
            axes.text(*place, text, fontsize=12 if best else 9, zorder=11)
    return figure


def _space(title: str, surface: Surface, colours: Floats) -> tuple[Figure, Any]:
    """A figure of the model. colours: (n, 4), of its nodes."""
    figure = new_figure(7.2, 5.6)
    axes: Any = figure.add_subplot(projection="3d")
    if surface.triangles.size:
        faces = colours[surface.triangles].mean(axis=1)
        axes.add_collection3d(
            Poly3DCollection(
                surface.coordinates[surface.triangles], facecolors=faces, edgecolors="none"
            )
        )
    elif surface.edges.size:
        ends = colours[surface.edges].mean(axis=1)
        axes.add_collection3d(
            Line3DCollection(surface.coordinates[surface.edges], colors=ends, linewidths=4.0)
        )
    else:
        axes.scatter(*surface.coordinates.T, c=colours)
    low, high = surface.coordinates.min(axis=0), surface.coordinates.max(axis=0)
    # A flat or straight model gets some room, or its axes would have no scale.
    room = np.maximum(high - low, 0.05 * (float((high - low).max()) or 1.0))
    for name, centre, width in zip("xyz", (low + high) / 2.0, room / 2.0, strict=True):
        axes.set(**{f"{name}lim": (centre - width, centre + width)})
    # The box is drawn with a diagonal of one size: a tall or long one needs all of the picture.
    longest = float(room.max() / np.linalg.norm(room))
    axes.set_box_aspect(room, zoom=1.3 * min(1.0, 0.65 / longest))
    axes.set_axis_off()
    axes.set_title(plain(title), fontsize=10)
    return figure, axes
