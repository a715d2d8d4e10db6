"""The report: one HTML file that holds everything it shows and asks nothing of a network.

The page's policy lets run only the three scripts that are written into it, named by their hashes,
and forbids every connection. What users wrote (names, reasons, the campaign) goes in as escaped
text or as JSON, never as markup. Charts are drawn when they come into sight.
"""

from __future__ import annotations

import base64
import hashlib
import json
import shlex
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from jinja2 import Environment, FileSystemLoader, StrictUndefined
from markupsafe import Markup

from modetune.core.storage.files import writing
from modetune.core.storage.keys import Json
from modetune.core.storage.record import CampaignRecord
from modetune.core.updating.judgement import trust_sentences
from modetune.flows.report.comparison import remarks, sensor_agreement
from modetune.flows.report.form_verdict import record_verdict
from modetune.flows.report.headline import headline, number, percent
from modetune.flows.report.held_out_tables import held_out_lines, held_out_table
from modetune.flows.report.iteration_tables import iteration_table, key_table, run_table
from modetune.flows.report.mode_tables import mode_table, pair_table
from modetune.flows.report.parameter_tables import (
    LONG_PARAMETERS,
    parameter_table,
    start_table,
    trust_table,
)
from modetune.flows.report.scene import Scene, scene, told_scene
from modetune.flows.report.tables import signed

if TYPE_CHECKING:
    import plotly.graph_objects as go

HERE = Path(__file__).resolve().parent
#: How each verdict looks.
MOOD = {"trusted": "good", "trusted with reservations": "fair", "not to be trusted": "outside"}


@dataclass(frozen=True, slots=True)
class Drawn:
    """A chart of the page: its title, what it shows, for who cannot see it, and Plotly's JSON."""

    title: str
    told: str
    height: int
    figure: Json


def write_page(record: CampaignRecord, path: Path) -> Path:
    """Write a campaign's report. Raises StorageUnavailable."""
    text = page(record)
    with writing(path, "name another place with --out") as part:
        part.write_text(text, encoding="utf-8")
    return path


def page(record: CampaignRecord) -> str:
    """The report of a campaign as HTML."""
    shown = scene(record)
    charts = _charts(record, shown)
    scripts = (_plotly(), _asset("page.js"), _asset("shapes.js"))
    pairing = [pair_table(record, item) for item in record.iterations]
    text = (
        _templates()
        .get_template("page.html")
        .render(
            record=record,
            headline=headline(record),
            points=remarks(record),
            tolerance=_tolerance(record),
            held_out_lines=[f"{line}." for line in held_out_lines(record.held_out)],
            trust=_trust(record),
            tables={
                "modes": mode_table(record),
                "held_out": held_out_table(record.held_out),
                "parameters": parameter_table(record, LONG_PARAMETERS),
                "trust": record.trust and trust_table(record.trust),
                "starts": start_table(record),
                "iterations": iteration_table(record.iterations),
                "pairing": pairing,
                "runs": run_table(record),
                "jobs": key_table(record),
            },
            best_pairs=pair_table(record, record.best).title,
            charts=charts,
            scene=shown,
            facts=_facts(record),
            command=" ".join(
                [
                    "modetune update CAMPAIGN.yaml",
                    *(f"--set {shlex.quote(s)}" for s in record.settings),
                ]
            ),
            data={
                "charts": {name: drawn.figure for name, drawn in charts.items()},
                "scene": told_scene(shown) if shown else None,
            },
            style=Markup(_asset("page.css")),
            scripts=[Markup(script) for script in scripts],
            policy=Markup(_policy(scripts)),
        )
    )
    return text.lstrip()  # nothing may stand before the document's type


