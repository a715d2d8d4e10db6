"""A campaign or a study on the pages of a Prefect server: flow run, tasks, tables.

The campaign runs by itself and tells a process beside it what happens (`poster.py`); that one
knows the server. Telling never waits: not for the server to start, not for a slow one, not at the
end, where the other process goes on by itself. So whatever becomes of a server, the campaign's
result, its exit code and its time stay the same, and no thread is left when the interpreter ends.

States tell what became of a piece: Cached (the store had the result), Skipped (e2), Derived (no job
was needed), Failed.
"""

from __future__ import annotations

import json
import logging
import os
import select
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from datetime import UTC, datetime
from pathlib import Path
from typing import Any
from uuid import uuid4

from modetune.core.errors import CampaignStopped, ModetuneError, SolverCancelled
from modetune.core.storage.record import CampaignRecord, IterationRecord
from modetune.core.updating.criteria import Tolerances
from modetune.flows.jobs.watching import Ended
from modetune.flows.report.tables import Table
from modetune.flows.updating.artifacts import Sheet, files_sheet, progress_sheets, table_sheet
from modetune.flows.updating.display import iteration_line
from modetune.flows.updating.updating import Progress

logger = logging.getLogger(__name__)

#: The process beside a campaign.
COMMAND = (sys.executable, "-P", "-m", "modetune.flows.updating.poster")
#: Seconds that a campaign's end is kept from who is left with a server that is up and answers: a
#: container that ends with the campaign ends the process beside it too.
END_S = 2.0
#: ... and for the first word of the process beside, where it has said none yet.
FIRST_WORD_S = 1.0
#: ... which tells what it found in the server's place.
FOUND = (b"up\n", b"waiting\n", b"warning ")
#: Keys that a task names.
SHOWN = 8
#: Bytes that may wait for a process that does not read.
MOST_WAITING = 16_000_000


class Pages:
    """The pages of one run of a campaign or a study, from `Pages(name)` to its end.

    name: of the campaign; flow_run: the run that the server started, or None to make one, of this
    flow; address: hears where people look at it, once that is known.
    Any thread may tell; nothing here raises but what a mistake of ours raises.
    """

    def __init__(
        self,
        name: str,
        flow_run: str | None = None,
        flow: str = "update",
        address: Callable[[str], None] = lambda address: None,
    ) -> None:
        self.name = name
        self.deployed = flow_run is not None
        self._address = address
        self._said = b""
        self._guard = threading.Lock()
        self._unsent = bytearray()
        try:
            self._beside: subprocess.Popen[bytes] | None = subprocess.Popen(
                COMMAND,
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=subprocess.DEVNULL,
                start_new_session=True,
            )
        except OSError as error:
            self._beside = None
            logger.warning("Prefect's pages lack this run: no process can be started (%s)", error)
            return
        assert self._beside.stdin is not None
        assert self._beside.stdout is not None
        os.set_blocking(self._beside.stdin.fileno(), False)
        os.set_blocking(self._beside.stdout.fileno(), False)
        begin = {"name": name, "flow_run": flow_run, "flow": flow, "parent": os.getpid()}
        self._tell(begin)

    def began(self, iteration: str, name: str) -> Callable[[Ended], None]:
        """A piece of work begins; what is returned hears how it ended."""
        task, name = str(uuid4()), f"{iteration} / {name}"
        began = time.monotonic()
        times: dict[str, str | float] = {"start_time": _now()}
        self._task(task, name, "RUNNING", "Running", "", times)

        def ended(done: Ended) -> None:
            times.update(end_time=_now(), total_run_time=time.monotonic() - began)
            self._task(task, name, *became(done), times)

        return ended

    def skipped(
        self, iteration: str, names: Sequence[str], reason: str, state: str = "Skipped"
    ) -> None:
        """Pieces that were not needed, by e2 or as others hold them, or that were not tried."""
        kind = "CANCELLED" if state == "Not tried" else "COMPLETED"
        for name in names:
            times = {"start_time": _now(), "end_time": _now()}
            self._task(str(uuid4()), f"{iteration} / {name}", kind, state, reason, times)

    def sheet(self, sheet: Sheet) -> None:
        """A table, a text or a number of the run; a later one of the same key replaces it."""
        self._tell({"sheet": sheet.told()})

    def licence(self, lease: str, held: bool) -> None:
        """A licence's lease was taken, or given back."""
        self._tell({"licence": {"lease": lease, "held": held}})

    def log(self, text: str, level: int = logging.INFO) -> None:
        """A line of the run's log."""
        self._tell({"log": {"level": level, "message": text, "timestamp": _now()}})

    def ended(self, record: CampaignRecord, folder: Path, unchanged: bool = False) -> None:
        """The campaign has come to its end, and its record is in this folder.

        unchanged: since the run before it, whose results the store had.
        """
        # What is not converged is not shown in green, and an alarm may wait for it.
        kind = "COMPLETED" if record.status == "converged" else "FAILED"
        name, reason = record.status.replace("_", " ").capitalize(), record.reason
        if unchanged:
            reason = (
                "nothing changed since the run before: no solver run, all "
                f"{record.runs.reused} results from the store; still {name.lower()}: {reason}"
            )
        self.end(kind, "Unchanged" if unchanged else name, reason, folder)

    def done(
        self,
        said: str,
        tables: Sequence[Table],
        written: Sequence[Path] = (),
        status: str = "completed",
        good: bool = True,
    ) -> None:
        """A study has come to its end.

        said: what it found, in a sentence; written: files it left; good: whether it is to be green.
        """
        for table in tables:
            self.sheet(table_sheet(self.name, table.title, table))
        if written:
            self.sheet(files_sheet(self.name, written))
        self.end("COMPLETED" if good else "FAILED", status.capitalize(), said)

    def failed(self, error: BaseException) -> None:
        """The campaign was broken off."""
        if isinstance(error, KeyboardInterrupt | CampaignStopped):
            self.end("CANCELLED", "Cancelled", "stopped by the user")
        elif isinstance(error, ModetuneError):
            self.end("FAILED", "Failed", str(error))
        else:
            self.end("CRASHED", "Crashed", f"{type(error).__name__}: {error}")

    def end(self, kind: str, name: str, message: str, folder: Path | None = None) -> None:
        """The run's last state. Waits a little for a server that answers, and for no other."""
        if self._beside is None:
            return
        place = None if folder is None else str(folder.resolve())
        self._tell({"end": {"type": kind, "name": name, "message": message, "folder": place}})
        beside, self._beside = self._beside, None
        assert beside.stdin is not None
        assert beside.stdout is not None
        with beside.stdout, beside.stdin:
            self._hear(beside.stdout.fileno(), FIRST_WORD_S, FOUND)
            deadline = time.monotonic() + END_S
            while self._unsent and b"up\n" in self._said and time.monotonic() < deadline:
                self._write(beside.stdin.fileno())
                time.sleep(0.01)
            if b"up\n" in self._said:
                self._hear(beside.stdout.fileno(), END_S, (b"ended\n",))
        try:
            beside.wait(END_S)  # it left at once for a process of its own
        except subprocess.TimeoutExpired:
            beside.kill()
            beside.wait()
        said = [line.partition(" ") for line in self._said.decode().splitlines()]
        for text in [text for kind, _, text in said if kind == "warning"]:
            logger.warning("%s", text)
        if b"waiting\n" in self._said and b"\npage " not in self._said:
            (server,) = {text for kind, _, text in said if kind == "at"}
            self._address(f"{server}/runs, as soon as the server is up")

    def _task(
        self,
        task: str,
        name: str,
        kind: str,
        state: str,
        message: str,
        times: Mapping[str, str | float],
    ) -> None:
        self._tell(
            {
                "task": {
                    "id": task,
                    "name": name,
                    "key": name.partition(" / ")[2].split()[0],
                    "type": kind,
                    "state": state,
                    "message": message,
                    "at": _now(),
                    "times": times,
                }
            }
        )

    def _tell(self, message: dict[str, Any]) -> None:
        with self._guard:
            if self._beside is None or len(self._unsent) > MOST_WAITING:
                return
            assert self._beside.stdin is not None
            self._unsent += json.dumps(message).encode() + b"\n"
            self._write(self._beside.stdin.fileno())
            assert self._beside.stdout is not None
            self._hear(self._beside.stdout.fileno())

    def _hear(self, pipe: int, patience_s: float = 0.0, wanted: Sequence[bytes] = ()) -> None:
        """Take what the process beside said by now, or by when it says something that is wanted."""
        deadline = time.monotonic() + patience_s
        known = self._said.count(b"\n")
        while not any(word in self._said for word in wanted):
            if not select.select([pipe], [], [], max(0.0, deadline - time.monotonic()))[0]:
                break
            piece = os.read(pipe, 65536)
            self._said += piece
            if not piece:
                break
        for line in self._said.decode().splitlines()[known : self._said.count(b"\n")]:
            kind, _, text = line.partition(" ")
            if kind == "page":
                self._address(text)

    def _write(self, pipe: int) -> None:
        """Write what the pipe takes now."""
        try:
            while self._unsent:
                del self._unsent[: os.write(pipe, self._unsent)]
        except BlockingIOError:
            pass
        except OSError:  # it is gone: the server was none
            self._unsent.clear()


