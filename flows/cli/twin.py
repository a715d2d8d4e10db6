"""`modetune twin`: one model on several solvers. Heavy packages are imported where needed."""

from __future__ import annotations

from typing import Annotated

import typer

from modetune.flows.cli.ending import tell_end
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
    from modetune.flows.studies.cross_solver.cross_solver import run_twin, twin_parts, twin_summary

    with stoppable():
        compared = run_twin(campaign_file, solvers.split(","), at or [], settings or [])
    tell_end(twin_summary(compared), twin_parts(compared), as_json)
    raise typer.Exit(0 if len(compared.solvers) > 1 else 4)
