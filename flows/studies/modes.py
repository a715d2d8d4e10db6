"""`modetune modes`: the modes of a campaign's model."""

from __future__ import annotations

from math import isfinite
from typing import Annotated

import typer

from modetune.flows.report.tables import json_object
from modetune.flows.studies.result import StudyResult
from modetune.flows.studies.study import DeckOptions, StudyContext, study


@study(DeckOptions)
def modes(
    on: StudyContext,
    number: Annotated[
        int | None, typer.Option(min=1, help="Number of modes, including rigid-body modes.")
    ] = None,
) -> StudyResult:
    """Compute the modes of a campaign's model or of a deck."""
    from modetune.flows.campaign.units import KILOGRAMS
    from modetune.flows.updating.mode_source import campaign_analysis, model_modes

    campaign = on.campaign
    found = model_modes(campaign, on.values, number)
    name, version, hz = campaign.solver_name, campaign.solver_version(), found.modes.frequencies_hz
    mass_kg = found.mass * KILOGRAMS[campaign.case.units]  # a model of rotations alone has none
    lines = ["mode      frequency"]
    for place, frequency in enumerate(hz.tolist(), start=1):
        rigid = "  rigid" if place <= found.n_rigid else ""
        lines.append(f"{place:4d} {frequency:14.6f} Hz{rigid}")
    mass = f"mass {found.mass:.6g} (the deck's unit)" if isfinite(found.mass) else "mass not known"
    mass = f"mass {mass_kg:.6g} kg" if isfinite(mass_kg) else mass
    summary = json_object(
        frequencies_hz=hz,
        rigid_modes=found.n_rigid,
        mass=found.mass,
        mass_kg=mass_kg,
        solver=name,
        solver_version=version,
    )
    sentence = f"{mass}; {name} {version.removeprefix(f'{name} ')}"
    if hz.size < (asked := number or campaign_analysis(campaign).n_modes):
        sentence += f"; the model has no more than {hz.size} modes ({asked} were requested)"
    return StudyResult(found, sentence, summary, lines=[*lines, sentence], written=None)
