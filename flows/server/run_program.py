"""The fixed program of one run that a server started: reads the run, checks it, runs its flow.

A worker starts it and writes the run's identity, flow name and parameters, and the folders that it
may use, to its standard input. The outcome is the state of the flow run, not the exit code.
"""

from __future__ import annotations

import json
import logging
import os
import sys
import time
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

from modetune.core.errors import ModetuneError
from modetune.flows.jobs.prefect_server import configured_server
from modetune.flows.jobs.server_client import ServerClient, ServerRefused
from modetune.flows.server.permission import check_request
from modetune.flows.server.prefect_client import prefect_client
from modetune.flows.studies.catalogue import find_study
from modetune.flows.updating.forecast import Unwatched

#: Seconds for which a run waits at its end for a server that is gone, and between two attempts.
RETURN_S, PAUSE_S = 300.0, 2.0


def run_deployed(run: str, name: str, parameters: dict[str, Any], folders: list[str]) -> None:
    """Run the flow of this name for a flow run; a run that is refused ends as Failed."""
    server = configured_server()
    assert server is not None  # the worker names it
    try:
        checked = check_request(find_study(name), parameters, [Path(item) for item in folders])
    except ModetuneError as error:
        _report(server.client, run, {"type": "FAILED", "name": "Failed", "message": str(error)})
        return
    with prefect_client(server.settings()):
        from prefect.client.orchestration import get_client
        from prefect.exceptions import Abort
        from prefect.flow_engine import run_flow

        from modetune.flows.server.flows import Handed, find_flow, handing

        with get_client(sync_client=True) as client:
            flow_run = client.read_flow_run(run)  # type: ignore[arg-type]  # a UUID's text will do
        handed = Handed(Unwatched(), own_process=True)
        with suppress(Abort), handing(handed):
            run_flow(find_flow(name), flow_run=flow_run, parameters=checked, return_type="state")
    if handed.state is not None:
        state = handed.state
        ended = {"type": state.type.value, "name": state.name, "message": state.message}
        _report(server.client, run, ended)


def _report(client: ServerClient, run: str, state: Mapping[str, Any]) -> None:
    """Set a final state unless the run has one; wait for a server that is gone."""
    deadline = time.monotonic() + RETURN_S
    while time.monotonic() < deadline:
        try:
            if client.get(f"/flow_runs/{run}")["state_type"] in ("PENDING", "RUNNING"):
                client.post(f"/flow_runs/{run}/set_state", {"state": state})
            return
        except ServerRefused as error:
            if error.status:
                raise
            time.sleep(PAUSE_S)


def main() -> None:
    """Read the run from standard input and work in the first of its folders."""
    logging.getLogger("modetune").propagate = False  # log lines go to the run's page alone
    request = json.load(sys.stdin)
    os.chdir(request["folders"][0])
    run_deployed(request["run"], request["flow"], request["parameters"], request["folders"])


if __name__ == "__main__":
    main()
