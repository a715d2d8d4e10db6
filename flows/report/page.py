"""The report: one HTML file that holds everything it shows and asks nothing of a network.

The page's policy lets run only the three scripts that are written into it, named by their hashes,
and forbids every connection. What users wrote (names, reasons, the campaign) goes in as escaped
text or as JSON, never as markup. Charts are drawn when they come into sight.
"""

from __future__ import annotations

import base64
import hashlib
import json
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from modetune.core.keys import Json
from modetune.core.record import CampaignRecord
from modetune.core.store import writing
from modetune.flows.report import charts, provenance, sections, space_charts
from modetune.flows.report.comparison import (
    fresh_matrices,
    mac_table,
    mode_label,
    mode_rows,
    sensor_agreement,
)
from modetune.flows.report.held_out import held_out_section
from modetune.flows.report.markup import Html, chart_text, element, joined, markup, paragraph
from modetune.flows.report.responses import response_charts
from modetune.flows.report.scene import Scene, scene
from modetune.flows.report.scene_data import told_scene
from modetune.flows.report.trust import l_curve_chart, trust_words

if TYPE_CHECKING:
    import plotly.graph_objects as go

HERE = Path(__file__).resolve().parent


@dataclass(frozen=True, slots=True)
class Section:
    """A part of the page: its anchor, title, and content."""

    anchor: str
    title: str
    content: Html


class Drawn:
    """The charts of a page, each under the name of its place."""

    def __init__(self) -> None:
        self.figures: dict[str, str] = {}

    def place(self, name: str, figure: go.Figure, told: str) -> Html:
        """A place for a chart; told: what it shows, for who cannot see it."""
        figure.update_layout(template="none")
        self.figures[name] = figure.to_json()
        height = int(figure.layout.height or 400)
        return Html(
            f'<div class="chart" id="chart-{name}" data-chart="{name}" role="img" '
            f'aria-label="{markup(told)}" style="min-height:{height}px"></div>'
        )


def write_page(record: CampaignRecord, path: Path) -> Path:
    """Write a campaign's report. Raises StorageUnavailable."""
    text = page(record)
    with writing(path, "name another place with --out") as part:
        part.write_text(text, encoding="utf-8")
    return path


def page(record: CampaignRecord) -> str:
    """The report of a campaign as HTML."""
    drawn, shown = Drawn(), scene(record)
    parts = [part for part in _sections(record, drawn, shown) if part.content.source]
    data = {"charts": {name: json.loads(text) for name, text in drawn.figures.items()},
            "scene": told_scene(shown) if shown else None}  # fmt: skip
    contents = joined([
        Html(f'<li><a href="#{part.anchor}">{markup(part.title)}</a></li>') for part in parts
    ])  # fmt: skip
    body = joined([
        Html(f'<section id="{part.anchor}"><h2>{markup(part.title)}</h2>{part.content.source}'
             "</section>")
        for part in parts
    ])  # fmt: skip
    scripts = (_plotly(), _asset("page.js"), _asset("shapes.js"))
    return (
        "<!DOCTYPE html>\n<html lang=\"en\">\n<head>\n<meta charset=\"utf-8\">\n"
        f'<meta http-equiv="Content-Security-Policy" content="{_policy(scripts)}">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        '<meta name="color-scheme" content="light dark">\n'
        f"<title>{markup(record.name)} - modetune report</title>\n"
        f"<style>{_asset('page.css')}</style>\n</head>\n<body>\n"
        f"<header><div><p class=\"kind\">modetune report</p><h1>{markup(record.name)}</h1>"
        f"<p class=\"sub\">{markup(_subtitle(record))}</p></div></header>\n"
        f"<div class=\"columns\"><nav><p>Contents</p><ol>{contents.source}</ol></nav>\n"
        f"<main>{body.source}</main></div>\n"
        f'<script type="application/json" id="data">{_json(data)}</script>\n'
        + "".join(f"<script>{script}</script>\n" for script in scripts)
        + "</body>\n</html>\n"
    )  # fmt: skip


