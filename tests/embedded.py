"""Jobs of programs that are Python themselves, run by a campaign in the test's own process.

A job's folder, input, log and return code are as they would be; only the interpreter and its
supervisor are not started. What kills, hangs or times out is left to a process.
"""

from __future__ import annotations

import sys
import threading
import time
import traceback
from collections.abc import Callable
from pathlib import Path

from modetune.adapters.matrices.job import run_job
from modetune.adapters.process import JOB_DISK, LOG, Finished, run_process
from modetune.adapters.solver import Command

#: Does a job in its folder and gives its return code; nothing where it takes a process.
Program = Callable[[Path], int | None]
#: A time-out below this is there to be met, seconds.
SHORT_S = 1.0


def matrices_program(folder: Path) -> int:
    """The embedded solver."""
    with (folder / LOG).open("w") as log:
        try:
            return run_job(folder, log)
        except Exception:
            traceback.print_exc(file=log)
            return 1


#: Programs by their arguments after Python's own name.
PROGRAMS: dict[tuple[str, ...], Program] = {
    ("-P", "-m", "modetune.adapters.matrices"): matrices_program
}


def run_embedded(
    command: Command,
    folder: Path,
    timeout_s: float,
    cancelled: threading.Event,
    disk_bytes: int = JOB_DISK,
) -> Finished:
    """Stands for `run_process` in the job engine."""
    started, busy = time.monotonic(), time.thread_time()
    program = (
        PROGRAMS.get(command.arguments[1:]) if command.arguments[0] == sys.executable else None
    )
    code = None
    if program is not None and timeout_s >= SHORT_S and not cancelled.is_set():
        code = program(folder)
    if code is None:
        return run_process(command, folder, timeout_s, cancelled, disk_bytes)
    return Finished(code, time.monotonic() - started, time.thread_time() - busy, 1 << 24)
