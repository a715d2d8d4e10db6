"""Limits over processes: never more holders than slots, and nothing lost when a holder dies."""

from __future__ import annotations

import signal
import subprocess
import sys
import threading
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from modetune.flows.jobs.limits import Limit, MachineLimits

HOLDER = """
import sys, time
from pathlib import Path
from modetune.flows.jobs.limits import Limit, MachineLimits
limits = MachineLimits(Path(sys.argv[1]))
with limits.held((Limit("nastran", 2, 2),), lambda name: time.sleep(0.01)):
    print("held", flush=True)
    sys.stdin.read()
"""


class Busy(Exception):
    """Raised instead of waiting."""


def busy(name: str) -> None:
    raise Busy(name)


@pytest.mark.parametrize(("slots", "taken"), [(1, 1), (3, 1), (4, 2), (3, 2)])
def test_never_more_are_held_than_there_are(tmp_path: Path, slots: int, taken: int) -> None:
    limits, guard = MachineLimits(tmp_path), threading.Lock()
    pause = threading.Event()
    now, most = 0, 0

    def work(_: int) -> None:
        nonlocal now, most
        with limits.held((Limit("cores", slots, taken),), lambda name: None):
            with guard:
                now += taken
                most = max(most, now)
            pause.wait(0.002)  # long enough for the others to try
            with guard:
                now -= taken

    with ThreadPoolExecutor(8) as pool:
        list(pool.map(work, range(40)))
    assert most <= slots
    assert now == 0


def test_two_limits_taken_in_any_order_do_not_block_each_other(tmp_path: Path) -> None:
    limits = MachineLimits(tmp_path)
    both = (Limit("cores", 2, 2), Limit("nastran", 1, 1))

    def work(turn: int) -> int:
        with limits.held(both if turn % 2 else both[::-1], lambda name: None):
            return turn

    with ThreadPoolExecutor(4) as pool:
        assert list(pool.map(work, range(50))) == list(range(50))


def test_a_killed_holder_frees_its_slots(tmp_path: Path) -> None:
    holder = subprocess.Popen(
        [sys.executable, "-c", HOLDER, str(tmp_path)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )
    assert holder.stdin is not None
    assert holder.stdout is not None
    assert holder.stdout.readline() == "held\n"
    limits = MachineLimits(tmp_path)
    with pytest.raises(Busy, match="nastran"), limits.held((Limit("nastran", 2, 1),), busy):
        pass
    holder.send_signal(signal.SIGKILL)
    holder.wait()
    holder.stdin.close()
    holder.stdout.close()
    with limits.held((Limit("nastran", 2, 2),), busy):
        pass


@pytest.mark.parametrize("name", ["../up", "", ".hidden", "a/b", "a b"])
def test_a_name_that_could_leave_the_folder_is_refused(name: str) -> None:
    with pytest.raises(ValueError, match="is not a name of a limit"):
        Limit(name, 1, 1)


def test_more_than_there_is_cannot_be_taken() -> None:
    with pytest.raises(ValueError, match="3 of 2 slots of cores"):
        Limit("cores", 2, 3)
