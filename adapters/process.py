"""The one place that starts programs.

A job's program runs in its own process group below a small supervisor (`supervisor.py`), which
holds the reading end of a pipe whose writing end only this process has. Whatever ends this
process, SIGKILL included, closes the pipe, and the supervisor kills the program and all of its
descendants. Time-out and cancelling close the pipe on purpose. No shell is involved anywhere.
"""

from __future__ import annotations

import atexit
import contextlib
import json
import os
import select
import shutil
import signal
import socket
import subprocess
import sys
import textwrap
import threading
import time
from dataclasses import dataclass
from pathlib import Path
from typing import IO

from modetune.adapters.regular_file import open_regular
from modetune.adapters.solver import Command
from modetune.core.errors import (
    NoResult,
    SolverCancelled,
    SolverCrashed,
    SolverExhausted,
    SolverMissing,
    SolverTimeout,
    StorageUnavailable,
)
from modetune.core.machine import ELSEWHERE, is_linux

SUPERVISOR = Path(__file__).with_name("supervisor.py")
#: Standard output and errors of the program, in its folder.
LOG = "solver.log"
#: How often a waiting thread looks for cancellation and time-out, milliseconds.
POLL_MS = 100
#: Below this a disk counts as full when a job has failed on it, bytes.
FULL_DISK = 1 << 20
#: Default limit of the disk that a job may take, bytes: models of a million equations spool about
#: ten GB of matrices and factors.
JOB_DISK = 100 * 10**9
#: Files above this are removed from the folder of a job that took too much disk, bytes.
KEPT_FILE = 32 << 20


@dataclass(frozen=True, slots=True)
class Finished:
    """How a program ended: its return code (negative: the signal), and what it cost."""

    return_code: int
    wall_s: float
    cpu_s: float
    peak_memory_bytes: int


def run_process(
    command: Command,
    folder: Path,
    timeout_s: float,
    cancelled: threading.Event,
    disk_bytes: int = JOB_DISK,
) -> Finished:
    """Run a program to its end in a folder, head and tail of its output in `solver.log` there.

    disk_bytes: what its files and output may take together. Raises SolverMissing, SolverTimeout,
    SolverCancelled, SolverExhausted (of too much disk; the program and its descendants are dead by
    then), and SolverCrashed where it was killed by a signal from elsewhere.
    """
    started = time.monotonic()
    command = command.started_in(folder)
    where = f"`{' '.join(command.arguments)}` in {folder}"
    supervisor = _supervisor(command, folder, disk_bytes, where)
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
    finished, taken = _finished(report, where, folder, time.monotonic() - started)
    if taken:
        _remove_large(folder)
        raise SolverExhausted(
            f"{where} wrote {taken / 1e9:.3g} GB, more than the {disk_bytes / 1e9:.3g} GB that a "
            "job may take, and was killed; its large files were removed; look at what it writes, "
            f"or raise `run: disk_gb` in the campaign\n{log_tail(folder)}"
        )
    if finished.return_code < 0:
        raise SolverCrashed(
            f"{where} was killed by signal {-finished.return_code}\n{log_tail(folder)}"
        )
    return finished


def log_tail(folder: Path, lines: int = 15) -> str:
    """Return the end of a job's log, for messages."""
    try:
        with open_regular(folder / LOG) as log:
            log.seek(0, os.SEEK_END)
            log.seek(max(0, log.tell() - 8192))
            text = log.read().decode("utf-8", "replace")
    except OSError:
        return "(no log)"
    kept = [line for line in text.splitlines() if line.strip()][-lines:]
    return as_block("\n".join(kept)) if kept else "(the log is empty)"


def read_log(folder: Path) -> str:
    """What a job's program printed. Raises NoResult where its log is gone."""
    try:
        with open_regular(folder / LOG) as log:
            return log.read().decode("utf-8", "replace")
    except OSError as error:
        raise NoResult(
            f"the log {folder / LOG} cannot be read ({error.strerror}): something else has changed "
            "the job's folder while the solver ran"
        ) from error


def as_block(text: str) -> str:
    """Return a program's output as one block, for messages."""
    return textwrap.indent(text.strip("\n"), "  | ")


@dataclass(frozen=True, slots=True)
class _Supervisor:
    """This process's ends of a supervisor's standard input and output."""

    stdin: IO[bytes]
    stdout: IO[bytes]


