"""The process beside a campaign that shows it on the pages of a Prefect server.

It finds or starts the server, waits for it, and tells it what the campaign tells: a JSON object a
line on standard input. The campaign waits for none of it, so no state of a server can hold it up or
end it; what happened before the server was up is told afterwards, with the times it happened at. A
server that is gone is asked again, and the shared one started again, until a minute after the
campaign's end. Where standard input ends without the campaign's end, the campaign was killed, and
its run is marked as crashed.

Lines on standard output: `at ...` with the server's address, then `waiting` while one starts, `up`
once it answers, `page ...` with the run's address, `ended` when it knows the end, and `warning ...`
for the user.
"""

from __future__ import annotations

import contextlib
import json
import os
import queue
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any
from uuid import uuid4

from modetune.core.errors import ModetuneError
from modetune.flows.jobs.heartbeats import BEAT_S, TAG, free_licences, give_sign, note_licences
from modetune.flows.jobs.prefect_api import PrefectApi, ServerRefused
from modetune.flows.jobs.prefect_server import START_PATIENCE_S, SharedServer, use_server

Message = dict[str, Any]
#: Seconds after the campaign's end that a server has to take what is left.
AFTERWARDS_S = 60.0
#: Seconds between two attempts to reach a server that is gone.
PAUSE_S = 2.0
#: Messages that are passed on together.
MOST_AT_ONCE = 200
#: Answers after which the same request may be taken later.
LATER = frozenset({0, 401, 403, 408, 429})
KILLED: Message = {
    "end": {
        "type": "CRASHED", "name": "Crashed", "folder": None,
        "message": "the campaign's process ended without a word: it was killed",
    }
}  # fmt: skip


class GivenUp(Exception):
    """The server did not come back in good time after the campaign's end."""


class Poster:
    """What a campaign tells, on its way to the server, in order.

    name: of the campaign; flow_run: the run that the server started, or None to make one, of this
    flow; parent: the campaign's process.
    """

    def __init__(self, name: str, flow_run: str | None, flow: str, parent: int) -> None:
        self.name = name
        self.flow = flow
        self.deployed = flow_run is not None
        self.run = flow_run or ""
        self.parent = parent
        self.waiting: queue.SimpleQueue[Message] = queue.SimpleQueue()
        self.deadline: float | None = None
        self._server: SharedServer | None = None
        self._api: PrefectApi | None = None
        self._sheets: dict[str, str] = {}
        self._beaten = 0.0
        self._refused = False
        self._leases: set[str] = set()

    def listen(self) -> None:
        """Hear the campaign to its end, and see to it that this process does not stay."""
        self.hear(sys.stdin)
        time.sleep(START_PATIENCE_S + AFTERWARDS_S)
        os._exit(1)

    def hear(self, campaign: Iterable[str]) -> None:
        """Take what the campaign tells."""
        last: Message = {}
        for line in campaign:
            try:
                last = json.loads(line)
            except ValueError:  # cut off by a kill
                break
            self.waiting.put(last)
            if "end" in last:
                break
        if "end" not in last:
            self.waiting.put(KILLED)
        self.deadline = time.monotonic() + AFTERWARDS_S

    def work(self) -> None:
        """Tell the server everything. Raises GivenUp, StorageUnavailable."""
        self._server = use_server()
        tell(f"at {self._server.pages}")
        if not self._ready(self._server):
            return
        tell("up")
        self._deliver(self._begin)
        tell(f"page {self._server.pages}/runs/flow-run/{self.run}")
        while True:
            told = self._told()
            self._pass_on(told)
            if told and "end" in told[-1]:
                end = told[-1]["end"]
                self._deliver(self._end, end)
                tell("ended")
                self._last_sheets(end["folder"])
                return
            if time.monotonic() - self._beaten > BEAT_S:
                self._deliver(self._live)

    def _told(self) -> list[Message]:
        """What the campaign has told meanwhile, up to its end; waits a little for a first word."""
        told: list[Message] = []
        with contextlib.suppress(queue.Empty):
            told.append(self.waiting.get(timeout=BEAT_S))
            while "end" not in told[-1] and len(told) < MOST_AT_ONCE:
                told.append(self.waiting.get_nowait())
        return told

    def _pass_on(self, told: list[Message]) -> None:
        """Tell the server what was told, in as few requests as it takes: each costs it, and the
        cores that jobs would have, some ten milliseconds. Raises GivenUp."""
        events = [task_event(self.run, item["task"]) for item in told if "task" in item]
        logs = [
            {"name": "modetune", "flow_run_id": self.run, **item["log"]}
            for item in told
            if "log" in item
        ]
        for path, items in (("/events", events), ("/logs/", logs)):
            if items:
                self._deliver(lambda api, path, items: api.post(path, items), path, items)
        leases = set(self._leases)
        for item in (item["licence"] for item in told if "licence" in item):
            (leases.add if item["held"] else leases.discard)(item["lease"])
        if leases != self._leases:
            self._leases = leases
            self._deliver(lambda api: note_licences(api, self.run, sorted(leases)))
        newest = {item["sheet"]["key"]: item["sheet"] for item in told if "sheet" in item}
        for sheet in newest.values():
            self._deliver(self._post_sheet, sheet)

    def _ready(self, server: SharedServer) -> bool:
        """Wait for the server, for as long as there is something to wait for."""
        found = server.answer()
        if server.shared and found == "does not answer":
            tell("waiting")
            found = server.wait()
        if found == "ready":
            return True
        tell(f"warning {server.told(found)}; the campaign goes on without its pages")
        while found == "does not answer" and self.deadline is None and not server.shared:
            time.sleep(PAUSE_S)
            found = server.answer()
        return found == "ready"

    def _deliver(self, request: Callable[..., object], *told: object) -> None:
        """Make a request, again while the server is gone. Raises GivenUp."""
        while True:
            try:
                if self._api is None:
                    self._api = self._connected()
                request(self._api, *told)
                return
            except ServerRefused as error:
                if error.status not in LATER and error.status < 500:
                    if not self._refused:
                        tell(f"warning {error}; the run's pages lack something")
                    self._refused = True
                    return
            except ModetuneError:
                pass  # the folder of the shared server cannot be written just now
            self._api = None
            if self.deadline is not None and time.monotonic() > self.deadline:
                raise GivenUp
            time.sleep(PAUSE_S)

    def _connected(self) -> PrefectApi:
        """The server; started again where it was modetune's own and is gone."""
        assert self._server is not None
        if self._server.shared and self._server.answer() != "ready":
            self._server.close()
            self._server = use_server()
            self._server.wait()
        return self._server.api()

    def _begin(self, api: PrefectApi) -> None:
        state = {"type": "RUNNING", "name": "Running"}
        if self.deployed:
            api.patch(f"/flow_runs/{self.run}", {"name": self.name})
            api.post(f"/flow_runs/{self.run}/set_state", {"state": state})
        else:
            flow = api.post("/flows/", {"name": self.flow})["id"]
            made = {"flow_id": flow, "name": self.name, "tags": [TAG], "state": state}
            self.run = str(api.post("/flow_runs/", made)["id"])
        self._live(api)

    def _live(self, api: PrefectApi) -> None:
        """A sign of life; a run that was taken for dead meanwhile lives again."""
        self._beaten = time.monotonic()
        give_sign(api, self.run)
        found = api.get(f"/flow_runs/{self.run}")["state_type"]
        if found == "CRASHED":
            state = {"type": "RUNNING", "name": "Running", "message": "it gives signs again"}
            api.post(f"/flow_runs/{self.run}/set_state", {"state": state, "force": True})
        elif found in ("CANCELLING", "CANCELLED") and self.deployed and self.deadline is None:
            with contextlib.suppress(ProcessLookupError):
                os.kill(self.parent, signal.SIGINT)  # the user ends it on the server's page

    def _post_sheet(self, api: PrefectApi, sheet: Message) -> None:
        known = self._sheets.get(sheet["key"])
        told = {"data": sheet["data"], "description": sheet["description"]}
        if known is not None:
            api.patch(f"/artifacts/{known}", told)
            return
        made = {**told, "type": sheet["kind"], "key": sheet["key"], "flow_run_id": self.run}
        self._sheets[sheet["key"]] = str(api.post("/artifacts/", made)["id"])

    def _end(self, api: PrefectApi, end: Message) -> None:
        state = {key: end[key] for key in ("type", "name", "message")}
        api.post(f"/flow_runs/{self.run}/set_state", {"state": state, "force": True})
        if end == KILLED["end"]:
            free_licences(api, self._leases)

    def _last_sheets(self, folder: str | None) -> None:
        """Tables and pictures of the result, drawn here and not in the campaign's time."""
        if folder is None:
            return
        from modetune.core.storage.record_file import read_record
        from modetune.flows.updating.artifacts import result_sheets

        record = read_record(Path(folder) / "campaign.h5")
        for sheet in result_sheets(record, Path(folder)):
            self._deliver(self._post_sheet, sheet.told())


