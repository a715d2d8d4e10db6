"""`modetune view`: show a campaign live in the browser, and edit its settings there."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Annotated

import typer

from modetune.flows.cli.options import stoppable
from modetune.flows.studies.study import CampaignPath, Runs


def view(
    campaign_file: CampaignPath,
    runs: Runs = Path("runs"),
    port: Annotated[
        int, typer.Option(help="Port on this machine; 0: any free port.", max=65535)
    ] = 0,
    browser: Annotated[
        bool, typer.Option("--open", help="Also open the page in the browser.")
    ] = False,
) -> None:
    """Show the campaign live in a browser, and set pairs, poles and sensors there."""
    from modetune.flows.studies.view.server import serve_view

    redirect = ExitStack()

    def opened(address: str) -> None:
        typer.echo(f"view  {address}")
        typer.echo(
            "Open the address in a browser on this machine; it opens once. Ctrl-C stops the view.",
            err=True,
        )
        if browser:
            import webbrowser

            webbrowser.open(redirect.enter_context(redirect_page(address)).as_uri())

    with redirect, stoppable("stopped; everything written is kept"):
        serve_view(campaign_file, runs, port, opened)


@contextmanager
def redirect_page(address: str) -> Iterator[Path]:
    """A page that only this account can read and that leads to an address.

    Any account can read a browser's command line, and the address holds the session's token.
    """
    with tempfile.NamedTemporaryFile("w", prefix="modetune-view-", suffix=".html") as file:  # 0600
        file.write(f'<meta http-equiv="refresh" content="0; url={address}">\n')
        file.flush()
        yield Path(file.name)
