"""Charts of two mode sets side by side: MAC as a heat map, frequencies, COMAC by sensor."""

from __future__ import annotations

import numpy as np

from modetune.core.modes import Floats, dof_name
from modetune.flows.report.chart import (
    AFTER,
    BEFORE,
    GREY,
    Axis,
    Bars,
    Chart,
    Curve,
    HeatMap,
    Panel,
)
from modetune.flows.studies.correlate.correlation import Correlation, Side

#: Sensors of which bars are drawn; the worst where there are more.
BARS = 40


def correlation_charts(found: Correlation) -> dict[str, Chart]:
    """Every chart that the comparison allows, by name."""
    first, second = found.first, found.second
    title, charts = f"{second.label} and {first.label}", {}
    if found.mac.size:
        charts["mac"] = heat_chart(f"MAC: {title}", found.mac, first, second)
        for name, side, table in (
            ("auto_mac_first", first, found.auto_first),
            ("auto_mac_second", second, found.auto_second),
        ):
            charts[name] = heat_chart(f"auto-MAC of {side.label}", table, side, side)
    if found.pairs:
        charts["frequencies"] = pair_chart(title, found)
    if found.comac.size:
        charts["comac"] = comac_chart(title, found)
    return charts


def heat_chart(title: str, table: Floats, rows: Side, columns: Side) -> Chart:
    """A MAC matrix (n_rows, n_columns) as coloured cells with numbers, mode 1 at the bottom."""
    height, width = table.shape
    heat = HeatMap(table, "mode {row} with mode {column}: MAC {value:.3f}", "MAC")
    panel = Panel(
        (heat,),
        Axis(f"{columns.label}: mode, Hz", _ticks(columns)[:width], slant=90),
        Axis(f"{rows.label}: mode, Hz", _ticks(rows)[:height]),
    )
    size = max(4.4, 0.42 * width + 1.6), max(3.6, 0.36 * height + 1.0)
    return Chart(title, title, (panel,), size=size)


def pair_chart(title: str, found: Correlation) -> Chart:
    """Frequencies of pairs, second over first, with the 45-degree line and lines of 10 %
    difference."""
    x = found.first.modes.frequencies_hz[[pair.first for pair in found.pairs]]
    y = found.second.modes.frequencies_hz[[pair.second for pair in found.pairs]]
    largest = 1.06 * float(max(x.max(), y.max()))
    ends, span = np.array([0.0, largest]), (0.0, largest)
    lines = [
        Curve(name, ends, factor * ends, GREY, line, width=1.0)
        for name, factor, line in (("equal", 1.0, "-"), ("10 % apart", 0.9, ":"),
                                   ("10 % apart", 1.1, ":"))
    ]  # fmt: skip
    told = tuple(
        f"mode {found.first.numbers[pair.first]} and mode {found.second.numbers[pair.second]}: "
        f"{one:.3f} Hz, {other:.3f} Hz"
        for pair, one, other in zip(found.pairs, x, y, strict=True)
    )
    written = _numbered(found, np.stack([x, y], axis=1), 0.015 * largest)
    points = Curve("pairs", x, y, AFTER, "", "o", tooltips=told, labels=written)
    panel = Panel(
        (*lines, points),
        Axis(f"{found.first.label}, Hz", span=span),
        Axis(f"{found.second.label}, Hz", span=span),
        square=True,
    )
    return Chart(title, "frequencies of the pairs", (panel,), size=(5.2, 5.0))


def comac_chart(title: str, found: Correlation) -> Chart:
    """COMAC (1 is good) and eCOMAC (0 is good) by degree of freedom; the worst where many."""
    worst = [dof for dof, _, _ in found.worst(BARS)]
    places = sorted(found.dofs.index(dof) for dof in worst)
    names = tuple(dof_name(found.dofs[place]) for place in places)
    more = len(found.dofs) - len(names)
    text = f" (worst {len(names)} of {len(found.dofs)})" if more else ""
    panels = (
        Panel(
            (Bars("", found.comac[places], BEFORE),),
            Axis(names=names, slant=90),
            Axis("COMAC", span=(0.0, 1.0)),
        ),
        Panel(
            (Bars("", found.ecomac[places], AFTER),), Axis(names=names, slant=90), Axis("eCOMAC")
        ),
    )
    size = max(5.0, 0.24 * len(names) + 1.0), 2.3
    return Chart(f"{title}{text}", "agreement of sensors", panels, size=size)


def _numbered(found: Correlation, points: Floats, reach: float) -> tuple[str, ...]:
    """Return the numbers of the first side's modes next to their points, (n_pairs, 2); close ones
    together."""
    text, left = [""] * points.shape[0], list(range(points.shape[0]))
    while left:
        near = [place for place in left if np.abs(points[place] - points[left[0]]).max() < reach]
        numbers = [str(found.first.numbers[found.pairs[place].first]) for place in near]
        text[near[-1]] = ", ".join(numbers)
        left = [place for place in left if place not in near]
    return tuple(text)


def _ticks(side: Side) -> tuple[str, ...]:
    frequencies = side.modes.frequencies_hz
    return tuple(
        f"{number}: {frequency:.4g}"
        for number, frequency in zip(side.numbers, frequencies, strict=True)
    )
