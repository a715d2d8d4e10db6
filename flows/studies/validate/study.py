"""`modetune validate`: predictions of the updated model for held-out data."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

import typer

from modetune.core.storage.keys import Json
from modetune.flows.report.tables import Column, Table, json_object
from modetune.flows.studies.result import StudyResult
from modetune.flows.studies.study import CampaignOptions, StudyContext, study

if TYPE_CHECKING:
    from modetune.flows.studies.validate.validation import Validation


@study(CampaignOptions)
def validate(
    on: StudyContext,
    leave_one_out: Annotated[
        bool, typer.Option("--leave-one-out", help="Update without each used mode in turn.")
    ] = False,
) -> StudyResult:
    """Validate an update: predict held-out data before and after it.

    Uses what the campaign holds out, or with --leave-one-out each used mode in turn. Writes only to
    the store. Exit code 3 if updating made the prediction of anything held out worse.
    """
    from modetune.flows.report.mode_tables import held_out_lines, held_out_table
    from modetune.flows.studies.validate.validation import leave_one_out as by_each_mode
    from modetune.flows.studies.validate.validation import validate as by_held_out

    judge = by_each_mode if leave_one_out else by_held_out
    found = judge(on.campaign, on.working)
    worse = held_out_lines(found.held_out)
    worse += [f"{fold.name} the update failed: {fold.reason}" for fold in found.failed]
    end = f"{found.status}: {found.sentence}"
    cost = f"{len(found.folds)} updates; {found.runs.sentence}; {found.wall_s:.1f} s"
    return StudyResult(
        found,
        found.sentence,
        summary(found, leave_one_out),
        [held_out_table(found.held_out), *_parameters(found)],
        [*worse, end, cost],
        doubts=[] if found.status == "good" else [*worse, end],
        status=found.status,
        exit_code=0 if found.status == "good" else 3,
    )


def summary(found: Validation, leave_one_out: bool) -> dict[str, Json]:
    """Return the JSON object of a validation."""
    from modetune.flows.report.mode_tables import held_out_rows

    spread = zip(found.parameters, *found.spread, strict=True)
    return json_object(
        found,
        "status name",
        leave_one_out=leave_one_out,
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


def _parameters(found: Validation) -> list[Table]:
    """Values of the parameters over several updates."""
    if len(found.folds) < 2:
        return []
    columns = [Column("without", words=True)]
    columns += [Column(parameter, form=".4f") for parameter in found.parameters]
    rows = [(fold.name.removeprefix("without "), *fold.updated) for fold in found.folds]
    return [Table("Parameters over the updates", tuple(columns), tuple(rows))]
