"""The record of a campaign under way, for who looks on, and for who comes after a kill.

What comes within a second of what was written last waits for the rest of that second, and the
newest is written: to write each would take a campaign that the store answers longer than its
iterations do. A kill loses no more than the sight of that second's work; its results are stored.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from modetune.core.errors import StorageUnavailable
from modetune.core.storage.record import CampaignRecord
from modetune.core.storage.record_file import write_record

#: Seconds that a record may wait to be written.
LATE_S = 1.0


@contextmanager
def unfinished_record(path: Path) -> Iterator[Callable[[CampaignRecord], None]]:
    """Gives what keeps a record in a file; the newest is there when this ends, however it does.

    Raises StorageUnavailable, of a record that waited with the next one.
    """
    lock, newest = threading.Lock(), list[CampaignRecord]()
    written = time.monotonic()
    timer: threading.Timer | None = None

    def write() -> None:
        nonlocal written, timer
        with lock:
            if timer is not None:
                timer.cancel()
            timer = None
            if newest:
                write_record(path, newest.pop())
                written = time.monotonic()

    def write_late() -> None:
        with suppress(StorageUnavailable):
            write()

    def keep(record: CampaignRecord) -> None:
        nonlocal timer
        with lock:
            newest[:] = [record]
        left = written + LATE_S - time.monotonic()
        if record.status != "running" or left <= 0.0:
            write()
        elif timer is None:
            timer = threading.Timer(left, write_late)
            timer.start()

    try:
        yield keep
    finally:
        write_late()
