"""Commands of Prefect's server: the shared one, deployments, schedules and workers."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated

import typer

from modetune.core.errors import CampaignStopped, ModetuneError

server_app = typer.Typer(help="The Prefect server that commands share.", no_args_is_help=True)

CampaignPath = Annotated[Path, typer.Argument(help="Campaign file (YAML).")]
Settings = Annotated[
    list[str] | None,
    typer.Option("--set", help="KEY.KEY=VALUE over the campaign file; may be repeated."),
]
Runs = Annotated[Path, typer.Option(help="Where run folders go.")]
CronLine = Annotated[
    str | None, typer.Option("--cron", help="When it starts: minute hour day month weekday.")
]
TimeZone = Annotated[str, typer.Option("--timezone", help="Of the schedule, e.g. Europe/Berlin.")]
Name = Annotated[
    str | None, typer.Option("--name", help="Of the deployment; the campaign's by default.")
]
Pool = Annotated[str, typer.Option("--pool", help="Work pool of processes; made when missing.")]
#: Prefect's settings in processes that start campaigns: their log lines go to the pages.
POOL, LOGS = (
    "modetune",
    {
        "PREFECT_LOGGING_TO_API_ENABLED": "true",
        "PREFECT_LOGGING_TO_API_WHEN_MISSING_FLOW": "ignore",
    },
)


def register(app: typer.Typer) -> None:
    """Add the commands to the command line."""
    app.add_typer(server_app, name="server")
    for command in (deploy, serve, worker):
        app.command()(command)


@server_app.command("status")
def server_status() -> None:
    """Whether the shared server runs, and where its pages are."""
    from modetune.flows.server import process

    address = process.read_address(process.server_home())
    if address is None or not process.answers(address.url):
        typer.echo("no shared server is running")
        return
    typer.echo(f"running at {address.url.removesuffix('/api')} (process {address.pid})")


@server_app.command("stop")
def server_stop() -> None:
    """End the shared server."""
    from modetune.flows.server import process

    said = {
        "stopped": "stopped",
        "none": "no shared server is running",
        "in use": "a campaign is using the server; it was left running",
    }
    typer.echo(said[process.stop_server(process.server_home())])


def deploy(
    campaign_file: CampaignPath,
    cron: CronLine = None,
    timezone: TimeZone = "UTC",
    pool: Pool = POOL,
    name: Name = None,
    settings: Settings = None,
    runs: Runs = Path("runs"),
    as_json: Annotated[
        bool, typer.Option("--json", help="One JSON object on standard output.")
    ] = False,
) -> None:
    """Put the campaign on a Prefect server, to be run by a worker, on a schedule or when asked."""
    from modetune.flows.campaign import load_campaign

    campaign = load_campaign(campaign_file, settings or [])
    with _server() as url:
        from modetune.flows.server.deployment import Schedule, campaign_deployment
        from modetune.flows.server.deployment import deploy as put_there

        schedule = Schedule(cron, timezone)
        deployment = campaign_deployment(campaign, runs, name or campaign.name, schedule, pool)
        put_there(deployment, pool)
        told = {
            "status": "deployed",
            "deployment": deployment.full_name,
            "pool": pool,
            "cron": cron,
            "timezone": timezone if cron else None,
            "server": url,
        }
    if as_json:
        typer.echo(json.dumps(told))
        return
    when = f"at `{cron}` ({timezone})" if cron else "when asked"
    typer.echo(
        f"deployed as {told['deployment']} on {url}; it runs {when}, once a worker is there:\n"
        f"  modetune worker --pool {pool}"
    )


def serve(
    campaign_file: CampaignPath,
    cron: CronLine = None,
    timezone: TimeZone = "UTC",
    name: Name = None,
    settings: Settings = None,
    runs: Runs = Path("runs"),
) -> None:
    """Run the campaign on a schedule from this process, until Ctrl-C."""
    from modetune.flows.campaign import load_campaign

    campaign = load_campaign(campaign_file, settings or [])
    with _server() as url:
        from modetune.flows.server.deployment import Schedule, campaign_deployment
        from modetune.flows.server.deployment import serve as keep_serving

        schedule = Schedule(cron, timezone)
        deployment = campaign_deployment(campaign, runs, name or campaign.name, schedule, None)
        when = f"at `{cron}` ({timezone})" if cron else "when asked"
        typer.echo(f"serving {deployment.full_name} {when}; pages at {url}; Ctrl-C ends it")
        with _ending("the schedule is paused; the same command goes on with it"):
            keep_serving(deployment)
            raise KeyboardInterrupt  # Prefect ends with good grace when it is interrupted


def worker(
    pool: Pool = POOL,
    limit: Annotated[
        int | None, typer.Option(min=1, help="Campaigns at the same time; any number by default.")
    ] = None,
    once: Annotated[bool, typer.Option("--once", help="Only what is due now, then end.")] = False,
) -> None:
    """Run deployed campaigns of a work pool on this machine, until Ctrl-C."""
    with _server() as url:
        from modetune.flows.server.deployment import work

        if not once:
            typer.echo(f"working for pool {pool} of {url}; Ctrl-C ends it")
        with _ending("the worker has ended; runs that are due wait for the next one"):
            work(pool, limit, once)


@contextmanager
def _server() -> Iterator[str]:
    """The address of the pages of a server that answers, in use for as long as this lasts."""
    from modetune.flows.server.process import use_server

    for name, value in LOGS.items():
        os.environ.setdefault(name, value)
    server = use_server()
    try:
        if not server.wait():
            where = f"its log is in {server.home}" if server.shared else "named by PREFECT_API_URL"
            raise ModetuneError(
                f"Prefect's server at {server.address.shown} does not answer ({where})"
            )
        yield server.address.shown.removesuffix("/api")
    finally:
        server.close()


@contextmanager
def _ending(said: str) -> Iterator[None]:
    """Ctrl-C is how these commands end."""
    try:
        yield
    except KeyboardInterrupt:
        raise CampaignStopped(said) from None
