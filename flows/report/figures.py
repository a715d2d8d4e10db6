"""Figures of a model beside its test, one function a figure; each returns it, `save` writes it.

Figures are made without pyplot, so nothing global is touched and any thread may draw. Colours are
those of Okabe and Ito (2008), told apart by everyone; test, before and after have the same colour
and line in all figures.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from matplotlib import colormaps
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from numpy.typing import NDArray

from modetune.core.frf import Complexes
from modetune.core.modes import Floats
from modetune.core.store import writing
from modetune.flows.report.palette import AFTER, BEFORE, PARAMETER_COLOURS, TEST

DPI = 150
#: Colour, line and width of each kind of curve.
STYLES: dict[str, tuple[str, str, float]] = {
    "test": (TEST, "-", 2.2),
    "before": (BEFORE, "-", 1.3),
    "after": (AFTER, "--", 1.5),
}
#: Side of a MAC bar, of the unit square it stands on.
BAR = 0.66


@dataclass(frozen=True, slots=True)
class ResponseCurve:
    """A response function: whose it is, its label, and its values (n_lines,)."""

    kind: Literal["test", "before", "after"]
    label: str
    values: Complexes


def mac_figure(title: str, tables: Sequence[tuple[str, Floats]]) -> Figure:
    """MAC matrices as 3D bars, side by side, each under its heading.

    tables: heading and MAC (n_computed, n_measured) in [0, 1].
    """
    figure = _figure(4.9 * len(tables) + 0.6, 4.6)
    for place, (heading, mac) in enumerate(tables, start=1):
        axes: Any = figure.add_subplot(1, len(tables), place, projection="3d")
        computed, measured = (index.ravel() + 1.0 for index in np.indices(mac.shape))
        heights = mac.ravel()
        axes.bar3d(
            measured - BAR / 2, computed - BAR / 2, np.zeros_like(heights), BAR, BAR,
            np.maximum(heights, 1e-3), color=colormaps["viridis"](Normalize(0.0, 1.0)(heights)),
            edgecolor="#00000040", linewidth=0.4,
        )  # fmt: skip
        axes.set_zlim(0.0, 1.0)
        axes.set_xticks(range(1, mac.shape[1] + 1))
        axes.set_yticks(range(1, mac.shape[0] + 1))
        axes.set_zticks([0.0, 0.2, 0.4, 0.6, 0.8, 1.0])
        axes.set_xlabel("test mode")
        axes.set_ylabel("computed mode")
        axes.set_zlabel("MAC", labelpad=6.0)
        axes.view_init(elev=32.0, azim=-58.0)
        axes.set_box_aspect(None, zoom=0.98)
        axes.set_title(heading, fontsize=10)
    figure.suptitle(title)
    return figure


def frequency_figure(
    title: str, numbers: Sequence[int], test_hz: Floats, before_hz: Floats, after_hz: Floats
) -> Figure:
    """Computed over measured frequencies, before and after, with the 45-degree line.

    numbers: of the modes, (n_modes,), like the frequencies.
    """
    figure = _figure(5.4, 5.2)
    axes = figure.add_subplot()
    largest = 1.06 * float(max(test_hz.max(), before_hz.max(), after_hz.max()))
    axes.plot([0.0, largest], [0.0, largest], color="#808080", linewidth=1.0, label="equal")
    axes.plot(test_hz, before_hz, "o", color=STYLES["before"][0], label="before", markersize=8)
    axes.plot(test_hz, after_hz, "x", color=STYLES["after"][0], label="after", markersize=8,
              markeredgewidth=2.0)  # fmt: skip
    for number, x, y in zip(numbers, test_hz, np.minimum(before_hz, after_hz), strict=True):
        axes.annotate(str(number), (float(x), float(y)), (0.0, -14.0), textcoords="offset points",
                      ha="center", va="center", fontsize=8)  # fmt: skip
    axes.set_xlim(0.0, largest)
    axes.set_ylim(0.0, largest)
    axes.set_aspect("equal")
    axes.set_xlabel("test, Hz")
    axes.set_ylabel("computed, Hz")
    axes.set_title(title)
    axes.grid(alpha=0.3)
    axes.legend()
    return figure


def parameter_figure(
    title: str,
    names: Sequence[str],
    iterations: Sequence[int],
    values: Floats,
    targets: Floats | None = None,
) -> Figure:
    """Parameters over iterations, relative to the deck.

    values: (n_iterations, n_parameters); targets: (n_parameters,), true values where they are
    known, as dotted lines.
    """
    figure = _figure(6.4, 4.2)
    axes = figure.add_subplot()
    for place, name in enumerate(names):
        colour = PARAMETER_COLOURS[place % len(PARAMETER_COLOURS)]
        axes.plot(iterations, values[:, place], "o-", color=colour, label=name, markersize=4)
        if targets is not None:
            axes.axhline(float(targets[place]), color=colour, linestyle=":", linewidth=1.2)
    axes.set_xticks(list(iterations))
    axes.set_xlabel("iteration")
    axes.set_ylabel("value relative to the deck")
    axes.set_title(title)
    axes.grid(alpha=0.3)
    axes.legend(loc="center left", bbox_to_anchor=(1.01, 0.5))
    return figure


def response_figure(
    title: str, unit: str, excitation_hz: Floats, curves: Sequence[ResponseCurve]
) -> Figure:
    """Magnitudes of response functions over frequency, semi-logarithmic, one over the other.

    excitation_hz: (n_lines,); unit: of the response, for the axis.
    """
    figure = _figure(7.2, 4.2)
    axes = figure.add_subplot()
    for curve in curves:
        colour, line, width = STYLES[curve.kind]
        axes.semilogy(excitation_hz, np.abs(curve.values), line, color=colour, linewidth=width,
                      label=curve.label)  # fmt: skip
    axes.set_xlim(float(excitation_hz[0]), float(excitation_hz[-1]))
    axes.set_xlabel("Hz")
    axes.set_ylabel(unit)
    axes.set_title(title)
    axes.grid(alpha=0.3, which="both")
    axes.legend()
    return figure


def mac_map_figure(
    title: str, tables: Sequence[tuple[str, Floats]], numbers: Sequence[int]
) -> Figure:
    """MAC matrices as maps side by side, values written in while there is room.

    tables: heading and MAC (n_computed, n_measured); numbers: of the measured modes.
    """
    n_rows, n_columns = tables[0][1].shape
    figure = _figure(len(tables) * (1.4 + 0.42 * n_columns) + 0.8, 1.5 + 0.36 * n_rows)
    for place, (heading, mac) in enumerate(tables, start=1):
        axes = figure.add_subplot(1, len(tables), place)
        image = axes.imshow(mac, origin="lower", vmin=0.0, vmax=1.0, cmap="viridis", aspect="auto")
        axes.set_xticks(range(n_columns), [str(number) for number in numbers])
        axes.set_yticks(range(n_rows), [str(row + 1) for row in range(n_rows)])
        axes.set_xlabel("test mode")
        axes.set_ylabel("computed mode")
        axes.set_title(heading, fontsize=10)
        for (row, column), value in np.ndenumerate(mac) if mac.size <= 150 else ():
            axes.text(column, row, f"{value:.2f}", ha="center", va="center", fontsize=7,
                      color="black" if value > 0.6 else "white")  # fmt: skip
    figure.colorbar(image, ax=figure.axes, label="MAC", fraction=0.03)
    figure.suptitle(title)
    return figure


def sensitivity_figure(
    title: str,
    numbers: Sequence[int],
    names: Sequence[str],
    matrices: Sequence[tuple[int, Floats]],
) -> Figure:
    """Normalised sensitivities, a chart a mode (as thesis, figures 49 to 51).

    matrices: iteration and (n_modes, n_parameters), at most two of them.
    """
    across = min(3, len(numbers))
    down = -(-len(numbers) // across)
    figure = _figure(3.2 * across + 0.6, 2.1 * down + 1.0)
    grid = figure.subplots(down, across, squeeze=False, sharey=True)
    width = 0.8 / len(matrices)
    colours = (STYLES["before"][0], STYLES["after"][0])
    for mode, axes in enumerate(grid.ravel()):
        if mode >= len(numbers):
            axes.set_axis_off()
            continue
        for place, (iteration, values) in enumerate(matrices):
            at = np.arange(len(names)) + (place - (len(matrices) - 1) / 2) * width
            axes.bar(at, values[mode], width, color=colours[place],
                     label=f"at iteration {iteration}")  # fmt: skip
        axes.set_xticks(range(len(names)), list(names), rotation=40, ha="right", fontsize=7)
        axes.set_title(f"mode {numbers[mode]}", fontsize=9)
        axes.grid(alpha=0.3, axis="y")
    figure.supylabel("(df/f) / (dp/p)", fontsize=9)
    figure.legend(*grid[0, 0].get_legend_handles_labels(), loc="outside lower center", ncols=2)
    figure.suptitle(title)
    return figure


def convergence_figure(
    title: str,
    iterations: Sequence[int],
    residuals: Floats,
    slopes: Floats,
    skipped: NDArray[np.bool_],
    e2: float,
) -> Figure:
    """Residual and slope over iterations; rings where e2 skipped a sensitivity.

    residuals, slopes, skipped: (n_iterations,); e2: NaN or 0 where there is none.
    """
    figure, numbers = _figure(8.0, 3.6), np.array(iterations)
    left, right = figure.subplots(1, 2)
    left.semilogy(numbers, np.where(residuals > 0.0, residuals, np.nan), "o-",
                  color=STYLES["after"][0])  # fmt: skip
    left.set_ylabel("residual |z|")
    known = np.where(slopes > 0.0, slopes, np.nan)
    right.semilogy(numbers, known, "o-", color=STYLES["after"][0], label="slope")
    right.set_ylabel("slope |Δz| / L")
    if skipped.any():
        right.plot(numbers[skipped], known[skipped], "o", color=STYLES["test"][0], markersize=12,
                   fillstyle="none", label="sensitivity skipped (e2)")  # fmt: skip
    if e2 > 0.0:
        right.axhline(e2, color="#808080", linestyle=":", label=f"e2 = {e2:g}")
    for axes in (left, right):
        axes.set_xlabel("iteration")
        axes.set_xticks(numbers[:: max(1, numbers.size // 12)])
        axes.grid(alpha=0.3)
    right.legend()
    figure.suptitle(title)
    return figure


def comac_figure(title: str, labels: Sequence[str], before: Floats, after: Floats) -> Figure:
    """COMAC of each sensor before and after, (n_sensors,)."""
    figure = _figure(max(6.4, min(0.14 * len(labels), 16.0)), 3.8)
    axes, places = figure.add_subplot(), np.arange(len(labels))
    axes.plot(places, before, "o", color=STYLES["before"][0], label="before")
    axes.plot(places, after, "x", color=STYLES["after"][0], label="after", markeredgewidth=2.0)
    every = max(1, len(labels) // 60)
    axes.set_xticks(places[::every], list(labels)[::every], rotation=90, fontsize=7)
    axes.set_ylabel("COMAC")
    axes.grid(alpha=0.3)
    axes.legend()
    axes.set_title(title)
    return figure


def save(figure: Figure, path: Path) -> Path:
    """Write a figure as PNG, or as SVG where the file is named so. Raises StorageUnavailable."""
    form = "svg" if path.suffix == ".svg" else "png"
    with writing(path) as part:
        # Without a date the same figure is the same file.
        figure.savefig(part, format=form, dpi=DPI, metadata={"Date": None} if form == "svg" else {})
    return path


def plain(text: str) -> str:
    """A user's text, in which no sign starts a formula."""
    return text.replace("$", r"\$")


def _figure(width: float, height: float) -> Figure:
    figure = Figure(figsize=(width, height), layout="constrained")
    FigureCanvasAgg(figure)
    return figure
