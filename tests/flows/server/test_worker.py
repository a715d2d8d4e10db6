"""A worker runs what is due and nothing else; runs that died without a word do not stand in the way
of the next one."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, nullcontext
from pathlib import Path
from typing import Any

import pytest

from modetune.core.errors import ModetuneError
from modetune.flows.campaign.campaign import cores
from modetune.flows.cli import deployed
from modetune.flows.jobs import heartbeats
from modetune.flows.jobs import prefect_server as process
from modetune.flows.jobs.heartbeats import LABEL, LICENCES, SilentRuns
from modetune.flows.jobs.limits import CORES, Limit, MachineLimits
from modetune.flows.jobs.prefect_api import PrefectApi, ServerRefused
from modetune.flows.server import worker as worker_module
from modetune.flows.server.deployment import make_pool
from modetune.flows.server.worker import Worker, check_login
from tests.flows.conftest import api_of

SIX_MASS = Path(__file__).resolve().parents[3] / "configs" / "six_mass"
#: What the processes of a site are, by a piece of their command lines.
WORKER, RUN, POSTER = b"modetune\0worker", b"cli.deployed", b"updating.poster"
SERVER = (b"jobs.prefect_server", b"prefect\0server")
#: Seconds that a busy machine may need to start something.
PATIENCE_S = 300.0
ENDED = {"COMPLETED", "FAILED", "CRASHED", "CANCELLED"}


class Site:
    """A deployed campaign with a server of its own, whose processes can be killed."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.base = folder / "home"
        self.home = process.machine_home(self.base)
        shutil.copytree(
            SIX_MASS,
            folder,
            dirs_exist_ok=True,
            ignore=shutil.ignore_patterns("__pycache__", "*.py"),
        )
        self.store = folder / "store"
        self.environment = {
            **os.environ,
            process.HOME_VARIABLE: str(self.base),
            "MODETUNE_STORE": str(self.store),
        }
        self._cores = ExitStack()
        for name in ("PREFECT_API_URL", "PREFECT_API_AUTH_STRING", "MODETUNE_NO_PREFECT"):
            self.environment.pop(name, None)
        subprocess.run(
            [sys.executable, "-m", "modetune", "deploy", "campaign.yaml"],
            cwd=folder,
            env=self.environment,
            capture_output=True,
            check=True,
            timeout=PATIENCE_S,
        )

    def ask(self, path: str, content: object = None) -> Any:
        with api_of(self.home) as api:
            return api.get(path) if content is None else api.post(path, content)

    def due(self) -> str:
        """Ask for a run of the deployment; its identity."""
        deployment = self.ask("/deployments/name/update/six-mass")["id"]
        asked = {"state": {"type": "SCHEDULED"}}
        return str(self.ask(f"/deployments/{deployment}/create_flow_run", asked)["id"])

    def worker(self) -> subprocess.Popen[str]:
        return subprocess.Popen(
            [sys.executable, "-m", "modetune", "worker"],
            cwd=self.folder,
            env=self.environment,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            text=True,
            start_new_session=True,
        )

    def state(self, run: str) -> Any:
        return self.ask(f"/flow_runs/{run}")

    def wait(self, run: str, wanted: Callable[[Any], bool]) -> tuple[Any, float]:
        """The run once it is as wanted, and the seconds until then; the server may be gone."""
        began, found = time.monotonic(), None
        while time.monotonic() - began < PATIENCE_S:
            try:
                found = self.state(run)
            except (ServerRefused, AssertionError):
                pass
            else:
                if wanted(found):
                    return found, time.monotonic() - began
            time.sleep(0.3)
        raise AssertionError(f"not in {PATIENCE_S:.0f} s: {found and found['state']}")

    def hang(self) -> None:
        """From now on a run of the campaign waits: its jobs want cores, which are all taken."""
        shutil.rmtree(self.store, ignore_errors=True)
        every = (Limit(CORES, cores(), cores()),)
        limits = MachineLimits(self.home / "limits")
        self._cores.enter_context(limits.held(every, lambda name: time.sleep(0.05)))

    def mend(self) -> None:
        self._cores.close()

    def kill(self, *kinds: bytes) -> int:
        """Kill the site's processes of these kinds at one blow; how many there were."""
        ours, found = f"{process.HOME_VARIABLE}={self.base}".encode(), []
        for entry in Path("/proc").glob("[0-9]*"):
            try:
                if ours in (entry / "environ").read_bytes().split(b"\0"):
                    line = (entry / "cmdline").read_bytes()
                    if any(kind in line for kind in kinds):
                        found.append(int(entry.name))
            except OSError:
                continue
        for pid in found:
            try:
                os.kill(pid, signal.SIGKILL)
            except ProcessLookupError:
                continue
        return len(found)

    def slots(self) -> int:
        """Runs of the deployment that hold its one slot."""
        deployment = self.ask("/deployments/name/update/six-mass")
        return int(deployment["global_concurrency_limit"]["active_slots"])


