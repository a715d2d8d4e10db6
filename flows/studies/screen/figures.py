"""Charts of a screening: sensitivities a mode, indices of the method, and what led to the choice.

Chosen parameters have one colour, those left out another.
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
#: Points of a scatter that are named: the strongest.
LABELLED = 5


def screening_charts(screening: Screening) -> dict[str, Chart]:
    """Every chart that the screening allows, by name."""
    charts = {"sensitivities": local_chart(screening, "frequencies")}
    if screening.local.mac.size:
        charts["sensitivities_mac"] = local_chart(screening, "MAC")
    if screening.indices is not None:
        draw = {"morris": morris_chart, "sobol": sobol_chart}
        method = screening.design.method
        charts[method] = draw.get(method, effect_chart)(screening)
        if screening.indices.interactions.size and len(screening.names) > 1:
            charts["interactions"] = interaction_chart(screening)
    charts["cosines"] = cosine_chart(screening)
    if len(screening.choice.misfits) > 1:
        charts["selection"] = selection_chart(screening)
    return charts


def local_chart(screening: Screening, what: str) -> Chart:
    """Normalised sensitivities at the deck's values, a panel of bars a mode.

    what: `frequencies`, as thesis, figures 49 to 51 and 67, or `MAC`.
    """
    shapes = what == "MAC"
    values = screening.local.mac if shapes else screening.local.frequencies
    unit = "dMAC / (dp/p)" if shapes else "(df/f) / (dp/p)"
    return _bars(screening, f"sensitivity of {what} at the deck's values", values, unit)


def effect_chart(screening: Screening) -> Chart:
    """Effects on frequencies by a Latin hypercube or a full factorial, a panel of bars a mode."""
    found, n = screening.indices, len(screening.numbers)
    assert found is not None
    if screening.design.method == "lhs":
        return _bars(
            screening,
            f"Latin hypercube, {found.used} points",
            found.measure("regression")[:n],
            "coefficient",
            found.measure("rank_correlation")[:n],
            ("standardised regression", "rank correlation"),
        )
    title = f"full factorial, main effects, {found.used} points"
    return _bars(screening, title, found.measure("main_effect")[:n], "df/f over the bounds")


def sobol_chart(screening: Screening) -> Chart:
    """First and total Sobol indices of frequencies with 95 % intervals, a panel a mode."""
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
    """Sigma over mu* of frequencies, a panel a mode; on the line sigma = mu*."""
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
                told=tuple(np.array(screening.names)[which].tolist()),
                written=tuple(named[which].tolist()),
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


def interaction_chart(screening: Screening) -> Chart:
    """Shares of main effects (diagonal) and interactions of two in frequencies, a map a mode."""
    found = screening.indices
    assert found is not None
    panels = [
        _map(
            screening,
            found.interaction_shares[mode] + np.diag(found.measure("main_share")[mode]),
            "Blues",
            name,
        )
        for mode, name in enumerate(screening.modes)
    ]
    return _chart(screening, "shares of main effects and of interactions", panels, (3.4, 3.0))


def cosine_chart(screening: Screening) -> Chart:
    """Cosines between the weighted sensitivity columns of all candidates."""
    panel = _map(screening, column_cosines(screening.local.weighted), "RdBu")
    side = 2.6 + 0.36 * len(screening.names)
    return _chart(screening, "cosines of sensitivity columns", [panel], (side, side - 0.6))


def selection_chart(screening: Screening) -> Chart:
    """What is left of the residual's square as forward selection takes its parameters."""
    left = 100.0 * np.array(screening.choice.misfits)
    bars = Bars(
        "",
        left,
        (OUT, *(CHOSEN,) * (left.size - 1)),
        written=tuple(f"{value:.3g}" for value in left.tolist()),
    )
    names = ("none", *(f"+ {name}" for name in screening.choice.chosen[: left.size - 1]))
    panel = Panel((bars,), Axis(names=names, slant=30), Axis("residual's square left, %"))
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
    """Bars of (n_modes, n_parameters), the candidates from top to bottom by importance.

    second: another measure next to the first; labels: of both; errors: half widths of both.
    """
    order = list(screening.choice.ranking)
    verdicts = [screening.choice.verdicts[place].chosen for place in order]
    colours = tuple(CHOSEN if chosen else OUT for chosen in verdicts)
    first_errors, second_errors = errors or (None, None)
    nothing = np.zeros(0)
    legend = [
        # A bar's name is one of all its bars; the legend has the meaning of their colours.
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


def _map(screening: Screening, table: Floats, colours: str, title: str = "") -> Panel:
    """A square table of the parameters as a map."""
    low = -1.0 if colours == "RdBu" else 0.0
    heat = HeatMap(table, "{row} and {column}: {value:.2f}", "", low, 1.0, colours)
    names = screening.names
    return Panel((heat,), Axis(names=names, slant=60), Axis(names=names, turned=True), title)