def _subtitle(record: CampaignRecord) -> str:
    return (
        f"{record.solver} {record.solver_version} · {len(record.parameters)} parameters · "
        f"{len(record.test.numbers)} measured modes · modetune {record.modetune_version}"
    )


def _sections(record: CampaignRecord, drawn: Drawn, shown: Scene | None) -> list[Section]:
    """All sections; those with nothing to tell are empty."""
    return [
        Section("summary", "Summary", sections.headline(record)),
        Section("remarks", "Points to look at", sections.points_to_look_at(record)),
        Section("modes", "Modes", _modes(record, drawn)),
        Section("held-out", "Held out", held_out_section(record)),
        Section("correlation", "Correlation of shapes", _correlation(record, drawn)),
        Section("shapes", "Mode shapes", _shapes(record, drawn, shown)),
        Section("sensors", "Agreement of sensors", _sensors(record, drawn, shown)),
        Section("parameters", "Parameters", _parameters(record, drawn)),
        Section("trust", "How far this can be trusted", _trust(record, drawn)),
        Section("sensitivities", "Sensitivities", _sensitivities(record, drawn)),
        Section("convergence", "Convergence", _convergence(record, drawn)),
        Section("responses", "Frequency responses", _responses(record, drawn)),
        Section("pairing", "Pairing", sections.pairing_tables(record)),
        Section("runs", "Solver runs", provenance.runs_table(record)),
        Section("repeat", "To repeat it", provenance.repetition(record)),
    ]


def _modes(record: CampaignRecord, drawn: Drawn) -> Html:
    figure = charts.frequency_lines(mode_rows(record))
    chart = drawn.place("frequencies", figure, "frequencies against the test and their errors")
    return sections.modes_table(record) + sections.tolerance_note(record) + chart


def _correlation(record: CampaignRecord, drawn: Drawn) -> Html:
    before, after = (mac_table(record, item) for item in (record.iterations[0], record.best))
    if before.size == 0 or not record.test.has_shapes:
        return Html("")
    numbers = [chart_text(mode_label(record, number)) for number in record.test.numbers]
    bars = [
        element("figure", element("figcaption", name) + drawn.place(
            f"mac-{name}", space_charts.mac_bars(mac, numbers), f"MAC {name} as bars"))
        for name, mac in (("before", before), ("after", after))
    ]  # fmt: skip
    maps = drawn.place("mac-maps", charts.mac_maps(before, after, numbers), "MAC before and after")
    told = paragraph(
        "Modal assurance criterion of the model's elastic modes with the measured ones, at the "
        "sensors: 1 is the same shape, 0 nothing in common. Turn the bars with the mouse.", "note",
    )  # fmt: skip
    return told + element("div", joined(bars), "pair") + maps


def _shapes(record: CampaignRecord, drawn: Drawn, shown: Scene | None) -> Html:
    if shown is not None:
        return Html(_asset("shapes.html"))
    if sensor_agreement(record) is None:
        return Html("")
    return drawn.place("sensor-shapes", charts.sensor_shapes(record), "shapes over the sensors")


def _sensors(record: CampaignRecord, drawn: Drawn, shown: Scene | None) -> Html:
    found = sensor_agreement(record)
    if found is None or not record.test.has_shapes:
        return Html("")
    told = paragraph(
        "Coordinate MAC over all paired modes: a sensor that stands out low is often swapped, "
        "loose or mounted elsewhere than the model believes. A sign alone does not show here.",
        "note",
    )  # fmt: skip
    space = Html("")
    if shown is not None and shown.nodes.size:
        figures = [
            element("figure", element("figcaption", name) + drawn.place(
                f"comac-{name}", space_charts.comac_points(shown, found, values),
                f"COMAC {name} updating on the sensors"))
            for name, values in (("before", found.before), ("after", found.after))
        ]  # fmt: skip
        space = element("div", joined(figures), "pair")
    return told + space + drawn.place("comac", charts.sensor_marks(found), "COMAC of each sensor")


