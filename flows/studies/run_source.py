"""A campaign together with its run: from the campaign file, or from the run folder alone."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from modetune.core.errors import CampaignError
from modetune.core.storage.campaign_record import CAMPAIGN, CampaignRecord, read_record
from modetune.flows.campaign.campaign import Campaign, load_campaign

#: How far above a run folder its campaign file is looked for.
LEVELS = 3


@dataclass(frozen=True, slots=True)
class RunSource:
    """A campaign, and its record where it was run."""

    campaign: Campaign
    record: CampaignRecord | None
    run_folder: Path


def open_run(place: Path, settings: list[str], runs: Path) -> RunSource:
    """The campaign of a campaign file or of a run folder. Raises CampaignError, StoreError."""
    record: CampaignRecord | None
    if place.is_dir():
        path = place / CAMPAIGN.file
        record = read_record(path)
        campaign = load_campaign(_campaign_file(path, record), [*record.settings, *settings])
    else:
        campaign = load_campaign(place, settings)
        path = runs / campaign.name / CAMPAIGN.file
        record = read_record(path) if path.is_file() else None
    if record is not None and record.parameters.names != campaign.parameters.names:
        raise CampaignError(
            f"{path} has the parameters {', '.join(record.parameters.names)}, but "
            f"{campaign.file} has {', '.join(campaign.parameters.names)}; run `modetune update` "
            "again, or name the campaign file it was made with"
        )
    return RunSource(campaign, record, path.parent)


def _campaign_file(path: Path, record: CampaignRecord) -> Path:
    """The campaign file of a record: the same text, in a folder above. Raises CampaignError."""
    above = [Path.cwd(), *path.resolve().parent.parents[:LEVELS]]
    for file in (file for parent in above for file in sorted(parent.glob("*.y*ml"))):
        try:
            if file.read_text(encoding="utf-8") == record.campaign_text:
                return file
        except (OSError, UnicodeDecodeError):
            continue
    raise CampaignError(
        f"{path}: no file in or above {path.parent} has the text of its campaign "
        f"{record.name}; name the campaign file instead of the folder (with --runs if run folders "
        "are not in ./runs)"
    )
