"""`modetune twin`: one model on several solvers. Heavy packages are imported where needed."""

from __future__ import annotations

import json
from typing import Annotated

import typer

from modetune.flows.cli.options import AsJson, At, CampaignPath, Settings, stoppable


def twin(
    campaign_file: CampaignPath,
    solvers: Annotated[
        str, typer.Option(help="Solvers to compare, with commas; the first is the reference.")
    ] = "nastran,calculix",
    at: At = None,
    settings: Settings = None,
    as_json: AsJson = False,
) -> None:
    """Run the model's modal analysis on several solvers and show their modes side by side."""
    from modetune.flows.studies.cross_solver.cross_solver import run_twin, twin_summary
    from modetune.flows.studies.cross_solver.telling import show_twin

    with stoppable():
        compared = run_twin(campaign_file, solvers.split(","), at or [], settings or [])
    if as_json:
        typer.echo(json.dumps(twin_summary(compared)))
    else:
        show_twin(compared)
    raise typer.Exit(0 if len(compared.solvers) > 1 else 4)
