"""Heartbeats of flow runs, and the end of runs that send none.

The watcher of a run sends an event to the server every few seconds, in the place of Prefect's own
thread, whose minimum is 30 s. Workers and the keeper of the shared server mark a run as crashed
whose events have stopped: its slots are free then, and the next run that is due starts. Only what
they have seen counts, by their own clock: machines need not agree on the time, and a server that
was gone for an hour ends no run when it is back.
"""

from __future__ import annotations

import time
from datetime import UTC, datetime, timedelta
from typing import Any
from uuid import uuid4

from modetune.flows.jobs.server_client import ServerClient

#: Seconds between two heartbeats of a run, and between two looks at all runs.
BEAT_S = 10.0
LOOK_S = 5.0
#: Seconds without a heartbeat after which a run has crashed: three may be lost, or wait for the
#: server, which writes events to its database every 5 s.
SILENT_S = 35.0
#: Marks runs that send heartbeats; others are left alone.
TAG = "modetune"
#: The event that Prefect's own thread sends, and the resource that it is about.
EVENT = "prefect.flow-run.heartbeat"
RESOURCE = "prefect.flow-run."
#: States of runs that a process carries out.
CARRIED = ("PENDING", "RUNNING", "CANCELLING")
#: How far the clocks of machines may differ: events of that time count.
CLOCKS = timedelta(days=1)


def send_heartbeat(client: ServerClient, run: str, seconds: float = 4.0) -> None:
    """Show that a process carries out this run. Raises ServerRefused."""
    event = {
        "id": str(uuid4()),
        "occurred": datetime.now(UTC).isoformat(),
        "event": EVENT,
        "resource": {"prefect.resource.id": f"{RESOURCE}{run}"},
    }
    client.post("/events", [event], seconds)


def mark_crashed(client: ServerClient, run: str, message: str) -> None:
    """Mark a run as crashed unless it has ended. Raises ServerRefused."""
    state = {"type": "CRASHED", "name": "Crashed", "message": message}
    client.post(f"/flow_runs/{run}/set_state", {"state": state})


class SilentRuns:
    """Runs of one server, and when each of them last sent a heartbeat."""

    def __init__(self) -> None:
        self._last: dict[str, tuple[object, float]] = {}

    def look(self, client: ServerClient) -> list[str]:
        """Mark runs as crashed that were silent for too long; return them. Raises ServerRefused."""
        carried = {"state": {"type": {"any_": list(CARRIED)}}, "tags": {"all_": [TAG]}}
        runs = client.post("/flow_runs/filter", {"flow_runs": carried})
        signs = _heartbeats(client, [run["id"] for run in runs]) if runs else {}
        now, last = time.monotonic(), self._last
        self._last, silent = {}, []
        for run in runs:
            sign = run["state_type"], signs.get(run["id"])
            before, since = last.get(run["id"], (sign, now))
            self._last[run["id"]] = sign, since if sign == before else now
            if sign == before and now - since > SILENT_S:
                silent.append(str(run["id"]))
        for run_id in silent:
            message = f"no heartbeat for {SILENT_S:.0f} s: its process, or its machine, is gone"
            mark_crashed(client, run_id, message)
        return silent


def _heartbeats(client: ServerClient, runs: list[Any]) -> dict[str, object]:
    """Return for each run the number of its heartbeats and the time of the last one."""
    now = datetime.now(UTC)
    found = client.post(
        "/events/count-by/resource",
        {
            "filter": {
                "event": {"name": [EVENT]},
                "resource": {"id": [f"{RESOURCE}{run}" for run in runs]},
                "occurred": {
                    "since": (now - CLOCKS).isoformat(),
                    "until": (now + CLOCKS).isoformat(),
                },
            }
        },
    )
    return {
        item["value"].removeprefix(RESOURCE): (item["count"], item["end_time"]) for item in found
    }
