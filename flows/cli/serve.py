"""`modetune serve`: an update or a study of a campaign on a schedule, from this process."""

from __future__ import annotations

from pathlib import Path

import typer

from modetune.flows.cli.options import stoppable
from modetune.flows.cli.server import CronLine, Name, StudyLine, TimeZone, WithoutLogin, serving
from modetune.flows.studies.study import CampaignPath, Runs, Settings


def serve(
    campaign_file: CampaignPath,
    study: StudyLine = "update",
    cron: CronLine = None,
    timezone: TimeZone = "UTC",
    name: Name = None,
    settings: Settings = None,
    runs: Runs = Path("runs"),
    without_login: WithoutLogin = False,
) -> None:
    """Run the campaign on a schedule from this process, until Ctrl-C."""
    from modetune.flows.cli.studies import read_study

    asked = read_study(study, campaign_file)
    campaign = asked.campaign(campaign_file, settings or [])
    name = name or campaign.name
    said = "the schedule is paused; the same command goes on with it"
    with stoppable(said), serving() as server:
        from modetune.flows.server import deployment
        from modetune.flows.server.worker import Worker, check_login

        if not without_login:
            check_login(server)
        pool, schedule = f"serve-{name}", deployment.Schedule(cron, timezone)
        with server.api() as api:
            told = asked.name, asked.options
            kept = deployment.deploy(api, campaign, told, runs, name, schedule, pool)
        when = f"at `{cron}` ({timezone})" if cron else "when asked"
        typer.echo(f"serving {asked.name}/{name} {when}; pages at {server.pages}; Ctrl-C ends it")
        keeper = Worker(server, pool, 1)
        try:
            keeper.work(once=False)
        finally:
            with keeper.server.api() as api:
                deployment.pause(api, kept)
