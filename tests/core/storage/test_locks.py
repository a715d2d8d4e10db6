"""Locks: one holder at a time, free when it dies, with flock and without."""

from __future__ import annotations

import errno
import fcntl
import os
import signal
import socket
import subprocess
import sys
import threading
from pathlib import Path

import pytest

from modetune.core.errors import StorageUnavailable
from modetune.core.storage import locks
from modetune.core.storage.locks import WITHOUT_FLOCK, FileLock
from modetune.core.storage.store import Store

#: A process that holds a lock until it is killed; without flock where an errno is given.
HOLDER = """
import fcntl, sys, time
from pathlib import Path
from modetune.core.storage.locks import FileLock
def refuse(*_):
    raise OSError(int(sys.argv[2]), "no locks here")
if int(sys.argv[2]):
    fcntl.flock = refuse
lock = FileLock(Path(sys.argv[1]))
print(lock.take(), flush=True)
time.sleep(600)
"""
ALL = (0, *WITHOUT_FLOCK)


def without_flock(monkeypatch: pytest.MonkeyPatch, number: int) -> None:
    """Let flock say what file systems without it say; 0: leave it as it is."""

    def refuse(*_: object) -> None:
        raise OSError(number, os.strerror(number))

    if number:
        monkeypatch.setattr(fcntl, "flock", refuse)


@pytest.fixture(params=ALL, ids=["flock", *(errno.errorcode[number] for number in WITHOUT_FLOCK)])
def refused(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> int:
    """What flock says here."""
    without_flock(monkeypatch, request.param)
    return int(request.param)


def holding(path: Path, refused: int) -> subprocess.Popen[str]:
    holder = subprocess.Popen(
        [sys.executable, "-c", HOLDER, str(path), str(refused)],
        stdout=subprocess.PIPE,
        text=True,
    )
    assert holder.stdout is not None
    assert holder.stdout.readline() == "True\n"
    return holder


def test_the_second_waits_for_the_first(tmp_path: Path, refused: int) -> None:
    first, second = FileLock(tmp_path / "a"), FileLock(tmp_path / "a")
    assert first.take()
    assert not second.take()
    first.release()
    assert second.take()
    second.release()
    assert first.take()
    first.release()


def test_threads_are_let_in_one_at_a_time(tmp_path: Path, refused: int) -> None:
    inside, most = [0], [0]
    store, step = Store(tmp_path), threading.Event()

    def waiting() -> None:
        step.wait(0.001)

    def work() -> None:
        for _ in range(5):
            with store.lock("ab", waiting):
                inside[0] += 1
                step.wait(0.0005)  # another thread gets its turn
                most[0] = max(most[0], inside[0])
                inside[0] -= 1

    threads = [threading.Thread(target=work) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert most == [1]
    # Each holder removes the file while others wait for it.
    assert list((tmp_path / "locks").iterdir()) == []


def test_the_lock_of_a_killed_process_is_free_at_once(tmp_path: Path, refused: int) -> None:
    for _ in range(2):
        holder = holding(tmp_path / "a", refused)
        lock = FileLock(tmp_path / "a")
        assert not lock.take()
        holder.send_signal(signal.SIGKILL)
        holder.communicate()
        with lock:
            assert lock.take()


def test_a_process_number_given_out_again_is_not_the_holder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    without_flock(monkeypatch, errno.ENOLCK)
    path = tmp_path / "a.lease"
    with FileLock(tmp_path / "a") as lock:
        assert lock.take()
        told = path.read_text()
    (started,) = (line for line in told.splitlines() if line.startswith("start="))
    path.write_text(told.replace(started, f"start={int(started[6:]) - 1}"))
    with FileLock(tmp_path / "a") as lock:
        assert lock.take()


def test_a_holder_on_another_machine_is_waited_for_as_long_as_it_lives(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its process cannot be seen from here: only the time since it last touched the file counts."""
    without_flock(monkeypatch, errno.EOPNOTSUPP)
    monkeypatch.setattr(locks, "LEASE_S", 0.2)
    path = tmp_path / "a.lease"
    with FileLock(tmp_path / "a") as lock:
        assert lock.take()
        told = path.read_text()
    ours = next(line for line in told.splitlines() if line.startswith("host="))
    path.write_text(told.replace(ours, f"host=other-{socket.gethostname()}"))
    waited, touched = threading.Event(), [0]
    with FileLock(tmp_path / "a") as lock:
        while not lock.take():
            if touched[0] < 20:
                os.utime(path)
                touched[0] += 1
            waited.wait(0.02)
    assert touched == [20]


@pytest.mark.parametrize("number", [errno.EIO, errno.ESTALE])
def test_a_share_that_is_broken_is_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, number: int
) -> None:
    without_flock(monkeypatch, number)
    with pytest.raises(StorageUnavailable, match="cannot be written"):
        FileLock(tmp_path / "a").take()


def test_a_lock_whose_file_was_removed_meanwhile_is_not_held(tmp_path: Path) -> None:
    waiting = fcntl.flock
    first, second = FileLock(tmp_path / "a"), FileLock(tmp_path / "a")
    assert first.take()

    def after_it_was_removed(*arguments: object) -> None:
        first.remove()
        first.release()
        waiting(*arguments)  # type: ignore[arg-type]  # as it was called

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(fcntl, "flock", after_it_was_removed)
        assert not second.take()
    assert second.take()
    assert not first.take()
    second.release()


def test_no_thread_is_left_when_a_lease_ends(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    without_flock(monkeypatch, errno.ENOSYS)
    before = threading.active_count()
    with FileLock(tmp_path / "a").held(lambda: None):
        assert threading.active_count() == before + 1
    assert threading.active_count() == before
    assert not list(tmp_path.glob("*.lease"))