def task_event(run: str, task: Message) -> Message:
    """The event by which Prefect records that a task run went into a state, at its own time."""
    kind, name, message = task["type"], task["state"], task["message"]
    return {
        "id": str(uuid4()),
        "occurred": task["at"],
        "event": f"prefect.task-run.{name}",
        "resource": {
            "prefect.resource.id": f"prefect.task-run.{task['id']}",
            "prefect.resource.name": task["name"],
            "prefect.state-name": name,
            "prefect.state-type": kind,
            "prefect.state-message": message,
            "prefect.state-timestamp": task["at"],
            "prefect.orchestration": "client",
        },
        "related": [
            {"prefect.resource.id": f"prefect.flow-run.{run}", "prefect.resource.role": "flow-run"}
        ],
        "payload": {
            "intended": {"from": None, "to": kind},
            "initial_state": None,
            "validated_state": {
                "type": kind,
                "name": name,
                "message": message,
                "state_details": {},
                "data": None,
            },
            "task_run": {
                "name": task["name"],
                "task_key": task["key"],
                "dynamic_key": task["id"],
                "run_count": 1,
                **task["times"],
            },
        },
    }


def tell(line: str) -> None:
    """A line for the campaign, where it still listens."""
    with contextlib.suppress(OSError):
        os.write(1, f"{line}\n".encode())


def main() -> None:
    """Leave the campaign's family, which shall not have to wait for this process, and work."""
    if os.fork():
        os._exit(0)
    begin = json.loads(sys.stdin.readline())
    poster = Poster(begin["name"], begin["flow_run"], begin["flow"], begin["parent"])
    threading.Thread(target=poster.listen, daemon=True).start()
    try:
        poster.work()
    except GivenUp:
        pass
    except ModetuneError as error:
        tell(f"warning {error}; the campaign goes on without Prefect's pages")
    except Exception as error:  # of what the campaign may not end of, the user shall know
        tell(f"warning Prefect's pages lack this run: {type(error).__name__}: {error}")
    finally:
        os._exit(0)  # the listening thread still reads


if __name__ == "__main__":
    main()
