"""Charts of the report's page, by Plotly; the same things as `figures.py` draws for print.

Colours are those of `figures.py`: test black, before light blue, after vermilion, everywhere.
Text and grid get the page's colours in the browser, so that one chart serves light and dark.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import plotly.graph_objects as go
from plotly.subplots import make_subplots

from modetune.core.frf import Complexes
from modetune.core.modes import COMPONENTS, Floats, common_dofs
from modetune.core.record import CampaignRecord
from modetune.flows.report.comparison import (
    ModeRow,
    SensorAgreement,
    mode_label,
    residual_norm,
    scaled_test,
)
from modetune.flows.report.markup import chart_text
from modetune.flows.report.palette import AFTER, BEFORE, PARAMETER_COLOURS, TEST


def mac_maps(before: Floats, after: Floats, numbers: Sequence[str]) -> go.Figure:
    """MAC tables before and after side by side, their values written in while there is room."""
    figure = make_subplots(1, 2, subplot_titles=("before", "after"), horizontal_spacing=0.09)
    columns = list(numbers)
    few = before.size <= 150
    for place, mac in enumerate((before, after), start=1):
        figure.add_heatmap(
            z=mac, x=columns, y=[str(row + 1) for row in range(mac.shape[0])],
            zmin=0.0, zmax=1.0, coloraxis="coloraxis", row=1, col=place,
            texttemplate="%{z:.2f}" if few else None, textfont={"size": 10},
            hovertemplate="test mode %{x}, computed mode %{y}: MAC %{z:.3f}<extra></extra>",
            xgap=1, ygap=1,
        )  # fmt: skip
    figure.update_xaxes(title_text="test mode", type="category", showgrid=False)
    figure.update_yaxes(type="category", showgrid=False)
    figure.update_yaxes(title_text="computed mode", row=1, col=1)
    figure.update_layout(
        height=150 + 30 * max(7, before.shape[0]), margin={"l": 56, "r": 8, "t": 32, "b": 46},
        coloraxis={"colorscale": "Viridis", "cmin": 0, "cmax": 1,
                   "colorbar": {"title": "MAC", "thickness": 12}},
    )  # fmt: skip
    return figure


def frequency_lines(rows: Sequence[ModeRow]) -> go.Figure:
    """Computed over measured frequencies with the 45-degree line, and the errors beside it."""
    figure = make_subplots(1, 2, column_widths=[0.46, 0.54], horizontal_spacing=0.11)
    test = [row.test_hz for row in rows]
    largest = 1.06 * max(max(row.test_hz, row.before_hz, row.after_hz) for row in rows)
    figure.add_scatter(x=[0, largest], y=[0, largest], mode="lines", name="equal", hoverinfo="skip",
                       line={"color": "#8a8f98", "width": 1}, row=1, col=1)  # fmt: skip
    labels = [chart_text(row.label) for row in rows]
    for name, values, colour, symbol in (
        ("before", [row.before_hz for row in rows], BEFORE, "circle"),
        ("after", [row.after_hz for row in rows], AFTER, "x-thin"),
    ):
        figure.add_scatter(
            x=test, y=values, mode="markers", name=name, text=labels, legendgroup=name,
            marker={"color": colour, "size": 10, "symbol": symbol,
                    "line": {"color": colour, "width": 2.5 if name == "after" else 0}},
            hovertemplate="mode %{text}: test %{x:.3f} Hz, " + name + " %{y:.3f} Hz<extra></extra>",
            row=1, col=1,
        )  # fmt: skip
        errors = [100 * (row.error_before if name == "before" else row.error_after) for row in rows]
        figure.add_bar(
            x=labels, y=errors, name=name, marker_color=colour, legendgroup=name, showlegend=False,
            hovertemplate="mode %{x}, " + name + ": %{y:+.2f} %<extra></extra>", row=1, col=2,
        )  # fmt: skip
    figure.update_xaxes(title_text="test, Hz", range=[0, largest], row=1, col=1)
    figure.update_yaxes(title_text="computed, Hz", range=[0, largest], row=1, col=1)
    figure.update_xaxes(title_text="test mode", type="category", row=1, col=2)
    figure.update_yaxes(title_text="frequency error, %", zeroline=True, row=1, col=2)
    figure.update_layout(height=380, margin={"l": 56, "r": 8, "t": 30, "b": 46}, bargap=0.3,
                         legend={"orientation": "h", "y": 1.1})  # fmt: skip
    return figure


def parameter_histories(record: CampaignRecord) -> go.Figure:
    """Values relative to the deck over the iterations; those not kept are open and unconnected."""
    figure = go.Figure()
    kept = [item for item in record.iterations if item.accepted]
    tried = [item for item in record.iterations if not item.accepted]
    for place, name in enumerate(record.parameters.names):
        colour = PARAMETER_COLOURS[place % len(PARAMETER_COLOURS)]
        for items, mode, symbol in (
            (kept, "lines+markers", "circle"),
            (tried, "markers", "circle-open"),
        ):
            if not items:
                continue
            figure.add_scatter(
                x=[item.number for item in items],
                y=[float(item.parameters[place]) for item in items],
                mode=mode, name=chart_text(name), legendgroup=str(place), showlegend=items is kept,
                line={"color": colour}, marker={"color": colour, "symbol": symbol, "size": 7},
                hovertemplate="%{fullData.name}: %{y:.4f}"
                + ("" if items is kept else " (not kept)") + "<extra></extra>",
            )  # fmt: skip
    figure.update_xaxes(title_text="iteration", dtick=_tick(record))
    figure.update_yaxes(title_text="value relative to the deck")
    figure.update_layout(height=360, margin={"l": 56, "r": 8, "t": 12, "b": 46}, hovermode="x")
    return figure


def correlation_map(names: Sequence[str], correlation: Floats) -> go.Figure:
    """Correlation of the parameters' estimates, (n_parameters, n_parameters)."""
    figure = go.Figure(
        go.Heatmap(
            z=correlation, x=list(names), y=list(names), zmin=-1, zmax=1, colorscale="RdBu",
            texttemplate="%{z:.2f}" if len(names) <= 12 else None, textfont={"size": 11},
            hovertemplate="%{y} and %{x}: %{z:+.3f}<extra></extra>", xgap=1, ygap=1,
            colorbar={"thickness": 12},
        )
    )  # fmt: skip
    figure.update_xaxes(type="category", showgrid=False)
    figure.update_yaxes(type="category", autorange="reversed", showgrid=False)
    figure.update_layout(height=150 + 28 * max(6, len(names)),
                         margin={"l": 8, "r": 8, "t": 12, "b": 8})  # fmt: skip
    figure.update_xaxes(automargin=True)
    figure.update_yaxes(automargin=True)
    return figure


