"""The fixed program of one run that a server started: reads the run, checks it, runs its flow.

A worker starts it and writes the run's identity, flow name and parameters, and the folders that it
may use, to its standard input. The outcome is the state of the flow run, not the exit code.
"""

from __future__ import annotations

import json
import logging
import os
import sys
from pathlib import Path
from typing import Any


def run_deployed(run: str, name: str, parameters: dict[str, Any], folders: list[str]) -> None:
    """Run the flow of this name for a flow run; a run that is refused ends as Failed."""
    from prefect.client.orchestration import get_client
    from prefect.flow_engine import run_flow
    from prefect.states import Failed

    from modetune.core.errors import ModetuneError
    from modetune.flows.server.flows import find_flow
    from modetune.flows.server.permission import check_request
    from modetune.flows.studies.catalogue import find_study

    with get_client(sync_client=True) as client:
        flow_run = client.read_flow_run(run)  # type: ignore[arg-type]  # the text of a UUID will do
        try:
            checked = check_request(find_study(name), parameters, [Path(item) for item in folders])
        except ModetuneError as error:
            client.set_flow_run_state(flow_run.id, Failed(message=str(error)))
            return
    run_flow(find_flow(name), flow_run=flow_run, parameters=checked, return_type="state")


def main() -> None:
    """Read the run from standard input and work in the first of its folders."""
    # modetune's log lines go to the page of the run alone; Prefect reads this when it is imported.
    os.environ["PREFECT_LOGGING_EXTRA_LOGGERS"] = "modetune"
    os.environ["PREFECT_LOGGING_TO_API_WHEN_MISSING_FLOW"] = "ignore"
    log = logging.getLogger("modetune")
    log.setLevel(logging.INFO)
    log.propagate = False
    request = json.load(sys.stdin)
    os.chdir(request["folders"][0])
    run_deployed(request["run"], request["flow"], request["parameters"], request["folders"])


if __name__ == "__main__":
    main()
