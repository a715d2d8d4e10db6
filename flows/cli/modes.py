"""`modetune modes`: the modes of a campaign's model. Heavy packages are imported where needed."""

from __future__ import annotations

import json
from math import isfinite
from typing import Annotated

import typer

from modetune.flows.cli.options import (
    AsJson,
    At,
    ModelPath,
    Settings,
    SolverChoice,
    UnitsChoice,
    begun,
    stoppable,
    with_model,
)
from modetune.flows.report.tables import json_of


def modes(
    model: ModelPath,
    at: At = None,
    number: Annotated[
        int | None, typer.Option(min=1, help="How many modes, rigid ones counted.")
    ] = None,
    solver: SolverChoice = None,
    units: UnitsChoice = None,
    settings: Settings = None,
    as_json: AsJson = False,
) -> None:
    """Compute the modes of a campaign's model or of a deck, at its values or those of --at."""
    with stoppable(), begun(f"reading {model}") as tell:
        from modetune.flows.campaign.sketch import looked_at
        from modetune.flows.updating.modal_run import modal_summary, model_modes, parse_values

        campaign = looked_at(model, with_model(settings, solver, units))
        values = parse_values(campaign, at or [])
        tell(f"modes of {campaign.name} by {campaign.solver_name}")
        result = model_modes(campaign, values, number)
    found = modal_summary(campaign, result)
    if as_json:
        typer.echo(json.dumps(json_of(found)))
        return
    typer.echo("mode      frequency")
    for place, frequency in enumerate(found.frequencies_hz.tolist(), start=1):
        rigid = "  rigid" if place <= found.rigid_modes else ""
        typer.echo(f"{place:4d} {frequency:14.6f} Hz{rigid}")
    mass = f"mass {found.mass:.6g} (the deck's unit)" if isfinite(found.mass) else "mass not known"
    mass = f"mass {found.mass_kg:.6g} kg" if isfinite(found.mass_kg) else mass
    version = found.solver_version.removeprefix(f"{found.solver} ")
    typer.echo(f"{mass}; {found.solver} {version}")
