"""Figures of a screening: sensitivities a mode, indices of the method, and what led to the choice.

Made as those of `figures`. Chosen parameters have one colour, those left out another.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from modetune.core.modes import Floats
from modetune.core.subset import column_cosines
from modetune.flows.report.figures import STYLES, _figure, save
from modetune.flows.screening.record import Screening

CHOSEN, OUT, SECOND = STYLES["after"][0], STYLES["before"][0], "#009E73"
#: Numbers in the cells of a map are left out beyond this many parameters.
NUMBERED = 16
#: Points of a scatter that are named: the strongest.
LABELLED = 5


def write_figures(screening: Screening, folder: Path) -> list[Path]:
    """Write all figures that the screening allows, as PNG. Raises StorageUnavailable."""
    figures = {"sensitivities": local_figure(screening, "frequencies")}
    if screening.local.mac.size:
        figures["sensitivities_mac"] = local_figure(screening, "MAC")
    if screening.indices is not None:
        draw = {"morris": morris_figure, "sobol": sobol_figure}
        method = screening.design.method
        figures[method] = draw.get(method, effect_figure)(screening)
        if screening.indices.interactions.size and len(screening.names) > 1:
            figures["interactions"] = interaction_figure(screening)
    figures["cosines"] = cosine_figure(screening)
    if len(screening.choice.misfits) > 1:
        figures["selection"] = selection_figure(screening)
    return [save(figure, folder / f"{name}.png") for name, figure in figures.items()]


def local_figure(screening: Screening, what: str) -> Figure:
    """Normalised sensitivities at the deck's values, a chart of bars a mode.

    what: `frequencies`, as thesis, figures 49 to 51 and 67, or `MAC`.
    """
    shapes = what == "MAC"
    values = screening.local.mac if shapes else screening.local.frequencies
    unit = "dMAC / (dp/p)" if shapes else "(df/f) / (dp/p)"
    figure = _bars(screening, values, unit)
    figure.suptitle(f"{screening.name}: sensitivity of {what} at the deck's values")
    return figure


def effect_figure(screening: Screening) -> Figure:
    """Effects on frequencies by a Latin hypercube or a full factorial, a chart of bars a mode."""
    found = screening.indices
    assert found is not None
    lhs = screening.design.method == "lhs"
    measures = ("regression", "rank_correlation") if lhs else ("main_effect", "")
    unit = "coefficient" if lhs else "df/f over the bounds"
    n = len(screening.numbers)
    second = found.measure(measures[1])[:n] if lhs else None
    figure = _bars(screening, found.measure(measures[0])[:n], unit, second,
                   ("standardised regression", "rank correlation"))  # fmt: skip
    name = "Latin hypercube" if lhs else "full factorial, main effects"
    figure.suptitle(f"{screening.name}: {name}, {found.used} points")
    return figure


def sobol_figure(screening: Screening) -> Figure:
    """First and total Sobol indices of frequencies with 95 % intervals, a chart a mode."""
    found, n = screening.indices, len(screening.numbers)
    assert found is not None
    figure = _bars(
        screening, found.measure("total")[:n], "share of the variance", found.measure("first")[:n],
        ("total", "first"),
        (found.measure("total_confidence")[:n], found.measure("first_confidence")[:n]),
    )  # fmt: skip
    figure.suptitle(f"{screening.name}: Sobol indices, {found.used} points")
    return figure


def morris_figure(screening: Screening) -> Figure:
    """Sigma over mu* of frequencies, a chart a mode; on the line sigma = mu*."""
    found = screening.indices
    assert found is not None
    figure, grid = _grid(len(screening.numbers), 3.4, 2.9)
    colours = _colours(screening)
    for mode, axes in enumerate(grid):
        mean, spread = (found.measure(name)[mode] for name in ("mu_star", "sigma"))
        reach = 1.12 * float(max(mean.max(), spread.max(), 1e-12))
        axes.plot([0.0, reach], [0.0, reach], color="#808080", linewidth=0.8, linestyle=":")
        axes.scatter(mean, spread, color=colours, zorder=3)
        for place in np.argsort(-np.hypot(mean, spread))[:LABELLED].tolist():
            if max(mean[place], spread[place]) > 0.08 * reach:
                left = mean[place] > 0.7 * reach
                axes.annotate(screening.names[place], (float(mean[place]), float(spread[place])),
                              (-4.0 if left else 4.0, 4.0), textcoords="offset points",
                              ha="right" if left else "left", fontsize=7)  # fmt: skip
        axes.set_xlim(0.0, reach)
        axes.set_ylim(0.0, reach)
        axes.set_title(f"mode {screening.numbers[mode]}", fontsize=9)
        axes.grid(alpha=0.3)
    figure.supxlabel("mu*, df/f over the bounds", fontsize=9)
    figure.supylabel("sigma", fontsize=9)
    figure.suptitle(f"{screening.name}: Morris, {found.used} points")
    return figure


def interaction_figure(screening: Screening) -> Figure:
    """Shares of main effects (diagonal) and interactions of two in frequencies, a map a mode."""
    found = screening.indices
    assert found is not None
    figure, grid = _grid(len(screening.numbers), 3.4, 3.0)
    for mode, axes in enumerate(grid):
        table = found.interaction_shares[mode] + np.diag(found.measure("main_share")[mode])
        _map(axes, table, screening.names, "Blues", 0.0, 1.0)
        axes.set_title(f"mode {screening.numbers[mode]}", fontsize=9)
    figure.suptitle(f"{screening.name}: shares of main effects and of interactions")
    return figure


def cosine_figure(screening: Screening) -> Figure:
    """Cosines between the weighted sensitivity columns of all candidates."""
    side = 2.6 + 0.36 * len(screening.names)
    figure = _figure(side + 0.6, side)
    axes = figure.add_subplot()
    _map(axes, column_cosines(screening.local.weighted), screening.names, "RdBu", -1.0, 1.0)
    figure.colorbar(axes.images[0], ax=axes, fraction=0.04)
    axes.set_title(f"{screening.name}: cosines of sensitivity columns", fontsize=10)
    return figure


def selection_figure(screening: Screening) -> Figure:
    """What is left of the residual's square as forward selection takes its parameters."""
    left = 100.0 * np.array(screening.choice.misfits)
    figure = _figure(max(4.6, 0.7 * left.size + 2.0), 3.6)
    axes = figure.add_subplot()
    axes.bar(range(left.size), left, 0.7, color=[OUT, *(CHOSEN,) * (left.size - 1)])
    for step, value in enumerate(left.tolist()):
        axes.annotate(f"{value:.3g}", (step, value), (0.0, 2.0), textcoords="offset points",
                      ha="center", fontsize=8)  # fmt: skip
    names = screening.choice.chosen[: left.size - 1]
    axes.set_xticks(range(left.size), ["none", *(f"+ {name}" for name in names)], rotation=30,
                    ha="right", fontsize=8)  # fmt: skip
    axes.set_ylabel("residual's square left, %")
    axes.grid(alpha=0.3, axis="y")
    axes.set_title(f"{screening.name}: forward selection", fontsize=10)
    return figure


