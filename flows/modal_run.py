"""Modes of a campaign's model at chosen parameter values: the Python API of `modetune modes`."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import TypedDict

from modetune.core.errors import CampaignError
from modetune.core.results import ModalResult
from modetune.flows.campaign import Campaign
from modetune.flows.evaluator import campaign_analysis
from modetune.flows.execution.engine import Job
from modetune.flows.running import job_engine
from modetune.flows.units import KILOGRAMS


class ModalSummary(TypedDict):
    """The `--json` object of `modetune modes`."""

    frequencies_hz: list[float]
    rigid_modes: int
    mass: float | None
    mass_kg: float | None
    solver: str
    solver_version: str


def parse_values(campaign: Campaign, settings: list[str]) -> dict[str, float]:
    """NAME=VALUE texts over the campaign's initial values. Raises CampaignError."""
    values = campaign.parameters.values(campaign.parameters.initial)
    for setting in settings:
        name, separator, text = setting.partition("=")
        if not separator or name not in values:
            raise CampaignError(
                f"--at {setting!r}: expected NAME=VALUE with NAME of {', '.join(values)}"
            )
        try:
            values[name] = float(text)
        except ValueError:
            raise CampaignError(f"--at {setting!r}: {text!r} is not a number") from None
        if not 0.0 < values[name] < 1e6:
            raise CampaignError(f"--at {setting!r}: a relative value above zero is expected")
    return values


def model_modes(campaign: Campaign, values: Mapping[str, float]) -> ModalResult:
    """The modes of the model, from the store or the solver. Raises SolverError, StoreError."""
    result = job_engine(campaign).result(Job(values, campaign_analysis(campaign)))
    assert isinstance(result, ModalResult)
    return result


def modal_summary(campaign: Campaign, result: ModalResult) -> ModalSummary:
    """What `modetune modes` tells; mass in the deck's unit and in kg."""
    known = math.isfinite(result.mass)  # a model of rotations alone has none
    return {
        "frequencies_hz": result.modes.frequencies_hz.tolist(),
        "rigid_modes": result.n_rigid,
        "mass": result.mass if known else None,
        "mass_kg": result.mass * KILOGRAMS[campaign.units] if known else None,
        "solver": campaign.solver.name,
        "solver_version": campaign.solver.version(),
    }
