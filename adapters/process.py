"""The one place that starts programs.

A job's program runs in its own process group below a small supervisor (`supervisor.py`), which
holds the reading end of a pipe whose writing end only this process has. Whatever ends this
process, SIGKILL included, closes the pipe, and the supervisor kills the whole group. Time-out and
cancelling close the pipe on purpose. No shell is involved anywhere.
"""

from __future__ import annotations

import contextlib
import json
import os
import select
import signal
import subprocess
import sys
import textwrap
import threading
import time
from dataclasses import dataclass
from pathlib import Path

from modetune.adapters.solver import Command
from modetune.core.errors import (
    SolverCancelled,
    SolverCrashed,
    SolverMissing,
    SolverTimeout,
    StorageUnavailable,
)

SUPERVISOR = Path(__file__).with_name("supervisor.py")
#: Standard output and errors of the program, in its folder.
LOG = "solver.log"
#: How often a waiting thread looks for cancellation and time-out, milliseconds.
POLL_MS = 100
#: Below this a disk counts as full when a job has failed on it, bytes.
FULL_DISK = 1 << 20


@dataclass(frozen=True, slots=True)
class Finished:
    """How a program ended: its return code (negative: the signal), and what it cost."""

    return_code: int
    wall_s: float
    cpu_s: float
    peak_memory_bytes: int


def run_process(
    command: Command, folder: Path, timeout_s: float, cancelled: threading.Event
) -> Finished:
    """Run a program to its end in a folder, its output in `solver.log` there.

    Raises SolverMissing, SolverTimeout, SolverCancelled (the group is dead by then), and
    SolverCrashed where the program was killed by a signal from elsewhere.
    """
    started = time.monotonic()
    where = f"`{' '.join(command.arguments)}` in {folder}"
    supervisor = _supervisor(command, folder, where)
    assert supervisor.stdin is not None
    assert supervisor.stdout is not None
    outcome, group = None, 0
    try:
        ended = select.poll()
        ended.register(supervisor.stdout, select.POLLIN | select.POLLHUP)
        group = _number(supervisor.stdout.readline())
        while outcome is None and not ended.poll(POLL_MS):
            if cancelled.is_set():
                outcome = "cancelled"
            elif time.monotonic() - started > timeout_s:
                outcome = "timeout"
    finally:
        supervisor.stdin.close()  # ends the group if it still runs
        report = _report(supervisor, group)
    if outcome == "cancelled":
        raise SolverCancelled(f"{where} was stopped because the campaign is ending")
    if outcome == "timeout":
        raise SolverTimeout(
            f"{where} ran longer than {timeout_s:g} s and was killed; raise `run: timeout_s` in "
            f"the campaign or make the model smaller\n{log_tail(folder)}"
        )
    return _finished(report, where, folder, time.monotonic() - started)


def log_tail(folder: Path, lines: int = 15) -> str:
    """The end of a job's log, for messages."""
    try:
        with (folder / LOG).open("rb") as log:
            log.seek(0, os.SEEK_END)
            log.seek(max(0, log.tell() - 8192))
            text = log.read().decode("utf-8", "replace")
    except OSError:
        return "(no log)"
    kept = [line for line in text.splitlines() if line.strip()][-lines:]
    return as_block("\n".join(kept)) if kept else "(the log is empty)"


def as_block(text: str) -> str:
    """What a program said as one block, for messages."""
    return textwrap.indent(text.strip("\n"), "  | ")


def _supervisor(command: Command, folder: Path, where: str) -> subprocess.Popen[bytes]:
    try:
        return subprocess.Popen(
            [sys.executable, "-I", "-S", str(SUPERVISOR), LOG, *command.arguments],
            cwd=folder,
            env={**os.environ, **dict(command.environment)},
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            start_new_session=True,
        )
    except OSError as error:  # no more processes, memory or open files: may pass
        raise SolverCrashed(f"{where} could not be started: {error.strerror}") from error


def _report(supervisor: subprocess.Popen[bytes], group: int) -> bytes:
    """What the supervisor says at its end; nothing where it was killed, and then its group too."""
    assert supervisor.stdout is not None
    with supervisor.stdout as pipe:
        report = pipe.read()
    if group and not report:
        with contextlib.suppress(ProcessLookupError, PermissionError):
            os.killpg(group, signal.SIGKILL)
    supervisor.wait()
    return report


def _finished(report: bytes, where: str, folder: Path, wall_s: float) -> Finished:
    if not report:
        raise SolverCrashed(f"{where}: its supervisor was killed\n{log_tail(folder)}")
    try:
        told = json.loads(report)
        said = str(told["error"])
        cost = (0, 0.0, 0.0, 0)
        if not said:
            cost = (
                int(told["return_code"]),
                wall_s,
                float(told["cpu_s"]),
                int(told["peak_memory_bytes"]),
            )
    except (ValueError, KeyError, TypeError, OverflowError) as error:
        raise SolverCrashed(
            f"{where}: its supervisor's report cannot be read: {report[:80]!r}"
        ) from error
    finished = Finished(*cost)
    if said == "missing":
        raise SolverMissing(f"{where}: there is no such program; install it or put it on PATH")
    if (said or finished.return_code != 0) and disk_full(folder):
        raise StorageUnavailable(
            f"{where} failed and the disk is full; free some space and run the same command "
            "again: finished jobs are not repeated"
        )
    if said:
        raise SolverCrashed(f"{where} could not be started: {said}")
    if finished.return_code < 0:
        raise SolverCrashed(
            f"{where} was killed by signal {-finished.return_code}\n{log_tail(folder)}"
        )
    return finished


def _number(line: bytes) -> int:
    """The group that the supervisor tells; 0 where it tells none."""
    return int(line) if line.strip().isdigit() and len(line) < 12 else 0


def disk_full(folder: Path) -> bool:
    """Whether the disk below a folder has no room left, the likely cause of what failed there."""
    status = os.statvfs(folder)
    return status.f_bavail * status.f_frsize < FULL_DISK
