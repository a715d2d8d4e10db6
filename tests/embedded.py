"""Jobs of programs that are Python themselves, run by a campaign in the test's own process, and
those of CalculiX, each deck of which is solved once a session.

A job's folder, input, log and return code are as they would be; only the interpreter and its
supervisor are not started. What kills, hangs or times out is left to a process.
"""

from __future__ import annotations

import contextlib
import os
import shutil
import sys
import threading
import time
import traceback
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from modetune.adapters.matrices.program import run_job
from modetune.adapters.process import JOB_DISK, LOG, Finished, run_process
from modetune.adapters.solver import Command
from tests.adapters.ccx_once import copied, files, keep, place_of

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
    if timeout_s < SHORT_S or cancelled.is_set():
        return run_process(command, folder, timeout_s, cancelled, disk_bytes)
    started, busy = time.monotonic(), time.thread_time()
    program = (
        PROGRAMS.get(command.arguments[1:]) if command.arguments[0] == sys.executable else None
    )
    code = program(folder) if program is not None else None
    kept = _kept(command, folder)
    if kept is not None:
        with contextlib.suppress(OSError):  # no room: CalculiX will say so
            said = copied(kept, str(folder))
            if said is not None:
                (folder / LOG).write_bytes(said)
                code = 0
    if code is not None:
        return Finished(code, time.monotonic() - started, time.thread_time() - busy, 1 << 24)
    if kept is None:
        return run_process(command, folder, timeout_s, cancelled, disk_bytes)
    path = f"{Path(kept).parents[1] / 'real'}:{os.environ['PATH']}"
    real = replace(command, environment=(*command.environment, ("PATH", path)))
    before = files(str(folder))
    ended = run_process(real, folder, timeout_s, cancelled, disk_bytes)
    if ended.return_code == 0:
        keep(kept, str(folder), before, (folder / LOG).read_bytes())
    return ended


def _kept(command: Command, folder: Path) -> str | None:
    """Where results of a job of CalculiX are kept; nothing for other programs."""
    found = shutil.which("ccx") if command.arguments[0] == "ccx" else None
    home = Path(found).parents[1] if found else None
    if home is None or not (home / "solved").is_dir():
        return None
    threads = dict(command.environment).get("OMP_NUM_THREADS")
    return place_of(str(home), str(folder), list(command.arguments[1:]), threads)
