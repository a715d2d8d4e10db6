"""Arguments and options that several commands have, and how Ctrl-C ends those that keep jobs."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated

import typer

from modetune.core.errors import CampaignStopped

CampaignPath = Annotated[Path, typer.Argument(help="Campaign file (YAML).")]
Settings = Annotated[
    list[str] | None,
    typer.Option("--set", help="KEY.KEY=VALUE over the campaign file; may be repeated."),
]
At = Annotated[
    list[str] | None,
    typer.Option(help="NAME=VALUE of a parameter, relative to the deck; may be repeated."),
]
Runs = Annotated[Path, typer.Option(help="Where run folders go.")]
Figures = Annotated[Path | None, typer.Option(help="Folder for figures (PNG).")]
AsJson = Annotated[bool, typer.Option("--json", help="One JSON object on standard output.")]


@contextmanager
def stoppable(
    said: str = "stopped; finished jobs are in the store, the same command goes on from there",
) -> Iterator[None]:
    """Turn Ctrl-C into the error that says how to go on."""
    try:
        yield
    except KeyboardInterrupt:
        raise CampaignStopped(said) from None
