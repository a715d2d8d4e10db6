"""The record of a campaign: its origin, and when it is written while the campaign runs."""

from __future__ import annotations

import hashlib
import threading
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from modetune.core.errors import StorageUnavailable
from modetune.core.storage.campaign_record import read_record
from modetune.flows.campaign.campaign import Campaign, load_campaign
from modetune.flows.updating.record import _deck_digest, unfinished_record
from tests.core.storage.test_campaign_record import record

RUNNING = replace(record(), status="running", reason="")
CONFIGS = Path(__file__).resolve().parents[3] / "configs"


def test_what_comes_soon_after_waits_for_the_last_one(tmp_path: Path) -> None:
    path = tmp_path / "record.h5"
    with unfinished_record(path) as keep:
        keep(RUNNING)
        keep(RUNNING)
        assert not path.exists()
        keep(replace(RUNNING, status="converged"))
        assert read_record(path).status == "converged"
    assert read_record(path).status == "converged"


def test_what_took_long_is_written_at_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("modetune.flows.updating.record.LATE_S", 0.0)
    with unfinished_record(tmp_path / "record.h5") as keep:
        keep(RUNNING)
        assert read_record(tmp_path / "record.h5").status == "running"


def test_the_next_one_waits_by_what_writing_took(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("modetune.flows.updating.record.LATE_S", 0.0)
    monkeypatch.setattr("modetune.flows.updating.record.LATE", 1e6)
    path = tmp_path / "record.h5"
    with unfinished_record(path) as keep:
        keep(RUNNING)
        path.unlink()
        keep(RUNNING)
        assert not path.exists()
    assert read_record(path).status == "running"


def test_what_waits_is_written_by_itself(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("modetune.flows.updating.record.LATE_S", 0.2)
    written = threading.Event()
    monkeypatch.setattr(
        "modetune.flows.updating.record.write_record", lambda path, record: written.set()
    )
    before = threading.active_count()
    with unfinished_record(tmp_path / "record.h5") as keep:
        keep(RUNNING)
        assert written.wait(60.0)
    for thread in threading.enumerate():
        if isinstance(thread, threading.Timer):
            thread.join(60.0)
    assert threading.active_count() == before


def test_quick_iterations_do_not_put_the_record_off_for_ever(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("modetune.flows.updating.record.LATE_S", 0.2)
    written = threading.Event()
    monkeypatch.setattr(
        "modetune.flows.updating.record.write_record", lambda path, record: written.set()
    )
    until = time.monotonic() + 60.0
    with unfinished_record(tmp_path / "record.h5") as keep:
        while not written.is_set() and time.monotonic() < until:
            keep(RUNNING)
            time.sleep(0.02)
        assert written.is_set()


def test_a_campaign_that_fails_leaves_its_newest_record(tmp_path: Path) -> None:
    path = tmp_path / "record.h5"

    def fail() -> None:
        with unfinished_record(path) as keep:
            keep(RUNNING)
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        fail()
    assert read_record(path).status == "running"


def test_a_place_that_cannot_be_written_is_told_with_the_last_record(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")

    def work() -> None:
        with unfinished_record(tmp_path / "file" / "record.h5") as keep:
            keep(RUNNING)
            keep(replace(RUNNING, status="converged"))

    with pytest.raises(StorageUnavailable, match="a folder is needed"):
        work()


def listed(path: Path) -> str:
    """A line of sha256sum."""
    return f"{hashlib.sha256(path.read_bytes()).hexdigest()}  {path.name}"


def six_mass() -> Campaign:
    return load_campaign(CONFIGS / "six_mass" / "campaign.yaml")


def test_the_decks_digest_is_that_of_its_file() -> None:
    assert _deck_digest(six_mass()) == listed(CONFIGS / "six_mass" / "six_mass.yaml")


def test_each_deck_of_several_configurations_is_told_once() -> None:
    one = six_mass()
    joint = replace(one, cases=tuple(replace(one.case, name=name) for name in "ab"))
    assert _deck_digest(joint) == listed(CONFIGS / "six_mass" / "six_mass.yaml")


def test_a_solver_without_a_deck_has_no_digest(bench: Any) -> None:
    assert _deck_digest(bench.campaign({"k1": 1.2})) == ""
