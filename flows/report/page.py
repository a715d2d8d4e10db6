"""The report: one self-contained HTML file without network access.

The page's security policy allows only its own scripts, identified by their hashes, and no
connections. Text from users (names, reasons, the campaign) is escaped or JSON, never markup. The
page's scripts draw charts and shapes from values, charts when they scroll into view.
"""

from __future__ import annotations

import base64
import hashlib
import re
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from jinja2 import Environment, FileSystemLoader, StrictUndefined
from markupsafe import Markup, escape

from modetune.core.errors import CampaignError
from modetune.core.storage.campaign_record import CampaignRecord
from modetune.core.storage.files import writing
from modetune.core.storage.keys import Json
from modetune.core.updating.responses.frf import Frf
from modetune.core.updating.trust import trust_sentences
from modetune.flows.report.campaign_charts import campaign_charts
from modetune.flows.report.chart import Chart, chart_json
from modetune.flows.report.comparison import remarks, sensor_agreement
from modetune.flows.report.field_tables import brief_record
from modetune.flows.report.form_verdict import record_verdict
from modetune.flows.report.headline import headline, number, percent
from modetune.flows.report.iteration_tables import iteration_table, key_table, run_table
from modetune.flows.report.mode_tables import held_out_lines, held_out_table, mode_table, pair_table
from modetune.flows.report.parameter_tables import (
    LONG_PARAMETERS,
    parameter_table,
    start_table,
    trust_table,
)
from modetune.flows.report.response_tables import response_table
from modetune.flows.report.scene import Scene, scene, scene_json
from modetune.flows.report.tables import Table, signed

HERE = Path(__file__).resolve().parent
#: Rows of a table that comes after the charts.
LONG = 40
#: Maximum number of singular values to print: a field has hundreds.
MOST_NUMBERS = 40
#: Size of the summary's picture in inches: on a phone's first screen with the verdict.
PICTURE = (5.2, 2.5)


#: A hyphen before a number.
MINUS = re.compile(r"(?<=[\s(])-(?=\d)")
#: The page's scripts, in the order in which they run; the first four need no others.
SCRIPTS = ("space.js", "charts.js", "gif.js", "shapes.js", "page.js")


def write_page(record: CampaignRecord, path: Path) -> Path:
    """Write a campaign's report. Raises StorageUnavailable."""
    text = page(record)
    with writing(path, "name another place with --out") as part:
        part.write_text(text, encoding="utf-8")
    return path


def write_chart(path: Path, chart: Chart) -> Path:
    """Write one chart as an interactive page. Raises StorageUnavailable."""
    return written_page(path, "chart.html", f"{chart.title} - modetune", {"chart": chart})


def written_page(
    path: Path, template: str, title: str, charts: Mapping[str, Chart], **shown: Any
) -> Path:
    """Write a page of charts and the other values of its template. Raises StorageUnavailable."""
    scripts = tuple(_asset(name) for name in ("space.js", "charts.js", "page.js"))
    data = {"charts": {name: chart_json(chart) for name, chart in charts.items()}}
    made = _templates().get_template(template)
    text = made.render(charts=charts, data=data, **shown, **_frame(title, scripts))
    with writing(path, "name another place for it") as part:
        part.write_text(text.lstrip(), encoding="utf-8")
    return path


def page(record: CampaignRecord) -> str:
    """Return the report of a campaign as HTML."""
    shown, brief = scene(record), brief_record(record)
    charts, comac = _charts(record, shown), _comac(record, shown)
    scripts = tuple(_asset(name) for name in SCRIPTS)
    pairing = [pair_table(record, item) for item in record.iterations]
    text = (
        _templates()
        .get_template("page.html")
        .render(
            record=record,
            headline=headline(record),
            points=remarks(brief),
            tolerance=_tolerance(record),
            held_out_lines=held_out_lines(record.held_out),
            trust=_trust(record),
            tables={
                "modes": mode_table(record),
                "responses": response_table(record),
                "held_out": held_out_table(record.held_out),
                "parameters": parameter_table(brief, LONG_PARAMETERS),
                "trust": brief.trust and trust_table(brief.trust),
                "starts": start_table(record),
                "iterations": iteration_table(record.iterations),
                "pairing": pairing,
                "runs": run_table(record),
                "jobs": key_table(record),
            },
            best_pairs=pair_table(record, record.best).title,
            charts=charts,
            compares_functions=record.best.residual.has(Frf.kind),
            scene=shown,
            facts=_facts(record),
            command=" ".join(
                [
                    "modetune update CAMPAIGN.yaml",
                    *(f"--set {shlex.quote(s)}" for s in record.settings),
                ]
            ),
            comac=comac,
            data={
                "charts": {name: chart_json(chart) for name, chart in charts.items()},
                "scene": scene_json(shown) if shown else None,
                "comac": comac,
            },
            **_frame(f"{record.name} - modetune report", scripts),
        )
    )
    return text.lstrip()  # the document's type must come first


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
    made.filters["prose"] = prose
    made.filters["breakable"] = breakable
    return made


