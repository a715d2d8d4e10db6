"""Figures of an identification: what was stable, how well it fits, and how different the modes are.

Made as those of `figures`; the stabilisation diagram also as a page that tells each pole's values
under the mouse, to pick from.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from modetune.core.modes import Floats
from modetune.core.stabilisation import OrderPoles, Stability
from modetune.core.store import writing
from modetune.flows.identification.identify import Identification
from modetune.flows.report.figures import (
    STYLES,
    ResponseCurve,
    _figure,
    plain,
    response_figure,
    save,
)

#: Symbol, colour, size and name of a pole, by what it agrees in with the order before.
POLES: dict[Stability, tuple[str, str, float, str]] = {
    Stability.NEW: ("o", "#C0C0C0", 2.0, "new"),
    Stability.FREQUENCY: ("v", "#56B4E9", 3.5, "frequency"),
    Stability.DAMPING: ("s", "#E69F00", 3.5, "frequency, damping"),
    Stability.STABLE: ("+", "#009E73", 5.5, "frequency, damping, shape: stable"),
}
LEGEND = "a pole agrees with the order before in"


def stabilisation_figure(title: str, found: Identification) -> Figure:
    """Poles over order and frequency, the chosen as lines, above the sum of the functions."""
    figure = _figure(9.0, 6.4)
    poles, sums = figure.subplots(2, 1, sharex=True, height_ratios=[2.4, 1.0])
    for stability, (symbol, colour, size, name) in POLES.items():
        x, y = _points(found.orders, stability)
        poles.plot(x, y, symbol, color=colour, markersize=size, label=name, linestyle="none")
    for axes in (poles, sums):
        for place, frequency in enumerate(found.modes.modes.frequencies_hz):
            label = "chosen" if axes is poles and place == 0 else None
            axes.axvline(float(frequency), color=STYLES["after"][0], linewidth=0.8, zorder=0.5,
                         label=label)  # fmt: skip
    poles.set_ylabel("order (pairs of poles)")
    poles.set_ylim(0.0, found.settings.order + 1.0)
    poles.set_title(plain(title))
    figure.legend(*poles.get_legend_handles_labels(), loc="outside lower center", ncols=5,
                  title=LEGEND, fontsize=9)  # fmt: skip
    lines = found.frfs.frequencies_hz
    sums.semilogy(lines, _sum(found), color=STYLES["test"][0], linewidth=1.0)
    sums.set_xlim(float(lines[0]), float(lines[-1]))
    sums.set_xlabel("Hz")
    sums.set_ylabel(f"sum of\n|{found.frfs.kind}|")
    sums.grid(alpha=0.3)
    return figure


def synthesis_figure(found: Identification, place: int, word: str) -> Figure:
    """Synthesised over measured function; word: why this one, for the title."""
    curves = [
        ResponseCurve("test", "measured", found.frfs.values[:, place]),
        ResponseCurve("after", "synthesised", found.synthesised[:, place]),
    ]
    title = f"{found.function_name(place)} ({word}), FRAC {found.frac[place]:.4f}"
    return response_figure(title, found.frfs.kind, found.frfs.frequencies_hz, curves)


def auto_mac_figure(found: Identification) -> Figure:
    """MAC of the modes with themselves, as a map with its values."""
    frequencies, mac = found.modes.modes.frequencies_hz, found.auto_mac
    n, side = frequencies.size, 0.5 * frequencies.size
    figure = _figure(max(3.4, side + 1.8), max(3.0, side + 1.2))
    axes = figure.add_subplot()
    image = axes.imshow(mac, vmin=0.0, vmax=1.0, cmap="viridis", origin="lower")
    for row in range(n):
        for column in range(n):
            value = float(mac[row, column])
            axes.text(column, row, f"{value:.2f}", ha="center", va="center", fontsize=7,
                      color="black" if value > 0.6 else "white")  # fmt: skip
    names = [f"{place + 1}: {frequency:.4g}" for place, frequency in enumerate(frequencies)]
    axes.set_xticks(range(n), names, rotation=60, ha="right", rotation_mode="anchor", fontsize=8)
    axes.set_yticks(range(n), names, fontsize=8)
    axes.set_xlabel("mode: Hz")
    axes.set_title("auto-MAC of the identified modes", fontsize=10)
    figure.colorbar(image, ax=axes, shrink=0.85)
    return figure


def write_figures(folder: Path, title: str, found: Identification) -> tuple[Path, ...]:
    """All figures of an identification, and the diagram as a page. Raises StorageUnavailable."""
    shown = {"worst": int(found.worst_functions[0])}
    if found.frac.size > 1:
        shown["best"] = int(found.worst_functions[-1])
    if found.driving_points:
        shown["driving point"] = found.driving_points[0]
    written = [
        save(stabilisation_figure(title, found), folder / "stabilisation.png"),
        save(auto_mac_figure(found), folder / "auto_mac.png"),
    ]
    for word, place in shown.items():
        path = folder / f"synthesis_{word.replace(' ', '_')}.png"
        written.append(save(synthesis_figure(found, place, word), path))
    written.append(_write_page(folder / "stabilisation.html", title, found))
    return tuple(written)


def _write_page(path: Path, title: str, found: Identification) -> Path:
    from plotly import graph_objects
    from plotly.subplots import make_subplots

    page: Any = make_subplots(rows=2, cols=1, shared_xaxes=True, row_heights=[0.7, 0.3],
                              vertical_spacing=0.04)  # fmt: skip
    symbols = {"o": "circle", "v": "triangle-down", "s": "square", "+": "cross"}
    for stability, (symbol, colour, size, name) in POLES.items():
        x, y = _points(found.orders, stability)
        page.add_trace(
            graph_objects.Scattergl(
                x=x, y=y, mode="markers", name=name, customdata=_damping(found.orders, stability),
                marker={"symbol": symbols[symbol], "color": colour, "size": max(5.0, 1.4 * size)},
                hovertemplate="%{x:.4f} Hz<br>damping %{customdata:.3%}<br>order %{y}",
            ), row=1, col=1,
        )  # fmt: skip
    sums = graph_objects.Scattergl(x=found.frfs.frequencies_hz, y=_sum(found), showlegend=False,
                                   line={"color": STYLES["test"][0], "width": 1})  # fmt: skip
    page.add_trace(sums, row=2, col=1)
    for frequency in found.modes.modes.frequencies_hz.tolist():
        page.add_vline(frequency, line_color=STYLES["after"][0], line_width=1.0, layer="below")
    page.update_yaxes(title_text="order (pairs of poles)", row=1, col=1)
    page.update_yaxes(type="log", title_text=f"sum of |{found.frfs.kind}|", row=2, col=1)
    page.update_xaxes(showgrid=False)
    page.update_xaxes(title_text="Hz", row=2, col=1)
    page.update_layout(title=title, template="plotly_white", height=760, legend_title=LEGEND)
    with writing(path) as part:
        part.write_text(page.to_html(include_plotlyjs=True, full_html=True), encoding="utf-8")
    return path


def _points(orders: tuple[OrderPoles, ...], stability: Stability) -> tuple[Floats, Floats]:
    """Frequencies and orders of all poles of a kind."""
    kept = [item.stability == stability for item in orders]
    x = [item.frequencies_hz[mask] for item, mask in zip(orders, kept, strict=True)]
    y = [np.full(np.count_nonzero(mask), float(item.order))
         for item, mask in zip(orders, kept, strict=True)]  # fmt: skip
    return np.concatenate(x), np.concatenate(y)


def _damping(orders: tuple[OrderPoles, ...], stability: Stability) -> Floats:
    return np.concatenate([item.damping_ratios[item.stability == stability] for item in orders])


def _sum(found: Identification) -> Floats:
    return np.asarray(np.abs(found.frfs.values).sum(axis=1))
