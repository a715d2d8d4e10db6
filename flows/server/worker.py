"""A worker: Prefect's own, for pools of type `modetune`, whose runs are studies and nothing else.

Prefect polls, counts, schedules and cancels pending runs. Of a run this worker reads its identity,
flow name and parameters: the pool's template and the deployment's job variables, entry point, pull
steps, path, command and environment could bring a program of whoever may write to the server. Each
run is a process with a fixed command (`run_program.py`). A run whose process ends without a final
state, here or on another machine, is marked as crashed, so that the next one can start. A server
that is gone is waited for.

`modetune server worker` and `prefect worker start --type modetune` both run it; the latter takes
the folders from MODETUNE_FOLDERS.
"""

from __future__ import annotations

import asyncio
import json
import logging
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, Self
from uuid import UUID

import anyio
import anyio.abc
import httpx
from prefect.client.orchestration import PrefectClient, get_client
from prefect.client.schemas.actions import WorkPoolCreate
from prefect.client.schemas.objects import FlowRun, StateType
from prefect.exceptions import InfrastructureNotAvailable, ObjectNotFound
from prefect.settings import (
    PREFECT_API_AUTH_STRING,
    PREFECT_API_KEY,
    PREFECT_API_URL,
    get_current_settings,
)
from prefect.workers.base import BaseJobConfiguration, BaseWorker, BaseWorkerResult

from modetune.core.errors import ModetuneError
from modetune.flows.jobs.heartbeats import HeartbeatWatch, send_heartbeat
from modetune.flows.jobs.prefect_server import SharedServer, shared_server
from modetune.flows.jobs.server_client import ServerClient, ServerRefused

logger = logging.getLogger(__name__)

#: The type of pools whose runs are studies and nothing else.
POOL_TYPE = "modetune"
#: Folders that runs may use, apart by the system's separator of paths.
FOLDERS_VARIABLE = "MODETUNE_FOLDERS"
#: Set, a server that asks for no login will do.
WITHOUT_LOGIN_VARIABLE = "MODETUNE_WITHOUT_LOGIN"
#: A run can set nothing of how it is run.
TEMPLATE: dict[str, Any] = {
    "job_configuration": {"program": "modetune"},  # the server requires one that is not empty
    "variables": {"type": "object", "properties": {}, "additionalProperties": False},
}
#: The command of every run.
COMMAND = (sys.executable, "-P", "-m", "modetune.flows.server.run_program")
#: Seconds that a run has to end when its worker does, or when it is cancelled before it began.
GRACE_S = 30.0
#: Seconds for which the worker sends heartbeats of a run: until its own watcher does.
STARTING_S = 120.0


class FixedConfiguration(BaseJobConfiguration):
    """What a worker uses of a flow run: its flow's name."""

    flow_name: str = ""

    @classmethod
    async def from_template_and_values(
        cls,
        base_job_template: dict[str, Any],
        values: dict[str, Any],
        client: PrefectClient | None = None,
    ) -> Self:
        """Return a configuration that takes nothing from the server."""
        return cls()

    @classmethod
    async def resolve_for_flow_run(
        cls, flow_run: FlowRun, *, client: PrefectClient, **ignored: Any
    ) -> Self:
        """Return the name of the run's flow. Nothing else of the server's is read."""
        flow = await client.read_flow(flow_run.flow_id)
        return cls(flow_name=flow.name)


class Ended(BaseWorkerResult):
    """The end of a run's process. Its exit code is 0 here: the worker has set the state itself."""


