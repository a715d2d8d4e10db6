"""Factors on disk: folders in the store, gone with their owner, however that ends."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

from modetune.core.storage.store import Store
from modetune.flows.jobs.store_files import factor_files, remove_abandoned

OWNER = """
import sys, time
from pathlib import Path
from modetune.core.storage.store import Store
from modetune.flows.jobs.store_files import factor_files
files = factor_files(Store(Path(sys.argv[1])))
(files.folder / "factors_mumps_0").write_bytes(b"0" * 1000)
print(files.folder, flush=True)
if len(sys.argv) > 2:
    time.sleep(600)
"""


def start(store: Path, *more: str) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [sys.executable, "-c", OWNER, str(store), *more], stdout=subprocess.PIPE, text=True
    )


def test_what_a_killed_process_left_is_removed_by_the_next_one(tmp_path: Path) -> None:
    owner = start(tmp_path, "wait")
    assert owner.stdout is not None
    folder = Path(owner.stdout.readline().strip())
    remove_abandoned(Store(tmp_path))
    assert folder.is_dir()  # its owner lives
    os.kill(owner.pid, signal.SIGKILL)
    owner.wait()
    owner.stdout.close()
    assert folder.is_dir()
    remove_abandoned(Store(tmp_path))
    assert not folder.exists()
    assert not list((tmp_path / "locks").iterdir())


def test_a_process_that_ends_takes_its_files_along(tmp_path: Path) -> None:
    with start(tmp_path) as owner:
        assert owner.wait() == 0
    assert not list((tmp_path / "jobs").iterdir())
    assert not list((tmp_path / "locks").iterdir())


def test_files_go_when_they_are_told_to(tmp_path: Path) -> None:
    files = factor_files(Store(tmp_path))
    files.remove()
    files.remove()
    assert not files.folder.exists()
