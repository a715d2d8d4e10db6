"""Charts drawn by Matplotlib for print, without pyplot, so that any thread may draw.

Each drawing is a figure that the caller may modify; `save` writes it as PNG or SVG.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.ticker import MultipleLocator

from modetune.core.modes import Floats
from modetune.core.storage.files import writing
from modetune.flows.report.chart import ZERO, Axis, Bars, Chart, Curve, HeatMap, Panel, Rule, Towers

DPI = 150
#: Width of a 3D bar in a grid of unit squares.
TOWER = 0.66
#: Maximum number of names along an axis; beyond it only every second or third appears.
MOST_NAMES = 60


def matplotlib_figure(chart: Chart) -> Figure:
    """Return a chart as a figure for print."""
    width, height = chart.size
    figure = new_figure(width * chart.across + 0.6, height * chart.down + 0.5)
    for place, panel in enumerate(chart.panels):
        row, column = divmod(place, chart.across)
        first = figure.axes[row * chart.across] if column else None
        top = figure.axes[column] if row else None
        axes: Any = figure.add_subplot(
            chart.down,
            chart.across,
            place + 1,
            projection="3d" if panel.is_space else None,
            sharex=top if chart.same_x else None,
            sharey=first if chart.same_y else None,
        )
        _draw(axes, panel)
        if chart.same_y and first is not None:
            axes.tick_params(labelleft=False)
            axes.set_ylabel("")
        if chart.same_x and place + chart.across < len(chart.panels):
            axes.set_xlabel("")
    _add_scale(figure, chart)
    _add_legend(figure, chart)
    if len(chart.panels) == 1 and not chart.panels[0].title:
        figure.axes[0].set_title(plain(chart.title), fontsize=10)
    else:
        figure.suptitle(plain(chart.title), fontsize=11)
    return figure


def save(figure: Figure | Chart, path: Path) -> Path:
    """Write a figure as PNG, or as SVG where the file is named so. Raises StorageUnavailable."""
    if isinstance(figure, Chart):
        figure = matplotlib_figure(figure)
    form = "svg" if path.suffix == ".svg" else "png"
    with writing(path) as part:
        # Without a date the same figure is the same file.
        figure.savefig(part, format=form, dpi=DPI, metadata={"Date": None} if form == "svg" else {})
    return path


def save_all(figures: Mapping[str, Figure | Chart], folder: Path, form: str = "png") -> list[Path]:
    """Write figures by their names. Raises StorageUnavailable."""
    return [save(figure, folder / f"{name}.{form}") for name, figure in figures.items()]


def plain(text: str) -> str:
    """A user's text, in which no sign starts a formula."""
    return text.replace("$", r"\$")


