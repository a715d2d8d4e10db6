"""Charts of an identification: stable poles, quality of the fit, and auto-MAC of the modes.

The stabilisation diagram is also a page on which the mouse shows the values of each pole.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from modetune.core.measurement.stabilisation import OrderPoles, Stability
from modetune.core.modes import Floats, MeasuredModes
from modetune.flows.report.campaign_charts import responses
from modetune.flows.report.chart import (
    AFTER,
    BEFORE,
    GREY,
    PARAMETER_COLOURS,
    TEST,
    Axis,
    Chart,
    Curve,
    HeatMap,
    Panel,
    Rule,
)
from modetune.flows.report.matplotlib_charts import save_all
from modetune.flows.report.page import write_chart
from modetune.flows.report.response_functions import ResponseCurve
from modetune.flows.studies.identify.identification import Identification

#: Mark, colour, size and name of a pole, by what it agrees in with the order before.
POLES: dict[Stability, tuple[str, str, float, str]] = {
    Stability.NEW: ("o", GREY, 2.0, "new"),
    Stability.FREQUENCY: ("v", BEFORE, 3.5, "frequency"),
    Stability.DAMPING: ("s", PARAMETER_COLOURS[4], 3.5, "frequency, damping"),
    Stability.STABLE: ("+", "#009E73", 5.5, "frequency, damping, shape: stable"),
}


def stabilisation_chart(title: str, found: Identification) -> Chart:
    """Poles over order and frequency, the chosen as lines, above the sum of the functions."""
    total = np.abs(found.frfs.values).sum(axis=1)
    label = f"sum of |{found.frfs.kind}|"
    return _diagram(title, found.orders, found.modes, found.frfs.frequencies_hz, total, label)


def _diagram(
    title: str,
    orders: tuple[OrderPoles, ...],
    modes: MeasuredModes,
    lines: Floats,
    total: Floats,
    label: str,
) -> Chart:
    """Poles of all orders above a curve of the measured responses, (n_lines,), called label."""
    chosen = modes.modes.frequencies_hz.tolist()
    above = [
        Rule("chosen" if place == 0 else "", value, AFTER, "-", upright=True)
        for place, value in enumerate(chosen)
    ]
    below = [Rule("", value, AFTER, "-", upright=True) for value in chosen]
    sums = Curve("", lines, total, TEST, width=1.0)
    span = (float(lines[0]), float(lines[-1]))
    panels = (
        Panel(
            (*(_poles(orders, kind) for kind in POLES), *above),
            Axis(span=span),
            Axis("order (pairs of poles)", span=(0.0, max(item.order for item in orders) + 1.0)),
        ),
        Panel(
            (sums, *below),
            Axis("frequency, Hz", span=span),
            Axis(label, log=True),
        ),
    )
    return Chart(
        title,
        "stabilisation diagram",
        panels,
        size=(9.0, 3.4),
        same_x=True,
        legend="a pole agrees with the order before in",
    )


def synthesis_chart(found: Identification, place: int, word: str) -> Chart:
    """Synthesised over measured function; word: why this one, for the title."""
    curves = [
        ResponseCurve("test", "measured", found.frfs.values[:, place]),
        ResponseCurve("after", "synthesised", found.synthesised[:, place]),
    ]
    title = f"{found.function_name(place)} ({word}), FRAC {found.frac[place]:.4f}"
    return responses(title, found.frfs.kind, found.frfs.frequencies_hz, curves)


def auto_mac_chart(modes: MeasuredModes, auto_mac: Floats) -> Chart:
    """MAC of the modes with themselves, (n_modes, n_modes), as a map with its values."""
    names = tuple(
        f"{place}: {frequency:.4g}"
        for place, frequency in enumerate(modes.modes.frequencies_hz, start=1)
    )
    heat = HeatMap(auto_mac, "{row} with {column}: MAC {value:.3f}", "MAC")
    panel = Panel((heat,), Axis("mode: Hz", names, slant=60), Axis(names=names))
    side = max(3.2, 0.5 * len(names) + 1.2)
    title = "auto-MAC of the identified modes"
    return Chart(title, title, (panel,), size=(side + 0.6, side))


def write_figures(folder: Path, title: str, found: Identification) -> tuple[Path, ...]:
    """All charts of an identification, and the diagram as a page. Raises StorageUnavailable."""
    shown = {"worst": int(found.worst_functions[0])}
    if found.frac.size > 1:
        shown["best"] = int(found.worst_functions[-1])
    if found.driving_points:
        shown["driving point"] = found.driving_points[0]
    diagram = stabilisation_chart(title, found)
    charts = {"stabilisation": diagram, "auto_mac": auto_mac_chart(found.modes, found.auto_mac)}
    charts |= {
        f"synthesis_{word.replace(' ', '_')}": synthesis_chart(found, place, word)
        for word, place in shown.items()
    }
    return (*save_all(charts, folder), write_chart(folder / "stabilisation.html", diagram))


def write_operational_figures(
    folder: Path,
    title: str,
    modes: MeasuredModes,
    auto_mac: Floats,
    orders: tuple[OrderPoles, ...],
    spectrum: tuple[Floats, Floats],
) -> tuple[Path, ...]:
    """Charts of modes from responses alone, the diagram also as a page.

    spectrum: its lines, Hz, and the sum of the responses' spectra. Raises StorageUnavailable.
    """
    diagram = _diagram(title, orders, modes, *spectrum, "sum of the responses' spectra")
    charts = {"stabilisation": diagram, "auto_mac": auto_mac_chart(modes, auto_mac)}
    return (*save_all(charts, folder), write_chart(folder / "stabilisation.html", diagram))


def _poles(orders: tuple[OrderPoles, ...], stability: Stability) -> Curve:
    """All poles of a kind, order over frequency."""
    mark, colour, size, name = POLES[stability]
    kept = [item.stability == stability for item in orders]
    x, damping = (
        np.concatenate([values[mask] for values, mask in zip(found, kept, strict=True)])
        for found in (
            [item.frequencies_hz for item in orders],
            [item.damping_ratios for item in orders],
        )
    )
    y = np.concatenate(
        [
            np.full(np.count_nonzero(mask), float(item.order))
            for item, mask in zip(orders, kept, strict=True)
        ]
    )
    told = tuple(
        f"{frequency:.4f} Hz, damping {ratio:.3%}, order {order:.0f}"
        for frequency, ratio, order in zip(x, damping, y, strict=True)
    )
    return Curve(name, x, y, colour, "", mark, size=size, tooltips=told)
