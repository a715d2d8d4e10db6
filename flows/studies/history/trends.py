"""The runs of a history as rows, tables and charts."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from modetune.core.modes import Floats
from modetune.core.monitoring.past_runs import PastRun
from modetune.flows.report.chart import (
    AFTER,
    BEFORE,
    GREY,
    PARAMETER_COLOURS,
    TEST,
    Axis,
    Chart,
    Curve,
    Panel,
    tick_step,
)
from modetune.flows.report.tables import Column, Table

#: Parameters with a column in the table, and panels of a chart.
COLUMNS, PANELS = 6, 12
#: Repeatability errors on each side of a value that are drawn.
BAND = 2.0
DAY_S = 86_400.0


def run_table(runs: Sequence[PastRun], title: str = "Runs, oldest first") -> Table:
    """Return a row a run: time, state, verdict, agreement, parameters and environment.

    A run whose structure has changed is marked.
    """
    names = tuple(dict.fromkeys(name for run in reversed(runs) for name in run.names))[:COLUMNS]
    quantities = tuple(dict.fromkeys(name for run in runs for name in run.environment))[:COLUMNS]
    columns = (
        Column("run", name="number"),
        Column("time (UTC)", words=True, name="at"),
        Column("structure", words=True, name="state"),
        Column("status", words=True, name="status"),
        Column("parameters", words=True, name="verdict"),
        Column("largest frequency error", "%", ".2f", name="error"),
        *(Column(f"{name}, of deck", "%", ".2f", name=f"parameter {name}") for name in names),
        *(Column(name, form=".4g", name=f"environment {name}") for name in quantities),
    )
    rows = tuple(
        (
            run.number,
            run.at[:16].replace("T", " "),
            run.state,
            run.status.replace("_", " "),
            run.verdict.brief,
            largest_error(run),
            *(relative(run, name) for name in names),
            *(run.environment.get(name, np.nan) for name in quantities),
        )
        for run in runs
    )
    changed = frozenset(
        (place, "state") for place, run in enumerate(runs) if run.state == "changed"
    )
    return Table(title, columns, rows, outside=changed)


def relative(run: PastRun, name: str) -> float:
    """Return a parameter over its deck's value; NaN where the run has no such parameter."""
    if name not in run.names:
        return float("nan")
    place = run.names.index(name)
    return float(run.values[place] / run.references[place])


def frequency_errors(run: PastRun) -> Floats:
    """Return computed minus measured over measured frequencies, (n_modes,); NaN without a pair."""
    return run.updated_hz / run.test_hz - 1.0


def largest_error(run: PastRun) -> float:
    """Return the largest frequency error of a run, a share; NaN without a pair."""
    errors = np.abs(frequency_errors(run))
    return float(np.nanmax(errors)) if np.isfinite(errors).any() else float("nan")


def trend_charts(name: str, runs: Sequence[PastRun]) -> dict[str, Chart]:
    """Return the charts of two runs or more: parameters, frequencies, agreement, environment."""
    if len(runs) < 2:
        return {}
    charts = {
        "parameters": _parameters(name, runs),
        "frequencies": _frequencies(name, runs),
        "agreement": _agreement(name, runs),
        "environment": _environment(name, runs),
    }
    return {key: chart for key, chart in charts.items() if chart is not None}


def _time(runs: Sequence[PastRun]) -> tuple[Floats, Axis]:
    """Return the place of each run along the axis: days, or numbers of runs within one day."""
    times = np.array([run.time for run in runs])
    days = (times - times[0]) / DAY_S
    if np.ptp(days) < 1.0 or (np.diff(days) < 0.0).any():
        numbers = np.array([float(run.number) for run in runs])
        return numbers, Axis("run", step=tick_step(float(np.ptp(numbers))))
    return days, Axis(f"days since {runs[0].at[:10]}")