def sensitivity_bars(
    numbers: Sequence[str], names: Sequence[str], matrices: Sequence[tuple[int, Floats]]
) -> go.Figure:
    """Normalised sensitivities, a chart a mode, a bar a parameter (as thesis, figures 49 to 51).

    matrices: iteration and (n_modes, n_parameters), the first and the last one.
    """
    across = min(3, len(numbers))
    down = -(-len(numbers) // across)
    # Names of parameters stand slanted below each chart, and the next one's title below them.
    below = 34 + 5 * max(len(name) for name in names)
    height = 64 + down * (150 + below)
    gap = min(0.9 / max(down - 1, 1), (26.0 + below) / height)
    figure = make_subplots(
        down, across, subplot_titles=[f"mode {number}" for number in numbers], shared_yaxes=True,
        vertical_spacing=gap if down > 1 else 0.0, horizontal_spacing=0.03,
    )  # fmt: skip
    colours = (BEFORE, AFTER)
    for place, (iteration, values) in enumerate(matrices):
        for mode in range(len(numbers)):
            figure.add_bar(
                x=list(names), y=values[mode], name=f"at iteration {iteration}",
                marker_color=colours[place], legendgroup=str(place), showlegend=mode == 0,
                hovertemplate="%{x}: %{y:+.4f}<extra></extra>",
                row=mode // across + 1, col=mode % across + 1,
            )  # fmt: skip
    figure.update_xaxes(type="category", tickangle=-40, tickfont={"size": 10})
    figure.update_yaxes(title_text="(df/f) / (dp/p)", col=1, title_font={"size": 11})
    figure.update_layout(height=height, margin={"l": 62, "r": 8, "t": 64, "b": below}, bargap=0.3,
                         legend={"orientation": "h", "yref": "container", "y": 0.995,
                                 "yanchor": "top", "x": 0})  # fmt: skip
    return figure


def convergence(record: CampaignRecord) -> go.Figure:
    """Residual and slope over the iterations; e2's line, and where it skipped a sensitivity."""
    figure = make_subplots(1, 2, horizontal_spacing=0.12, subplot_titles=(
        "residual |z|", "slope |Δz| / L"))  # fmt: skip
    items = record.iterations
    for chosen, name, symbol in (
        ([item for item in items if item.accepted], "kept", "circle"),
        ([item for item in items if not item.accepted], "not kept", "x"),
    ):
        if not chosen:
            continue
        shown: dict[str, Any] = {
            "x": [item.number for item in chosen], "name": name, "legendgroup": name,
            "mode": "lines+markers" if name == "kept" else "markers",
            "line": {"color": AFTER}, "marker": {"symbol": symbol, "size": 8, "color": AFTER},
        }  # fmt: skip
        figure.add_scatter(y=[residual_norm(item) for item in chosen], row=1, col=1, **shown)
        slopes = [item.slope if item.slope > 0.0 else None for item in chosen]
        figure.add_scatter(y=slopes, row=1, col=2, showlegend=False, **shown)
    skipped = [item for item in items if item.sensitivity_skipped]
    if skipped:
        figure.add_scatter(
            x=[item.number for item in skipped], y=[item.slope for item in skipped],
            mode="markers", name="sensitivity skipped (e2)", row=1, col=2,
            marker={"symbol": "circle-open", "size": 16, "color": TEST, "line": {"width": 2}},
        )  # fmt: skip
    if record.e2 > 0.0:
        figure.add_hline(y=record.e2, line={"dash": "dot", "width": 1.2, "color": "#8a8f98"},
                         annotation={"text": f"e2 = {record.e2:g}"}, row=1, col=2)  # fmt: skip
    figure.update_xaxes(
        title_text="iteration", dtick=_tick(record), range=[-0.3, items[-1].number + 0.3]
    )
    figure.update_yaxes(type="log", tickformat="~g")
    figure.update_layout(height=350, margin={"l": 60, "r": 8, "t": 40, "b": 46},
                         legend={"orientation": "h", "y": -0.2})  # fmt: skip
    return figure


def sensor_marks(found: SensorAgreement) -> go.Figure:
    """COMAC of each sensor before and after."""
    figure = go.Figure()
    for name, values, colour, symbol in (
        ("before", found.before, BEFORE, "circle"),
        ("after", found.after, AFTER, "x-thin"),
    ):
        figure.add_scatter(
            x=list(found.labels), y=values, name=name, mode="markers",
            marker={"color": colour, "symbol": symbol, "size": 7,
                    "line": {"color": colour, "width": 2 if name == "after" else 0}},
            hovertemplate="%{x}, " + name + ": %{y:.3f}<extra></extra>",
        )  # fmt: skip
    figure.update_xaxes(type="category", automargin=True, tickangle=-90, tickfont={"size": 10})
    figure.update_yaxes(title_text="COMAC", range=[scale_foot(found) - 0.02, 1.02])
    figure.update_layout(height=330, margin={"l": 56, "r": 8, "t": 30, "b": 60},
                         legend={"orientation": "h", "y": 1.12})  # fmt: skip
    return figure


def scale_foot(found: SensorAgreement) -> float:
    """Where the scale of a COMAC starts: below the least, at 0.8 at most."""
    return min(0.8, float(np.floor(10 * min(found.before.min(), found.after.min())) / 10))


def response_overlay(
    unit: str, frequencies_hz: Floats, curves: Sequence[tuple[str, str, Complexes]]
) -> go.Figure:
    """Response functions over each other: kind (test, before, after), label, (n_lines,) each."""
    figure = go.Figure()
    looks = {
        "test": (TEST, "solid", 2.0),
        "before": (BEFORE, "solid", 1.3),
        "after": (AFTER, "dash", 1.6),
    }
    for kind, label, values in curves:
        colour, dash, width = looks[kind]
        figure.add_scatter(x=frequencies_hz, y=np.abs(values), mode="lines", name=label,
                           line={"color": colour, "dash": dash, "width": width},
                           hovertemplate="%{x:.2f} Hz: %{y:.3g}<extra></extra>")  # fmt: skip
    figure.update_xaxes(title_text="Hz")
    figure.update_yaxes(title_text=unit, type="log", exponentformat="power")
    figure.update_layout(height=330, margin={"l": 64, "r": 8, "t": 26, "b": 46},
                         legend={"orientation": "h", "y": 1.13})  # fmt: skip
    return figure


def sensor_shapes(record: CampaignRecord) -> go.Figure:
    """Shapes of test and model over the sensors, a chart a mode, where none has a place in space.

    All have the scale of a test's shape of length one.
    """
    first, last = record.iterations[0], record.best
    test, before = scaled_test(record, first)
    curves = (("test", test, TEST), ("before", before, BEFORE),
              ("after", scaled_test(record, last)[1], AFTER))  # fmt: skip
    rows, _ = common_dofs(record.test.modes, first.computed)
    modes = record.test.modes
    labels = [f"{modes.nodes[row]}.{COMPONENTS[modes.components[row] - 1]}" for row in rows]
    n, across = test.shape[1], min(3, test.shape[1])
    down = -(-n // across)
    numbers = [chart_text(mode_label(record, record.test.numbers[place]))
               for place in first.pairing.measured]  # fmt: skip
    figure = make_subplots(down, across, subplot_titles=[f"mode {number}" for number in numbers],
                           vertical_spacing=0.3 / down, horizontal_spacing=0.05)  # fmt: skip
    for name, shapes, colour in curves:
        for mode in range(n):
            figure.add_scatter(
                x=labels, y=shapes[:, mode], name=name, legendgroup=name, showlegend=mode == 0,
                line={"color": colour, "width": 3 if name == "test" else 1.6},
                row=mode // across + 1, col=mode % across + 1,
            )  # fmt: skip
    figure.update_xaxes(type="category", tickfont={"size": 10})
    figure.update_layout(height=90 + 220 * down, margin={"l": 40, "r": 8, "t": 64, "b": 40},
                         legend={"orientation": "h", "yref": "container", "y": 0.995,
                                 "yanchor": "top", "x": 0})  # fmt: skip
    return figure


def _tick(record: CampaignRecord) -> int:
    return max(1, record.iterations[-1].number // 12)
