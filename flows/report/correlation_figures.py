"""Figures of two mode sets side by side: MAC as a heat map, frequencies, COMAC by sensor."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from modetune.core.modes import Floats, dof_name
from modetune.flows.correlation.correlate import Correlation, Side
from modetune.flows.report.figures import STYLES, _figure, plain, save

#: Numbers in the cells are left out beyond this many modes, they would be dust.
NUMBERED = 24
#: Sensors of which bars are drawn; the worst where there are more.
BARS = 40


def write_figures(found: Correlation, folder: Path) -> list[Path]:
    """Write all figures that the comparison allows, as PNG. Raises StorageUnavailable."""
    first, second = found.first, found.second
    title = f"{second.label} beside {first.label}"
    paths = []
    if found.mac.size:
        figure = heat_figure(f"MAC: {title}", found.mac, first, second)
        paths.append(save(figure, folder / "mac.png"))
        for name, side, table in (
            ("auto_mac_first", first, found.auto_first),
            ("auto_mac_second", second, found.auto_second),
        ):
            figure = heat_figure(f"auto-MAC of {side.label}", table, side, side)
            paths.append(save(figure, folder / f"{name}.png"))
    if found.pairs:
        paths.append(save(pair_figure(title, found), folder / "frequencies.png"))
    if found.comac.size:
        paths.append(save(comac_figure(title, found), folder / "comac.png"))
    return paths


def heat_figure(title: str, table: Floats, rows: Side, columns: Side) -> Figure:
    """A MAC matrix (n_rows, n_columns) as coloured cells with numbers, mode 1 at the bottom."""
    height, width = table.shape
    figure = _figure(max(4.4, 0.42 * width + 2.2), max(3.6, 0.36 * height + 1.5))
    axes = figure.add_subplot()
    image = axes.imshow(table, origin="lower", cmap="viridis", vmin=0.0, vmax=1.0, aspect="auto")
    axes.set_xticks(range(width), [_tick(columns, place) for place in range(width)], rotation=90)
    axes.set_yticks(range(height), [_tick(rows, place) for place in range(height)])
    axes.tick_params(labelsize=8)
    axes.set_xlabel(plain(f"{columns.label}: mode, Hz"))
    axes.set_ylabel(plain(f"{rows.label}: mode, Hz"))
    axes.set_title(plain(title), fontsize=10)
    if max(height, width) <= NUMBERED:
        for row, column in np.ndindex(height, width):
            value = float(table[row, column])
            if value >= 0.005:  # a field of zeros hides what is to be seen
                axes.text(column, row, f"{value:.2f}", ha="center", va="center", fontsize=7,
                          color="#000000" if value > 0.6 else "#FFFFFF")  # fmt: skip
    figure.colorbar(image, ax=axes, label="MAC")
    return figure


def pair_figure(title: str, found: Correlation) -> Figure:
    """Frequencies of pairs, second over first, with the 45-degree line."""
    figure = _figure(5.6, 5.4)
    axes = figure.add_subplot()
    x = found.first.modes.frequencies_hz[[pair.first for pair in found.pairs]]
    y = found.second.modes.frequencies_hz[[pair.second for pair in found.pairs]]
    largest = 1.06 * float(max(x.max(), y.max()))
    axes.plot([0.0, largest], [0.0, largest], color="#808080", linewidth=1.0, label="equal")
    axes.fill_between([0.0, largest], [0.0, 0.9 * largest], [0.0, 1.1 * largest],
                      color="#808080", alpha=0.15, linewidth=0.0, label="within 10 %")  # fmt: skip
    axes.plot(x, y, "o", color=STYLES["after"][0], markersize=7, label="pairs")
    _number_points(axes, found, np.stack([x, y], axis=1), 0.015 * largest)
    axes.set_xlim(0.0, largest)
    axes.set_ylim(0.0, largest)
    axes.set_aspect("equal")
    axes.set_xlabel(plain(f"{found.first.label}, Hz"))
    axes.set_ylabel(plain(f"{found.second.label}, Hz"))
    axes.set_title(plain(title), fontsize=10)
    axes.grid(alpha=0.3)
    axes.legend(loc="upper left")
    return figure


def comac_figure(title: str, found: Correlation) -> Figure:
    """COMAC (1 is good) and eCOMAC (0 is good) by degree of freedom; the worst where many."""
    worst = [dof for dof, _, _ in found.worst(BARS)]
    places = sorted(found.dofs.index(dof) for dof in worst)
    names = [dof_name(found.dofs[place]) for place in places]
    figure = _figure(max(5.0, 0.24 * len(names) + 1.6), 4.8)
    upper, lower = figure.subplots(2, 1, sharex=True)
    upper.bar(range(len(names)), found.comac[places], color=STYLES["before"][0])
    upper.set_ylim(0.0, 1.0)
    upper.set_xlim(-0.7, len(names) - 0.3)
    upper.set_ylabel("COMAC")
    lower.bar(range(len(names)), found.ecomac[places], color=STYLES["after"][0])
    lower.set_ylabel("eCOMAC")
    lower.set_xticks(range(len(names)), names, rotation=90, fontsize=7)
    more = len(found.dofs) - len(names)
    said = f" (worst {len(names)} of {len(found.dofs)})" if more else ""
    upper.set_title(plain(f"{title}{said}"), fontsize=10)
    for axes in (upper, lower):
        axes.grid(alpha=0.3, axis="y")
    return figure


def _number_points(axes: Axes, found: Correlation, points: Floats, reach: float) -> None:
    """Numbers of the first side's modes beside their points, (n_pairs, 2); close ones together."""
    left = list(range(points.shape[0]))
    while left:
        near = [place for place in left if np.abs(points[place] - points[left[0]]).max() < reach]
        said = ", ".join(str(found.first.numbers[found.pairs[place].first]) for place in near)
        x, y = points[near].max(axis=0).tolist()
        axes.annotate(said, (x, y), (7.0, 0.0), textcoords="offset points", va="center",
                      fontsize=8)  # fmt: skip
        left = [place for place in left if place not in near]


def _tick(side: Side, place: int) -> str:
    return f"{side.numbers[place]}: {side.modes.frequencies_hz[place]:.4g}"
