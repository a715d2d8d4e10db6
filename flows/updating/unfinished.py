"""The record of a campaign under way, for who looks on, and for who comes after a kill.

What a second or more went by for is written at once. What comes sooner, as from the store, waits
for the next for so long: to write each would take a campaign that the store answers longer than its
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
    waiting: list[tuple[threading.Timer, CampaignRecord]] = []
    last = time.monotonic()

    def write(record: CampaignRecord) -> None:
        with suppress(StorageUnavailable):
            write_record(path, record)

    def keep(record: CampaignRecord) -> None:
        nonlocal last
        for timer, _ in waiting:
            timer.cancel()
            timer.join()  # it may be writing
        waiting.clear()
        if record.status != "running" or time.monotonic() - last >= LATE_S:
            write_record(path, record)
        else:
            timer = threading.Timer(LATE_S, write, [record])
            waiting.append((timer, record))
            timer.start()
        last = time.monotonic()

    try:
        yield keep
    finally:
        for timer, record in waiting:
            timer.cancel()
            timer.join()
            write(record)
