"""The current state of a campaign: its record so far, running jobs and the end of its log."""

from __future__ import annotations

import json
import time
from pathlib import Path

from modetune.core.errors import ModetuneError
from modetune.core.storage.campaign_record import CampaignRecord, read_record
from modetune.core.storage.keys import Json
from modetune.core.storage.store import Store
from modetune.flows.jobs.job import NOTE_FILE, read_note
from modetune.flows.jobs.progress import PROGRESS_FILE
from modetune.flows.jobs.store_files import campaigns_running
from modetune.flows.report.iteration_tables import iteration_table
from modetune.flows.report.parameter_tables import BRIEF_PARAMETERS, parameter_table
from modetune.flows.report.tables import Table
from modetune.flows.updating.update import LOG

#: Lines of the log that are shown.
LAST_LINES = 12


class LiveRecord:
    """The newest record in a run folder, read once for each time it was written."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._known: tuple[tuple[str, int], CampaignRecord | None] | None = None

    def newest(self) -> tuple[str, CampaignRecord | None]:
        """A mark that changes with the record, and the record; nothing where there is none yet."""
        files = [self.folder / name for name in ("campaign.unfinished.h5", "campaign.h5")]
        times = {path: path.stat().st_mtime_ns for path in files if path.is_file()}
        if not times:
            return "", None
        path = max(times, key=times.__getitem__)
        mark = path.name, times[path]
        if self._known is None or self._known[0] != mark:
            try:
                record = read_record(path)
            except ModetuneError:  # renamed in the meantime, or another version
                record = None
            self._known = mark, record
        return f"{mark[0]} {mark[1]}", self._known[1]


def live_json(record: LiveRecord, store: Store) -> dict[str, Json]:
    """What the page asks for every second."""
    mark, known = record.newest()
    running = campaigns_running(store)
    told: dict[str, Json] = {
        "mark": mark,
        "status": _status(mark, known, running),
        "reason": known.reason if known else "",
        "progress": _progress(record.folder / PROGRESS_FILE) if running else None,
        "jobs": _jobs(store) if running else [],
        "log": _last_lines(record.folder / LOG),
        "tables": [],
        "iteration": None,
    }
    if known is not None:
        tables = iteration_table(known.iterations), parameter_table(known, BRIEF_PARAMETERS)
        told["tables"] = [_table_json(table) for table in tables]
        told["iteration"] = known.iterations[-1].number
    return told


def _table_json(table: Table) -> dict[str, Json]:
    """A table for the page: its heads, whether a column holds words, and its texts."""
    return {
        "title": table.title,
        "heads": [column.head for column in table.columns],
        "words": [column.words for column in table.columns],
        "rows": [list(row) for row in (*table.texts, *table.foot_texts)],
    }


def _status(mark: str, known: CampaignRecord | None, running: int) -> str:
    unfinished = mark.startswith("campaign.unfinished")
    if unfinished or known is None:
        return "running" if running else "broken off" if unfinished else "not run yet"
    return known.status


def _progress(path: Path) -> Json:
    """Return the current step and the jobs done and requested; None if the run reports none."""
    try:
        progress: Json = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None
    return progress


def _jobs(store: Store) -> list[Json]:
    """Describe each running job of a store, of any campaign."""
    found = []
    for folder in sorted((store.folder / "jobs").glob("*.part")):
        try:
            since = time.time() - folder.stat().st_mtime
            note = read_note((folder / NOTE_FILE).read_text(encoding="utf-8"))
        except OSError:  # has just ended or started
            continue
        what = f"{note.analysis} of {note.model} by {note.solver}" if note else "job"
        found.append(f"{what}, {folder.stem[:12]}, {max(since, 0.0):.0f} s")
    return list(found)


def _last_lines(path: Path) -> list[Json]:
    try:
        with path.open("rb") as file:
            file.seek(max(path.stat().st_size - 8192, 0))
            text = file.read().decode("utf-8", "replace")
    except OSError:
        return []
    return list(text.splitlines()[-LAST_LINES:])
