"""`modetune update --dry-run`: the jobs that an update would run."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import typer

from modetune.core.storage.keys import Json
from modetune.flows.cli.explain import SHORT, job_json
from modetune.flows.report.tables import json_object
from modetune.flows.studies.catalogue import find_study

if TYPE_CHECKING:
    from modetune.flows.updating.dry_run import DryRun, PlannedJob


def show_dry_run(parameters: Mapping[str, Any], as_json: bool) -> None:
    """Print the jobs that an update with these parameters would run. Raises CampaignError,
    StoreError."""
    from modetune.flows.updating.dry_run import dry_run
    from modetune.flows.updating.forecast import Unwatched

    with find_study("update").opened(parameters, Unwatched()) as on:
        found = dry_run(on.campaign, on.folder)
    if as_json:
        typer.echo(json.dumps(_dry_run_json(found)))
        return
    if found.answered:
        typer.echo(
            f"the store has the {found.answered} jobs of "
            f"{_count(len(found.iterations), 'evaluation')}"
        )
    for item in found.jobs:
        typer.echo(_planned_line(item))
    if found.ended is not None:
        typer.echo(f"nothing would run; {found.ended.status}: {found.ended.reason}")
    elif not found.jobs:
        later = on.campaign.update.confirm == "later"
        last = "" if later else ", followed by one modal job at the final parameters"
        typer.echo(f"modes would be computed from the stored matrices{last}")
    else:
        typer.echo(
            f"{_count(len(found.runs), 'job')} of {len(found.jobs)} in this iteration would run; "
            "later jobs depend on their results"
        )


def _planned_line(item: PlannedJob) -> str:
    word = "hit" if item.stored else "run"
    return f"{word}   {item.key[:SHORT]}   {item.iteration} / {item.name}"


def _dry_run_json(found: DryRun) -> dict[str, Json]:
    return json_object(
        found,
        "answered",
        status="complete" if found.ended else "would run",
        reason=found.ended.reason if found.ended else "",
        runs=len(found.runs),
        jobs=[
            json_object(item, "key iteration name stored", job=job_json(item.asked))
            for item in found.jobs
        ],
    )


def _count(number: int, word: str) -> str:
    return f"{number} {word}{'' if number == 1 else 's'}"
