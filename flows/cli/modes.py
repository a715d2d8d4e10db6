"""`modetune modes`: the modes of a campaign's model. Heavy packages are imported where needed."""

from __future__ import annotations

from math import isfinite
from typing import Annotated

import typer

from modetune.flows.cli.ending import tell_end
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
from modetune.flows.report.tables import json_object


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
        from modetune.flows.campaign.units import KILOGRAMS
        from modetune.flows.updating.modal_run import model_modes, parse_values

        campaign = looked_at(model, with_model(settings, solver, units))
        values = parse_values(campaign, at or [])
        tell(f"modes of {campaign.name} by {campaign.solver_name}")
        found = model_modes(campaign, values, number)
    name, version, hz = campaign.solver_name, campaign.solver_version(), found.modes.frequencies_hz
    mass_kg = found.mass * KILOGRAMS[campaign.case.units]  # a model of rotations alone has none
    told = json_object(
        frequencies_hz=hz,
        rigid_modes=found.n_rigid,
        mass=found.mass,
        mass_kg=mass_kg,
        solver=name,
        solver_version=version,
    )
    lines = ["mode      frequency"]
    for place, frequency in enumerate(hz.tolist(), start=1):
        rigid = "  rigid" if place <= found.n_rigid else ""
        lines.append(f"{place:4d} {frequency:14.6f} Hz{rigid}")
    mass = f"mass {found.mass:.6g} (the deck's unit)" if isfinite(found.mass) else "mass not known"
    mass = f"mass {mass_kg:.6g} kg" if isfinite(mass_kg) else mass
    tell_end(told, [*lines, f"{mass}; {name} {version.removeprefix(f'{name} ')}"], as_json)
