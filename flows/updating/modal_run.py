"""Modes of a campaign's model at chosen parameter values: the Python API of `modetune modes`."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace

from modetune.core.errors import CampaignError
from modetune.core.updating.results import ModalResult
from modetune.flows.campaign.campaign import Campaign
from modetune.flows.jobs.job import Job
from modetune.flows.updating.finders import campaign_analysis
from modetune.flows.updating.running import job_engine


def parse_values(campaign: Campaign, settings: list[str]) -> dict[str, float]:
    """NAME=VALUE texts over the campaign's initial values. Raises CampaignError."""
    values = campaign.parameters.values(campaign.parameters.initial)
    known = {item.name: item for item in campaign.parameters.parameters}
    for setting in settings:
        name, separator, text = setting.partition("=")
        if not separator or name not in values:
            raise CampaignError(
                f"--at {setting!r}: expected NAME=VALUE with NAME of {', '.join(values)}"
            )
        try:
            given = float(text)
        except ValueError:
            raise CampaignError(f"--at {setting!r}: {text!r} is not a number") from None
        values[name] = known[name].counted(given)
        relative = known[name].values == "relative"
        if not math.isfinite(given) or (relative and not 0.0 < given < 1e6):
            raise CampaignError(f"--at {setting!r}: a relative value above zero is expected")
    return values


def model_modes(
    campaign: Campaign, values: Mapping[str, float], number: int | None = None
) -> ModalResult:
    """The modes of the model, from the store or the solver; number: how many, rigid ones counted.

    Raises SolverError, StoreError.
    """
    analysis = campaign_analysis(campaign)
    job = Job(values, replace(analysis, n_modes=number or analysis.n_modes))
    return job_engine(campaign).solve(job).result(ModalResult)
