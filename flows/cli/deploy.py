"""`modetune server deploy`: a study of a campaign on a Prefect server."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from modetune.flows.cli.options import AsJson
from modetune.flows.cli.server import POOL, CronLine, Name, Pool, StudyLine, TimeZone, serving
from modetune.flows.studies.study import CampaignPath, Runs, Settings

if TYPE_CHECKING:
    from modetune.flows.studies.study import Study


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
    """Deploy a study of the campaign on a Prefect server, on a schedule or on demand."""
    chosen, parameters, own_name = deployable(study, campaign_file, settings, runs)
    name = name or own_name
    with serving() as server:
        from modetune.flows.server import deployment

        schedule = deployment.Schedule(cron, timezone)
        deployment.deploy(chosen, parameters, name, schedule, pool)
        summary = {
            "status": "deployed",
            "deployment": f"{chosen.name}/{name}",
            "pool": pool,
            "cron": cron,
            "timezone": timezone if cron else None,
            "server": server.pages,
        }
        entrance = server.entrance
    if as_json:
        typer.echo(json.dumps(summary))
        return
    when = f"at `{cron}` ({timezone})" if cron else "on request"
    typer.echo(
        f"deployed as {summary['deployment']} on {server.pages}{entrance}; it runs {when}, as soon "
        f"as a worker is running:\n  modetune server worker --pool {pool}"
    )


def deployable(
    line: str, campaign_file: Path, settings: list[str] | None, runs: Path
) -> tuple[Study, dict[str, Any], str]:
    """Return the study of a line, its parameters and the campaign's name. Raises CampaignError."""
    from modetune.flows.cli.command import parse_study
    from modetune.flows.updating.forecast import Unwatched

    study, options = parse_study(line)
    first, *others = study.fields
    typed = {first.name: first.of_one(campaign_file), "settings": settings or [], **options}
    if any(item.name == "runs" for item in others):
        typed["runs"] = runs
    checked = study.checked(typed)
    with study.opened(checked, Unwatched()) as on:
        return study, {key: checked[key] for key in typed}, on.name
