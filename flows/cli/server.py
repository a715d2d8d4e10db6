"""`modetune server`: the Prefect server that commands share, and what they have of it."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Annotated

import typer

from modetune.core.errors import ModetuneError

if TYPE_CHECKING:
    from modetune.flows.jobs.prefect_server import SharedServer

server_app = typer.Typer(help="The Prefect server that commands share.", no_args_is_help=True)

CronLine = Annotated[
    str | None, typer.Option("--cron", help="When it starts: minute hour day month weekday.")
]
StudyLine = Annotated[
    str,
    typer.Option(
        "--study",
        help="What is run, as it is typed without the campaign: update, 'screen --method morris', "
        "sample, validate, localise, check, pretest, correlate.",
    ),
]
TimeZone = Annotated[str, typer.Option("--timezone", help="Of the schedule, e.g. Europe/Berlin.")]
Name = Annotated[
    str | None, typer.Option("--name", help="Of the deployment; the campaign's by default.")
]
Pool = Annotated[str, typer.Option("--pool", help="Work pool of campaigns; made when missing.")]
WithoutLogin = Annotated[
    bool,
    typer.Option(
        "--without-login", help="Also for a server that everybody who reaches it may use."
    ),
]
#: The work pool that is meant where none is named.
POOL = "modetune"


@server_app.command("status")
def server_status() -> None:
    """Whether the shared server runs, and where its pages are."""
    from modetune.flows.jobs import prefect_server as process

    home = process.server_home()
    address = process.running_address(home)
    if address is None or not process.is_ours(address.url):
        typer.echo("no shared server is running")
        return
    typer.echo(
        f"running at {address.url.removesuffix('/api')} (process {address.pid}); "
        f"its pages ask for the login in {home / 'login'}"
    )


@server_app.command("stop")
def server_stop() -> None:
    """End the shared server."""
    from modetune.flows.jobs import prefect_server as process

    said = {
        "stopped": "stopped",
        "none": "no shared server is running",
        "in use": "a campaign is using the server; it was left running",
    }
    typer.echo(said[process.stop_server(process.server_home())])


@contextmanager
def serving() -> Iterator[SharedServer]:
    """A server that answers, in use for as long as this lasts. Raises ModetuneError."""
    from modetune.flows.jobs.prefect_server import use_server

    server = use_server()
    try:
        found = server.wait(waiting=_show_wait)
        if found != "ready":
            raise ModetuneError(server.describe(found))
        yield server
    finally:
        server.close()


def _show_wait(seconds: float) -> None:
    """Report every ten seconds that the server is still starting."""
    if int(seconds) % 10 == 0:
        typer.echo(f"waiting for Prefect's server ({seconds:.0f} s)", err=True)
