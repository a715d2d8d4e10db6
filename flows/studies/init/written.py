"""A drafted campaign as a file that `check` accepts."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from modetune.core.errors import CampaignError
from modetune.core.storage.files import writing
from modetune.flows.campaign.campaign import load_campaign
from modetune.flows.campaign.schema import CampaignFile, OpenFile
from modetune.flows.studies.init.draft import Draft, draft_campaign, keep
from modetune.flows.studies.init.text import campaign_text


def init_campaign(
    deck: Path,
    tests: Sequence[Path] = (),
    settings: Sequence[str] = (),
    out: Path | None = None,
    force: bool = False,
) -> Draft:
    """Write a campaign for a deck, beside it unless named, and read it as `check` will.

    settings: `model.solver=NAME`, `model.units=NAME`. Files that are there stay unless force.
    Raises CampaignError, ModelError for why there can be none.
    """
    path = out or deck.with_name("campaign.yaml")
    keep(path, force)
    draft = draft_campaign(deck, tests, settings, path, force)
    with writing(path) as part:
        part.write_text(campaign_text(draft), encoding="utf-8")
    try:
        load_campaign(path, [], CampaignFile if draft.test else OpenFile)
    except CampaignError as error:
        path.unlink()
        raise CampaignError([f"a campaign for {deck} is refused:", *error.problems]) from error
    return draft
