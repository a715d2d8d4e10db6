"""A worker: starts the deployed campaigns that are due, and watches over them.

Each run is a process of its own with a fixed command (`cli/deployed.py`); of what the server has
about a run only its parameters are read, and those are a campaign file, settings, folders, and a
study with its options. A run whose process ends without a word, here or on another machine, is
marked as crashed, so that the next one can start. A server that is gone is waited for.
"""

from __future__ import annotations

import json
import logging
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from datetime import UTC, datetime
from typing import Any

from modetune.core.errors import ModetuneError
from modetune.flows.jobs.heartbeats import BEAT_S, CARRIED, SilentRuns, give_sign
from modetune.flows.jobs.prefect_api import PrefectApi, ServerRefused
from modetune.flows.jobs.prefect_server import SharedServer, use_server
from modetune.flows.server.deployment import make_pool

logger = logging.getLogger(__name__)

#: Seconds between two looks at what is due.
LOOK_S = 5.0
#: Seconds that a campaign has to end when its worker does.
GRACE_S = 30.0


@dataclass(slots=True)
class Worker:
    """A worker of one pool.

    limit: campaigns at the same time, None for any number.
    """

    server: SharedServer
    pool: str
    limit: int | None
    name: str = field(default_factory=lambda: f"{socket.gethostname()}-{os.getpid()}")
    _running: dict[str, subprocess.Popen[bytes]] = field(default_factory=dict)
    _watch: SilentRuns = field(default_factory=SilentRuns)
    _silent: bool = False

    def work(self, once: bool) -> None:
        """Run what is due until this process is interrupted; once: only what is due now.

        Raises ModetuneError where the server does not take the first requests.
        """
        with self._api() as api:
            make_pool(api, self.pool)
        try:
            if once:
                with self._api() as api:
                    self._start_due(api)
            while self._running or not once:
                self._look(start=not once)
                self._pause(LOOK_S)
        finally:
            self._stop()

    def _look(self, start: bool) -> None:
        """Once round all that a worker does; a server that is gone is told of once."""
        try:
            with self._api() as api:
                self._sign(api)
                self._bury(api)
                self._watch.look(api)
                if start:
                    self._start_due(api)
            self._silent = False
        except ModetuneError as error:
            self._watch = SilentRuns()  # a server that was gone heard nobody meanwhile
            if not self._silent:
                logger.warning("%s; the worker goes on trying", error)
            self._silent = True

    def _pause(self, seconds: float) -> None:
        """Wait, but not longer than until a campaign has ended."""
        until = time.monotonic() + seconds
        running = list(self._running.values())
        while time.monotonic() < until and all(item.poll() is None for item in running):
            time.sleep(0.1)

    @contextmanager
    def _api(self) -> Iterator[PrefectApi]:
        """The server; the shared one is started again where it is gone."""
        if self.server.shared and self.server.answer() != "ready":
            self.server.close()
            self.server = use_server()
            self.server.wait()
            self._watch = SilentRuns()  # a server that was gone heard nobody meanwhile
        with self.server.api() as api:
            yield api

    def _sign(self, api: PrefectApi) -> None:
        """Signs of life, of the worker and of the campaigns whose processes live."""
        beat = {"name": self.name, "heartbeat_interval_seconds": int(BEAT_S)}
        api.post(f"/work_pools/{self.pool}/workers/heartbeat", beat)
        for run, process in self._running.items():
            if process.poll() is None:
                give_sign(api, run)

    def _bury(self, api: PrefectApi) -> None:
        """Campaigns whose process has ended; those that did not tell how have crashed."""
        for run, process in list(self._running.items()):
            if process.poll() is None:
                continue
            if process.returncode and api.get(f"/flow_runs/{run}")["state_type"] in CARRIED:
                message = f"its process ended with code {process.returncode} and told no end"
                state = {"type": "CRASHED", "name": "Crashed", "message": message}
                api.post(f"/flow_runs/{run}/set_state", {"state": state})
            del self._running[run]

    def _start_due(self, api: PrefectApi) -> None:
        due = api.post(
            f"/work_pools/{self.pool}/get_scheduled_flow_runs",
            {"scheduled_before": datetime.now(UTC).isoformat()},
        )
        for item in due:
            if self.limit is not None and len(self._running) >= self.limit:
                return
            self._start(api, item["flow_run"])

    def _start(self, api: PrefectApi, run: dict[str, Any]) -> None:
        """Start a run unless another worker has it, or the server keeps it back."""
        try:
            told = api.post(f"/flow_runs/{run['id']}/set_state", {"state": {"type": "PENDING"}})
        except ServerRefused as error:
            if not error.status or error.status >= 500:
                raise
            return
        if told["status"] != "ACCEPT":
            return
        process = subprocess.Popen(
            [sys.executable, "-P", "-m", "modetune.flows.cli.deployed"],
            stdin=subprocess.PIPE,
            start_new_session=True,
        )
        assert process.stdin is not None
        self._running[run["id"]] = process
        with process.stdin as pipe:
            pipe.write(json.dumps([run["id"], run["parameters"]]).encode())
        give_sign(api, run["id"])

    def _stop(self) -> None:
        """End the campaigns that still run; finished jobs are in the store."""
        for process in self._running.values():
            if process.poll() is None:
                process.send_signal(signal.SIGTERM)
        deadline = time.monotonic() + GRACE_S
        for process in self._running.values():
            try:
                process.wait(max(0.0, deadline - time.monotonic()))
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()


def check_login(server: SharedServer) -> None:
    """A server that anybody may use can have anybody's campaigns run. Raises ModetuneError."""
    with PrefectApi(server.address.url, login="") as api:
        if api.answer() == "ready":
            raise ModetuneError(
                f"Prefect's server at {server.address.shown} asks for no login, so everybody who "
                "reaches it can have campaigns run as this user; start it with "
                "PREFECT_SERVER_API_AUTH_STRING=name:password, or allow this with --without-login"
            )
