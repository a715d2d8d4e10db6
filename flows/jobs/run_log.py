"""The log lines of one run: a process may have several runs at a time."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager

from modetune.flows.jobs.tasks import StudyRun, study_run

_lock = threading.Lock()
#: The level of modetune's loggers before the first of the runs that are logged now.
_before: list[int] = []


@contextmanager
def logged_to(
    handlers: Sequence[logging.Handler], own: Callable[[], StudyRun | None]
) -> Iterator[None]:
    """Pass modetune's log lines from INFO on to handlers, and close them at the end.

    own: returns the run; lines of other runs in this process are left out.
    """
    ours = logging.getLogger("modetune")

    def is_own(record: logging.LogRecord) -> bool:
        return study_run() in (None, own())

    with _lock:
        _before.append(_before[0] if _before else ours.level)
        ours.setLevel(min(logging.INFO, ours.getEffectiveLevel()))
    for handler in handlers:
        handler.addFilter(is_own)
        ours.addHandler(handler)
    try:
        yield
    finally:
        for handler in handlers:
            ours.removeHandler(handler)
            handler.close()
        with _lock:
            level = _before.pop()
            if not _before:
                ours.setLevel(level)
