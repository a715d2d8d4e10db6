"""`modetune validate`: does the model hold on what it was not updated with?"""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from modetune.core.keys import number_or_null
from modetune.flows.commands.stopping import stoppable

if TYPE_CHECKING:
    from rich.console import Console

    from modetune.flows.validation.leave_out import Validation


def register(app: typer.Typer) -> None:
    """Add this file's command to the command line."""
    app.command()(validate)


def validate(
    campaign_file: Annotated[Path, typer.Argument(help="Campaign file (YAML).")],
    one_out: Annotated[
        bool,
        typer.Option("--leave-one-out", help="Update without each used mode in turn."),
    ] = False,
    settings: Annotated[
        list[str] | None,
        typer.Option("--set", help="KEY.KEY=VALUE over the campaign file; may be repeated."),
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="One JSON object.")] = False,
) -> None:
    """Judge an update by what it was not made from, before and after.

    By what the campaign holds out, or with --leave-one-out by each used mode in turn. Nothing but
    the store is written. Exit code 3 where something that was held out got worse.
    """
    from modetune.flows.campaign import load_campaign
    from modetune.flows.display import ConsoleProgress
    from modetune.flows.terminal import terminal
    from modetune.flows.validation.leave_out import leave_one_out
    from modetune.flows.validation.leave_out import validate as by_held_out

    campaign = load_campaign(campaign_file, settings or [])
    with stoppable(), ConsoleProgress(terminal(stderr=True)).shown() as progress:
        judge = leave_one_out if one_out else by_held_out
        found = judge(campaign, progress.working)
    if as_json:
        typer.echo(json.dumps(told(found, one_out)))
    else:
        _show(terminal(), found)
    raise typer.Exit(0 if found.status == "good" else 3)


def told(found: Validation, one_out: bool) -> dict[str, Any]:
    """The `--json` object of `modetune validate`."""
    from modetune.flows.recording import held_out_summary

    least, largest = found.spread
    return {
        "status": found.status,
        "name": found.name,
        "leave_one_out": one_out,
        "held_out": held_out_summary(found.held_out, found.configurations),
        "updates": [
            {
                "left_out": fold.number or None,
                "status": fold.status,
                "reason": fold.reason,
                "iterations": fold.iterations,
                "parameters": dict(
                    zip(found.parameters, map(number_or_null, fold.updated.tolist()), strict=True)
                ),
            }
            for fold in found.folds
        ],
        "parameters": [
            {"name": name, "least": number_or_null(low), "largest": number_or_null(high)}
            for name, low, high in zip(
                found.parameters, least.tolist(), largest.tolist(), strict=True
            )
        ],
        "solver_runs": {
            "modal": found.runs.modal,
            "sensitivity": found.runs.sensitivity,
            "reused": found.runs.reused,
        },
        "wall_s": round(found.wall_s, 3),
    }


def _show(console: Console, found: Validation) -> None:
    from rich.table import Table
    from rich.text import Text

    from modetune.core.numbering import mode_name
    from modetune.flows.validation.table import WORSE, show_held_out

    show_held_out(console, found.held_out, found.configurations)
    for fold in found.failed:
        name = mode_name(found.configurations, fold.number)
        console.print(Text(f"without {name} the update failed: {fold.reason}", style=WORSE),
                      soft_wrap=True)  # fmt: skip
    if len(found.folds) > 1:
        table = Table(title="Parameters over the updates", title_justify="left")
        table.add_column("without", no_wrap=True)
        for parameter in found.parameters:
            table.add_column(parameter, justify="right")
        for fold in found.folds:
            cells = (f"{value:.4f}" if math.isfinite(value) else "-" for value in fold.updated)
            table.add_row(mode_name(found.configurations, fold.number), *cells)
        console.print(table)
    runs = found.runs
    said = {
        "good": "nothing that was held out got worse",
        "worse": "what was held out got worse",
        "failed": "not every update came to an end",
    }[found.status]
    console.print(
        Text(
            f"{found.status}: {said}\n{len(found.folds)} updates; solver runs: {runs.modal} modal, "
            f"{runs.sensitivity} sensitivity, {runs.reused} answered by the store; "
            f"{found.wall_s:.1f} s"
        ),
        soft_wrap=True,
    )
