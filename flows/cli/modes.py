"""`modetune modes`: the modes of a campaign's model. Heavy packages are imported where needed."""

from __future__ import annotations

import json
from math import isfinite

import typer

from modetune.flows.cli.options import AsJson, At, CampaignPath, Settings, stoppable
from modetune.flows.report.tables import json_of


def modes(
    campaign_file: CampaignPath, at: At = None, settings: Settings = None, as_json: AsJson = False
) -> None:
    """Compute the model's modes, at the deck's values or at those of --at."""
    from modetune.flows.campaign.campaign import load_campaign
    from modetune.flows.updating.modal_run import modal_summary, model_modes, parse_values

    campaign = load_campaign(campaign_file, settings or [])
    with stoppable():
        result = model_modes(campaign, parse_values(campaign, at or []))
    found = modal_summary(campaign, result)
    if as_json:
        typer.echo(json.dumps(json_of(found)))
        return
    for number, frequency in enumerate(found.frequencies_hz.tolist(), start=1):
        rigid = "  rigid" if number <= found.rigid_modes else ""
        typer.echo(f"{number:4d} {frequency:14.6f} Hz{rigid}")
    mass = f"{found.mass_kg:.6g} kg" if isfinite(found.mass_kg) else "not known"
    typer.echo(f"mass {mass}; {found.solver} {found.solver_version}")
