"""Charts in space: MAC as bars, and COMAC on the geometry of the test."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import plotly.graph_objects as go

from modetune.core.modes import Floats, Integers
from modetune.flows.report.charts import scale_foot
from modetune.flows.report.comparison import SensorAgreement
from modetune.flows.report.scene import Scene

#: Half the side of a MAC bar, of the unit square it stands on.
BAR = 0.34
#: Corners of a box, (8, 3), and its twelve triangles.
CORNERS = np.array([[x, y, z] for z in (0, 1) for y in (-1, 1) for x in (-1, 1)], dtype=float)
FACES = np.array([
    [0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1],
    [2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4], [1, 5, 7], [1, 7, 3],
])  # fmt: skip
#: The twelve edges of a box in one stroke, with gaps.
STROKE = (0, 1, 3, 2, 0, 4, 5, 7, 6, 4, -1, 1, 5, -1, 2, 6, -1, 3, 7, -1)


def mac_bars(mac: Floats, numbers: Sequence[str]) -> go.Figure:
    """MAC (n_computed, n_measured) as bars in space; numbers: of the measured modes."""
    computed, measured = (index.ravel() + 1.0 for index in np.indices(mac.shape))
    heights = np.maximum(mac.ravel(), 0.004)
    base = np.stack([measured, computed, np.zeros_like(heights)], axis=1)
    size = np.stack([np.full_like(heights, BAR), np.full_like(heights, BAR), heights], axis=1)
    corners = (base[:, None] + CORNERS[None] * size[:, None]).reshape(-1, 3)
    faces = (FACES[None] + 8 * np.arange(heights.size)[:, None, None]).reshape(-1, 3)
    told = [
        f"test mode {numbers[int(x) - 1]}, computed mode {int(y)}: MAC {value:.3f}"
        for x, y, value in zip(measured, computed, mac.ravel(), strict=True)
    ]
    figure = go.Figure(
        go.Mesh3d(
            x=corners[:, 0], y=corners[:, 1], z=corners[:, 2],
            i=faces[:, 0], j=faces[:, 1], k=faces[:, 2],
            intensity=np.repeat(heights, 8), cmin=0.0, cmax=1.0, colorscale="Viridis",
            flatshading=True, text=np.repeat(told, 8), hoverinfo="text",
            lighting={"ambient": 0.75, "diffuse": 0.5, "specular": 0.05},
            showscale=False,  # the maps below have it
        )
    )  # fmt: skip
    strokes = np.concatenate([corners.reshape(-1, 8, 3), np.full((heights.size, 1, 3), np.nan)], 1)
    lines = strokes[:, list(STROKE)].reshape(-1, 3)
    figure.add_scatter3d(
        x=lines[:, 0], y=lines[:, 1], z=lines[:, 2], mode="lines", hoverinfo="skip",
        line={"color": "rgba(0,0,0,0.35)", "width": 1}, showlegend=False,
    )  # fmt: skip
    figure.update_layout(
        height=400, margin={"l": 0, "r": 0, "t": 8, "b": 0},
        scene={
            "xaxis": _modes_axis("test mode", numbers),
            "yaxis": _modes_axis("computed mode", [str(row + 1) for row in range(mac.shape[0])]),
            "zaxis": {"title": {"text": "MAC"}, "range": [0, 1], "dtick": 0.25},
            # Across the diagonal and from above: the bars of the pairs stand beside each other.
            "camera": {"eye": {"x": 1.5, "y": -1.15, "z": 1.25}, "center": {"z": -0.12},
                       "projection": {"type": "orthographic"}},
            "aspectratio": {"x": 1.0, "y": 1.0, "z": 0.62},
        },
    )  # fmt: skip
    return figure


def comac_points(shown: Scene, found: SensorAgreement, values: Floats) -> go.Figure:
    """COMAC on the geometry: each test point has the least of its sensors.

    values: (n_sensors,), those of before or of after.
    """
    least = dict.fromkeys(found.nodes.tolist(), 1.0)
    for node, value in zip(found.nodes.tolist(), values.tolist(), strict=True):
        least[node] = min(least[node], value)
    told = [f"test point {node}: {least[node]:.3f}" for node in shown.nodes.tolist()]
    x, y, z = _strokes(shown.coordinates, shown.edges)
    figure = go.Figure(
        go.Scatter3d(x=x, y=y, z=z, mode="lines", hoverinfo="skip", showlegend=False,
                     line={"color": "#9aa4b0", "width": 1})
    )  # fmt: skip
    figure.add_scatter3d(
        x=shown.points[:, 0], y=shown.points[:, 1], z=shown.points[:, 2], mode="markers",
        text=told, hoverinfo="text", showlegend=False,
        marker={"size": 6, "color": [least[node] for node in shown.nodes.tolist()],
                "cmin": scale_foot(found), "cmax": 1.0, "colorscale": "Viridis",
                "colorbar": {"title": "COMAC", "thickness": 12, "len": 0.7}},
    )  # fmt: skip
    hidden, sizes = {"visible": False}, np.ptp(np.vstack([shown.coordinates, shown.points]), axis=0)
    sides = np.maximum(sizes / (sizes.max() or 1.0), 0.05)
    figure.update_layout(
        height=380, margin={"l": 0, "r": 0, "t": 8, "b": 0},
        scene={"xaxis": hidden, "yaxis": hidden, "zaxis": hidden, "aspectmode": "manual",
               "aspectratio": dict(zip("xyz", (2.2 * sides).tolist(), strict=True)),
               "camera": {"eye": {"x": -1.0, "y": -1.25, "z": 0.85},
                          "projection": {"type": "orthographic"}}},
    )  # fmt: skip
    return figure


def _strokes(coordinates: Floats, edges: Integers) -> tuple[Floats, Floats, Floats]:
    """Ends of edges in one line with gaps, x, y and z."""
    ends = np.concatenate([coordinates[edges], np.full((edges.shape[0], 1, 3), np.nan)], axis=1)
    x, y, z = ends.reshape(-1, 3).T.astype(np.float32)
    return x, y, z


def _modes_axis(title: str, numbers: Sequence[str]) -> dict[str, Any]:
    named = any(not number.isdigit() for number in numbers)  # long, and the title would cross them
    return {
        "title": {"text": "" if named else title},
        "tickfont": {"size": 9 if named else 12},
        "tickvals": list(range(1, len(numbers) + 1)),
        "ticktext": list(numbers),
    }
