"""Waiting for another process, and deadlines on busy cores."""

from __future__ import annotations

import os
import time
from collections.abc import Callable


def eventually(condition: Callable[[], object], seconds: float = 60.0) -> bool:
    began = time.monotonic()
    while not condition():
        if time.monotonic() - began > allowed(seconds):
            return False
        time.sleep(0.02)  # looks at other processes, which tell nobody
    return True


def allowed(seconds: float) -> float:
    """Return a deadline for free cores in seconds of the present ones, which other tests share."""
    return seconds * max(1.0, os.getloadavg()[0] / (os.cpu_count() or 1))