def _parameters(record: CampaignRecord, drawn: Drawn) -> Html:
    parts = [
        sections.parameters_table(record),
        drawn.place("histories", charts.parameter_histories(record), "parameters by iteration"),
    ]
    if len(record.parameters) > 1 and np.isfinite(record.correlation).any():
        names = [chart_text(name) for name in record.parameters.names]
        parts += [
            element("h3", "Correlation of the estimates"),
            paragraph("Near ±1 the test tells the two parameters' combined effect only.", "note"),
            drawn.place("estimates", charts.correlation_map(names, record.correlation),
                        "correlation of the parameters"),
        ]  # fmt: skip
    return joined(parts)


def _trust(record: CampaignRecord, drawn: Drawn) -> Html:
    if record.trust is None or record.trust.curve is None:
        return trust_words(record)
    return joined([
        trust_words(record),
        element("h3", "L-curve of the last step"),
        drawn.place("l-curve", l_curve_chart(record.trust), "L-curve of the last step"),
    ])  # fmt: skip


def _sensitivities(record: CampaignRecord, drawn: Drawn) -> Html:
    matrices = fresh_matrices(record)
    if not matrices:
        return Html("")
    names = [chart_text(name) for name in record.parameters.names]
    numbers = [chart_text(mode_label(record, record.test.numbers[place]))
               for place in record.iterations[0].pairing.measured]  # fmt: skip
    told = paragraph(
        "Change of each natural frequency in percent where a parameter changes by one percent, at "
        "the first and the last set a sensitivity was computed at.", "note",
    )  # fmt: skip
    figure = charts.sensitivity_bars(numbers, names, matrices)
    return told + drawn.place("sensitivities", figure, "normalised sensitivities of each mode")


def _convergence(record: CampaignRecord, drawn: Drawn) -> Html:
    chart = drawn.place("convergence", charts.convergence(record), "residual, slope")
    told = paragraph(
        "The norm of the residual and its change for each parameter, which e2 is compared with. "
        "The weighted residual of the table is what a step brings down; its weights grow as shapes "
        "come near the test's, so it may rise from one iteration to the next.", "note",
    )  # fmt: skip
    return told + chart + provenance.iterations_table(record)


def _responses(record: CampaignRecord, drawn: Drawn) -> Html:
    found = response_charts(record)
    if not found:
        return Html("")
    told = paragraph(
        "Measured functions beside those superposed from the model's elastic modes with the test's "
        "damping; rigid motion and modes above the computed ones are not in them.", "note",
    )  # fmt: skip
    return told + joined([
        element("h3", title) + drawn.place(f"response-{place}", figure, title)
        for place, (title, figure) in enumerate(found)
    ])  # fmt: skip


def _json(data: Json) -> str:
    """JSON that no browser takes for the end of a script."""
    text = json.dumps(data, separators=(",", ":"))
    return text.replace("&", "\\u0026").replace("<", "\\u003c").replace(">", "\\u003e")


def _policy(scripts: tuple[str, ...]) -> str:
    hashes = " ".join(
        f"'sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}'"
        for text in scripts
    )
    return (
        f"default-src 'none'; script-src {hashes}; style-src 'unsafe-inline'; "
        "img-src data: blob:; base-uri 'none'; form-action 'none'"
    )


@cache
def _plotly() -> str:
    from plotly.offline import get_plotlyjs

    text = str(get_plotlyjs()).replace("</script", "<\\/script")
    # A browser reads CR LF as LF, and the hash is of what it reads.
    return text.replace("\r\n", "\n").replace("\r", "\n")


@cache
def _asset(name: str) -> str:
    return (HERE / name).read_text(encoding="utf-8")
