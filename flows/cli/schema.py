"""`modetune files schema`: the campaign file's JSON schema."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from modetune.core.storage.files import writing


def schema(
    out: Annotated[
        Path | None, typer.Option(help="File to write; default: standard output.")
    ] = None,
) -> None:
    """Print the JSON schema of campaign files, for completion in editors."""
    from modetune.flows.campaign.schema import schema_text

    text = schema_text()
    if out is None:
        typer.echo(text, nl=False)
        return
    with writing(out) as part:
        part.write_text(text, encoding="utf-8")
    typer.echo(
        f"written to {out}; to use it in an editor, put this first in a campaign file:\n"
        f"# yaml-language-server: $schema={out.name}"
    )
