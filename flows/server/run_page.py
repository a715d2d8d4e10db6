"""The page of a flow run: what a study shows on it, and what the user asks for there.

One thread of the run's own process does all of it, so that no study waits for a server: it sends
heartbeats, log lines and artifacts, and looks every few seconds whether the user has cancelled the
run. Then it stops the solvers and interrupts the study. Heartbeats take the place of those of
Prefect's own thread, which adds a second to each flow. The first request that fails ends logs and
artifacts; heartbeats and looks go on, because a server may come back.
"""

from __future__ import annotations

import json
import logging
import os
import queue
import signal
import threading
import time
from collections.abc import Callable
from contextvars import copy_context
from datetime import UTC, datetime
from typing import Any
from uuid import UUID, uuid4

from prefect.artifacts import (
    create_markdown_artifact,
    create_progress_artifact,
    create_table_artifact,
)
from prefect.client.orchestration import get_client
from prefect.client.schemas.actions import ArtifactUpdate
from prefect.settings import PREFECT_CLIENT_MAX_RETRIES, temporary_settings

from modetune.core.storage.campaign_record import IterationRecord
from modetune.core.updating.criteria import Tolerances
from modetune.flows.jobs.heartbeats import BEAT_S, RESOURCE, send_heartbeat
from modetune.flows.jobs.server_client import ServerClient, ServerRefused
from modetune.flows.server.artifacts import Artifact, ServerEvent, progress_artifacts
from modetune.flows.updating.display import iteration_line
from modetune.flows.updating.forecast import Progress

#: Seconds between two looks at the state of the run, and that one request may take.
LOOK_S, REQUEST_S = 3.0, 4.0
#: Seconds that a cancelled study has to end, before its process ends.
GRACE_S = 5.0
#: Seconds in which a server must answer after the study, to receive its end.
END_S = 2.0
#: Seconds after the study in which a server that answers takes what is left.
FLUSH_S = 10.0
#: Exit code of a process that was stopped by the user.
STOPPED = 130


