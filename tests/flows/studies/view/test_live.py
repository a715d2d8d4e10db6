"""What the page is told of a campaign that runs, was broken off, or never ran."""

from __future__ import annotations

import dataclasses
import json
import re
from pathlib import Path
from typing import Any

import pytest
from rich.console import Console

from modetune.core.storage.store import Store
from modetune.flows.jobs.job import NOTE_FILE, JobNote
from modetune.flows.jobs.progress import JobProgress
from modetune.flows.jobs.store_files import in_use
from modetune.flows.studies.view.live_record import LiveRecord, live_json
from modetune.flows.updating.update import update_campaign


def test_jobs_under_way_are_told_while_a_campaign_runs(tmp_path: Path) -> None:
    store, record = Store(tmp_path / "store"), LiveRecord(tmp_path / "runs" / "pipe")
    job = store.folder / "jobs" / f"{'ab' * 32}.part"
    job.mkdir(parents=True)
    note = JobNote("ccx", "2.20", "pipe", "d", "modal", (), 4, 0, "d", (), 1)
    (job / NOTE_FILE).write_text(json.dumps(dataclasses.asdict(note)))
    told: Any = live_json(record, store)
    assert (told["status"], told["jobs"], told["tables"]) == ("not run yet", [], [])
    with in_use(store):
        told = live_json(record, store)
        assert told["status"] == "running"
        assert re.fullmatch(r"modal of pipe by ccx, abababababab, \d+ s", told["jobs"][0])


def test_a_run_counts_its_finished_and_submitted_jobs(tmp_path: Path) -> None:
    store, folder = Store(tmp_path / "store"), tmp_path / "runs" / "pipe"
    folder.mkdir(parents=True)
    record, jobs = LiveRecord(folder), JobProgress(Console(quiet=True))
    with in_use(store), jobs.shown():
        told: Any = live_json(record, store)
        assert told["progress"] is None  # a run that keeps no file
        jobs.keep(folder)
        jobs.submitted(3)
        told = live_json(record, store)
        assert told["progress"] == {"text": "starting; 0 of 3 jobs done", "done": 0, "asked": 3}
    assert not list(folder.iterdir())
    assert live_json(record, store)["progress"] is None


def test_a_record_is_told_with_each_iteration_and_a_run_that_was_broken_off(
    bench: Any, watcher: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    for wait in ("LATE_S", "LATE"):  # as of iterations that take longer
        monkeypatch.setattr(f"modetune.flows.updating.record.{wait}", 0.0)
    folder, store = Path(bench.folder) / "run", Store(Path(bench.folder) / "store")
    marks = []
    record = LiveRecord(folder)

    class Watching(type(watcher)):  # type: ignore[misc]
        def iteration(self, item: Any) -> None:
            super().iteration(item)
            told: Any = live_json(record, store)
            marks.append((told["mark"], told["status"], told["iteration"]))

    run = update_campaign(bench.campaign({"k1": 1.2, "k2": 0.8}), folder, Watching())
    assert {status for _, status, _ in marks} == {"running"}
    assert len({mark for mark, _, _ in marks}) == len(marks) > 1
    told: Any = live_json(record, store)
    assert told["status"] == run.record.status
    assert len(told["tables"][0]["rows"]) == len(run.record.iterations)
    assert told["tables"][1]["heads"][0] == "parameter"
    assert any("iteration 0" in line for line in told["log"])
    (folder / "campaign.h5").rename(folder / "campaign.unfinished.h5")
    told = live_json(record, store)
    assert told["status"] == "broken off"
    (folder / "campaign.unfinished.h5").write_bytes(b"cut short")
    told = live_json(record, store)
    assert (told["status"], told["tables"]) == ("broken off", [])
