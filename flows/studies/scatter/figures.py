"""Figures of a scatter study: tests with the predicted ellipses, and the answers' places."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from scipy.stats import chi2

from modetune.core.modes import Floats
from modetune.flows.report.chart import PARAMETER_COLOURS, TEST, Axis, Chart, Curve, Panel
from modetune.flows.studies.scatter.record import ScatterRecord
from modetune.flows.studies.scatter.summary import is_frequency

#: Pairs of neighbours that are drawn, at most; points of an ellipse.
SHOWN, POINTS = 9, 181
LINES = ("-", "--", ":")


def scatter_charts(record: ScatterRecord) -> dict[str, Chart]:
    """All charts that the record gives, by name."""
    charts = {"scatter": scatter_chart(record), "answers": answers_chart(record)}
    return {name: chart for name, chart in charts.items() if chart is not None}


def scatter_chart(record: ScatterRecord) -> Chart | None:
    """Frequencies of each test, of neighbouring modes, with ellipses of 95 %: of the tests, and of
    what each answer predicts. None of one mode."""
    panels = []
    measured = np.nanmean(record.tests, axis=0)
    for x, y in list(pairwise(range(len(record.measured))))[:SHOWN]:
        both = [x, y]
        dots = 100.0 * record.tests[:, both]
        ring = _ellipse(measured[both], record.covariance[np.ix_(both, both)])
        items = [
            Curve("a test", dots[:, 0], dots[:, 1], TEST, "", "o", size=4.0),
            Curve("measured, 95 %", *ring, TEST, "-"),
        ]
        for place, answer in enumerate(record.answers):
            ring = _ellipse(answer.predicted[both], answer.predicted_covariance[np.ix_(both, both)])
            name = f"predicted by {_name(record, place)}, 95 %"
            items.append(Curve(name, *ring, _colour(place), LINES[min(place + 1, 2)]))
        panels.append(Panel(tuple(items), Axis(_told(record, x)), Axis(_told(record, y))))
    return _chart(record, "frequencies from test to test", panels)


def answers_chart(record: ScatterRecord) -> Chart | None:
    """The means that the tests leave possible, of neighbouring parameters, around each answer."""
    panels = []
    for x, y in list(pairwise(range(len(record.names))))[:SHOWN]:
        items = [
            Curve(
                f"{_name(record, place)}, {100 * answer.share:.0f} %",
                answer.draws[:, x],
                answer.draws[:, y],
                _colour(place),
                "",
                "o",
                size=3.0,
            )
            for place, answer in enumerate(record.answers)
        ]
        panels.append(Panel(tuple(items), Axis(record.names[x]), Axis(record.names[y])))
    return _chart(record, "means of the parameters, relative to the deck", panels)


def _told(record: ScatterRecord, place: int) -> str:
    name, unit = record.measured[place], " Hz" if is_frequency(record.measured[place]) else ""
    return f"{name.removeprefix('frequency of ')}: % of {record.sizes[place]:.5g}{unit}"


def _chart(record: ScatterRecord, told: str, panels: list[Panel]) -> Chart | None:
    if not panels:
        return None
    return Chart(f"{record.name}: {told}", told, tuple(panels), min(3, len(panels)), (3.6, 3.4))


def _name(record: ScatterRecord, place: int) -> str:
    return f"answer {place + 1}" if len(record.answers) > 1 else "the answer"


def _colour(place: int) -> str:
    return PARAMETER_COLOURS[(place + 1) % (len(PARAMETER_COLOURS) - 1)]


def _ellipse(mean: Floats, covariance: Floats) -> tuple[Floats, Floats]:
    """Where a normal distribution has 95 %, in per cent."""
    angle = np.linspace(0.0, 2.0 * np.pi, POINTS)
    values, vectors = np.linalg.eigh(covariance)
    root = vectors * np.sqrt(np.maximum(values, 0.0))
    circle = np.sqrt(chi2.ppf(0.95, 2)) * np.array([np.cos(angle), np.sin(angle)])
    x, y = 100.0 * (mean[:, None] + root @ circle)
    return x, y