def killed_round(site: Site, *kinds: bytes) -> float:
    """Kill processes under a run that is under way; seconds until it is known to have crashed.

    Then the next run that is due must start, once, and come to its end.
    """
    site.mend()
    first = site.worker()
    site.hang()
    lost = site.due()
    site.wait(lost, lambda run: run["state_type"] == "RUNNING" and LABEL in run["labels"])
    assert site.kill(*kinds) >= 2
    first.communicate()
    site.mend()
    second = site.worker()
    try:
        found, silent_s = site.wait(lost, lambda run: run["state_type"] in ENDED)
        assert found["state_type"] == "CRASHED"
        assert site.slots() == 0
        following = site.due()
        run, _ = site.wait(following, lambda run: run["state_type"] in ENDED)
        assert run["state_name"] in ("Converged", "Unchanged"), run["state"]
        assert run["run_count"] == 1
        assert site.slots() == 0
    finally:
        second.terminate()
        said = second.communicate(timeout=60.0)[1]
    assert second.returncode == 130
    assert "fault" not in said
    assert "the worker has ended" in said
    return silent_s


def killed_server_round(site: Site) -> None:
    """Kill the server under a run that is under way: it goes on, and its end is known."""
    site.mend()
    worker = site.worker()
    site.hang()
    run = site.due()
    site.wait(run, lambda run: run["state_type"] == "RUNNING" and LABEL in run["labels"])
    try:
        assert site.kill(*SERVER) >= 2
        site.mend()
        found, _ = site.wait(run, lambda run: run["state_type"] in ENDED)
        assert found["state_name"] in ("Converged", "Unchanged"), found["state"]
        assert site.slots() == 0
    finally:
        worker.terminate()
        assert "fault" not in worker.communicate(timeout=60.0)[1]


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Site]:
    site = Site(tmp_path_factory.mktemp("site"))
    yield site
    site.kill(WORKER, RUN, POSTER)
    process.stop_server(site.home)


def test_a_run_whose_process_is_killed_has_crashed_at_once(site: Site) -> None:
    """The process beside it sees it; nobody needs to wait for signs of life."""
    assert killed_round(site, WORKER, RUN) < heartbeats.SILENT_S


def test_a_run_whose_machine_is_gone_has_crashed_within_a_minute(site: Site) -> None:
    assert killed_round(site, WORKER, RUN, POSTER) < 60.0


def test_a_server_that_is_killed_under_a_run_hears_how_it_ended(site: Site) -> None:
    """Whoever needs it next starts it again, and the campaign goes on meanwhile."""
    killed_server_round(site)


def test_a_run_that_is_cancelled_on_its_page_ends_and_leaves_its_slot(site: Site) -> None:
    """Nothing asks the worker: the campaign itself sees it, and ends in good order."""
    site.mend()
    worker = site.worker()
    try:
        site.hang()
        run = site.due()
        site.wait(run, lambda run: run["state_type"] == "RUNNING" and LABEL in run["labels"])
        asked = {"type": "CANCELLING", "name": "Cancelling"}  # what the page's button sends
        assert site.ask(f"/flow_runs/{run}/set_state", {"state": asked})["status"] == "ACCEPT"
        found, _ = site.wait(run, lambda run: run["state_type"] in ENDED)
        assert (found["state_type"], found["state"]["message"]) == (
            "CANCELLED",
            "stopped by the user",
        )
        assert site.slots() == 0
        site.mend()
        found, _ = site.wait(site.due(), lambda run: run["state_type"] in ENDED)
        assert found["state_name"] in ("Converged", "Unchanged"), found["state"]
    finally:
        worker.terminate()
        assert "fault" not in worker.communicate(timeout=60.0)[1]


