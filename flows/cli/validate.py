"""`modetune validate`: does the model hold on what it was not updated with?"""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

import typer

from modetune.core.storage.keys import Json
from modetune.flows.cli.ending import tell_end
from modetune.flows.cli.options import (
    AsJson,
    CampaignPath,
    NoPrefect,
    Settings,
    begun,
    paged,
    stoppable,
)
from modetune.flows.report.tables import OUTSIDE, Column, Table, json_object

if TYPE_CHECKING:
    from rich.text import Text

    from modetune.flows.studies.validate.leave_out import Validation


def validate(
    campaign_file: CampaignPath,
    one_out: Annotated[
        bool, typer.Option("--leave-one-out", help="Update without each used mode in turn.")
    ] = False,
    settings: Settings = None,
    no_prefect: NoPrefect = False,
    as_json: AsJson = False,
) -> None:
    """Judge an update by what it was not made from, before and after.

    By what the campaign holds out, or with --leave-one-out by each used mode in turn. Nothing but
    the store is written. Exit code 3 where something that was held out got worse.
    """
    with begun(f"reading {campaign_file}"):
        from modetune.flows.campaign.campaign import load_campaign
        from modetune.flows.report.mode_tables import held_out_table
        from modetune.flows.studies.validate.leave_out import leave_one_out
        from modetune.flows.studies.validate.leave_out import validate as by_held_out

        campaign = load_campaign(campaign_file, settings or [])
    with (
        stoppable(),
        begun(f"validating {campaign.name}") as working,
        paged("validate", campaign.name, no_prefect) as pages,
    ):
        judge = leave_one_out if one_out else by_held_out
        found = judge(campaign, working, pages)
        if pages is not None:
            tables, good = [held_out_table(found.held_out)], found.status == "good"
            pages.done(found.sentence, tables, status=found.status, good=good)
    tell_end(told(found, one_out), _parts(found), as_json)
    raise typer.Exit(0 if found.status == "good" else 3)


def told(found: Validation, one_out: bool) -> dict[str, Json]:
    """The `--json` object of `modetune validate`."""
    from modetune.flows.report.mode_tables import held_out_rows

    spread = zip(found.parameters, *found.spread, strict=True)
    return json_object(
        found,
        "status name",
        leave_one_out=one_out,
        held_out=held_out_rows(found.held_out),
        updates=[
            json_object(
                fold,
                "status reason iterations",
                left_out=fold.number or None,
                configuration=fold.configuration or None,
                parameters=dict(zip(found.parameters, fold.updated, strict=True)),
            )
            for fold in found.folds
        ],
        parameters=[{"name": name, "least": low, "largest": high} for name, low, high in spread],
        solver_runs=found.runs,
        wall_s=round(found.wall_s, 3),
    )


def _parts(found: Validation) -> list[Table | Text | str]:
    """What was found, for people."""
    from rich.text import Text

    from modetune.flows.updating.display import held_out_parts

    parts: list[Table | Text | str] = [*held_out_parts(found.held_out)]
    for fold in found.failed:
        parts.append(Text(f"{fold.name} the update failed: {fold.reason}", style=OUTSIDE))
    if len(found.folds) > 1:
        columns = [Column("without", words=True)]
        columns += [Column(parameter, form=".4f") for parameter in found.parameters]
        rows = [(fold.name.removeprefix("without "), *fold.updated) for fold in found.folds]
        parts.append(Table("Parameters over the updates", tuple(columns), tuple(rows)))
    return [
        *parts,
        f"{found.status}: {found.sentence}",
        f"{len(found.folds)} updates; {found.runs.sentence}; {found.wall_s:.1f} s",
    ]
