"""The history of a campaign's run folder: what an update adds to it, and what it finds in it.

The newest run is in the run folder. Its past run (`core/monitoring/past_runs`) stays for ever; its
record, report and deck stay in a folder next to it until `run.keep` later runs have their own.
Record and report share their space on the disk with those of the newest run until the next one. The
deck is a copy, because people edit decks in place.

Nothing here fails an update: a history that cannot be written or read is a warning.
"""

from __future__ import annotations

import logging
import os
import shutil
from contextlib import suppress
from pathlib import Path

from modetune.core.errors import StorageUnavailable
from modetune.core.monitoring.past_runs import (
    FOLDER,
    History,
    PastRun,
    add_past_run,
    past_run,
    read_history,
)
from modetune.core.storage.campaign_record import CAMPAIGN, CampaignRecord
from modetune.core.storage.files import storage_errors
from modetune.flows.report.report_file import PAGE

logger = logging.getLogger(__name__)


class RunHistory:
    """The history in a run folder, while an update adds to it."""

    def __init__(self, folder: Path, keep: int) -> None:
        self.folder, self.keep = folder, keep
        self.history = read_history(folder)
        for problem in self.history.problems:
            logger.warning("left out of the history: %s", problem)

    def recover(self, record: CampaignRecord) -> None:
        """Add the previous run if it was killed between its record and its history."""
        if record.ended_at == record.ended_at:  # not NaN, as in records of earlier versions
            self.add(record, self.folder / PAGE)

    def add(self, record: CampaignRecord, page: Path | None) -> None:
        """Add a finished run, unless the history has its evidence, and keep its files."""
        run = past_run(record, self.history)
        if self.history.with_same_evidence(run) is not None:
            return
        try:
            _keep_files(self.folder, run, page, self.keep)
            add_past_run(self.folder, run)
            self.history = self.history.until(run)
            _prune(self.folder, self.history, self.keep)
        except StorageUnavailable as error:
            logger.warning("the history of %s was not written: %s", self.folder, error)


def kept_folder(folder: Path, run: PastRun) -> Path | None:
    """Return the folder with the record of a past run; None where it is no longer kept."""
    place = folder / FOLDER / run.stem
    return place if (place / CAMPAIGN.file).is_file() else None


def _keep_files(folder: Path, run: PastRun, page: Path | None, keep: int) -> None:
    """Put record, report and deck of the newest run into a folder of their own."""
    place = folder / FOLDER / run.stem
    part = place.with_name(f".{run.stem}.part")
    with storage_errors(place):
        if not keep or place.exists():
            return
        shutil.rmtree(part, ignore_errors=True)
        part.mkdir(parents=True)
        for file in filter(None, (folder / CAMPAIGN.file, page)):
            if file.is_file():
                _link(file, part / file.name)
        if (folder / "updated").is_dir():
            shutil.copytree(folder / "updated", part / "updated")
        part.rename(place)


def _link(source: Path, target: Path) -> None:
    """Give a file that is only ever replaced a second name, or copy it where that is impossible."""
    try:
        os.link(source, target)
    except OSError:
        shutil.copy2(source, target)


def _prune(folder: Path, history: History, keep: int) -> None:
    """Remove the files of all but the newest runs; their past runs stay."""
    stems = [run.stem for run in history.runs]
    for stem in stems[: max(0, len(stems) - keep)]:
        with suppress(OSError):
            shutil.rmtree(folder / FOLDER / stem)
