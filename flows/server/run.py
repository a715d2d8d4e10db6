"""One entry for every study: the command and the Python verb run it here."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Literal

from modetune.flows.campaign.campaign import Campaign
from modetune.flows.studies.ending import StudyEnd
from modetune.flows.studies.study import Study
from modetune.flows.updating.updating import Progress


def carried_out(
    study: Study,
    parameters: Mapping[str, Any],
    progress: Progress,
    *,
    prefect: Literal["start", "find", "off"] = "start",
    campaign: Campaign | None = None,
) -> StudyEnd:
    """Run a study.

    campaign: one that Python has loaded already. Raises CampaignError and the errors of the study.
    """
    with study.opened(parameters, progress, campaign) as on:
        return study.call(on, parameters)
