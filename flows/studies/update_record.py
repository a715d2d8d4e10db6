"""The update that a study of its campaign starts from."""

from __future__ import annotations

from pathlib import Path

from modetune.core.errors import CampaignError
from modetune.core.storage.campaign_record import CAMPAIGN, CampaignRecord, read_record
from modetune.flows.campaign.campaign import Campaign
from modetune.flows.studies.study import ModelState


def update_record(
    campaign: Campaign, record: Path | None, state: ModelState | None, folder: Path
) -> CampaignRecord | None:
    """Return the record that is named, else that of the newest update; None: the campaign's start.

    record: run folder or campaign.h5; folder: the campaign's run folder. Raises CampaignError
    where `state` contradicts what is there, StoreError.
    """
    if state == "initial":
        if record is not None:
            raise CampaignError("--record names an updated model, and --state initial the start")
        return None
    if record is None and not (folder / CAMPAIGN.file).is_file():
        if state == "updated":
            raise CampaignError(
                f"{campaign.file}: --state updated: there is no update in {folder}; run `modetune "
                "update`, or name a run folder with --record"
            )
        return None
    return read_record(folder if record is None else record)
