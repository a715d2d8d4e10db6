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
import time
from contextlib import suppress
from dataclasses import replace
from datetime import UTC, date, datetime
from pathlib import Path

import numpy as np

from modetune.core.errors import StorageUnavailable
from modetune.core.modes import Floats
from modetune.core.monitoring.drift import Drift, find_drift
from modetune.core.monitoring.past_runs import (
    FOLDER,
    History,
    PastRun,
    add_past_run,
    past_run,
    read_history,
)
from modetune.core.storage.campaign_record import CAMPAIGN, CampaignRecord
from modetune.core.storage.files import make_folder, storage_errors
from modetune.core.storage.keys import Json
from modetune.flows.campaign.schema import MonitoringSection
from modetune.flows.report.report_file import FAILURES, PAGE
from modetune.flows.report.tables import json_object

logger = logging.getLogger(__name__)

#: Parameters of fields and the like: one test determines none of them by itself.
MOST_PARAMETERS = 100


class RunHistory:
    """The history in a run folder, while an update adds to it."""

    def __init__(self, folder: Path, keep: int, monitoring: MonitoringSection) -> None:
        self.folder, self.keep, self.monitoring = folder, keep, monitoring
        self.history = read_history(folder)
        for problem in self.history.problems:
            logger.warning("left out of the history: %s", problem)

    def recover(self, record: CampaignRecord) -> None:
        """Add the previous run if it was killed between its record and its history."""
        if record.ended_at == record.ended_at:  # not NaN, as in records of earlier versions
            self.add(record, self.folder / PAGE)

    def concluded(self, record: CampaignRecord) -> tuple[CampaignRecord, Drift | None]:
        """Return a finished record with its time and the state of the structure, and its drift.

        The first test of a structure has nothing to be compared with, so the record says nothing.
        """
        record = replace(record, ended_at=time.time())
        run = past_run(record, self.history)
        drift = drift_at(self.history, run, self.monitoring)
        if drift is None:
            return record, None
        first = len(self.history.until(run).nights()) == 1
        changed = tuple(item.name for item in drift.changes if item.changed)
        found = replace(
            record, state=drift.state, drift="" if first else drift.sentence, changed=changed
        )
        return found, drift

    def is_news(self, record: CampaignRecord) -> bool:
        """Return whether a record shows a change that the run before it did not show."""
        if self.history.with_same_evidence(past_run(record, self.history)) is not None:
            return False
        before = self.history.runs[-1].changed if self.history.runs else ()
        return record.state == "changed" and not set(record.changed) <= set(before)

    def add(self, record: CampaignRecord, page: Path | None) -> None:
        """Add a finished run, unless the history has its evidence, and keep its files."""
        run = past_run(record, self.history)
        known = self.history.with_same_evidence(run)
        try:
            if known is not None:
                _keep_page(self.folder, known, page)
                return
            _keep_files(self.folder, run, page, self.keep)
            add_past_run(self.folder, run)
            self.history = self.history.until(run)
            _prune(self.folder, self.history, self.keep)
        except StorageUnavailable as error:
            logger.warning("the history of %s was not written: %s", self.folder, error)


def drift_at(history: History, run: PastRun, monitoring: MonitoringSection) -> Drift | None:
    """Return how the structure drifted up to a run; None where its parameters cannot show it.

    A run whose evidence the history has counts when it was new.
    """
    if len(run.names) > MOST_PARAMETERS:
        return None
    until = history.until(history.with_same_evidence(run) or run)
    try:
        series = until.series()
        return find_drift(
            series,
            monitoring.learning,
            _first(series.times, monitoring.reference),
            monitoring.structures,
            monitoring.false_alarm_rate,
        )
    except FAILURES as error:  # hours of solving are not lost for a statistic
        logger.warning("the drift of %s is unknown (%s: %s)", run.name, type(error).__name__, error)
        return None


def drift_json(drift: Drift | None) -> Json:
    """Return the drift of a structure as JSON, without what it was for each run."""
    names = "state sentence changes joint_limit lag_correlation scatter left_out notes"
    return None if drift is None else json_object(drift, names)


def _first(times: Floats, reference: date | None) -> int:
    """Return the place of the first run on a date or after it, at most the last one."""
    if reference is None:
        return 0
    start = datetime.combine(reference, datetime.min.time(), UTC).timestamp()
    return min(int(np.searchsorted(times, start)), times.size - 1)


def kept_folder(folder: Path, run: PastRun) -> Path | None:
    """Return the folder with the record of a past run; None where it is no longer kept."""
    place = folder / FOLDER / run.stem
    return place if (place / CAMPAIGN.file).is_file() else None


def _keep_files(folder: Path, run: PastRun, page: Path | None, keep: int) -> None:
    """Put record, report and deck of the newest run into a folder."""
    place = folder / FOLDER / run.stem
    part = place.with_name(f".{run.stem}.part")
    with storage_errors(place):
        if not keep or place.exists():
            return
        shutil.rmtree(part, ignore_errors=True)
        make_folder(part)
        for file in filter(None, (folder / CAMPAIGN.file, page)):
            if file.is_file():
                _link(file, part / file.name)
        if (folder / "updated").is_dir():
            shutil.copytree(folder / "updated", part / "updated")
        part.rename(place)


def _keep_page(folder: Path, run: PastRun, page: Path | None) -> None:
    """Add the report of a run that was killed between its record and its report."""
    place = kept_folder(folder, run)
    if place and page and page.is_file() and not (place / PAGE).exists():
        with storage_errors(place):
            _link(page, place / PAGE)


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
