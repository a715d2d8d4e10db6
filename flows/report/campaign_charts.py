"""The charts of a campaign, for its report and for print.

Each is described once (`chart`); `campaign_charts` yields all charts of a record.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from modetune.core.modes import Floats
from modetune.core.storage.campaign_record import CampaignRecord
from modetune.core.updating.trust import Trust
from modetune.flows.report.chart import (
    AFTER,
    BEFORE,
    GREY,
    PARAMETER_COLOURS,
    TEST,
    Axis,
    Bars,
    Chart,
    Curve,
    HeatMap,
    Panel,
    Rule,
    Towers,
    names_of,
    positions,
    tick_step,
)
from modetune.flows.report.comparison import (
    SensorAgreement,
    fresh_matrices,
    mac_table,
    residual_norm,
    sensor_agreement,
)
from modetune.flows.report.field_tables import FieldMap, brief_record, field_map
from modetune.flows.report.mode_shapes import mode_shapes
from modetune.flows.report.mode_tables import mode_labels, mode_rows
from modetune.flows.report.response_functions import UNITS, ResponseCurve, response_pairs

#: Of a field's map from low to high (viridis in seven steps), and its size in inches.
FIELD_COLOURS = ("#440154", "#443a83", "#31688e", "#21908c", "#35b779", "#8fd744", "#fde725")
MAP = (7.2, 3.2)
PAIR = "test mode {column}, computed mode {row}: MAC {value:.3f}"
#: Lines of a response function that are drawn; finer ones are left out evenly.
MOST_LINES = 2000
#: An L-curve whose residual changes by less is a straight line of rounding: charts have six digits.
LEAST_BEND = 1e-4


def campaign_charts(record: CampaignRecord) -> Iterator[tuple[str, Chart]]:
    """Yield name and chart of everything that a record contains."""
    first, last, title = record.iterations[0], record.best, record.name
    if record.test.has_shapes and mac_table(record, last).size:
        tables = [("before", mac_table(record, first)), ("after", mac_table(record, last))]
        numbers = mode_labels(record)
        yield "mac", mac_towers(title, tables, numbers)
        yield "mac_map", mac_maps(title, tables, numbers)
    rows = mode_rows(record)
    hz = [
        np.array([getattr(row, name) for row in rows])
        for name in ("test_hz", "initial_hz", "updated_hz")
    ]
    yield "frequencies", frequencies(title, [row.label for row in rows], *hz)
    for place, item in enumerate(record.fields):
        yield f"field_{place}", field_chart(field_map(record, item))
    brief = brief_record(record)
    yield "parameters", parameter_histories(brief)
    if len(brief.parameters) > 1 and np.isfinite(brief.correlation).any():
        yield "estimates", estimates(brief)
    if matrices := fresh_matrices(brief):
        yield "sensitivities", sensitivities(brief, matrices)
    yield "convergence", convergence(record)
    found = sensor_agreement(record)
    if found is not None and record.test.has_shapes:
        yield "comac", comac(title, found)
        yield "sensor_shapes", mode_shapes(record).chart()
    curve = record.trust and record.trust.curve
    if record.trust is not None and curve and np.ptp(np.log(curve.misfits)) > LEAST_BEND:
        yield "l_curve", l_curve(record.trust)
    for place, pair in enumerate(response_pairs(record)):
        lines, at = slice(None, None, -(-pair.frequencies_hz.size // MOST_LINES)), pair.compared_hz
        own = lines if at is None else slice(None)
        curves = (
            ResponseCurve("test", "test", pair.measured[lines]),
            ResponseCurve("before", f"before, FRAC {pair.fracs[0]:.2f}", pair.before[own], at),
            ResponseCurve("after", f"after, FRAC {pair.fracs[1]:.2f}", pair.after[own], at),
        )
        unit = UNITS[record.frfs.kind] if record.frfs else ""
        yield f"response_{place}", responses(pair.title, unit, pair.frequencies_hz[lines], curves)


def mac_towers(
    title: str, tables: Sequence[tuple[str, Floats]], numbers: Sequence[object]
) -> Chart:
    """Return MAC matrices as 3D bars, side by side.

    tables has headings and MAC matrices (n_computed, n_measured); numbers are the measured modes'.
    """
    panels = _mac_panels(Towers, tables, numbers)
    return Chart(title, "MAC as bars", panels, len(panels), (4.9, 4.2))


def mac_maps(title: str, tables: Sequence[tuple[str, Floats]], numbers: Sequence[object]) -> Chart:
    """The same as maps, their values labels in while there is room."""
    panels = _mac_panels(HeatMap, tables, numbers)
    n_rows, n_columns = tables[0][1].shape
    size = max(2.8, 1.4 + 0.42 * n_columns), max(2.6, 1.0 + 0.36 * n_rows)
    return Chart(title, "MAC before and after", panels, len(panels), size)


def _mac_panels(
    shown: type[Towers | HeatMap], tables: Sequence[tuple[str, Floats]], numbers: Sequence[object]
) -> tuple[Panel, ...]:
    measured, panels = Axis("test mode", names_of(numbers)), []
    for heading, mac in tables:
        computed = Axis("computed mode", names_of(range(1, mac.shape[0] + 1)))
        panels.append(Panel((shown(mac, PAIR, "MAC"),), measured, computed, heading))
    return tuple(panels)


def frequencies(
    title: str, numbers: Sequence[object], test_hz: Floats, before_hz: Floats, after_hz: Floats
) -> Chart:
    """Return computed over measured frequencies with the 45-degree line, and their errors."""
    names, largest = names_of(numbers), 1.06 * float(np.max((test_hz, before_hz, after_hz)))
    ends, span = np.array([0.0, largest]), (0.0, largest)
    points, bars = [Curve("equal", ends, ends, GREY, width=1.0)], []
    for name, values, colour, mark in (
        ("before", before_hz, BEFORE, "o"),
        ("after", after_hz, AFTER, "x"),
    ):
        tooltips = tuple(
            f"mode {number}: test {x:.3f} Hz, {name} {y:.3f} Hz"
            for number, x, y in zip(names, test_hz, values, strict=True)
        )
        labels = names if name == "after" else ()
        points.append(
            Curve(name, test_hz, values, colour, "", mark, tooltips=tooltips, labels=labels)
        )
        bars.append(Bars(name, 100.0 * (values / test_hz - 1.0), colour))
    panels = (
        Panel(tuple(points), Axis("test, Hz", span=span), Axis("computed, Hz", span=span)),
        Panel(tuple(bars), Axis("test mode", names), Axis("frequency error, %")),
    )
    return Chart(title, "frequencies against the test and their errors", panels, 2, (5.2, 4.2))


def parameter_histories(record: CampaignRecord) -> Chart:
    """Return values relative to the deck by iteration; rejected ones are open and unconnected."""
    items = []
    kept = [item for item in record.iterations if item.accepted]
    tried = [item for item in record.iterations if not item.accepted]
    for place, name in enumerate(record.parameters.names):
        again, shade = divmod(place, len(PARAMETER_COLOURS))
        colour, line = PARAMETER_COLOURS[shade], ("-", "--", ":")[again % 3]
        looks = (kept, "", (line, "o")), (tried, " (not kept)", ("", "ring"))
        for which, text, look in looks:
            values = np.array([item.parameters[place] for item in which])
            tooltips = tuple(f"{name}: {value:.4f}{text}" for value in values)
            numbers = np.array([item.number for item in which])
            if which:
                items.append(
                    Curve(name, numbers, values, colour, *look, size=5.0, tooltips=tooltips)
                )
    panel = Panel(tuple(items), _iteration_axis(record), Axis("value relative to the deck"))
    return Chart(record.name, "parameters by iteration", (panel,), size=(6.4, 4.2))


def field_chart(found: FieldMap) -> Chart:
    """Return a field on its part, and its values by element with two standard errors."""
    ends = np.linspace(found.values.min(), found.values.max() + 1e-12, len(FIELD_COLOURS) + 1)
    classes = np.digitize(found.values, ends[1:-1])
    tooltips = [
        f"element {number}: {value:.3f} ± {error:.3f}"
        for number, value, error in zip(found.elements, found.values, found.errors, strict=True)
    ]
    apart = found.centres - found.centres.mean(axis=0)
    along, across = np.linalg.svd(apart, full_matrices=False)[2][:2] @ apart.T
    reach_along = 1.1 * float(np.abs(along).max())
    reach_across = max(1.1 * float(np.abs(across).max()), MAP[1] / MAP[0] * reach_along)
    dots = []
    for place, colour in enumerate(FIELD_COLOURS):
        own = np.flatnonzero(classes == place)
        if own.size:
            text = tuple(tooltips[row] for row in own)
            name = f"{ends[place]:.3g} to {ends[place + 1]:.3g}"
            dots.append(Curve(name, along[own], across[own], colour, "", "s", tooltips=text))
    order = np.argsort(found.elements, kind="stable")
    x, y, reach = positions(order.tolist()), found.values[order], 2.0 * found.errors[order]
    curves = (
        Curve(
            "value", x, y, AFTER, "-", "o", size=4.0, tooltips=tuple(tooltips[row] for row in order)
        ),
        *(Curve("two standard errors", x, y + way * reach, GREY, ":") for way in (-1.0, 1.0)),
    )
    names = tuple(str(number) for number in found.elements[order])
    values = "value relative to the deck"
    panels = (
        Panel(
            tuple(dots),
            Axis("along the part", span=(-reach_along, reach_along)),
            Axis("across it", span=(-reach_across, reach_across)),
        ),
        Panel(curves, Axis("element", names, 40), Axis(values)),
    )
    return Chart(f"The field {found.name}", f"{values}, on the part", panels, 1, MAP)


def estimates(record: CampaignRecord) -> Chart:
    """Return the correlation of the estimated parameters."""
    names = record.parameters.names
    heat = HeatMap(record.correlation, "{row} and {column}: {value:+.3f}", "", -1.0, 1.0, "RdBu")
    panel = Panel((heat,), Axis(names=names, slant=40), Axis(names=names, turned=True))
    side = max(3.4, 1.6 + 0.4 * len(names))
    return Chart(record.name, "correlation of the parameters", (panel,), size=(side + 0.8, side))


def sensitivities(record: CampaignRecord, matrices: Sequence[tuple[int, Floats]]) -> Chart:
    """Return normalised sensitivities by mode and parameter (as thesis, figures 49 to 51).

    matrices has iteration and (n_modes, n_parameters) of the first and the last.
    """
    labels, colours = [row.label for row in mode_rows(record)], (BEFORE, AFTER)
    panels = tuple(
        Panel(
            tuple(
                Bars(f"at iteration {iteration}", values[mode], colours[place])
                for place, (iteration, values) in enumerate(matrices)
            ),
            Axis(names=record.parameters.names, slant=40),
            Axis("(df/f) / (dp/p)"),
            f"mode {label}",
        )
        for mode, label in enumerate(labels)
    )
    what, columns = "normalised sensitivities of each mode", min(3, len(panels))
    return Chart(record.name, what, panels, columns, (3.2, 2.1), same_y=True)


def convergence(record: CampaignRecord) -> Chart:
    """Return residual and slope by iteration, with e2 and the sensitivities it skipped."""
    items, norms, slopes = record.iterations, [], []
    for name, line, mark, kept in (("kept", "-", "o", True), ("not kept", "", "x", False)):
        chosen = [item for item in items if item.accepted is kept]
        numbers = np.array([item.number for item in chosen])
        if chosen:
            norm = np.array([residual_norm(item) for item in chosen])
            slope = np.array([item.slope for item in chosen])
            norms.append(Curve(name, numbers, _above_zero(norm), AFTER, line, mark))
            slopes.append(Curve(name, numbers, _above_zero(slope), AFTER, line, mark))
    skipped = [item for item in items if item.sensitivity_skipped]
    if skipped:
        numbers = np.array([item.number for item in skipped])
        slope, name = np.array([item.slope for item in skipped]), "sensitivity skipped (e2)"
        slopes.append(Curve(name, numbers, _above_zero(slope), TEST, "", "ring", size=13.0))
    rules = (Rule(f"e2 = {record.e2:g}", record.e2),) if record.e2 > 0.0 else ()
    axis = _iteration_axis(record)
    panels = (
        Panel(tuple(norms), axis, Axis(log=True), "residual |z|"),
        Panel((*slopes, *rules), axis, Axis(log=True), "slope |Δz| / L"),
    )
    return Chart(record.name, "residual, slope", panels, 2, (4.2, 3.2))


def comac(title: str, found: SensorAgreement) -> Chart:
    """Return COMAC of each sensor before and after."""
    at, items = positions(found.labels), []
    looks = ("before", found.before, BEFORE, "o"), ("after", found.after, AFTER, "x")
    for name, values, colour, mark in looks:
        pairs = zip(found.labels, values, strict=True)
        tooltips = tuple(f"{label}, {name}: {value:.3f}" for label, value in pairs)
        items.append(Curve(name, at, values, colour, "", mark, size=6.0, tooltips=tooltips))
    y = Axis("COMAC", span=(found.scale_foot - 0.02, 1.02))
    panel = Panel(tuple(items), Axis(names=found.labels, slant=90), y)
    size = max(6.4, min(0.14 * len(found.labels), 16.0)), 3.4
    return Chart(title, "COMAC of each sensor", (panel,), size=size)


def l_curve(trust: Trust) -> Chart:
    """Return step size over remaining residual for all factors, with the corner and the choice."""
    curve = trust.curve
    assert curve is not None
    tooltips = tuple(
        f"factor {factor:.3g}: residual {left:.3g}, step {size:.3g}"
        for factor, left, size in zip(curve.factors, curve.misfits, curve.sizes, strict=True)
    )
    items = [Curve("all factors", curve.misfits, curve.sizes, GREY, tooltips=tooltips)]
    points = [("corner", curve.corner, TEST, "ring")]
    if trust.regularisation > 0.0:
        points.append(("selected", trust.regularisation, AFTER, "x"))
    for name, factor, colour, mark in points:
        at = [int(np.argmin(np.abs(np.log(curve.factors / factor))))]
        there, label = (curve.misfits[at], curve.sizes[at]), f"{name}: {factor:.3g}"
        items.append(Curve(label, *there, colour, "", mark, size=9.0))
    panel = Panel(
        tuple(items),
        Axis("remaining residual, in standard deviations", log=True),
        Axis("step size, in prior standard deviations", log=True),
    )
    return Chart("L-curve of the last step", "L-curve of the last step", (panel,))


def responses(title: str, unit: str, lines_hz: Floats, curves: Sequence[ResponseCurve]) -> Chart:
    """Return magnitudes of response functions over frequency, with the unit of the response."""
    looks = {"test": (TEST, "-", 2.0), "before": (BEFORE, "-", 1.3), "after": (AFTER, "--", 1.5)}
    items = []
    for curve in curves:
        colour, line, width = looks[curve.kind]
        hz, values = curve.lines_hz, np.abs(curve.values)
        items.append(
            Curve(curve.label, lines_hz, values, colour, line, width=width)
            if hz is None
            else Curve(curve.label, hz, values, colour, "", {"before": "o"}.get(curve.kind, "x"))
        )
    span = (float(lines_hz[0]), float(lines_hz[-1]))
    panel = Panel(tuple(items), Axis("frequency, Hz", span=span), Axis(unit, log=True))
    return Chart(title, title, (panel,), size=(7.2, 3.6))


def _above_zero(values: Floats) -> Floats:
    return np.where(values > 0.0, values, np.nan)


def _iteration_axis(record: CampaignRecord) -> Axis:
    last = record.iterations[-1].number
    return Axis("iteration", step=tick_step(last), span=(-0.3, last + 0.3))
