"""`modetune server`: the Prefect server that commands share."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import TYPE_CHECKING, Annotated

import typer

from modetune.core.errors import CampaignError, ModetuneError
from modetune.core.storage.keys import Json
from modetune.flows.cli.options import AsJson, show_progress, stoppable
from modetune.flows.cli.output import print_result
from modetune.flows.cli.store import age_s, shown_size

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


def server_prune(
    older: Annotated[
        str | None,
        typer.Option(
            help="Remove runs that ended longer ago than this: 12h, 30d, 8w; default: "
            "MODETUNE_SERVER_KEEP_DAYS, or 30d."
        ),
    ] = None,
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Count what would be removed, and remove nothing.")
    ] = False,
    as_json: AsJson = False,
) -> None:
    """Remove old runs from the database of the shared server.

    Finished flow runs go, with their tasks, states, logs and artifacts, and events after a week
    (heartbeats after a day). Unfinished runs, deployments and schedules stay, and so does every
    file of a campaign. The server does the same when it starts and then every hour. Free space goes
    back to the disk if no campaign uses the server; otherwise new runs use it.
    """
    from modetune.flows.jobs import prefect_server as process
    from modetune.flows.jobs import server_database as rows

    older_s = age_s(older) if older else rows.keep_s()
    if older or older_s:
        rows.check_age(older_s)
    if configured := process.configured_server():
        raise CampaignError(
            f"PREFECT_API_URL names {configured.address.url}, which prunes itself if "
            "PREFECT_SERVER_SERVICES_DB_VACUUM_ENABLED=events,flow_runs is set where it is "
            "started; unset PREFECT_API_URL to prune the shared server"
        )
    home = process.server_home()
    database = rows.database_of(home)
    if not database.is_file():
        raise CampaignError(f"there is no database in {database.parent}: nothing to prune")
    if dry_run:
        found = rows.prunable(database, older_s)
    else:
        with (
            stoppable("stopped; the same command continues from there"),
            serving(),  # a server of this version has brought the database up to date
            show_progress("counting rows") as working,
        ):
            found = rows.prune(database, older_s, working)
        found = replace(found, compacted=process.compact_unused(home))
        found = replace(found, size_after=rows.size_of(database))
    told: Json = {
        "database": str(database),
        "dry_run": dry_run,
        "older_s": older_s,
        "removed": dict(found.rows),
        "size_bytes": found.size,
        "size_after_bytes": found.size_after,
        "compacted": found.compacted,
    }
    rest = "would be removed" if dry_run else "removed"
    lines = [f"{count:9} rows of {table} {rest}" for table, count in found.rows.items() if count]
    lines = lines or ["nothing to remove"]
    sizes = shown_size(found.size)
    if not dry_run:
        free = "" if found.compacted else "; new runs use what is free in it"
        sizes = f"{sizes} before, {shown_size(found.size_after)} after{free}"
    print_result(told, [*lines, f"{database}: {sizes}"], as_json)


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