class RunPage:
    """The page of one flow run. Any thread may use it; nothing here raises.

    cancel: ends the solvers of the run. own_process: whether the process is the run's alone, and
    may be ended if the study does not end.
    """

    def __init__(
        self, client: ServerClient, run: UUID, cancel: Callable[[], None], own_process: bool
    ) -> None:
        self.client = client
        self.run = str(run)
        self.cancelled = False
        self._cancel = cancel
        self._own_process = own_process
        self._main = threading.get_ident()
        self._waiting: queue.SimpleQueue[dict[str, Any] | Artifact | ServerEvent] = (
            queue.SimpleQueue()
        )
        self._artifacts: dict[str, UUID] = {}
        self._over, self._silent = threading.Event(), False
        self._interrupted = False
        # A copy of the context: artifacts belong to the flow run that is in it.
        watch = copy_context().run
        self._thread = threading.Thread(
            target=watch, args=(self._watch,), name="modetune-page", daemon=True
        )
        self._thread.start()

    def log(self, text: str, level: int = logging.INFO) -> None:
        """Show a line in the log of the run."""
        self._waiting.put(self._line(text, level))

    def _line(self, text: str, level: int) -> dict[str, Any]:
        return {
            "name": "modetune",
            "level": level,
            "message": text,
            "timestamp": datetime.now(UTC).isoformat(),
            "flow_run_id": self.run,
        }

    def artifact(self, artifact: Artifact) -> None:
        """Show a table, a text or a number; a later one of the same key replaces it."""
        self._waiting.put(artifact)

    def event(self, event: ServerEvent) -> None:
        """Send an event to the server's automations."""
        self._waiting.put(event)

    def finish(self) -> bool:
        """Send what is left, end the thread, and return whether the server answers."""
        self._over.set()
        self._thread.join(FLUSH_S)
        return not self._thread.is_alive() and not self._silent

    def _watch(self) -> None:
        beat = look = -1e9
        while not self._over.is_set():
            now = time.monotonic()
            if now - beat >= BEAT_S:
                beat = now
                self._asked(lambda: send_heartbeat(self.client, self.run, REQUEST_S))
            if now - look >= LOOK_S:
                look = now
                self._look()
            self._send()
            self._over.wait(min(0.5, LOOK_S))
        self._send()
        self._silent = not self._takes_the_end()

    def _takes_the_end(self) -> bool:
        """Return whether the server answers and writes to its database, which may be locked."""
        if self.client.answer(END_S) != "ready":
            return False
        try:
            self.client.post(
                "/logs/", [self._line("the study has ended", logging.DEBUG)], REQUEST_S
            )
        except ServerRefused:
            return False
        return True

    def _asked(self, request: Callable[[], Any]) -> Any:
        """The answer to a request; None where the server gives none."""
        try:
            return request()
        except ServerRefused:
            return None

    def _look(self) -> None:
        found = self._asked(lambda: self.client.get(f"/flow_runs/{self.run}", REQUEST_S))
        state = found.get("state_type") if isinstance(found, dict) and "name" in found else None
        if found and found.get("id") == self.run and state in ("CANCELLING", "CANCELLED"):
            self._stop()

    def _stop(self) -> None:
        """End the study: its solvers, then its thread, at last its process."""
        if not self.cancelled:
            self.cancelled = True
            self._cancel()
            if self._main == threading.main_thread().ident:
                signal.pthread_kill(self._main, signal.SIGINT)
            if self._own_process:
                ends = threading.Timer(GRACE_S, self._end)
                ends.daemon = True
                ends.start()

    def _end(self) -> None:
        """End the process of a study that cannot be interrupted: a factorisation, for example."""
        state = {"type": "CANCELLED", "name": "Cancelled", "message": "cancelled on its page"}
        path = f"/flow_runs/{self.run}/set_state"
        self._asked(lambda: self.client.post(path, {"state": state, "force": True}, 2.0))
        os._exit(STOPPED)

    def _send(self) -> None:
        """Send all that waits: log lines together, the newest artifact of each key."""
        lines: list[dict[str, Any]] = []
        events: list[ServerEvent] = []
        artifacts: dict[str, Artifact] = {}
        while not self._waiting.empty():
            item = self._waiting.get()
            if isinstance(item, Artifact):
                artifacts[item.key] = item
            elif isinstance(item, ServerEvent):
                events.append(item)
            else:
                lines.append(item)
        if self._silent:
            return
        try:
            if lines:
                self.client.post("/logs/", lines, REQUEST_S)
            if events:
                self.client.post("/events", [self._event(item) for item in events], REQUEST_S)
            for artifact in artifacts.values():
                with temporary_settings({PREFECT_CLIENT_MAX_RETRIES: 0}):
                    self._show(artifact)
        except Exception:  # a page that lacks a table is no reason for a study to fail
            self._silent = True

    def _event(self, event: ServerEvent) -> dict[str, Any]:
        """Return an event as the server takes it, related to this run."""
        run = {
            "prefect.resource.id": f"{RESOURCE}{self.run}",
            "prefect.resource.role": "flow-run",
        }
        return {
            "id": str(uuid4()),
            "occurred": datetime.now(UTC).isoformat(),
            "event": event.event,
            "resource": {
                "prefect.resource.id": event.resource,
                "prefect.resource.name": event.name,
            },
            "related": [run],
            "payload": event.payload,
        }

    def _show(self, artifact: Artifact) -> None:
        known = self._artifacts.get(artifact.key)
        if known is not None:
            with get_client(sync_client=True) as client:
                new = ArtifactUpdate(data=artifact.data, description=artifact.description)
                client.update_artifact(known, new)
            return
        named: dict[str, Any] = {"key": artifact.key, "description": artifact.description}
        if artifact.kind == "table":
            made = create_table_artifact(json.loads(str(artifact.data)), **named)
        elif artifact.kind == "markdown":
            made = create_markdown_artifact(str(artifact.data), **named)
        else:
            made = create_progress_artifact(float(artifact.data), **named)
        assert isinstance(made, UUID)
        self._artifacts[artifact.key] = made


class PageLog(logging.Handler):
    """modetune's own log lines on the page of a run."""

    def __init__(self, page: RunPage) -> None:
        super().__init__(logging.INFO)
        self.page = page

    def emit(self, record: logging.LogRecord) -> None:
        self.page.log(record.getMessage(), record.levelno)


class PageProgress(Progress):
    """A study's progress that its page shows too. tolerances: of an update's e1."""

    def __init__(self, watcher: Progress, page: RunPage) -> None:
        self.watcher = watcher
        self.run_page = page
        self.tolerances: Tolerances | None = None
        self.name = ""
        self._iterations: list[IterationRecord] = []

    def keep(self, folder: Any) -> None:
        self.watcher.keep(folder)

    def forecast(self, forecast: Any) -> None:
        self.watcher.forecast(forecast)

    def working(self, text: str) -> None:
        self.watcher.working(text)
        self.run_page.log(text)

    def iteration(self, record: IterationRecord) -> None:
        self.watcher.iteration(record)
        self._iterations.append(record)
        self.run_page.log(iteration_line(record))
        if self.tolerances is not None:
            for artifact in progress_artifacts(self.name, self.tolerances, self._iterations):
                self.run_page.artifact(artifact)
