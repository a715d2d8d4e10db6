"""Slots, the server's users and whole campaigns where the file system has no flock."""

from __future__ import annotations

import errno
import signal
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from modetune.core.errors import CampaignRunning
from modetune.core.storage.locks import FileLock
from modetune.flows.jobs.limits import Limit, MachineLimits
from modetune.flows.jobs.prefect_server import _in_use, _new_use
from modetune.flows.updating.update import update_campaign
from tests.core.storage.test_locks import holding, without_flock

TRUTH = {"k1": 1.2, "k2": 0.8}


class Busy(Exception):
    """Others hold it."""


def busy(_: str) -> None:
    raise Busy


@pytest.fixture(params=[0, errno.ENOLCK], ids=["flock", "no flock"])
def refused(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> int:
    without_flock(monkeypatch, request.param)
    return int(request.param)


def test_slots_are_never_lost_and_never_taken_twice(tmp_path: Path, refused: int) -> None:
    limits, limit = MachineLimits(tmp_path), Limit("cores", 2, 1)
    (tmp_path / "cores").mkdir()
    holder = holding(tmp_path / "cores" / "slot0", refused)
    with limits.held((limit,), busy):
        with pytest.raises(Busy), limits.held((limit,), busy):
            pass
        holder.send_signal(signal.SIGKILL)
        holder.communicate()
        with limits.held((limit,), busy):
            pass


def test_a_server_is_in_use_until_its_last_user_has_ended(tmp_path: Path, refused: int) -> None:
    assert not _in_use(tmp_path)
    use = _new_use(tmp_path)
    dead = holding(tmp_path / "users" / "1-dead.lock", refused)
    assert _in_use(tmp_path)
    use.remove()
    use.release()
    assert _in_use(tmp_path)
    dead.send_signal(signal.SIGKILL)
    dead.communicate()
    assert not _in_use(tmp_path)
    assert not list((tmp_path / "users").iterdir())


def test_a_campaign_runs_and_refuses_a_second_run_in_its_folder(
    bench: Any, watcher: Any, refused: int
) -> None:
    folder = bench.folder / "run"
    folder.mkdir()
    with FileLock(folder / ".lock") as lock:
        assert lock.take()
        with pytest.raises(CampaignRunning, match="in progress"):
            update_campaign(bench.campaign(TRUTH), folder, watcher)
    record = update_campaign(bench.campaign(TRUTH), folder, watcher).record
    assert record.status == "converged"
    np.testing.assert_allclose(record.updated, list(TRUTH.values()), rtol=1e-3)
    assert not list(bench.folder.rglob("*.lease"))
