"""The command that draws what a campaign left: a page, and pictures for print."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

if TYPE_CHECKING:
    from modetune.core.record import CampaignRecord

#: How a record in a run folder is named.
RECORD = "campaign.h5"


def report(
    record: Annotated[Path, typer.Argument(help="Run folder, or the campaign.h5 in it.")],
    out: Annotated[
        Path | None, typer.Option(help="The page; report.html beside the record if not given.")
    ] = None,
    figures: Annotated[
        Path | None, typer.Option(help="Folder for the same figures as pictures.")
    ] = None,
    form: Annotated[str, typer.Option("--format", help="Of the pictures: png or svg.")] = "png",
    as_json: Annotated[bool, typer.Option("--json", help="One JSON object.")] = False,
) -> None:
    """Draw a campaign's report: one HTML file that needs no network, and pictures if asked for."""
    from modetune.core.errors import CampaignError
    from modetune.core.record_file import read_record
    from modetune.flows.report.page import write_page

    if form not in ("png", "svg"):
        raise CampaignError(f"--format {form!r}: expected png or svg")
    path = record / RECORD if record.is_dir() else record
    known = read_record(path)
    page = write_page(known, out or path.with_name("report.html"))
    kind: Literal["png", "svg"] = "svg" if form == "svg" else "png"
    pictures = _pictures(known, figures, kind) if figures is not None else ()
    if as_json:
        told = {"status": "good", "name": known.name, "page": str(page),
                "figures": [str(picture) for picture in pictures]}  # fmt: skip
        typer.echo(json.dumps(told))
        return
    typer.echo(f"report  {page}")
    for picture in pictures:
        typer.echo(f"figure  {picture}")


def _pictures(
    record: CampaignRecord, folder: Path, form: Literal["png", "svg"]
) -> tuple[Path, ...]:
    from modetune.flows.report.pictures import write_pictures

    return write_pictures(record, folder, form)


def register(app: typer.Typer) -> None:
    """Add this file's command to the command line."""
    app.command()(report)