def breakable(name: str) -> Markup:
    """Return a name that a narrow column breaks behind its underscores, points and hyphens."""
    return Markup(re.sub(r"([_.-])", r"\1<wbr>", str(escape(name))))


def prose(text: str) -> Markup:
    """Format a sentence: a capital first (except e1, e2 and files), a stop last, a real minus.

    A percent sign stays with its number; text between backticks is code.
    """
    if not text[1:2].isdigit() and "." not in text.partition(" ")[0].rstrip(".,:"):
        text = text[:1].upper() + text[1:]
    text = MINUS.sub("\N{MINUS SIGN}", text).replace(" %", "\N{NO-BREAK SPACE}%")
    if text[-1:] not in ".?!:":
        text += "."
    parts = str(escape(text)).split("`")
    return Markup(
        "".join(f"<code>{part}</code>" if at % 2 else part for at, part in enumerate(parts))
    )


def _charts(record: CampaignRecord, shown: Scene | None) -> dict[str, Chart]:
    """All charts of the page by name; shapes over the sensors only without a scene."""
    found = dict(campaign_charts(record))
    picture = found["frequencies"].alone(1)
    found["errors"] = replace(picture, description="frequency errors", size=PICTURE)
    if shown is not None:
        found.pop("sensor_shapes", None)
    return found


def _comac(record: CampaignRecord, shown: Scene | None) -> Json:
    """The minimum COMAC of each point of the scene, before and after; null without a scene."""
    agreement = sensor_agreement(record) if record.test.has_shapes else None
    if agreement is None or shown is None or not shown.nodes.size:
        return None
    return {
        "foot": agreement.scale_foot,
        "before": agreement.least_of_points(shown.nodes, agreement.before),
        "after": agreement.least_of_points(shown.nodes, agreement.after),
    }


def _tolerance(record: CampaignRecord) -> str:
    if not np.isfinite(record.e1_frequency):
        return ""
    mac = "" if not record.test.has_shapes else f" and a MAC of at least {record.e1_mac:g}"
    return (
        f"Tolerance e1: frequencies within {percent(record.e1_frequency, 3, sign=False)}{mac}; "
        "values outside are marked."
    )


def _trust(record: CampaignRecord) -> dict[str, Any] | None:
    """The reasons of the verdict and the numbers behind it; None without a verdict."""
    trust = record.trust
    if trust is None:
        return None
    _, *more = trust_sentences(trust)
    found, form = trust.identifiability, record_verdict(record)
    if form is not None and form.sentence in (*trust.concerns, *trust.notes):
        form = None  # it is among the sentences
    singular = ", ".join(number(value, ".3g") for value in found.singular_values[:MOST_NUMBERS])
    numbers = (
        "Singular values of the weighted sensitivity (change of the responses in standard "
        "deviations per prior standard deviation of a parameter combination; below 1 the prior "
        f"dominates): {singular}; "
        f"condition {number(found.condition, '.3g')}; collinearity index of all parameters "
        f"{number(found.collinearity.whole, '.3g')}."
    )
    return {
        "more": more,
        "numbers": numbers,
        "form": form and form.sentence,
        "suspected": form and form.form.suspected,
    }


def _facts(record: CampaignRecord) -> list[tuple[str, str]]:
    """Return what reproduces the numbers in addition to the campaign."""
    spread = None if record.trust is None else record.trust.spread
    drawn = (
        "not used"
        if spread is None
        else f"starts 2 to {spread.n_starts}, drawn with seed {spread.seed}; not in steps"
    )
    # Older records have a digest of the job's content, without a file name.
    is_file = " " in record.deck_digest
    deck = "SHA-256 of the deck" if is_file else "content key of the deck"
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


def _frame(title: str, scripts: tuple[str, ...]) -> dict[str, Any]:
    return {
        "title": title,
        "style": Markup(_asset("page.css")),
        "scripts": [Markup(script) for script in scripts],
        "policy": Markup(_policy(scripts)),
    }


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
def _asset(name: str) -> str:
    return (HERE / name).read_text(encoding="utf-8")


def check_page(path: Path | None) -> None:
    """Refuse a page of another kind of file before the work is done. Raises CampaignError."""
    if path is not None and (path.suffix.lower() not in (".html", ".htm") or path.is_dir()):
        raise CampaignError(f"--page {path}: expected a file name that ends in .html")


def write_study(
    path: Path,
    title: tuple[str, str],
    tables: Sequence[Table],
    lines: Sequence[str],
    doubts: Sequence[str],
    charts: Mapping[str, object],
) -> Path:
    """Write a study's page with its interactive charts. Raises StorageUnavailable.

    title has the study's name and the campaign's; doubts are the lines that come first.
    """
    kind, name = title
    long_tables = [table for table in tables if charts and len(table.rows) > LONG]
    return written_page(
        path,
        "study.html",
        f"{name} - modetune {kind}",
        {name: chart for name, chart in charts.items() if isinstance(chart, Chart)},
        kind=kind,
        name=name,
        tables=[table for table in tables if table not in long_tables],
        long_tables=long_tables,
        doubts=doubts,
        lines=[line for line in lines if line not in doubts],
    )
