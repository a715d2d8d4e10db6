"""Charts drawn by Plotly: for the report's page, and for who looks at a chart on its own.

Text and grid get the page's colours in the browser, so that one drawing serves light and dark.
"""

from __future__ import annotations

import html
from typing import Any

import numpy as np
import plotly.graph_objects as go
from plotly.subplots import make_subplots

from modetune.core.modes import Floats, Integers
from modetune.flows.report.chart import Axis, Bars, Chart, Curve, HeatMap, Panel, Rule, Towers

#: Pixels of an inch of a panel.
PIXELS = 84
SYMBOLS = {"o": "circle", "ring": "circle-open", "x": "x-thin", "+": "cross", "v": "triangle-down",
           "s": "square"}  # fmt: skip
DASHES = {"-": "solid", "--": "dash", ":": "dot"}
#: Points from which the graphics card draws them.
MANY = 2000
#: Half the side of a tower, of the unit square it stands on.
TOWER = 0.34
#: Corners of a box, (8, 3), and its twelve triangles.
CORNERS = np.array([[x, y, z] for z in (0, 1) for y in (-1, 1) for x in (-1, 1)], dtype=float)
FACES = np.array([
    [0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1],
    [2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4], [1, 5, 7], [1, 7, 3],
])  # fmt: skip
#: The twelve edges of a box in one stroke, with gaps.
STROKE = (0, 1, 3, 2, 0, 4, 5, 7, 6, 4, -1, 1, 5, -1, 2, 6, -1, 3, 7, -1)


