"""`modetune deploy`: an update or a study of a campaign on a Prefect server."""

from __future__ import annotations

import json
from pathlib import Path

import typer

from modetune.flows.cli.options import AsJson
from modetune.flows.cli.server import POOL, CronLine, Name, Pool, StudyLine, TimeZone, serving
from modetune.flows.studies.study import CampaignPath, Runs, Settings


def deploy(
    campaign_file: CampaignPath,
    study: StudyLine = "update",
    cron: CronLine = None,
    timezone: TimeZone = "UTC",
    pool: Pool = POOL,
    name: Name = None,
    settings: Settings = None,
    runs: Runs = Path("runs"),
    as_json: AsJson = False,
) -> None:
    """Put an update, or a study, of the campaign on a Prefect server, to be run by a worker, on a
    schedule or when asked."""
    from modetune.flows.cli.studies import read_study

    asked = read_study(study, campaign_file)
    campaign = asked.campaign(campaign_file, settings or [])
    name = name or campaign.name
    with serving() as server, server.api() as api:
        from modetune.flows.server import deployment

        schedule = deployment.Schedule(cron, timezone)
        deployment.deploy(api, campaign, (asked.name, asked.options), runs, name, schedule, pool)
        told = {
            "status": "deployed",
            "deployment": f"{asked.name}/{name}",
            "pool": pool,
            "cron": cron,
            "timezone": timezone if cron else None,
            "server": server.pages,
        }
    if as_json:
        typer.echo(json.dumps(told))
        return
    when = f"at `{cron}` ({timezone})" if cron else "when asked"
    typer.echo(
        f"deployed as {told['deployment']} on {told['server']}; it runs {when}, once a worker is "
        "there:\n"
        f"  modetune worker --pool {pool}"
    )
