"""Figures of a posterior: every pair of parameters, and the surrogate against the solver."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from scipy.stats import truncnorm

from modetune.core.modes import Floats
from modetune.flows.report.chart import (
    AFTER,
    BEFORE,
    TEST,
    Axis,
    Chart,
    Curve,
    Panel,
    Rule,
    positions,
)
from modetune.flows.report.matplotlib_charts import new_figure
from modetune.flows.studies.sample.record import PosteriorRecord

#: Cells of a histogram along one parameter, and parameters of which pairs are drawn.
CELLS, SHOWN = 32, 10


def posterior_figures(record: PosteriorRecord) -> dict[str, Figure | Chart]:
    """All figures by name."""
    return {"posterior": corner_figure(record), "surrogate": surrogate_chart(record)}


def corner_figure(record: PosteriorRecord) -> Figure:
    """Densities of all parameters on the diagonal, of all pairs below it.

    Of more than SHOWN parameters those that the test narrowed most.
    """
    shown = np.sort(np.argsort(record.deviation / record.prior_deviation)[:SHOWN])
    n = shown.size
    figure = new_figure(1.9 * n + 1.4, 1.75 * n + 1.3)
    grid = figure.subplots(n, n, squeeze=False)
    edges = [_edges(record, place) for place in shown.tolist()]
    for row, column in np.ndindex(n, n):
        axes = grid[row, column]
        if column > row:
            axes.set_axis_off()
        elif column == row:
            _draw_density(axes, record, int(shown[row]), edges[row])
        else:
            _draw_pair(
                axes, record, (int(shown[column]), int(shown[row])), (edges[column], edges[row])
            )
        axes.tick_params(labelsize=7)
        axes.locator_params(nbins=3)
        if row == n - 1:
            axes.set_xlabel(record.names[shown[column]], fontsize=9)
            axes.tick_params(axis="x", rotation=45)
        else:
            axes.tick_params(labelbottom=False)
        if column == 0 and row:
            axes.set_ylabel(record.names[shown[row]], fontsize=9)
        elif column != row:
            axes.tick_params(labelleft=False)
    if n > 1:
        handles, labels = grid[0, 0].get_legend_handles_labels()
        pairs, named = grid[1, 0].get_legend_handles_labels()
        grid[0, n - 1].legend(handles + pairs, labels + named, loc="upper right", fontsize=8)
    else:
        grid[0, 0].legend(fontsize=8)
    more = len(record.names) - n
    text = f" ({n} of {n + more} parameters)" if more else ""
    figure.suptitle(f"{record.name}: posterior relative to the deck{text}", fontsize=10)
    return figure


def surrogate_chart(record: PosteriorRecord) -> Chart:
    """What the surrogate misses of each response, in standard deviations of the test."""
    names, at = record.training.names, positions(record.training.names)
    items: list[Curve | Rule] = []
    if not record.by_reduced_model:
        items.append(Curve("a run left out", at, record.left_out, BEFORE, "", "o"))
    if np.isfinite(record.check_errors).all():
        name = f"at {len(record.check_keys)} checks"
        items.append(Curve(name, at, record.check_errors, AFTER, "", "x"))
    items.append(Rule("the test's own deviation", 1.0, TEST))
    panel = Panel(
        tuple(items),
        Axis(names=names, slant=90),
        Axis("error of the surrogate / deviation of the test", log=True),
    )
    return Chart(
        record.name,
        "errors of the surrogate",
        (panel,),
        size=(max(4.4, 0.34 * len(names) + 1.2), 3.8),
    )


def _edges(record: PosteriorRecord, place: int) -> Floats:
    """Edges of cells over all but the outermost thousandth of the samples."""
    low, high = np.quantile(record.samples[:, place], [0.0005, 0.9995])
    margin = 0.06 * (high - low) + 1e-12
    ends = (max(low - margin, record.lower[place]), min(high + margin, record.upper[place]))
    return np.asarray(np.linspace(*ends, CELLS + 1), dtype=np.float64)


def _draw_density(axes: Axes, record: PosteriorRecord, place: int, edges: Floats) -> None:
    axes.hist(
        record.samples[:, place],
        bins=edges.tolist(),
        density=True,
        color=BEFORE,
        alpha=0.6,
        label="posterior",
    )
    mean, deviation = record.prior_mean[place], record.prior_deviation[place]
    ends = (record.lower[place] - mean) / deviation, (record.upper[place] - mean) / deviation
    x = np.linspace(edges[0], edges[-1], 200)
    axes.plot(
        x,
        truncnorm.pdf(x, *ends, loc=mean, scale=deviation),
        color=TEST,
        linewidth=1.2,
        label="prior",
    )
    for end in (record.interval_lower[place], record.interval_upper[place]):
        first = end == record.interval_lower[place]
        axes.axvline(
            end,
            color=AFTER,
            linewidth=1.0,
            linestyle="--",
            label="95 % interval" if first else None,
        )
    axes.set_xlim(edges[0], edges[-1])
    axes.set_yticks([])
    axes.set_title(f"{record.mean[place]:.4g} ± {record.deviation[place]:.2g}", fontsize=8)


def _draw_pair(
    axes: Axes, record: PosteriorRecord, places: tuple[int, int], edges: tuple[Floats, Floats]
) -> None:
    x, y = (record.samples[:, place] for place in places)
    axes.hist2d(x, y, bins=(edges[0], edges[1]), cmap="Blues", rasterized=True)
    axes.plot(
        *record.most_likely[list(places)],
        "x",
        color=AFTER,
        markersize=7,
        markeredgewidth=2.0,
        linestyle="none",
        label="most likely",
    )
    near = record.training.points[record.near]
    axes.plot(
        near[:, places[0]],
        near[:, places[1]],
        ".",
        color=TEST,
        markersize=3,
        alpha=0.6,
        linestyle="none",
        label="solver run",
    )
    axes.set_xlim(edges[0][0], edges[0][-1])
    axes.set_ylim(edges[1][0], edges[1][-1])