class _Supervisors:
    """The process that forks supervisors for this one; started when the first job needs it, and
    again where it was killed. It ends with this process, however that ends."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._process: subprocess.Popen[bytes] | None = None
        self._requests: socket.socket | None = None

    def start(self, what: bytes) -> _Supervisor:
        """Start a supervisor of a program described in JSON. Raises OSError."""
        wanted, stdin = os.pipe()
        stdout, text = os.pipe()
        made = _Supervisor(os.fdopen(stdin, "wb", 0), os.fdopen(stdout, "rb"))
        try:
            self._send([wanted, text])
        except BaseException:
            made.stdin.close()
            made.stdout.close()
            raise
        finally:
            os.close(wanted)
            os.close(text)
        with contextlib.suppress(BrokenPipeError):  # it was killed, as its output shows
            rest = memoryview(len(what).to_bytes(8, "big") + what)
            while rest:
                rest = rest[made.stdin.write(rest) :]
        return made

    def _send(self, ends: list[int]) -> None:
        with self._lock:
            if self._requests is not None:
                with contextlib.suppress(BrokenPipeError, ConnectionResetError):
                    socket.send_fds(self._requests, [b"1"], ends)
                    return
                self.end()
            ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
            with theirs:
                self._process = subprocess.Popen(
                    [sys.executable, "-I", "-S", str(SUPERVISOR)],
                    cwd="/",
                    stdin=theirs.fileno(),
                    stdout=subprocess.DEVNULL,
                    stderr=subprocess.DEVNULL,
                    start_new_session=True,
                )
            self._requests = ours
            socket.send_fds(ours, [b"1"], ends)

    def end(self) -> None:
        """End it; supervisors that are there already are on their own."""
        if self._requests is not None:
            self._requests.close()
            self._requests = None
        if self._process is not None:
            self._process.wait()
            self._process = None


_supervisors = _Supervisors()
atexit.register(_supervisors.end)


def _supervisor(command: Command, folder: Path, disk_bytes: int, where: str) -> _Supervisor:
    if not is_linux():
        raise SolverMissing(f"{where}: {ELSEWHERE}")
    environment = {**os.environ, **dict(command.environment)}
    # Each text escapes what is not UTF-8 in it as the system's own texts do.
    what = [LOG, disk_bytes, list(command.arguments), environment, str(folder.absolute())]
    try:
        return _supervisors.start(json.dumps(what).encode())
    except OSError as error:  # no more processes, memory or open files: may pass
        raise SolverCrashed(f"{where} could not be started: {error.strerror}") from error


def _report(supervisor: _Supervisor, group: int) -> bytes:
    """What the supervisor says at its end; nothing where it was killed, and then its group too."""
    with supervisor.stdout as pipe:
        report = pipe.read()
    if group and not report:
        with contextlib.suppress(ProcessLookupError, PermissionError):
            os.killpg(group, signal.SIGKILL)
    return report


def _finished(report: bytes, where: str, folder: Path, wall_s: float) -> tuple[Finished, int]:
    """Return how a program ended, and the bytes of disk it took if they were too many, else 0."""
    if not report:
        raise SolverCrashed(f"{where}: its supervisor was killed\n{log_tail(folder)}")
    try:
        told = json.loads(report)
        text = str(told["error"])
        cost, taken = (0, 0.0, 0.0, 0), 0
        if not text:
            cost = (
                int(told["return_code"]),
                wall_s,
                float(told["cpu_s"]),
                int(told["peak_memory_bytes"]),
            )
            taken = int(told["disk_bytes"])
    except (ValueError, KeyError, TypeError, OverflowError) as error:
        raise SolverCrashed(
            f"{where}: its supervisor's report cannot be read: {report[:80]!r}"
        ) from error
    finished = Finished(*cost)
    if text == "missing":
        raise SolverMissing(f"{where}: there is no such program; install it or put it on PATH")
    if not taken and (text or finished.return_code != 0) and disk_full(folder):
        raise StorageUnavailable(
            f"{where} failed and the disk is full; free some space and run the same command "
            "again: finished jobs are not repeated"
        )
    if text:
        raise SolverCrashed(f"{where} could not be started: {text}")
    return finished, taken


def _remove_large(folder: Path) -> None:
    """Free the disk that a job took too much of."""
    for path in folder.rglob("*"):
        with contextlib.suppress(OSError):
            if path.is_file() and not path.is_symlink() and path.stat().st_size > KEPT_FILE:
                path.unlink()


def _number(line: bytes) -> int:
    """Return the process group that the supervisor printed; 0 if it printed none."""
    return int(line) if line.strip().isdigit() and len(line) < 12 else 0


def disk_full(folder: Path) -> bool:
    """Return whether the disk below a folder is full, the likely cause of a failure there.

    False for a folder that is no longer there.
    """
    try:
        return shutil.disk_usage(folder).free < FULL_DISK
    except OSError:
        return False