def plotly_figure(chart: Chart) -> go.Figure:
    """The chart with what its points say under the mouse."""
    if any(panel.is_space for panel in chart.panels):
        return _space(chart)
    below = _room_below(chart)
    height = 70 + chart.down * (PIXELS * chart.size[1] + below)
    figure = make_subplots(
        chart.down,
        chart.across,
        shared_xaxes=chart.same_x,
        shared_yaxes=chart.same_y,
        subplot_titles=[_text(panel.title) for panel in chart.panels],
        vertical_spacing=min(0.9 / max(chart.down - 1, 1), (42.0 + below) / height),
        horizontal_spacing=0.03 if chart.same_y else 0.22 / max(chart.across, 2),
    )
    named: set[str] = set()
    for place, panel in enumerate(chart.panels):
        at = {"row": place // chart.across + 1, "col": place % chart.across + 1}
        _draw(figure, panel, at, named)
        figure.update_xaxes(**_axis(panel.x), **at)
        figure.update_yaxes(**_axis(panel.y), **at)
        if chart.same_y and at["col"] > 1:
            figure.update_yaxes(title_text="", **at)
        if chart.same_x and at["row"] < chart.down:
            figure.update_xaxes(title_text="", **at)
    top = 64 if any(panel.title for panel in chart.panels) else 40
    figure.update_layout(
        height=height, bargap=0.3, margin={"l": 62, "r": 8, "t": top, "b": 46 + below},
        legend={"orientation": "h", "yref": "container", "y": 0.995, "yanchor": "top", "x": 0,
                "title": {"text": _text(chart.legend)}},
        showlegend=len(named) > 1,
    )  # fmt: skip
    return figure


def _draw(figure: go.Figure, panel: Panel, at: dict[str, int], named: set[str]) -> None:
    for item in panel.items:
        shown: dict[str, Any] = {}
        if not isinstance(item, HeatMap | Towers):
            shown = {
                "name": _text(item.name),
                "legendgroup": _text(item.name),
                "showlegend": bool(item.name) and item.name not in named,
            }
            named |= {item.name} - {""}
        if isinstance(item, Curve):
            figure.add_trace(_curve(item, shown), **at)
        elif isinstance(item, Bars):
            figure.add_bar(**_bars(item, panel, shown), **at)
        elif isinstance(item, HeatMap):
            figure.add_heatmap(**_heat(item, panel), **at)
        elif isinstance(item, Rule):
            line = {"dash": DASHES[item.line], "width": 1.2, "color": item.colour}
            add = figure.add_vline if item.upright else figure.add_hline
            add(
                item.value,
                line=line,
                layer="below",
                annotation={"text": _text(item.name)} if item.name else None,
                **at,
            )


def _curve(item: Curve, shown: dict[str, Any]) -> Any:
    mode = "+".join(
        [
            *["lines"] * bool(item.line),
            *["markers"] * bool(item.mark),
            *["text"] * bool(item.written),
        ]
    )
    kind = go.Scattergl if len(item.x) > MANY else go.Scatter
    thin = 2.0 if item.mark in ("x", "ring") else 0.0
    return kind(
        x=item.x,
        y=item.y,
        mode=mode,
        **shown,
        text=[_text(text) for text in item.written] or None,
        textposition="bottom center",
        hovertext=[_text(text) for text in item.told] or None,
        hoverinfo="text" if item.told else "skip" if not item.name else None,
        line={"color": item.colour, "width": item.width, "dash": DASHES.get(item.line, "solid")}
        if item.line
        else None,
        marker={
            "color": item.colour,
            "size": 1.15 * item.size,
            "symbol": SYMBOLS[item.mark],
            "line": {"color": item.colour, "width": thin},
        }
        if item.mark
        else None,
    )


def _bars(item: Bars, panel: Panel, shown: dict[str, Any]) -> dict[str, Any]:
    names = panel.y.names if panel.sideways else panel.x.names
    along, across = ("y", "x") if panel.sideways else ("x", "y")
    colours = item.colours if isinstance(item.colours, str) else list(item.colours)
    made: dict[str, Any] = {
        along: list(range(len(names))),
        across: item.values,
        "marker": {"color": colours},
        "orientation": "h" if panel.sideways else "v",
        "text": list(item.written) or None,
        "hovertext": [
            f"{_text(name)}: {value:+.4g}" for name, value in zip(names, item.values, strict=True)
        ],
        "hoverinfo": "text+name",
        **shown,
    }
    if item.errors is not None:
        made[f"error_{across}"] = {"array": item.errors, "thickness": 0.8}
    return made


def _heat(item: HeatMap, panel: Panel) -> dict[str, Any]:
    return {
        "z": item.values,
        "x": list(range(len(panel.x.names))),
        "y": list(range(len(panel.y.names))),
        "zmin": item.low,
        "zmax": item.high,
        "colorscale": item.scale,
        "xgap": 1,
        "ygap": 1,
        "texttemplate": "%{z:.2f}" if item.is_numbered else None,
        "textfont": {"size": 10},
        "hovertext": _cells(item, panel),
        "hoverinfo": "text",
        "colorbar": {"title": _text(item.unit), "thickness": 12},
    }


def _cells(item: HeatMap | Towers, panel: Panel) -> list[list[str]]:
    return [
        [
            _text(item.told.format(row=row, column=column, value=value))
            for column, value in zip(panel.x.names, values, strict=True)
        ]
        for row, values in zip(panel.y.names, item.values.tolist(), strict=True)
    ]


def _axis(axis: Axis) -> dict[str, Any]:
    made: dict[str, Any] = {"title_text": _text(axis.label), "automargin": True}
    if axis.log:
        made |= {"type": "log", "tickformat": "~g", "nticks": 6}
    if axis.names:
        made |= {
            "tickvals": list(range(len(axis.names))),
            "showgrid": False,
            "ticktext": [_text(name) for name in axis.names],
            "tickangle": -axis.slant,
            "range": [-0.6, len(axis.names) - 0.4],
            "tickfont": {"size": 10},
        }
    if axis.span:
        made["range"] = [np.log10(end) for end in axis.span] if axis.log else list(axis.span)
    if axis.turned:
        made |= {"range": made["range"][::-1]} if "range" in made else {"autorange": "reversed"}
    if axis.step:
        made["dtick"] = axis.step
    return made


def _room_below(chart: Chart) -> float:
    """Pixels that slanted names take below each row of panels."""
    longest = max(
        (len(name) for panel in chart.panels if panel.x.slant for name in panel.x.names), default=0
    )
    return 5.0 * longest


def _space(chart: Chart) -> go.Figure:
    """Towers of one panel."""
    (panel,) = chart.panels
    (item,) = [one for one in panel.items if isinstance(one, Towers)]
    rows, columns = (index.ravel() + 1.0 for index in np.indices(item.values.shape))
    heights = np.maximum(item.values.ravel(), 0.004)
    base = np.stack([columns, rows, np.zeros_like(heights)], axis=1)
    size = np.stack([np.full_like(heights, TOWER), np.full_like(heights, TOWER), heights], axis=1)
    corners = (base[:, None] + CORNERS[None] * size[:, None]).reshape(-1, 3)
    faces = (FACES[None] + 8 * np.arange(heights.size)[:, None, None]).reshape(-1, 3)
    told = [text for texts in _cells(item, panel) for text in texts]
    figure = go.Figure(
        go.Mesh3d(
            x=corners[:, 0],
            y=corners[:, 1],
            z=corners[:, 2],
            i=faces[:, 0],
            j=faces[:, 1],
            k=faces[:, 2],
            intensity=np.repeat(heights, 8),
            cmin=0.0,
            cmax=1.0,
            colorscale="Viridis",
            flatshading=True,
            text=np.repeat(told, 8),
            hoverinfo="text",
            lighting={"ambient": 0.75, "diffuse": 0.5, "specular": 0.05},
            showscale=False,  # the maps have it
        )
    )
    strokes = np.concatenate([corners.reshape(-1, 8, 3), np.full((heights.size, 1, 3), np.nan)], 1)
    figure.add_trace(_stroke(strokes[:, list(STROKE)].reshape(-1, 3), "rgba(0,0,0,0.35)"))
    figure.update_layout(
        height=400, margin={"l": 0, "r": 0, "t": 8, "b": 0},
        scene={
            "xaxis": _space_axis(panel.x), "yaxis": _space_axis(panel.y),
            "zaxis": {"title": {"text": _text(item.unit)}, "range": [0, 1], "dtick": 0.25},
            # Across the diagonal and from above: the bars of the pairs stand beside each other.
            "camera": {"eye": {"x": 1.5, "y": -1.15, "z": 1.25}, "center": {"z": -0.12},
                       "projection": {"type": "orthographic"}},
            "aspectratio": {"x": 1.0, "y": 1.0, "z": 0.62},
        },
    )  # fmt: skip
    return figure


def points_in_space(
    coordinates: Floats,
    edges: Integers,
    points: Floats,
    values: list[float],
    told: list[str],
    unit: str,
    low: float,
) -> go.Figure:
    """Points (n, 3) on lines, coloured by their values (n,) from low to 1.

    coordinates: (n_nodes, 3); edges: (n_edges, 2), rows of them.
    """
    ends = np.concatenate([coordinates[edges], np.full((edges.shape[0], 1, 3), np.nan)], axis=1)
    figure = go.Figure(_stroke(ends.reshape(-1, 3).astype(np.float32), "#9aa4b0"))
    figure.add_scatter3d(
        x=points[:, 0], y=points[:, 1], z=points[:, 2], mode="markers", text=told,
        hoverinfo="text", showlegend=False,
        marker={"size": 6, "color": values, "cmin": low, "cmax": 1.0, "colorscale": "Viridis",
                "colorbar": {"title": unit, "thickness": 12, "len": 0.7}},
    )  # fmt: skip
    hidden, sizes = {"visible": False}, np.ptp(np.vstack([coordinates, points]), axis=0)
    sides = np.maximum(sizes / (sizes.max() or 1.0), 0.05)
    figure.update_layout(
        height=380, margin={"l": 0, "r": 0, "t": 8, "b": 0},
        scene={"xaxis": hidden, "yaxis": hidden, "zaxis": hidden, "aspectmode": "manual",
               "aspectratio": dict(zip("xyz", (2.2 * sides).tolist(), strict=True)),
               "camera": {"eye": {"x": -1.0, "y": -1.25, "z": 0.85},
                          "projection": {"type": "orthographic"}}},
    )  # fmt: skip
    return figure


def _stroke(points: Floats, colour: str) -> go.Scatter3d:
    return go.Scatter3d(
        x=points[:, 0],
        y=points[:, 1],
        z=points[:, 2],
        mode="lines",
        hoverinfo="skip",
        line={"color": colour, "width": 1},
        showlegend=False,
    )


def _space_axis(axis: Axis) -> dict[str, Any]:
    named = any(not name.isdigit() for name in axis.names)  # long, and the title would cross them
    return {
        "title": {"text": "" if named else _text(axis.label)},
        "tickfont": {"size": 9 if named else 12},
        "tickvals": list(range(1, len(axis.names) + 1)),
        "ticktext": [_text(name) for name in axis.names],
    }


def _text(text: str) -> str:
    """A text in which Plotly finds no tag."""
    return html.escape(text, quote=False)
