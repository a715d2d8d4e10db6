"""The process of one deployed run: reads which campaign on standard input, and updates it.

Started by a worker, which is told nothing but an exit code; what became of the campaign is the
state of its flow run.
"""

from __future__ import annotations

import json
import logging
import os
import signal
import sys
from pathlib import Path

from pydantic import BaseModel, ConfigDict, ValidationError

from modetune.core.errors import CampaignRunning, ModetuneError
from modetune.core.storage.record import CampaignRecord, IterationRecord
from modetune.flows.campaign.campaign import load_campaign
from modetune.flows.updating.prefect import Pages, shown
from modetune.flows.updating.running import job_engine
from modetune.flows.updating.starting import is_unchanged, read_earlier
from modetune.flows.updating.starts import update_from_starts


class Parameters(BaseModel):
    """What a deployment says of its campaign; nothing of how it is run."""

    model_config = ConfigDict(extra="forbid", strict=True)

    name: str
    campaign_file: str
    settings: list[str]
    runs: str


class LogProgress:
    """What is being computed, as lines of the run's log; pages tell of iterations themselves."""

    def __init__(self, pages: Pages) -> None:
        self.pages = pages

    def working(self, text: str) -> None:
        self.pages.log(text)

    def iteration(self, record: IterationRecord) -> None:
        pass


class PagesLog(logging.Handler):
    """modetune's own log lines on the page of the flow run."""

    def __init__(self, pages: Pages) -> None:
        super().__init__(logging.INFO)
        self.pages = pages

    def emit(self, record: logging.LogRecord) -> None:
        self.pages.log(record.getMessage(), record.levelno)


def update(run: str, told: object) -> None:
    """Update a deployed campaign. run: its flow run; told: its parameters."""
    name = told.get("name", "") if isinstance(told, dict) else ""
    with shown(str(name) or "unknown", run) as pages:
        ours = logging.getLogger("modetune")
        handler, level = PagesLog(pages), ours.level
        ours.addHandler(handler)
        ours.setLevel(logging.INFO)
        try:
            parameters = Parameters.model_validate(told)
            _update(parameters, pages)
        except ValidationError as error:
            pages.end("FAILED", "Failed", f"these are not a campaign's parameters: {error}")
        except CampaignRunning as error:
            pages.end("COMPLETED", "Already running", str(error))
        except ModetuneError as error:
            pages.log(str(error), logging.ERROR)
            pages.failed(error)
        finally:
            ours.removeHandler(handler)
            ours.setLevel(level)


def _update(told: Parameters, pages: Pages) -> None:
    campaign = load_campaign(Path(told.campaign_file), told.settings)
    folder = Path(told.runs) / campaign.name
    earlier = read_earlier(folder)
    same = earlier is not None and is_unchanged(campaign, job_engine(campaign), earlier)
    run = update_from_starts(campaign, folder, LogProgress(pages), pages)
    if same and not run.record.runs.modal + run.record.runs.sensitivity:
        pages.end("COMPLETED", "Unchanged", _unchanged(run.record), run.folder)
    else:
        pages.ended(run.record, run.folder)


def _unchanged(record: CampaignRecord) -> str:
    return (
        "nothing changed since the run before: no solver run, all "
        f"{record.runs.reused} results from the store; still {record.status.replace('_', ' ')}: "
        f"{record.reason}"
    )


def main() -> None:
    """Read the run from standard input; SIGTERM and Ctrl-C end it in good order."""
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    run, told = json.load(sys.stdin)
    logging.getLogger("modetune").propagate = False
    try:
        update(run, told)
    except KeyboardInterrupt:
        os._exit(0)  # it was told


if __name__ == "__main__":
    main()