def test_a_pool_of_our_runs_takes_no_settings_of_a_run(site: Site) -> None:
    deployment = site.ask("/deployments/name/update/six-mass")["id"]
    asked = {"state": {"type": "SCHEDULED"}, "job_variables": {"command": "touch /tmp/owned"}}
    with pytest.raises(ServerRefused) as refused:
        site.ask(f"/deployments/{deployment}/create_flow_run", asked)
    assert refused.value.status in (409, 422)


def test_a_pool_of_another_type_is_refused(site: Site) -> None:
    """Its runs could bring a command of their own."""
    made = {"name": "processes", "type": "process", "base_job_template": {}}
    site.ask("/work_pools/", made)
    with api_of(site.home) as api, pytest.raises(ModetuneError, match="is of type process"):
        make_pool(api, "processes")


def test_a_worker_refuses_a_server_without_a_login(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(PrefectApi, "answer", lambda self: "ready")
    server = process.SharedServer(tmp_path, process.Address("http://127.0.0.1:9/api", 0), None)
    with pytest.raises(ModetuneError, match="--without-login"):
        check_login(server)
    monkeypatch.setattr(PrefectApi, "answer", lambda self: "asks for a login")
    check_login(server)


@pytest.mark.parametrize(
    "told",
    [{"name": "x", "campaign_file": "/x", "settings": [], "runs": "/x", "command": "true"},
     {"name": "x"}, ["true"], {"name": "x", "campaign_file": 1, "settings": [], "runs": "/x"}],
)  # fmt: skip
def test_a_run_with_other_parameters_than_a_campaigns_fails(
    told: object, monkeypatch: pytest.MonkeyPatch
) -> None:
    ended: list[tuple[str, str, str]] = []
    monkeypatch.setattr(deployed, "shown", Recorded(ended))
    deployed.run_deployed("run", told)
    assert [(kind, name) for kind, name, _ in ended] == [("FAILED", "Failed")]


class Recorded:
    """Pages that keep what a run ended with."""

    def __init__(self, ended: list[tuple[str, str, str]]) -> None:
        self.ended = ended

    def __call__(self, name: str, run: str) -> Recorded:
        return self

    def __enter__(self) -> Recorded:
        return self

    def __exit__(self, *error: object) -> None:
        pass

    def end(self, kind: str, name: str, message: str, folder: Path | None = None) -> None:
        self.ended.append((kind, name, message))


class Server:
    """A server's flow runs, as `SilentRuns` asks for them."""

    def __init__(self) -> None:
        self.signs = {"a": "1", "b": "1"}
        self.crashed: list[str] = []
        self.freed: list[str] = []

    def post(self, path: str, content: Any) -> Any:
        if path == "/flow_runs/filter":
            return [
                {
                    "id": run,
                    "state_type": "RUNNING",
                    "labels": {LABEL: sign, LICENCES: f"{run}1 {run}2"},
                }
                for run, sign in self.signs.items()
                if run not in self.crashed
            ]
        if path == "/v2/concurrency_limits/decrement-with-lease":
            self.freed.append(content["lease_id"])
            return None
        assert content["state"]["type"] == "CRASHED"
        self.crashed.append(path.split("/")[2])
        return {}


def test_only_a_run_that_gives_no_signs_is_taken_for_dead(monkeypatch: pytest.MonkeyPatch) -> None:
    """Its licences are free with it."""
    server, watch, now = Server(), SilentRuns(), [0.0]
    monkeypatch.setattr(time, "monotonic", lambda: now[0])
    for turn in range(4):  # 30 s are long enough
        now[0], server.signs["a"] = 10.0 * turn, str(turn)
        watch.look(server)  # type: ignore[arg-type]  # it asks for three paths
    assert (server.crashed, server.freed) == (["b"], ["b1", "b2"])


class Gone:
    """A shared server that ended by itself."""

    shared = True

    def answer(self) -> str:
        return "does not answer"

    def close(self) -> None:
        pass

    def wait(self) -> None:
        pass

    def api(self) -> Any:
        return nullcontext(Server())


def test_a_worker_that_started_the_server_again_counts_silence_anew(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Else runs of others, which told nothing to a server that was gone, would be dead at once."""
    now = [0.0]
    monkeypatch.setattr(time, "monotonic", lambda: now[0])
    monkeypatch.setattr(worker_module, "use_server", Gone)
    worker: Any = Worker(Gone(), "pool", None)  # type: ignore[arg-type]  # it asks for four things
    server = Server()
    worker._watch.look(server)
    now[0] = 40.0
    with worker._api():
        worker._watch.look(server)
    assert server.crashed == []
