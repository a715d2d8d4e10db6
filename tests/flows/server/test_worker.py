"""A worker runs what is due; runs that died do not block the next one."""

from __future__ import annotations

import asyncio
import socket
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from prefect.exceptions import InfrastructureNotAvailable

from modetune.core.errors import ModetuneError
from modetune.flows.jobs import prefect_server as process
from modetune.flows.jobs.heartbeats import (
    COLLIDED,
    RESOURCE,
    SILENT_S,
    HeartbeatWatch,
    send_heartbeat,
)
from modetune.flows.jobs.server_client import ServerClient
from modetune.flows.server.worker import CampaignWorker, FixedConfiguration, check_login
from tests.eventually import allowed, eventually
from tests.flows.conftest import api_of
from tests.flows.server.site import ENDED, GOOD, PATIENCE_S, RUN, SERVER, WORKER, Site, stop


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Site]:
    site = Site(tmp_path_factory.mktemp("site"))
    yield site
    site.resume()
    site.end_started()
    site.kill(WORKER, RUN)
    process.stop_server(site.home)


def running(site: Site) -> str:
    """A run whose jobs wait."""
    site.hang()
    run = site.due()
    site.wait(run, lambda run: run["state_type"] == "RUNNING")
    return run


def check_next(site: Site) -> None:
    """The next run that is due starts and comes to its end."""
    site.resume()
    found, _ = site.wait(site.due(), lambda run: run["state_type"] in ENDED)
    assert found["state_name"] in GOOD, found["state"]
    assert site.slots() == 0


def test_a_run_whose_process_is_killed_has_crashed_at_once(site: Site) -> None:
    worker = site.worker()
    lost = running(site)
    assert site.kill(RUN) == 1
    found, seconds = site.wait(lost, lambda run: run["state_type"] in ENDED)
    assert (found["name"], found["state_type"], seconds < 10.0) == ("six-mass", "CRASHED", True)
    assert "ended with code -9" in found["state"]["message"]
    check_next(site)
    assert "the worker stopped" in stop(worker)


def test_a_run_that_collides_has_the_campaigns_name_and_the_run_in_its_way(site: Site) -> None:
    """Prefect refuses it before it has a process, with a random name."""
    worker = site.worker()
    first, second = running(site), site.due()
    found, _ = site.wait(second, lambda run: run["state_name"] == COLLIDED)
    began = site.state(first)["start_time"][:19]
    assert (found["name"], found["state_type"]) == ("six-mass", "CANCELLED")
    assert found["state"]["message"] == (
        f"another run of six-mass, which began at {began} UTC, was in progress; this one did "
        "nothing"
    )
    site.resume()
    site.wait(first, lambda run: run["state_type"] in ENDED)
    stop(worker)


def test_a_run_whose_machine_is_gone_has_crashed_within_a_minute(site: Site) -> None:
    first = site.worker()
    lost = running(site)
    assert site.kill(WORKER, RUN) == 2
    first.communicate()
    second = site.worker()
    found, seconds = site.wait(lost, lambda run: run["state_type"] in ENDED)
    assert (found["state_type"], seconds < 60.0) == ("CRASHED", True)
    assert f"its process ({socket.gethostname()}:" in found["state"]["message"]
    check_next(site)
    stop(second)


def test_a_server_that_is_killed_under_a_run_receives_its_end(site: Site) -> None:
    """The worker starts it again at its address, and the run continues meanwhile."""
    worker = site.worker()
    run = running(site)
    address = process.running_address(site.home)
    assert address is not None
    assert site.kill(*SERVER) >= 2
    site.resume()
    found, _ = site.wait(run, lambda run: run["state_type"] in ENDED)
    assert found["state_name"] in GOOD, found["state"]
    again = process.running_address(site.home)
    assert again is not None
    assert again.url == address.url
    assert site.slots() == 0
    assert stop(worker).count("the worker continues to try") == 1


def test_a_run_that_is_cancelled_on_its_page_ends_and_frees_its_slot(site: Site) -> None:
    worker = site.worker()
    run = running(site)
    content = {
        "state": {"type": "CANCELLING", "name": "Cancelling"}
    }  # what the page's button sends
    assert site.ask(f"/flow_runs/{run}/set_state", content)["status"] == "ACCEPT"
    found, seconds = site.wait(run, lambda run: run["state_type"] in ENDED)
    assert (found["state_type"], seconds < 10.0) == ("CANCELLED", True)
    assert eventually(lambda: site.processes(RUN) == [])
    check_next(site)
    stop(worker)


def test_a_run_of_a_command_shows_what_repeats_and_what_cancels_it(site: Site) -> None:
    """Prefect's pages have no button for runs without a deployment."""
    site.hang()
    command = site.start("update", "campaign.yaml", "--set", "update.max_iterations=5")
    of_command = {"deployment_id": {"is_null_": True}, "state": {"type": {"any_": ["RUNNING"]}}}

    def lines() -> list[str]:
        runs = site.ask("/flow_runs/filter", {"flow_runs": of_command})
        logs = {"logs": {"flow_run_id": {"any_": [run["id"] for run in runs]}}}
        return [item["message"] for item in site.ask("/logs/filter", logs)] if runs else []

    assert eventually(lambda: any(line.startswith("to cancel") for line in lines()), PATIENCE_S)
    shown = dict(line.split(": ", 1) for line in lines() if line.startswith("to "))
    file, runs = site.folder / "campaign.yaml", site.folder / "runs"
    assert shown["to repeat this run"] == (
        f"modetune update {file} --runs {runs} --set update.max_iterations=5"
    )
    prefect, *words = shown["to cancel this run"].split()
    cancelled = site.program(sys.executable, "-m", prefect, *words, **site.prefect())
    assert cancelled.returncode == 0, cancelled.stderr
    began = time.monotonic()
    command.communicate(timeout=60.0)
    assert command.returncode == 130
    assert time.monotonic() - began < allowed(10.0)
    site.resume()
    assert site.state(words[-1])["state_type"] == "CANCELLED"


