"""`modetune server`: the Prefect server that commands share."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Annotated

import typer

from modetune.core.errors import ModetuneError

if TYPE_CHECKING:
    from modetune.flows.jobs.prefect_server import SharedServer

CronLine = Annotated[
    str | None, typer.Option("--cron", help="Schedule: minute hour day month weekday.")
]
StudyLine = Annotated[
    str,
    typer.Option(
        "--study",
        help="Study and its options, without the campaign file: 'screen --method morris'.",
    ),
]
TimeZone = Annotated[
    str, typer.Option("--timezone", help="Time zone of the schedule, e.g. Europe/Berlin.")
]
Name = Annotated[
    str | None, typer.Option("--name", help="Name of the deployment; default: the campaign's.")
]
Pool = Annotated[str, typer.Option("--pool", help="Work pool of campaigns; created if missing.")]
WithoutLogin = Annotated[
    bool,
    typer.Option(
        "--without-login", help="Allow a server without login, which anyone who reaches it may use."
    ),
]
#: Default work pool.
POOL = "modetune"
#: Interval at which Prefect's worker asks for due runs, in seconds.
POLL = {"PREFECT_WORKER_QUERY_SECONDS": "5", "PREFECT_WORKER_HEARTBEAT_SECONDS": "10"}


def server_status() -> None:
    """Show whether the shared server runs, and the address of its pages."""
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


def server_stop() -> None:
    """Stop the shared server."""
    from modetune.flows.jobs import prefect_server as process

    text = {
        "stopped": "stopped",
        "none": "no shared server is running",
        "in use": "a campaign is using the server; it was left running",
    }
    typer.echo(text[process.stop_server(process.server_home())])


@contextmanager
def serving() -> Iterator[SharedServer]:
    """Yield a running server, with Prefect as its client; it counts as in use until the block ends.

    Raises ModetuneError.
    """
    from modetune.flows.jobs.prefect_server import use_server

    server = use_server()
    try:
        found = server.wait(waiting=_show_wait)
        if found != "ready":
            raise ModetuneError(server.describe(found))
        os.environ.update(server.settings())  # before Prefect is imported
        yield server
    finally:
        server.close()


def _show_wait(seconds: float) -> None:
    """Report every ten seconds that the server is still starting."""
    if int(seconds) % 10 == 0:
        typer.echo(f"waiting for Prefect's server ({seconds:.0f} s)", err=True)
