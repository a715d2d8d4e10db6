"""`modetune server serve`: a study of a campaign on a schedule, from this process."""

from __future__ import annotations

import os
from pathlib import Path

import typer

from modetune.flows.cli.deploy import deployable
from modetune.flows.cli.options import stoppable
from modetune.flows.cli.server import (
    POLL,
    CronLine,
    Name,
    StudyLine,
    TimeZone,
    WithoutLogin,
    serving,
)
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
    """Deploy a study of the campaign and run it in this process, until Ctrl-C.

    The deployment gets its own work pool.
    """
    chosen, parameters, own_name = deployable(study, campaign_file, settings, runs)
    name = name or own_name
    os.environ.update(POLL)
    paused = "the schedule is paused; the same command continues it"
    with stoppable(paused), serving() as server:
        from modetune.flows.server import deployment
        from modetune.flows.server.worker import check_login, work

        if not without_login:
            check_login(server.address.url)
        pool, schedule = f"serve-{name}", deployment.Schedule(cron, timezone)
        identity = deployment.deploy(chosen, parameters, name, schedule, pool)
        when = f"at `{cron}` ({timezone})" if cron else "on request"
        typer.echo(
            f"serving {chosen.name}/{name} {when}; pages at {server.pages}{server.entrance}; "
            "Ctrl-C ends it"
        )
        folders = [campaign_file.parent, *chosen.paths(chosen.checked(parameters))]
        try:
            work(server, pool, folders, limit=1, without_login=without_login)
        finally:
            deployment.pause(identity)
