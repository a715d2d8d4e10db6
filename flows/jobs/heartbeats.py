"""Heartbeats of flow runs, and the detection of runs that stopped sending them.

Each run sends an event to the server every few seconds, in place of Prefect's own thread, whose
minimum interval is 30 s. Workers and the keeper of the shared server mark a run as crashed when its
events have stopped, so that its slots are free and the next due run starts. They measure the
silence by their own clock while they watch: machines may disagree on the time, and a server that
was down for an hour crashes no run when it returns.
"""

from __future__ import annotations

import time
from datetime import UTC, datetime, timedelta
from typing import Any
from uuid import uuid4

from modetune.flows.jobs.server_client import ServerClient

#: Seconds between two heartbeats of a run, and between two checks of all runs.
BEAT_S = 10.0
LOOK_S = 5.0
#: Seconds without a heartbeat until a run counts as crashed: three may be lost, or delayed by the
#: server, which writes events to its database every 5 s.
SILENT_S = 35.0
#: Tag of runs that send heartbeats; other runs are ignored.
TAG = "modetune"
#: The event that Prefect's own thread sends, and the resource that it is about.
EVENT = "prefect.flow-run.heartbeat"
RESOURCE = "prefect.flow-run."
#: States of runs that have a process.
CARRIED = ("PENDING", "RUNNING", "CANCELLING")
#: Tolerated difference between the clocks of machines.
CLOCKS = timedelta(days=1)


def send_heartbeat(client: ServerClient, run: str, seconds: float = 4.0) -> None:
    """Send a run's heartbeat. Raises ServerRefused."""
    event = {
        "id": str(uuid4()),
        "occurred": datetime.now(UTC).isoformat(),
        "event": EVENT,
        "resource": {"prefect.resource.id": f"{RESOURCE}{run}"},
    }
    client.post("/events", [event], seconds)


def _end(client: ServerClient, run: str, before: str) -> None:
    """Mark a silent run as crashed, or as cancelled if it was being cancelled."""
    message = f"no heartbeat for {SILENT_S:.0f} s: its process or machine has died"
    # From Cancelling the server accepts no other final state.
    kind = "CANCELLED" if before == "CANCELLING" else "CRASHED"
    state = {"type": kind, "name": kind.capitalize(), "message": message}
    client.post(f"/flow_runs/{run}/set_state", {"state": state})


class HeartbeatWatch:
    """Watches the heartbeats of one server's runs.

    The silence of a run without a heartbeat is counted from the first check that found it.
    """

    def __init__(self) -> None:
        self._last: dict[str, tuple[object, float]] = {}

    def look(self, client: ServerClient) -> list[str]:
        """Mark runs that were silent too long as crashed; return them. Raises ServerRefused."""
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
                silent.append(run)
        for run in silent:
            _end(client, run["id"], run["state_type"])
        return [str(run["id"]) for run in silent]


def _heartbeats(client: ServerClient, runs: list[Any]) -> dict[str, object]:
    """Return the number of heartbeats of each run and the time of the last one."""
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
