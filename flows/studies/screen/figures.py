"""Charts of a screening: sensitivities per mode, indices of the method, and the choice.

Proposed parameters have one colour, rejected ones another.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from modetune.core.modes import Floats
from modetune.core.updating.subset import column_cosines
from modetune.flows.report.chart import (
    AFTER,
    BEFORE,
    GREY,
    Axis,
    Bars,
    Chart,
    Curve,
    HeatMap,
    Item,
    Panel,
    Rule,
)
from modetune.flows.studies.screen.record import Screening

CHOSEN, OUT, SECOND = AFTER, BEFORE, "#009E73"
#: Number of labelled points in a scatter chart: the strongest.
LABELLED = 5


def screening_charts(screening: Screening) -> dict[str, Chart]:
    """Return the charts of a screening by name."""
    charts = {"sensitivities": local_chart(screening, "frequencies")}
    if screening.local.mac.size:
        charts["sensitivities_mac"] = local_chart(screening, "MAC")
    if screening.indices is not None:
        draw = {"morris": morris_chart, "sobol": sobol_chart, "lhs": regression_chart}
        charts[screening.design.method] = draw[screening.design.method](screening)
    charts["cosines"] = cosine_chart(screening)
    if len(screening.choice.misfits) > 1:
        charts["selection"] = selection_chart(screening)
    return charts


def local_chart(screening: Screening, what: str) -> Chart:
    """Normalised sensitivities at the deck's values, one panel of bars per mode.

    what: `frequencies` (as in figures 49 to 51 and 67 of the thesis), or `MAC`.
    """
    shapes = what == "MAC"
    values = screening.local.mac if shapes else screening.local.frequencies
    unit = "dMAC / (dp/p)" if shapes else "(df/f) / (dp/p)"
    return _bars(screening, f"sensitivity of {what} at the deck's values", values, unit)


def regression_chart(screening: Screening) -> Chart:
    """Regression and rank correlation of frequencies, one panel of bars per mode."""
    found, n = screening.indices, len(screening.numbers)
    assert found is not None
    return _bars(
        screening,
        f"Latin hypercube, {found.used} points",
        found.measure("regression")[:n],
        "coefficient",
        found.measure("rank_correlation")[:n],
        ("standardised regression", "rank correlation"),
    )


def sobol_chart(screening: Screening) -> Chart:
    """First and total Sobol indices of frequencies with 95 % intervals, one panel per mode."""
    found, n = screening.indices, len(screening.numbers)
    assert found is not None
    return _bars(
        screening,
        f"Sobol indices, {found.used} points",
        found.measure("total")[:n],
        "share of the variance",
        found.measure("first")[:n],
        ("total", "first"),
        (found.measure("total_confidence")[:n], found.measure("first_confidence")[:n]),
    )


def morris_chart(screening: Screening) -> Chart:
    """Sigma over mu* of frequencies with the line sigma = mu*, one panel per mode."""
    found, panels = screening.indices, []
    assert found is not None
    chosen = np.array([item.chosen for item in screening.choice.verdicts])
    for mode, title in enumerate(screening.modes):
        mean, spread = (found.measure(name)[mode] for name in ("mu_star", "sigma"))
        reach = 1.12 * float(max(mean.max(), spread.max(), 1e-12))
        strong = set(np.argsort(-np.hypot(mean, spread))[:LABELLED].tolist())
        named = np.array(
            [
                name if place in strong and max(mean[place], spread[place]) > 0.08 * reach else ""
                for place, name in enumerate(screening.names)
            ]
        )
        ends, span = np.array([0.0, reach]), (0.0, reach)
        points = [
            Curve(
                name,
                mean[which],
                spread[which],
                colour,
                "",
                "o",
                size=6.0,
                tooltips=tuple(np.array(screening.names)[which].tolist()),
                labels=tuple(named[which].tolist()),
            )
            for name, which, colour in (("proposed", chosen, CHOSEN), ("left out", ~chosen, OUT))
            if which.any()
        ]
        line = Curve("sigma = mu*", ends, ends, GREY, ":", width=0.8)
        panels.append(
            Panel(
                (line, *points),
                Axis("mu*, df/f over the bounds", span=span),
                Axis("sigma", span=span),
                title,
            )
        )
    return _chart(screening, f"Morris, {found.used} points", panels, (3.4, 2.9))


def cosine_chart(screening: Screening) -> Chart:
    """Cosines between the weighted sensitivity columns of all candidates."""
    panel = _map(screening, column_cosines(screening.local.weighted), "RdBu")
    side = 2.6 + 0.36 * len(screening.names)
    return _chart(screening, "cosines of sensitivity columns", [panel], (side, side - 0.6))


def selection_chart(screening: Screening) -> Chart:
    """The squared residual that remains after each step of forward selection."""
    left = 100.0 * np.array(screening.choice.misfits)
    bars = Bars(
        "",
        left,
        (OUT, *(CHOSEN,) * (left.size - 1)),
        labels=tuple(f"{value:.3g}" for value in left.tolist()),
    )
    names = ("none", *(f"+ {name}" for name in screening.choice.chosen[: left.size - 1]))
    panel = Panel((bars,), Axis(names=names, slant=30), Axis("remaining squared residual, %"))
    return _chart(screening, "forward selection", [panel], (max(4.0, 0.7 * left.size + 1.4), 3.2))


def _chart(
    screening: Screening, title: str, panels: Sequence[Panel], size: tuple[float, float]
) -> Chart:
    across = min(4 if len(panels) > 6 else 3, len(panels))
    return Chart(f"{screening.name}: {title}", title, tuple(panels), across, size)


def _bars(
    screening: Screening,
    title: str,
    values: Floats,
    unit: str,
    second: Floats | None = None,
    labels: Sequence[str] = ("", ""),
    errors: tuple[Floats | None, Floats | None] | None = None,
) -> Chart:
    """Bars of values (n_modes, n_parameters), the most important candidate at the top.

    second: another measure next to the first. labels, errors: names and half widths of both.
    """
    order = list(screening.choice.ranking)
    verdicts = [screening.choice.verdicts[place].chosen for place in order]
    colours = tuple(CHOSEN if chosen else OUT for chosen in verdicts)
    first_errors, second_errors = errors or (None, None)
    nothing = np.zeros(0)
    legend = [
        # A bar series has one name, so the legend explains its colours by curves without points.
        Curve(f"{word}{f': {labels[0]}' if labels[0] else ''}", nothing, nothing, colour, "", "s")
        for word, colour in (("proposed", CHOSEN), ("left out", OUT))
    ]
    y = Axis(names=tuple(screening.names[place] for place in order), turned=True)
    panels = []
    for mode, name in enumerate(screening.modes[: len(values)]):
        spread = None if first_errors is None else first_errors[mode, order]
        items: list[Item] = [Bars("", values[mode, order], colours, spread)]
        if second is not None:
            spread = None if second_errors is None else second_errors[mode, order]
            items.append(Bars(labels[1], second[mode, order], SECOND, spread))
        items += [Rule("", 0.0, "#404040", "-", upright=True), *legend]
        panels.append(Panel(tuple(items), Axis(unit), y, name, sideways=True))
    made = _chart(screening, title, panels, (3.2, max(1.5, 0.7 + 0.17 * len(order))))
    return replace(made, same_y=True, same_x=True)


def _map(screening: Screening, table: Floats, colours: str) -> Panel:
    """A square table of the parameters as a colour map."""
    low = -1.0 if colours == "RdBu" else 0.0
    heat = HeatMap(table, "{row} and {column}: {value:.2f}", "", low, 1.0, colours)
    names = screening.names
    return Panel((heat,), Axis(names=names, slant=60), Axis(names=names, turned=True))