def _grid(n: int, width: float, height: float, shared: bool = False) -> tuple[Figure, list[Axes]]:
    """A figure of n charts, on one scale where it is shared; those beyond are empty."""
    across = min(4 if n > 6 else 3, n)
    down = -(-n // across)
    figure = _figure(width * across + 0.6, height * down + 0.8)
    charts = figure.subplots(down, across, squeeze=False, sharex=shared).ravel().tolist()
    for axes in charts[n:]:
        axes.set_axis_off()
    return figure, charts[:n]


def _colours(screening: Screening) -> list[str]:
    return [CHOSEN if item.chosen else OUT for item in screening.choice.verdicts]


def _bars(
    screening: Screening,
    values: Floats,
    unit: str,
    second: Floats | None = None,
    labels: Sequence[str] = ("", ""),
    errors: tuple[Floats, Floats] | None = None,
) -> Figure:
    """Bars of (n_modes, n_parameters), the candidates from top to bottom by importance."""
    order = list(screening.choice.ranking)
    figure, grid = _grid(len(values), 3.2, max(1.5, 0.7 + 0.17 * len(order)), shared=True)
    at, colours = np.arange(len(order)), np.array(_colours(screening))[order]
    width = 0.76 if second is None else 0.38
    for mode, axes in enumerate(grid):
        shift = 0.0 if second is None else width / 2
        bars = [(at - shift, values[mode, order], colours.tolist(), 0)]
        if second is not None:
            bars.append((at + shift, second[mode, order], [SECOND] * len(order), 1))
        for places, lengths, colour, row in bars:
            error = None if errors is None else errors[row][mode, order]
            axes.barh(places, lengths, width, color=colour, xerr=error,
                      error_kw={"linewidth": 0.8})  # fmt: skip
        first = mode % (4 if len(values) > 6 else 3) == 0
        axes.set_yticks(at, [screening.names[place] for place in order] if first
                        else [""] * len(order), fontsize=7)  # fmt: skip
        axes.invert_yaxis()
        axes.axvline(0.0, color="#404040", linewidth=0.7)
        axes.set_title(f"mode {screening.numbers[mode]}", fontsize=9)
        axes.tick_params(axis="x", labelsize=7, labelbottom=True)
        axes.grid(alpha=0.3, axis="x")
    _legend(figure, unit, labels if second is not None else ())
    return figure


def _legend(figure: Figure, unit: str, labels: Sequence[str]) -> None:
    """The bars' unit, and what colours mean: proposed or left out, and the second measure."""
    patches = [Patch(color=colour) for colour in (CHOSEN, OUT)]
    said = [f"{word}{f': {labels[0]}' if labels else ''}" for word in ("proposed", "left out")]
    if labels:
        patches.append(Patch(color=SECOND))
        said.append(labels[1])
    figure.legend(patches, said, loc="outside lower center", ncols=3, fontsize=8,
                  title=unit, title_fontsize=8)  # fmt: skip


def _map(
    axes: Axes, table: Floats, names: Sequence[str], colours: str, low: float, high: float
) -> None:
    """A square table as a map; numbers in its cells while there is room."""
    axes.imshow(table, vmin=low, vmax=high, cmap=colours, aspect="auto")
    places = range(len(names))
    axes.set_xticks(places, list(names), rotation=60, ha="right", fontsize=7)
    axes.set_yticks(places, list(names), fontsize=7)
    for (row, column), value in np.ndenumerate(table) if len(names) <= NUMBERED else ():
        axes.text(column, row, f"{value:.2f}", ha="center", va="center", fontsize=6,
                  color="white" if abs(value) > 0.6 else "black")  # fmt: skip
