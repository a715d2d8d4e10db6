"""Signs of life of flow runs, and the end of those that give none.

Whoever carries a run writes a new value to a label of it every few seconds. Whoever looks after
runs (workers, the keeper of the shared server) marks a run as crashed whose label has not changed
for a while: its slots are free then, and the next run that is due starts. Only what the watcher
itself saw counts, by its own clock: machines need not agree on the time, and a server that was
gone for an hour ends nobody's run when it is back. A run that was taken for dead and is alive sets
itself running again with its next sign.

Prefect's own signs of life come every 30 s at the least, too rarely to see a death in a minute.
"""

from __future__ import annotations

import time
from collections.abc import Iterable
from uuid import uuid4

from modetune.flows.jobs.prefect_api import PrefectApi

#: Seconds between two signs of life.
BEAT_S = 5.0
#: Seconds without one after which a run is dead: four may be lost.
SILENT_S = 25.0
#: Marks runs that give signs of life; others are left alone.
TAG = "modetune"
LABEL = "modetune.sign-of-life"
#: Names the leases of licences that a run holds, apart by blanks.
LICENCES = "modetune.licences"
#: States of runs that somebody carries.
CARRIED = ("PENDING", "RUNNING", "CANCELLING")


def give_sign(api: PrefectApi, run: str) -> None:
    """Say that somebody carries this run. Raises ServerRefused."""
    api.patch(f"/flow_runs/{run}/labels", {LABEL: uuid4().hex})


def note_licences(api: PrefectApi, run: str, leases: Iterable[str]) -> None:
    """Say which leases this run holds, for whoever finds it dead. Raises ServerRefused."""
    api.patch(f"/flow_runs/{run}/labels", {LICENCES: " ".join(leases)})


def free_licences(api: PrefectApi, leases: Iterable[str]) -> None:
    """Give back what a dead run held. Raises ServerRefused."""
    for lease in leases:
        api.post("/v2/concurrency_limits/decrement-with-lease", {"lease_id": lease})


class SilentRuns:
    """Runs of one server, when each of them was last heard of, and what became of the silent."""

    def __init__(self) -> None:
        self._heard: dict[str, tuple[object, float]] = {}

    def look(self, api: PrefectApi) -> list[str]:
        """Mark runs as crashed that were silent for too long; their ids. Raises ServerRefused."""
        carried = {"state": {"type": {"any_": list(CARRIED)}}, "tags": {"all_": [TAG]}}
        now, heard = time.monotonic(), self._heard
        self._heard = {}
        silent: dict[str, str] = {}
        for run in api.post("/flow_runs/filter", {"flow_runs": carried}):
            labels = run.get("labels") or {}
            sign = (run["state_type"], labels.get(LABEL))
            last, since = heard.get(run["id"], (sign, now))
            self._heard[run["id"]] = sign, since if sign == last else now
            if sign == last and now - since > SILENT_S:
                silent[str(run["id"])] = str(labels.get(LICENCES, ""))
        for run_id, leases in silent.items():
            message = f"no sign of life for {SILENT_S:.0f} s: its process, or its machine, is gone"
            state = {"type": "CRASHED", "name": "Crashed", "message": message}
            api.post(f"/flow_runs/{run_id}/set_state", {"state": state})
            free_licences(api, leases.split())
        return list(silent)