@cache
def _templates() -> Environment:
    made = Environment(
        loader=FileSystemLoader(HERE / "templates"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    made.filters["signed"] = signed
    return made


def _charts(record: CampaignRecord, shown: Scene | None) -> dict[str, Drawn]:
    """Every chart of the page under its name; those in space one for each state."""
    from modetune.flows.report.charts import campaign_charts
    from modetune.flows.report.plotly_charts import plotly_figure, points_in_space

    found = {}
    for name, chart in campaign_charts(record):
        if name == "mac":
            for place, panel in enumerate(chart.panels):
                told = f"MAC {panel.title} as bars"
                figure = plotly_figure(chart.alone(place))
                found[f"mac-{panel.title}"] = _drawn(chart.title, told, figure)
        elif name != "sensor_shapes" or shown is None:
            found[name] = _drawn(chart.title, chart.told, plotly_figure(chart))
    agreement = sensor_agreement(record)
    if "comac" in found and agreement is not None and shown is not None and shown.nodes.size:
        for state, values in (("before", agreement.before), ("after", agreement.after)):
            least = agreement.least_of_points(shown.nodes, values)
            points = [
                f"test point {node}: {value:.3f}"
                for node, value in zip(shown.nodes.tolist(), least, strict=True)
            ]
            figure = points_in_space(
                shown.coordinates,
                shown.edges,
                shown.points,
                least,
                points,
                "COMAC",
                agreement.scale_foot,
            )
            found[f"comac-{state}"] = _drawn("", f"COMAC {state} updating on the sensors", figure)
    return found


def _drawn(title: str, told: str, figure: go.Figure) -> Drawn:
    figure.update_layout(template="none")
    return Drawn(title, told, int(figure.layout.height or 400), json.loads(figure.to_json()))


def _tolerance(record: CampaignRecord) -> str:
    if not np.isfinite(record.e1_frequency):
        return ""
    mac = "" if not record.test.has_shapes else f" and a MAC of at least {record.e1_mac:g}"
    return (
        f"The campaign asks for frequencies within {percent(record.e1_frequency, 3, sign=False)}"
        f"{mac} (e1); what is outside is marked."
    )


def _trust(record: CampaignRecord) -> dict[str, Any] | None:
    """The verdict with its reasons, and the numbers behind them; None where there is none."""
    trust = record.trust
    if trust is None:
        return None
    verdict, *more = trust_sentences(trust)
    found, form = trust.identifiability, record_verdict(record)
    if form is not None and form.sentence in (*trust.concerns, *trust.notes):
        form = None  # it is among the sentences
    numbers = (
        "Singular values of the weighted sensitivity (standard deviations of the test by which one "
        "deviation of a combination of parameters moves it; below 1 the test knows less than was "
        f"known beforehand): {', '.join(number(value, '.3g') for value in found.singular_values)}; "
        f"condition {number(found.condition, '.3g')}; collinearity index of all parameters "
        f"{number(found.collinearity.whole, '.3g')}."
    )
    return {
        "verdict": verdict,
        "mood": MOOD[trust.verdict],
        "more": more,
        "numbers": numbers,
        "form": form and form.sentence,
        "suspected": form and form.form.suspected,
    }


def _facts(record: CampaignRecord) -> list[tuple[str, str]]:
    """What is needed to get the same numbers again, beside the campaign."""
    spread = None if record.trust is None else record.trust.spread
    drawn = (
        "none are used: the same inputs give the same steps"
        if spread is None
        else (f"starts 2 to {len(spread.outcomes)}, drawn with seed {spread.seed}; steps use none")
    )
    # Records of before have a digest of the job's content, without a file's name.
    is_file = " " in record.deck_digest
    deck = "deck, as sha256sum tells it" if is_file else "content key of the deck"
    return [
        ("modetune", record.modetune_version),
        ("solver", f"{record.solver} {record.solver_version}"),
        ("ran with", ", ".join(record.versions) or "not recorded"),
        ("units", record.units or "not recorded"),
        *([(deck, record.deck_digest)] if record.deck_digest else []),
        ("first modal job", record.iterations[0].modal_key),
        ("modal job of the updated model", record.best.modal_key),
        ("random numbers", drawn),
    ]


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