class CampaignWorker(BaseWorker[FixedConfiguration, Any, Ended]):
    """A worker of one pool of type `modetune`."""

    type = POOL_TYPE
    job_configuration = FixedConfiguration
    _description = "Run modetune's studies of campaigns."

    def __init__(self, *arguments: Any, **options: Any) -> None:
        super().__init__(*arguments, **options)
        text = os.environ.get(FOLDERS_VARIABLE)
        named = [Path(item) for item in text.split(os.pathsep) if item] if text else []
        self.folders = [path.resolve() for path in named or [Path()]]
        self.without_login = bool(os.environ.get(WITHOUT_LOGIN_VARIABLE))
        self.server: SharedServer | None = None
        self._runs: dict[str, tuple[anyio.abc.Process, float, UUID]] = {}
        self._watch = HeartbeatWatch()
        self._silent = False

    @classmethod
    def get_default_base_job_template(cls) -> dict[str, Any]:
        """The template of a new pool: a run can set nothing."""
        return TEMPLATE

    async def setup(self) -> None:
        """Begin to work. Raises ModetuneError for a server or a pool that is not safe."""
        if not self.without_login:
            await anyio.to_thread.run_sync(check_login, PREFECT_API_URL.value())
        await super().setup()
        if self._work_pool is not None:
            check_pool(self._work_pool_name, self._work_pool.type)

    async def get_and_submit_flow_runs(self) -> list[FlowRun]:
        """Start runs that are due, and look for silent ones; wait for a server that is gone."""
        try:
            # First, because Prefect's client retries for a minute where a server is gone.
            await anyio.to_thread.run_sync(self._look)
            found = await super().get_and_submit_flow_runs()
        except (httpx.HTTPError, OSError, ServerRefused) as error:
            await self._gone(error)
            return []
        self._silent = False
        return found

    async def sync_with_backend(self) -> None:
        """Send the worker's heartbeat; a server that is gone is waited for."""
        try:
            await super().sync_with_backend()
        except (httpx.HTTPError, OSError) as error:
            if not self.is_setup:
                raise  # Prefect's own start reports it
            await self._gone(error)

    async def _gone(self, error: Exception) -> None:
        """Warn once; start the shared server again, which keeps its address."""
        self._watch = HeartbeatWatch()  # a server that was gone received no heartbeat either
        if not self._silent:
            logger.warning("%s; the worker continues to try", error)
        self._silent = True
        if self.server is not None and self.server.shared:
            self.server = await anyio.to_thread.run_sync(restarted, self.server)

    def _look(self) -> None:
        client = _client()
        for run, (_, began, _) in list(self._runs.items()):
            if time.monotonic() - began < STARTING_S:
                send_heartbeat(client, run)
        self._watch.look(client)

    async def run(
        self,
        flow_run: FlowRun,
        configuration: FixedConfiguration,
        task_status: anyio.abc.TaskStatus[Any] | None = None,
    ) -> Ended:
        """Run the fixed program for a flow run and wait for its end."""
        await self._name(flow_run)
        request = {
            "run": str(flow_run.id),
            "flow": configuration.flow_name,
            "parameters": flow_run.parameters,
            "folders": [str(folder) for folder in self.folders],
        }
        settings = get_current_settings().to_environment_variables(
            exclude_unset=True, include_secrets=True
        )
        process = await anyio.open_process(
            COMMAND,
            stdin=subprocess.PIPE,
            stdout=None,
            stderr=None,
            env={**os.environ, **settings},
            start_new_session=True,
        )
        self._runs[str(flow_run.id)] = process, time.monotonic(), flow_run.id
        try:
            if task_status is not None:
                task_status.started(f"{socket.gethostname()}:{process.pid}")
            assert process.stdin is not None
            try:
                await process.stdin.send(json.dumps(request).encode())
                await process.stdin.aclose()
            except (anyio.BrokenResourceError, OSError):
                pass  # it has died already
            await process.wait()
        finally:
            with anyio.CancelScope(shield=True):
                await _end(process)
                del self._runs[str(flow_run.id)]
                with anyio.move_on_after(GRACE_S):
                    await self._settle(flow_run, process.returncode)
        return Ended(identifier=str(process.pid), status_code=0)

    async def _name(self, flow_run: FlowRun) -> None:
        """Name a run after its deployment, until its process has read the campaign's name."""
        if flow_run.deployment_id is None:
            return
        with suppress(httpx.HTTPError, ObjectNotFound, OSError):  # a name is no reason to fail
            deployment = await self.client.read_deployment(flow_run.deployment_id)
            await self.client.update_flow_run(flow_run.id, name=deployment.name)

    async def _settle(self, flow_run: FlowRun, code: int | None) -> None:
        """Mark a run whose process ended without a final state."""
        try:
            found = await self.client.read_flow_run(flow_run.id)
        except (httpx.HTTPError, ObjectNotFound, OSError):
            return  # whoever looks for silent runs marks it later
        if found.state is None or found.state.is_final():
            return
        if found.state.type == StateType.CANCELLING:
            await self._mark_flow_run_as_cancelled(found, {"message": "stopped by the user"})
            return
        message = f"its process ended with code {code} and without a final state"
        await self._propose_crashed_state(found, message)

    async def kill_infrastructure(
        self,
        infrastructure_pid: str,
        configuration: FixedConfiguration,
        grace_seconds: int = int(GRACE_S),
    ) -> None:
        """End a run of this worker that is cancelled before it began.

        The server's text is compared, never used as a process number. Raises
        InfrastructureNotAvailable for a run of another worker.
        """
        for process, _, _ in self._runs.values():
            if infrastructure_pid == f"{socket.gethostname()}:{process.pid}":
                await _end(process, grace_seconds)
                return
        raise InfrastructureNotAvailable("the run is not one of this worker")


