"""Prefect artifacts of a run: result tables, a MAC picture, progress, links to the files.

They are made from records, without a server. A key joins the names of campaign and artifact, so
that Prefect shows the history of an artifact over several runs.
"""

from __future__ import annotations

import base64
import io
import json
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from modetune.core.storage.campaign_record import CampaignRecord, IterationRecord
from modetune.core.storage.keys import Json
from modetune.core.updating.criteria import Tolerances
from modetune.core.updating.trust import trust_sentences
from modetune.flows.report.comparison import mac_table
from modetune.flows.report.headline import first_line
from modetune.flows.report.iteration_tables import iteration_table
from modetune.flows.report.mode_tables import mode_labels, mode_table
from modetune.flows.report.parameter_tables import parameter_table
from modetune.flows.report.report_file import PAGE
from modetune.flows.report.tables import Table, artifact_rows, json_object
from modetune.flows.updating.record import CampaignRun

#: Characters; an artifact contains its picture, which is drawn at lower resolutions until it fits.
LARGEST_PICTURE = 200_000
#: Dots per inch, tried in this order.
RESOLUTIONS = (110, 80, 55, 40)


@dataclass(frozen=True, slots=True)
class Artifact:
    """An artifact of Prefect; data is JSON rows, Markdown or a percentage, depending on kind."""

    kind: Literal["table", "markdown", "progress"]
    key: str
    description: str
    data: str | float


@dataclass(frozen=True, slots=True)
class ServerEvent:
    """An event of Prefect, which automations react to: what happened to a resource, with facts."""

    event: str
    resource: str
    name: str
    payload: dict[str, Json]


#: The event of a structure that was not found changed before.
CHANGED = "modetune.structure.changed"


def change_event(run: CampaignRun) -> ServerEvent:
    """Return the event of an update that shows a change of its structure."""
    record = run.record
    payload = json_object(
        record, "drift verdict status", run_dir=run.folder.resolve(), drift_details=run.drift
    )
    return ServerEvent(CHANGED, f"modetune.structure.{record.name}", record.name, payload)


def artifact_key(campaign: str, name: str) -> str:
    """Return a key of lower-case letters, digits and dashes, as Prefect requires."""
    return re.sub(r"[^a-z0-9]+", "-", f"{campaign}-{name}".lower()).strip("-")


def progress_artifacts(
    name: str, tolerances: Tolerances, iterations: Sequence[IterationRecord]
) -> list[Artifact]:
    """Return the progress towards e1 (100 where it is met) and the table of iterations."""
    last = [item for item in iterations if item.accepted][-1]
    return [
        Artifact(
            "progress",
            artifact_key(name, "progress"),
            f"Largest frequency error {100 * last.worst_error:.2f} %, "
            f"e1 {100 * tolerances.frequency:g} % (at 100 e1 is met)",
            round(100.0 * _progress(last, tolerances), 1),
        ),
        table_artifact(name, "iterations", iteration_table(iterations), f"Iterations of {name}"),
    ]


def result_artifacts(record: CampaignRecord, folder: Path) -> list[Artifact]:
    """Return result and files, frequencies, parameters and, with measured shapes, the MAC picture
    of a run."""
    name = record.name
    artifacts = [
        table_artifact(
            name, "frequencies", mode_table(record), f"Frequencies of {name} before and after"
        ),
        table_artifact(name, "parameters", parameter_table(record), f"Parameters of {name}"),
        Artifact(
            "markdown",
            artifact_key(name, "record"),
            f"Result of {name}: {record.verdict}",
            _result_and_files(record, folder),
        ),
    ]
    if record.test.has_shapes:
        picture = base64.b64encode(mac_picture(record)).decode()
        artifacts.append(
            Artifact(
                "markdown",
                artifact_key(name, "mac"),
                f"MAC of {name} before and after",
                f"![MAC](data:image/png;base64,{picture})",
            )
        )
    return artifacts


def table_artifact(campaign: str, name: str, table: Table, description: str = "") -> Artifact:
    """Return a table as an artifact; the description defaults to its name."""
    data = json.dumps(artifact_rows(table))
    return Artifact("table", artifact_key(campaign, name), description or name, data)


def files_artifact(campaign: str, written: Sequence[Path]) -> Artifact:
    """Return links to the files of a run, for a browser on the same machine."""
    return Artifact(
        "markdown", artifact_key(campaign, "files"), f"Files of {campaign}", _links(written)
    )


def _links(files: Sequence[Path]) -> str:
    paths = [path.resolve() for path in files]
    return "\n".join(f"* [{path.name}]({path.as_uri()}): `{path}`" for path in paths)


def mac_picture(record: CampaignRecord) -> bytes:
    """Return the MAC matrices before and after as a PNG that fits into an artifact."""
    # Matplotlib is slow to import.
    from modetune.flows.report.campaign_charts import mac_towers
    from modetune.flows.report.matplotlib_charts import matplotlib_figure

    first, last = record.iterations[0], record.best
    tables = [("before", mac_table(record, first)), ("after", mac_table(record, last))]
    numbers = mode_labels(record)
    figure = matplotlib_figure(mac_towers(record.name, tables, numbers))
    drawn = b""
    for resolution in RESOLUTIONS:
        file = io.BytesIO()
        figure.savefig(file, format="png", dpi=resolution)
        drawn = file.getvalue()
        if 4 * len(drawn) / 3 < LARGEST_PICTURE:
            break
    return drawn


def _progress(record: IterationRecord, tolerances: Tolerances) -> float:
    """Tolerance over the largest difference that exceeds it; 1 if none does (e1 is met)."""
    shares = [tolerances.frequency / max(record.worst_error, tolerances.frequency)]
    mac = record.pairing.judged_mac
    if np.isfinite(mac).all() and mac.min() < tolerances.mac:
        shares.append((1.0 - tolerances.mac) / (1.0 - float(mac.min())))
    return min(shares)


def _result_and_files(record: CampaignRecord, folder: Path) -> str:
    place, runs = folder.resolve(), record.runs
    files = [*filter(Path.exists, [place / PAGE]), place / "campaign.h5"]
    reasons = "" if record.trust is None else "\n\n".join(trust_sentences(record.trust))
    return (
        f"**{first_line(record)}**\n\n"
        + (f"**structure**: {record.drift}\n\n" if record.drift else "")
        + (f"{reasons}\n\n" if reasons else "")
        + f"**{record.status.replace('_', ' ')}**: {record.reason}\n\n"
        f"{_links(files)}\n"
        f"* updated deck in `{place / 'updated'}`\n"
        f"* solver runs: {runs.modal} modal, {runs.sensitivity} sensitivity, {runs.reused} cached\n"
        f"* {record.solver} {record.solver_version}, {record.wall_s:.1f} s\n"
    )
