"""A store of a team: set-group-ID and writable by the group, with accounts of any umask."""

from __future__ import annotations

import os
import shutil
import stat
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest

from modetune.core.storage.files import make_folder, writing
from modetune.core.storage.store import Store
from tests.core.storage.test_store_attack import key_of, needs_root

#: The group, its two accounts and one outside: any numbers do.
TEAM, ANN, BOB, OUTSIDER = 61000, 61001, 61002, 61003
ROOT = Path(__file__).resolve().parents[3]
#: Imports as root, who may read this Python, then goes on as an account with a umask.
AS_ACCOUNT = """
import logging, os, signal, sys
from pathlib import Path
from modetune.core.errors import StorageUnavailable
from modetune.core.storage.files import writing
from modetune.core.storage.store import Store
from tests.core.storage.test_store_attack import is_right, key_of, put
logging.basicConfig(format="%(message)s")
folder, account, group, umask, deed = sys.argv[1:]
os.setgroups([int(group)] if int(group) else [])
os.setgid(int(account))
os.setuid(int(account))
os.umask(int(umask, 8))
store = Store(Path(folder))
def wait():
    raise SystemExit("the lock is held")
def die():
    os.kill(os.getpid(), signal.SIGKILL)
if deed == "put":
    with store.lock(key_of(1), wait):
        put(store, 1)
elif deed == "die":
    lock = store.lock(key_of(1), wait)
    lock.__enter__()
    with writing(store.path(key_of(1))) as part:
        part.write_bytes(b"half")
        die()
elif deed == "read":
    print(is_right(store.get(key_of(1)), 1))
elif deed == "damaged":
    print(store.get(key_of(1)))
else:
    try:
        print(store.get(key_of(1)))
    except StorageUnavailable as error:
        print(error)
"""


@pytest.fixture
def team_store() -> Iterator[Store]:
    """Not below pytest's folders, which are closed to other accounts."""
    with tempfile.TemporaryDirectory() as place:
        Path(place).chmod(0o755)
        folder = Path(place) / "store"
        folder.mkdir()
        shutil.chown(folder, group=TEAM)
        folder.chmod(0o2770)
        yield Store(folder)


def as_account(
    store: Store, account: int, umask: str, deed: str
) -> subprocess.CompletedProcess[str]:
    group = 0 if account == OUTSIDER else TEAM
    words = [str(store.folder), str(account), str(group), umask, deed]
    return subprocess.run(
        [sys.executable, "-c", AS_ACCOUNT, *words],
        cwd=ROOT, capture_output=True, text=True, check=False,
    )  # fmt: skip


@needs_root
@pytest.mark.parametrize("umask", ["022", "077"])
def test_a_member_that_is_killed_or_damages_an_entry_locks_no_other_out(
    team_store: Store, umask: str
) -> None:
    killed = as_account(team_store, ANN, umask, "die")
    assert killed.returncode == -9, killed.stderr
    assert (team_store.folder / "locks" / key_of(1)).exists()
    written = as_account(team_store, BOB, umask, "put")
    assert written.returncode == 0, written.stderr
    assert as_account(team_store, ANN, umask, "read").stdout == "True\n"
    for path in team_store.folder.rglob("*"):
        if not path.name.endswith(".part"):
            mode, group = path.stat().st_mode, path.stat().st_gid
            assert (group, bool(mode & stat.S_IWGRP)) == (TEAM, True), path
    entry = team_store.path(key_of(1))
    entry.write_bytes(entry.read_bytes()[:-1])
    damaged = as_account(team_store, ANN, umask, "damaged")
    assert damaged.stdout == "None\n", damaged.stderr
    assert "set aside" in damaged.stderr
    assert (team_store.folder / "damaged" / entry.name).exists()


@needs_root
def test_an_account_outside_the_team_reads_nothing(team_store: Store) -> None:
    assert as_account(team_store, ANN, "000", "put").returncode == 0
    told = as_account(team_store, OUTSIDER, "022", "look")
    assert "give read permission" in told.stdout, told.stderr


def test_only_a_folder_of_a_group_is_shared(tmp_path: Path) -> None:
    before = os.umask(0o077)
    try:
        make_folder(tmp_path / "own" / "below")
        with writing(tmp_path / "own" / "file"):
            pass
    finally:
        os.umask(before)
    assert stat.S_IMODE((tmp_path / "own" / "below").stat().st_mode) == 0o700
    assert stat.S_IMODE((tmp_path / "own" / "file").stat().st_mode) == 0o600
