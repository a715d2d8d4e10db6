"""`modetune report`: the page of a campaign, and its figures as pictures for print."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from modetune.core.near_names import named
from modetune.flows.cli.options import AsJson, show_progress
from modetune.flows.cli.output import print_result
from modetune.flows.report.tables import json_object


def report(
    record: Annotated[Path, typer.Argument(help="Run folder, or the campaign.h5 in it.")],
    out: Annotated[
        Path | None,
        typer.Option(help="HTML file to write; default: report.html next to the record."),
    ] = None,
    figures: Annotated[
        Path | None, typer.Option(help="Folder for the report's figures as pictures.")
    ] = None,
    form: Annotated[
        str, typer.Option("--format", help="Format of the pictures: png or svg.")
    ] = "png",
    as_json: AsJson = False,
) -> None:
    """Write the report of an update: one HTML file, and pictures on request."""
    with show_progress(f"reading {record}") as tell:
        from modetune.core.storage.campaign_record import read_record
        from modetune.flows.report.page import write_page

        named("--format", form, ("png", "svg"))
        known, folder = read_record(record), record if record.is_dir() else record.parent
        tell("drawing the report")
        page = write_page(known, out or folder / "report.html")
        pictures: list[Path] = []
        if figures is not None:
            from modetune.flows.report.campaign_charts import campaign_charts
            from modetune.flows.report.matplotlib_charts import save_all

            pictures = save_all(dict(campaign_charts(known)), figures, form)
    told = json_object(known, "name", status="good", page=page, figures=pictures)
    lines = [f"report  {page}", *(f"figure  {picture}" for picture in pictures)]
    print_result(told, lines, as_json)
