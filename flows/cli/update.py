"""`modetune update`: a campaign's model updated until it agrees with its test.

Heavy packages are imported where they are needed.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from modetune.core.storage.keys import Json
from modetune.flows.cli.explain import SHORT, nearest_line, told_job
from modetune.flows.cli.options import (
    AsJson,
    CampaignPath,
    NoPrefect,
    Runs,
    Settings,
    begun,
    paged,
    stoppable,
)
from modetune.flows.report.tables import json_object

if TYPE_CHECKING:
    from modetune.flows.updating.dry_run import DryRun, PlannedJob
    from modetune.flows.updating.forecast import Forecast
    from modetune.flows.updating.run import CampaignRun


def update(
    campaign_file: CampaignPath,
    settings: Settings = None,
    runs: Runs = Path("runs"),
    no_prefect: NoPrefect = False,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Say what would be run.")] = False,
    starts: Annotated[
        int | None, typer.Option(help="Update from so many starts; as `--set update.starts=N`.")
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Update the campaign's model until it agrees with its test."""
    changed = settings or []
    if starts is not None:
        changed = [*changed, f"update.starts={starts}"]
    with stoppable():
        if dry_run:
            show_dry_run(campaign_file, changed, runs, as_json)
            return
        run = run_update(campaign_file, changed, runs, not no_prefect)
    if as_json:
        from modetune.flows.updating.recording import summary

        typer.echo(json.dumps(with_forecast(summary(run.record, run.folder), run.forecast)))
    else:
        show(run)
    raise typer.Exit(0 if run.record.status == "converged" else 3)


def run_update(
    campaign_file: Path, settings: list[str], runs: Path, with_prefect: bool
) -> CampaignRun:
    """Run a campaign, with its progress on standard error."""
    from modetune.flows.campaign.terminal import terminal

    with begun(f"reading {campaign_file}"):  # a large deck takes a moment, as do imports
        from modetune.flows.campaign.campaign import load_campaign
        from modetune.flows.updating.display import ConsoleProgress
        from modetune.flows.updating.running import is_same
        from modetune.flows.updating.starts import update_from_starts

        campaign = load_campaign(campaign_file, settings)
        campaign.solver_version()
    with ConsoleProgress(terminal(stderr=True)).shown() as progress:
        folder = runs / campaign.name
        progress.keep(folder)
        with paged("update", campaign.name, not with_prefect) as pages:
            same = pages is not None and pages.deployed and is_same(campaign, folder)
            run = update_from_starts(campaign, folder, progress, pages, progress.forecast)
            if pages is not None:
                spent = run.record.runs
                pages.ended(run.record, folder, same and not spent.modal + spent.sensitivity)
            return run


def show(run: CampaignRun) -> None:
    """Show on standard output what a campaign ended with."""
    from modetune.flows.campaign.terminal import terminal
    from modetune.flows.updating.display import show_run

    show_run(terminal(), run)


def with_forecast(told: dict[str, Json], forecast: Forecast | None) -> dict[str, Json]:
    """A summary and what the campaign was expected to cost before it started."""
    from modetune.flows.updating.forecast import told_forecast

    return {**told, "forecast": told_forecast(forecast) if forecast else None}


def show_dry_run(campaign_file: Path, settings: list[str], runs: Path, as_json: bool) -> None:
    """Say what an update would run."""
    from modetune.flows.campaign.campaign import load_campaign
    from modetune.flows.updating.dry_run import dry_run

    campaign = load_campaign(campaign_file, settings)
    found = dry_run(campaign, runs / campaign.name)
    if as_json:
        typer.echo(json.dumps(_told_dry_run(found)))
        return
    if found.answered:
        typer.echo(
            f"the store answers the {found.answered} jobs of "
            f"{_count(len(found.iterations), 'evaluation')}"
        )
    for item in found.jobs:
        typer.echo(_planned_line(item))
        if not item.stored:
            typer.echo(f"      {nearest_line(item.nearest)}")
    if found.ended is not None:
        typer.echo(f"nothing would be run; {found.ended.status}: {found.ended.reason}")
    elif not found.jobs:
        typer.echo(
            "modes would be found from the stored matrices, and then one modal job would be "
            "run at the parameters where that ends"
        )
    else:
        typer.echo(
            f"{_count(len(found.runs), 'job')} would be run, {len(found.jobs)} are asked "
            "for in this iteration; what follows depends on their results"
        )


def _planned_line(item: PlannedJob) -> str:
    word = "hit" if item.stored else "run"
    return f"{word}   {item.key[:SHORT]}   {item.iteration} / {item.name}"


def _told_dry_run(found: DryRun) -> dict[str, Json]:
    return json_object(
        found,
        "answered",
        status="complete" if found.ended else "would run",
        reason=found.ended.reason if found.ended else "",
        runs=len(found.runs),
        jobs=[
            json_object(item, "key iteration name stored nearest", job=told_job(item.asked))
            for item in found.jobs
        ],
    )


def _count(number: int, word: str) -> str:
    return f"{number} {word}{'' if number == 1 else 's'}"
