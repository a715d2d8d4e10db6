"""Heartbeats of flow runs, and the detection of runs that stopped sending them.

Each run sends an event to the server every few seconds, in place of Prefect's own thread, whose
minimum interval is 30 s. Workers and the keeper of the shared server mark a run as crashed when its
events have stopped, so that its slots are free and the next due run starts. They measure the
silence by their own clock while they watch: machines may disagree on the time, and a server that
was down for an hour crashes no run when it returns.

They also name the runs that no process has named. A server gives a deployment's run a random name,
and the run's process renames it after its campaign; a run that was refused, missed or lost before
that gets the deployment's name, and a refused one the run that was in its way as its reason.
"""

from __future__ import annotations

import time
from datetime import UTC, datetime, timedelta
from typing import Any
from uuid import uuid4

from modetune.flows.jobs.server_client import ServerClient, ServerRefused

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
#: States of runs that may have ended, or wait in vain, without a process.
UNBEGUN = ("Cancelled", "Crashed", "Late")
#: How long ago such a run was due, at most: at the first check, and at later ones.
FIRST_DUE, LATER_DUE = timedelta(days=7), timedelta(hours=1)
#: State of a run that another one was in the way of, and the start of the server's message then.
COLLIDED, LIMIT_REACHED = "Already running", "Deployment concurrency limit reached"


def send_heartbeat(client: ServerClient, run: str, seconds: float = 4.0) -> None:
    """Send a run's heartbeat. Raises ServerRefused."""
    event = {
        "id": str(uuid4()),
        "occurred": datetime.now(UTC).isoformat(),
        "event": EVENT,
        "resource": {"prefect.resource.id": f"{RESOURCE}{run}"},
    }
    client.post("/events", [event], seconds)


def _end(client: ServerClient, run: str, before: str, process: str) -> None:
    """Mark a silent run as crashed, or as cancelled if it was being cancelled.

    process: HOST:PID of a run that a worker started, else empty.
    """
    where = f" ({process})" if process else ""
    message = f"no heartbeat for {SILENT_S:.0f} s: its process{where} or machine has died"
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
        self._due = FIRST_DUE
        self._named: set[tuple[str, str]] = set()

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
            _end(client, run["id"], run["state_type"], run.get("infrastructure_pid") or "")
        self._named |= name_unbegun(client, datetime.now(UTC) - self._due, self._named)
        self._due = LATER_DUE
        return [str(run["id"]) for run in silent]


def name_unbegun(
    client: ServerClient, due: datetime, known: set[tuple[str, str]]
) -> set[tuple[str, str]]:
    """Name deployments' runs that were due after a time and did not begin, and give the reason.

    known: runs, with their states, that need nothing more. Returns those that need nothing now. A
    run whose deployment was deleted keeps its name. Raises ServerRefused.
    """
    unbegun = {
        "tags": {"all_": [TAG]},
        "deployment_id": {"is_null_": False},
        "state": {"name": {"any_": list(UNBEGUN)}},
        "expected_start_time": {"after_": due.isoformat()},
    }
    ended = client.post("/flow_runs/filter", {"flow_runs": unbegun})
    found = [run for run in ended if not run["run_count"]]
    for run in (run for run in found if (run["id"], run["state_name"]) not in known):
        try:
            name = client.get(f"/deployments/{run['deployment_id']}")["name"]
            if run["name"] != name:
                client.patch(f"/flow_runs/{run['id']}", {"name": name})
            if str(run["state"]["message"]).startswith(LIMIT_REACHED):
                _explain_collision(client, run, name)
        except ServerRefused as error:
            if not error.status:
                raise
    return {(run["id"], run["state_name"]) for run in found}


def _explain_collision(client: ServerClient, run: dict[str, Any], name: str) -> None:
    """Give a refused run the one that was in its way as its reason."""
    others = {
        "deployment_id": {"any_": [run["deployment_id"]]},
        "start_time": {"before_": run["end_time"]},
    }
    found = client.post("/flow_runs/filter", {"flow_runs": others, "sort": "START_TIME_DESC"})
    begun = [item["start_time"][:19] for item in found if item["run_count"]]
    since = f", which began at {begun[0]} UTC," if begun else ""
    message = f"another run of {name}{since} was in progress; this one did nothing"
    state = {"type": "CANCELLED", "name": COLLIDED, "message": message}
    client.post(f"/flow_runs/{run['id']}/set_state", {"state": state, "force": True})


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
