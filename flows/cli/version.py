"""`modetune version`."""

from __future__ import annotations

import typer

from modetune import __version__


def version() -> None:
    """Print modetune's version."""
    typer.echo(__version__)