async def _end(process: anyio.abc.Process, grace_s: float = GRACE_S) -> None:
    """End a process, and what is left of its group."""
    if process.returncode is None:
        _signal(process.pid, signal.SIGTERM)
        with anyio.move_on_after(grace_s):
            await process.wait()
    _signal(process.pid, signal.SIGKILL)
    await process.wait()


def _signal(group: int, number: signal.Signals) -> None:
    try:
        os.killpg(group, number)
    except ProcessLookupError:
        pass


def _client() -> ServerClient:
    return ServerClient(
        PREFECT_API_URL.value(), PREFECT_API_AUTH_STRING.value(), PREFECT_API_KEY.value()
    )


def restarted(server: SharedServer) -> SharedServer:
    """Return the shared server, started again where it is gone. Raises StorageUnavailable."""
    if server.answer() == "ready":
        return server
    server.close()
    found = shared_server()
    found.wait()
    return found


def check_login(url: str) -> None:
    """Refuse a server that anybody may use, who could have studies run. Raises ModetuneError."""
    if ServerClient(url).answer() == "ready":
        raise ModetuneError(
            f"Prefect's server at {url} requires no login, so anybody who can reach it can run "
            "campaigns as this user; start it with "
            "PREFECT_SERVER_API_AUTH_STRING=name:password, or allow this with --without-login"
        )


def make_pool(pool: str) -> None:
    """Make a work pool unless it is there. Raises ModetuneError for one of another type."""
    with get_client(sync_client=True) as client:
        try:
            kind = client.read_work_pool(pool).type
        except ObjectNotFound:
            client.create_work_pool(
                WorkPoolCreate(name=pool, type=POOL_TYPE, base_job_template=TEMPLATE)
            )
            return
    check_pool(pool, kind)


def check_pool(pool: str, kind: str) -> None:
    """Refuse a pool of another type. Raises ModetuneError."""
    if kind != POOL_TYPE:
        raise ModetuneError(
            f"work pool {pool} has type {kind}, whose runs may start any program; expected type "
            f"{POOL_TYPE}: delete that pool on the server, or select another with --pool"
        )


def work(
    server: SharedServer,
    pool: str,
    folders: Sequence[Path],
    *,
    limit: int | None = None,
    once: bool = False,
    without_login: bool = False,
) -> None:
    """Run what is due in a pool until SIGINT or SIGTERM; once: only what is due now.

    folders: that runs may use; limit: runs at the same time, None for any number. The environment
    makes Prefect a client of the server. Raises KeyboardInterrupt, ModetuneError.
    """
    make_pool(pool)
    worker = CampaignWorker(pool, limit=limit, name=f"{socket.gethostname()}-{os.getpid()}")
    worker.server, worker.without_login = server, without_login
    worker.folders = [folder.resolve() for folder in folders]

    async def until_signal() -> None:
        task, loop = asyncio.current_task(), asyncio.get_running_loop()
        assert task is not None
        for number in (signal.SIGINT, signal.SIGTERM):
            loop.add_signal_handler(number, task.cancel)
        await worker.start(run_once=once, printer=lambda *text: None)

    try:
        asyncio.run(until_signal())
    except asyncio.CancelledError:
        raise KeyboardInterrupt from None
    finally:
        if worker.server is not server:
            worker.server.close()