def _parameters(name: str, runs: Sequence[PastRun]) -> Chart:
    x, axis = _time(runs)
    panels = []
    for parameter in runs[-1].names[:PANELS]:
        values = 100.0 * np.array([relative(run, parameter) for run in runs])
        errors = 100.0 * np.array([_repeatability(run, parameter) for run in runs])
        tooltips = tuple(
            f"{run.at}: {parameter} {value:.2f} % of the deck, repeatability {error:.2g} %"
            + (f"; {run.drift}" if run.drift else "")
            for run, value, error in zip(runs, values, errors, strict=True)
        )
        band = f"{BAND:g} repeatability errors"
        items = [
            Curve(band, x, values + sign * BAND * errors, GREY, ":", width=1.0)
            for sign in (-1.0, 1.0)
        ]
        items.append(Curve("updated", x, values, AFTER, "-", "o", size=4.0, tooltips=tooltips))
        changed = np.array([parameter in run.changed for run in runs])
        if changed.any():
            marked = np.where(changed, values, np.nan)
            items.append(Curve("changed", x, marked, TEST, "", "ring", size=11.0))
        panels.append(Panel(tuple(items), axis, Axis("% of the deck"), parameter))
    return _chart(name, "updated parameters over the runs", panels)


def _repeatability(run: PastRun, name: str) -> float:
    if name not in run.names:
        return float("nan")
    place = run.names.index(name)
    return float(run.repeatability[place] / abs(run.references[place]))


def _frequencies(name: str, runs: Sequence[PastRun]) -> Chart:
    """Measured frequencies over the first run's, in per cent."""
    x, axis = _time(runs)
    labels = tuple(dict.fromkeys(label for run in runs for label in run.modes))[:PANELS]
    items = []
    for place, label in enumerate(labels):
        hz = np.array([_of_mode(run, label) for run in runs])
        first = hz[np.isfinite(hz)][0]
        tooltips = tuple(
            f"{run.at}: mode {label}, {value:.5g} Hz" for run, value in zip(runs, hz, strict=True)
        )
        colour = PARAMETER_COLOURS[place % len(PARAMETER_COLOURS)]
        items.append(
            Curve(
                f"mode {label}, {first:.5g} Hz",
                x,
                100.0 * (hz / first - 1.0),
                colour,
                "-",
                "o",
                size=4.0,
                tooltips=tooltips,
            )
        )
    panel = Panel(tuple(items), axis, Axis("change since its first run, %"))
    return Chart(name, "measured frequencies over the runs", (panel,), size=(7.2, 3.6))


def _of_mode(run: PastRun, label: str) -> float:
    return float(run.test_hz[run.modes.index(label)]) if label in run.modes else float("nan")


def _agreement(name: str, runs: Sequence[PastRun]) -> Chart:
    x, axis = _time(runs)
    errors = 100.0 * np.array([largest_error(run) for run in runs])
    macs = np.array(
        [np.nanmin(run.macs) if np.isfinite(run.macs).any() else np.nan for run in runs]
    )
    panels = [
        Panel(
            (Curve("largest frequency error", x, errors, AFTER, "-", "o", size=4.0),),
            axis,
            Axis("%"),
            "largest frequency error",
        )
    ]
    if np.isfinite(macs).any():
        lowest = Curve("lowest MAC", x, macs, AFTER, "-", "o", size=4.0)
        panels.append(Panel((lowest,), axis, Axis("MAC"), "lowest MAC"))
    return _chart(name, "agreement of the updated model over the runs", panels)


def _environment(name: str, runs: Sequence[PastRun]) -> Chart | None:
    x, axis = _time(runs)
    quantities = tuple(dict.fromkeys(key for run in runs for key in run.environment))[:PANELS]
    panels = []
    for quantity in quantities:
        values = np.array([run.environment.get(quantity, np.nan) for run in runs])
        items = (Curve(quantity, x, values, BEFORE, "-", "o", size=4.0),)
        panels.append(Panel(items, axis, Axis(quantity), quantity))
    return _chart(name, "environment of the tests over the runs", panels) if panels else None


def _chart(name: str, what: str, panels: Sequence[Panel]) -> Chart:
    return Chart(name, what, tuple(panels), min(2, len(panels)), (5.0, 2.6))