@contextmanager
def shown(
    name: str,
    flow_run: str | None = None,
    flow: str = "update",
    address: Callable[[str], None] = lambda address: None,
) -> Iterator[Pages]:
    """The pages of a run that ends in here; one that is broken off is told as such."""
    pages = Pages(name, flow_run, flow, address)
    try:
        yield pages
    except BaseException as error:
        pages.failed(error)
        raise


class PagesProgress(Progress):
    """A campaign's progress that its pages hear of too."""

    def __init__(self, watcher: Progress, pages: Pages, tolerances: Tolerances) -> None:
        self.watcher = watcher
        self.pages = pages
        self.tolerances = tolerances
        self._iterations: list[IterationRecord] = []

    def working(self, text: str) -> None:
        self.watcher.working(text)
        self.pages.log(text)

    def iteration(self, record: IterationRecord) -> None:
        self.watcher.iteration(record)
        self._iterations.append(record)
        self.pages.log(iteration_line(record))
        for sheet in progress_sheets(self.pages.name, self.tolerances, self._iterations):
            self.pages.sheet(sheet)


def became(done: Ended) -> tuple[str, str, str]:
    """Type, name and message of the state of a piece of work that has ended."""
    if isinstance(done, SolverCancelled):
        return "CANCELLED", "Cancelled", str(done)
    if isinstance(done, ModetuneError):
        return "FAILED", "Failed", str(done)
    if not done:
        return "COMPLETED", "Derived", "no job was needed"
    keys = ", ".join(outcome.key[:12] for outcome in done[:SHOWN])
    if len(done) > SHOWN:
        keys += f" and {len(done) - SHOWN} more"
    if all(outcome.reused for outcome in done):
        return "COMPLETED", "Cached", keys
    return "COMPLETED", "Completed", f"{keys} in {sum(item.wall_s for item in done):.1f} s"


def _now() -> str:
    return datetime.now(UTC).isoformat()
