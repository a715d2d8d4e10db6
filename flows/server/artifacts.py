"""What Prefect's pages show of a run besides its tasks: tables, a picture, progress, places.

Sheets are made from records and know no server. A key is the campaign's name and the sheet's: one
key over runs is a history.
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
from modetune.core.updating.criteria import Tolerances
from modetune.flows.report.comparison import mac_table
from modetune.flows.report.iteration_tables import iteration_table
from modetune.flows.report.mode_tables import mode_labels, mode_table
from modetune.flows.report.parameter_tables import parameter_table
from modetune.flows.report.report_file import PAGE
from modetune.flows.report.tables import Table, artifact_rows

#: A picture travels inside its sheet; larger ones are drawn again at less resolution.
LARGEST_PICTURE = 200_000
#: Dots per inch that are tried one after another.
RESOLUTIONS = (110, 80, 55, 40)


@dataclass(frozen=True, slots=True)
class Sheet:
    """One artifact: its kind, key, description in Markdown, and what it shows."""

    kind: Literal["table", "markdown", "progress"]
    key: str
    description: str
    data: str | float


def sheet_key(campaign: str, sheet: str) -> str:
    """A key as Prefect requires it: small letters, digits, dashes."""
    return re.sub(r"[^a-z0-9]+", "-", f"{campaign}-{sheet}".lower()).strip("-")


def progress_sheets(
    name: str, tolerances: Tolerances, iterations: Sequence[IterationRecord]
) -> list[Sheet]:
    """How near e1 is, and a line an iteration."""
    kept = [item for item in iterations if item.accepted][-1]
    return [
        Sheet(
            "progress",
            sheet_key(name, "progress"),
            f"Largest frequency error {100 * kept.worst_error:.2f} %, "
            f"e1 asks for {100 * tolerances.frequency:g} % (100 is e1 met)",
            round(100.0 * _nearness(kept, tolerances), 1),
        ),
        table_sheet(name, "iterations", iteration_table(iterations), f"Iterations of {name}"),
    ]


def result_sheets(record: CampaignRecord, folder: Path) -> list[Sheet]:
    """Frequencies, parameters, MAC and places at the end of a run."""
    name = record.name
    sheets = [
        table_sheet(
            name, "frequencies", mode_table(record), f"Frequencies of {name} before and after"
        ),
        table_sheet(name, "parameters", parameter_table(record), f"Parameters of {name}"),
        Sheet(
            "markdown",
            sheet_key(name, "record"),
            f"Where the run of {name} left its files",
            _places(record, folder),
        ),
    ]
    if record.test.has_shapes:
        picture = base64.b64encode(mac_picture(record)).decode()
        sheets.append(
            Sheet(
                "markdown",
                sheet_key(name, "mac"),
                f"MAC of {name} before and after",
                f"![MAC](data:image/png;base64,{picture})",
            )
        )
    return sheets


def table_sheet(campaign: str, sheet: str, table: Table, description: str = "") -> Sheet:
    """A table as a sheet; it is described by its name unless told."""
    data = json.dumps(artifact_rows(table))
    return Sheet("table", sheet_key(campaign, sheet), description or sheet, data)


def files_sheet(campaign: str, written: Sequence[Path]) -> Sheet:
    """Where a run left its report and other files, as links for a browser on the same machine."""
    said = f"Where the run of {campaign} left its files"
    return Sheet("markdown", sheet_key(campaign, "files"), said, _links(written))


def _links(files: Sequence[Path]) -> str:
    paths = [path.resolve() for path in files]
    return "\n".join(f"* [{path.name}]({path.as_uri()}): `{path}`" for path in paths)


def mac_picture(record: CampaignRecord) -> bytes:
    """MAC of computed with measured modes before and after, as PNG that fits into a sheet."""
    # Drawing is imported where something is drawn.
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


def _nearness(record: IterationRecord, tolerances: Tolerances) -> float:
    """1 where e1 is met, else the tolerance over the largest difference that exceeds it."""
    shares = [tolerances.frequency / max(record.worst_error, tolerances.frequency)]
    mac = record.pairing.judged_mac
    if np.isfinite(mac).all() and mac.min() < tolerances.mac:
        shares.append((1.0 - tolerances.mac) / (1.0 - float(mac.min())))
    return min(shares)


def _places(record: CampaignRecord, folder: Path) -> str:
    place, runs = folder.resolve(), record.runs
    files = [*filter(Path.exists, [place / PAGE]), place / "campaign.h5"]
    return (
        f"**{record.status.replace('_', ' ')}**: {record.reason}\n\n"
        f"{_links(files)}\n"
        f"* updated deck in `{place / 'updated'}`\n"
        f"* solver runs: {runs.modal} modal, {runs.sensitivity} sensitivity, {runs.reused} answered"
        f" by the store\n* {record.solver} {record.solver_version}, {record.wall_s:.1f} s\n"
    )