def new_figure(width: float, height: float) -> Figure:
    """Return an empty figure of this size in inches."""
    figure = Figure(figsize=(width, height), layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def _draw(axes: Any, panel: Panel) -> None:
    bars = [item for item in panel.items if isinstance(item, Bars)]
    for item in panel.items:
        if isinstance(item, Curve):
            _draw_curve(axes, item, panel.y.span)
        elif isinstance(item, Bars):
            _draw_bars(axes, panel, item, bars.index(item), len(bars))
        elif isinstance(item, HeatMap):
            _draw_heat(axes, item)
        elif isinstance(item, Towers):
            _draw_towers(axes, item)
        elif isinstance(item, Rule):
            rule = axes.axvline if item.upright else axes.axhline
            rule(
                item.value,
                color=item.colour,
                linestyle=item.line,
                linewidth=1.0,
                zorder=0.5,
                label=plain(item.name) or None,
            )
    shift = 1 if panel.is_space else 0
    _set_axis(axes, "x", panel.x, shift)
    _set_axis(axes, "y", panel.y, shift)
    if panel.title:
        axes.set_title(plain(panel.title), fontsize=9)
    if panel.square:
        axes.set_aspect("equal")
    if not panel.is_space and not any(isinstance(item, HeatMap) for item in panel.items):
        axes.grid(alpha=0.3)


def _draw_curve(axes: Axes, item: Curve, span: tuple[float, float] | None) -> None:
    ring = item.mark == "ring"
    axes.plot(
        item.x,
        item.y,
        color=item.colour,
        linestyle=item.line or "none",
        linewidth=item.width,
        marker="o" if ring else item.mark,
        fillstyle="none" if ring else "full",
        markersize=item.size,
        markeredgewidth=2.0 if item.mark in ("x", "ring") else None,
        label=plain(item.name) or None,
    )
    # Names are below their points, and above points at the foot of the panel.
    foot = -np.inf if span is None else 0.9 * span[0] + 0.1 * span[1]
    up = np.where(np.asarray(item.y) > foot, -12.0, 10.0)
    _write(axes, item.labels, (item.x, item.y), up, "center")


def _draw_bars(axes: Axes, panel: Panel, item: Bars, place: int, count: int) -> None:
    width = 0.8 / count
    at = np.arange(len(item.values)) + (place - (count - 1) / 2) * width
    colours = item.colours if isinstance(item.colours, str) else list(item.colours)
    draw, errors = (axes.barh, "xerr") if panel.sideways else (axes.bar, "yerr")
    more: dict[str, Any] = {errors: item.errors, "label": plain(item.name) or None}
    draw(at, item.values, width, color=colours, error_kw={"linewidth": 0.8}, **more)
    _write(axes, item.labels, (at, item.values), np.full(len(at), 2.0), "baseline")


def _write(
    axes: Axes, texts: tuple[str, ...], places: tuple[Floats, Floats], up: Floats, on: str
) -> None:
    """Texts beside their places, so many points up, on this line of theirs; none where no texts."""
    for text, x, y, points in zip(texts, *places, up, strict=bool(texts)):
        at = float(x), float(y)
        style: dict[str, Any] = {"ha": "center", "va": on, "fontsize": 8}
        axes.annotate(plain(text), at, (0.0, points), textcoords="offset points", **style)


def _draw_heat(axes: Axes, item: HeatMap) -> None:
    axes.imshow(
        item.values, origin="lower", vmin=item.low, vmax=item.high, cmap=item.scale, aspect="auto"
    )
    for (row, column), value in np.ndenumerate(item.values) if item.is_numbered else ():
        if abs(value) >= ZERO:
            is_light = (abs(value) > 0.6) == (item.scale == "viridis")
            axes.text(
                column,
                row,
                f"{value:.2f}",
                ha="center",
                va="center",
                fontsize=7,
                color="black" if is_light else "white",
            )


def _draw_towers(axes: Any, item: Towers) -> None:
    rows, columns = (index.ravel() + 1.0 for index in np.indices(item.values.shape))
    heights = item.values.ravel()
    axes.bar3d(
        columns - TOWER / 2,
        rows - TOWER / 2,
        np.zeros_like(heights),
        TOWER,
        TOWER,
        np.maximum(heights, 1e-3),
        color=colormaps["viridis"](Normalize(0.0, 1.0)(heights)),
        edgecolor="#00000040",
        linewidth=0.4,
    )
    axes.set_zlim(0.0, 1.0)
    axes.set_zticks([0.0, 0.2, 0.4, 0.6, 0.8, 1.0])
    axes.set_zlabel(plain(item.unit), labelpad=6.0)
    axes.view_init(elev=32.0, azim=-58.0)
    axes.set_box_aspect(None, zoom=0.98)


def _set_axis(axes: Any, which: str, axis: Axis, shift: int) -> None:
    axes.set(**{f"{which}label": plain(axis.label)})
    if axis.log:
        axes.set(**{f"{which}scale": "log"})
    if axis.names:
        every = max(1, len(axis.names) // MOST_NAMES)
        places = range(shift, len(axis.names) + shift)
        names = [plain(name) for name in axis.names]
        turned = {
            "rotation": axis.slant,
            "ha": "right" if 0 < axis.slant < 90 else "center",
            "rotation_mode": "anchor" if 0 < axis.slant < 90 else "default",
        }
        set_ticks = axes.set_xticks if which == "x" else axes.set_yticks
        set_ticks(
            places[::every],
            names[::every],
            fontsize=8 if len(names) < 20 else 7,
            **(turned if which == "x" else {}),
        )
    elif axis.step:
        getattr(axes, f"{which}axis").set_major_locator(MultipleLocator(axis.step))
    elif which == "x" and not axis.log and not shift:
        axes.locator_params(axis="x", nbins=5)  # in a narrow panel more would run together
    if axis.span:
        axes.set(**{f"{which}lim": axis.span})
    if axis.turned:
        getattr(axes, f"{which}axis").set_inverted(True)


def _add_scale(figure: Figure, chart: Chart) -> None:
    """The scale of a chart of maps; all its maps have the same."""
    maps = [item for panel in chart.panels for item in panel.items if isinstance(item, HeatMap)]
    if maps:
        figure.colorbar(
            figure.axes[0].images[0], ax=figure.axes, label=plain(maps[0].unit), fraction=0.04
        )


def _add_legend(figure: Figure, chart: Chart) -> None:
    """Each name once, below the panels."""
    found: dict[str, Any] = {}
    for axes in figure.axes:
        for handle, label in zip(*axes.get_legend_handles_labels(), strict=True):
            found.setdefault(label, handle)
    if len(found) > 1 or (found and chart.legend):
        figure.legend(
            list(found.values()),
            list(found),
            loc="outside lower center",
            fontsize=8,
            ncols=min(len(found), 5),
            title=plain(chart.legend) or None,
        )