def test_a_worker_that_is_ended_ends_its_runs(site: Site) -> None:
    worker = site.worker()
    run = running(site)
    stop(worker)
    assert site.processes(RUN) == []
    site.resume()
    assert site.state(run)["state_type"] in ENDED
    assert site.slots() == 0


def test_the_keeper_marks_a_run_that_nobody_carries_out(site: Site) -> None:
    """An interactive run whose process was killed: no worker is there."""
    flow = site.ask("/flows/", {"name": "update"})["id"]
    content = {"flow_id": flow, "tags": ["modetune"], "state": {"type": "RUNNING"}}
    lost, live = (str(site.ask("/flow_runs/", content)["id"]) for _ in range(2))
    began, client = time.monotonic(), api_of(site.home)
    while site.state(lost)["state_type"] == "RUNNING":
        assert time.monotonic() - began < allowed(60.0)
        send_heartbeat(client, live)
        time.sleep(2.0)  # a heartbeat comes every few seconds
    assert site.state(lost)["state_type"] == "CRASHED"
    assert site.state(live)["state_type"] == "RUNNING"


def test_prefects_own_command_starts_the_worker(site: Site, tmp_path: Path) -> None:
    """It finds the type by the package's entry point, which an installation registers."""
    metadata = tmp_path / "registered-1.dist-info"
    metadata.mkdir()
    (metadata / "METADATA").write_text("Metadata-Version: 2.1\nName: registered\nVersion: 1\n")
    project = Path(__file__).resolve().parents[3] / "pyproject.toml"
    line = next(line for line in project.read_text().splitlines() if "flows.server.worker" in line)
    (metadata / "entry_points.txt").write_text(
        "[prefect.collections]\nmodetune = " + line.split('"')[1] + "\n"
    )
    run = site.due()
    started = site.program(
        *(sys.executable, "-m", "prefect", "worker", "start"),
        *("--type", "modetune", "--pool", "modetune", "--run-once"),
        PYTHONPATH=":".join([str(tmp_path), *(item for item in sys.path if item)]),
        MODETUNE_FOLDERS=str(site.folder),
        **site.prefect(),
    )
    assert started.returncode == 0, started.stdout + started.stderr
    assert site.state(run)["state_name"] in GOOD


def test_a_pool_of_another_type_is_refused(site: Site) -> None:
    """Its runs could bring a command of their own."""
    site.ask("/work_pools/", {"name": "processes", "type": "process", "base_job_template": {}})
    for command in (["worker", "--once"], ["deploy", "campaign.yaml"]):
        refused = site.run("server", *command, "--pool", "processes")
        assert refused.returncode == 2
        assert "work pool processes has type process" in refused.stderr


def test_a_worker_refuses_a_server_without_a_login(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ServerClient, "answer", lambda self: "ready")
    with pytest.raises(ModetuneError, match="--without-login"):
        check_login("http://127.0.0.1:9/api")
    monkeypatch.setattr(ServerClient, "answer", lambda self: "asks for a login")
    check_login("http://127.0.0.1:9/api")


def test_a_process_number_of_the_server_is_never_a_process_to_end() -> None:
    worker = CampaignWorker("pool")
    for text in ("1", "host:1", ""):
        with pytest.raises(InfrastructureNotAvailable):
            asyncio.run(worker.kill_infrastructure(text, FixedConfiguration()))


class Server:
    """A server's flow runs and heartbeats, as `HeartbeatWatch` asks for them."""

    def __init__(self, **states: str) -> None:
        self.states = states
        self.beats = dict.fromkeys(states, 0)
        self.ended: dict[str, str] = {}

    def post(self, path: str, content: Any) -> Any:
        if "deployment_id" in content.get("flow_runs", ()):
            return []  # none that did not begin
        if path == "/flow_runs/filter":
            return [
                {"id": run, "state_type": state}
                for run, state in self.states.items()
                if run not in self.ended
            ]
        if path == "/events/count-by/resource":
            return [
                {"value": f"{RESOURCE}{run}", "count": count, "end_time": ""}
                for run, count in self.beats.items()
                if count
            ]
        self.ended[path.split("/")[2]] = content["state"]["type"]
        return {}


def test_only_a_run_without_heartbeats_is_marked(monkeypatch: pytest.MonkeyPatch) -> None:
    """A run that was to be cancelled ends as cancelled."""
    server, watch, now = Server(a="RUNNING", b="RUNNING", c="CANCELLING"), HeartbeatWatch(), [0.0]
    monkeypatch.setattr(time, "monotonic", lambda: now[0])
    while now[0] <= SILENT_S + 10.0:
        server.beats["a"] += 1
        watch.look(server)  # type: ignore[arg-type]  # it asks for three paths
        now[0] += 5.0
    assert server.ended == {"b": "CRASHED", "c": "CANCELLED"}


def test_a_server_that_was_gone_ends_no_run(site: Site, monkeypatch: pytest.MonkeyPatch) -> None:
    """Runs sent it nothing meanwhile: they count from when it is seen again."""
    now, server = [0.0], Server(a="RUNNING")
    monkeypatch.setattr(time, "monotonic", lambda: now[0])
    worker: Any = CampaignWorker("pool")
    worker._watch.look(server)
    now[0] = 2.0 * SILENT_S
    asyncio.run(worker._gone(OSError("gone")))
    worker._watch.look(server)
    assert server.ended == {}
