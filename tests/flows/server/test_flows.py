"""Studies on Prefect's engine and a real server: states, retries and edges of task runs.

`make prefect-versions` runs these tests on the oldest and on the newest Prefect 3.
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import threading
from collections import Counter
from collections.abc import Iterator
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import modetune
from modetune.core.errors import SolverCrashed
from modetune.flows.campaign.campaign import Campaign
from modetune.flows.campaign.schema import SensitivitySection
from modetune.flows.campaign.site import HOME_VARIABLE
from modetune.flows.jobs.prefect_server import machine_home
from modetune.flows.server.run import carried_out
from modetune.flows.studies.catalogue import find_study
from tests.eventually import eventually
from tests.flows.conftest import Bench, Watcher, api_of
from tests.flows.server.site import SIX_MASS
from tests.flows.updating.test_update import settings

TRUTH = {"k1": 1.2, "k4": 0.9}
DIFFERENCES = SensitivitySection(method="finite_difference", step=0.001)


@dataclass
class Served:
    """The server of the session, for studies in this process."""

    bench: Bench
    home: Path

    def update(self, campaign: Campaign, folder: str = "run") -> tuple[Any, list[dict[str, Any]]]:
        """Run an update as a flow; its end, and its task runs in the order of their begin."""
        seen = {run["id"] for run in self.runs()}
        parameters = {
            "campaign_file": campaign.file,
            "settings": [],
            "runs": self.bench.folder / folder,
        }
        try:
            end: Any = carried_out(find_study("update"), parameters, Watcher(), campaign=campaign)
        except SolverCrashed as error:
            end = error
        (run,) = (run for run in self.runs() if run["id"] not in seen)
        assert run["parameters"]["campaign_file"] == str(campaign.file)
        return end, self.tasks(run["id"])

    def runs(self) -> Any:
        return api_of(self.home).post("/flow_runs/filter", {})

    def newest(self) -> Any:
        """The run that was made last."""
        return max(self.runs(), key=lambda run: str(run["created"]))

    def tasks(self, run: str) -> list[dict[str, Any]]:
        of_run = {"flow_runs": {"id": {"any_": [run]}}, "sort": "EXPECTED_START_TIME_ASC"}
        found: list[dict[str, Any]] = []
        before = -1
        while len(found) != before:  # the server records them in batches
            before = len(found)
            threading.Event().wait(1.0)
            found = api_of(self.home).post("/task_runs/filter", of_run)
        return found


@pytest.fixture
def served(bench: Bench, server_base: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Served]:
    monkeypatch.setenv(HOME_VARIABLE, str(server_base))
    for name in ("MODETUNE_NO_PREFECT", "PREFECT_API_URL", "PREFECT_API_AUTH_STRING"):
        monkeypatch.delenv(name, raising=False)
    threads = set(threading.enumerate())
    yield Served(bench, machine_home(server_base))
    left = set(threading.enumerate()) - threads
    assert not {thread.name for thread in left if thread.name.startswith("modetune")}


def states(tasks: list[dict[str, Any]], part: str) -> Counter[str]:
    return Counter(task["state_name"] for task in tasks if part in task["name"])


def upstream(task: dict[str, Any]) -> set[str]:
    """The task runs that a task follows from."""
    return {item["id"] for items in task["task_inputs"].values() for item in items}


def test_a_solver_that_fails_once_is_run_again_by_prefect(served: Served) -> None:
    served.bench.script({1: "killed"})
    end, tasks = served.update(served.bench.campaign(TRUTH, retries=1))
    assert end.exit_code == 0
    (first,) = (task for task in tasks if task["name"] == "iteration 0 / modal")
    assert (first["run_count"], first["state_name"]) == (2, "Completed")
    assert {task["run_count"] for task in tasks if task is not first} == {1}
    assert not end.remark


def test_a_function_of_python_is_called_in_the_tasks_of_a_flow(
    served: Served, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Two unit masses on springs of 900 and 1000 N/m; eigenvalues of K in closed form."""
    from prefect.context import TaskRunContext

    names = set()

    def model(k1: float, k2: float) -> tuple[Any, Any]:
        context = TaskRunContext.get()
        names.add(context.task_run.name if context else "")
        return np.array([[k1 + k2, -k2], [-k2, k2]]), np.eye(2)

    monkeypatch.chdir(served.bench.folder)
    root = (2900.0**2 / 4.0 - 900.0 * 1000.0) ** 0.5
    test = {
        "frequencies_hz": np.sqrt([1450.0 - root, 1450.0 + root]) / (2.0 * np.pi),
        "mode_shapes": np.array([[1000.0, 1000.0], [450.0 + root, 450.0 - root]]),
        "dofs": ["1.x", "2.x"],
    }
    found = modetune.update(model=model, test=test, parameters={"k1": 1000.0, "k2": 1000.0})
    assert found.record.updated == pytest.approx([0.9, 1.0], rel=0.005)  # e1: 0.1 % of a frequency
    assert served.newest()["state_name"].startswith("Converged")
    assert "iteration 0 / modal" in names
    assert "" not in names


def test_the_state_of_a_run_carries_the_verdict(served: Served) -> None:
    """Two springs from one frequency: it agrees, and cannot be trusted."""
    campaign = served.bench.campaign(TRUTH, modes=(1,))
    end, _ = served.update(campaign)
    assert end.found.record.status == "converged"
    kept = served.newest()
    assert (kept["state_name"], kept["state_type"]) == ("Converged, not trusted", "COMPLETED")
    assert kept["state"]["message"].startswith("chain: 2 parameters updated, ")
    failing = replace(campaign, run=campaign.run.model_copy(update={"fail_on": "not-trusted"}))
    end, _ = served.update(failing)
    assert end.exit_code == 6
    failed = served.newest()
    assert (failed["state_name"], failed["state_type"]) == ("Converged, not trusted", "FAILED")
    assert "excludes this verdict" in failed["state"]["message"]
    end, _ = served.update(served.bench.campaign(TRUTH), "trusted")
    # Without matrices no other start was tried.
    assert served.newest()["state_name"] == "Converged, with reservations"


def test_a_changed_structure_is_in_the_state_and_sends_an_event_once(served: Served) -> None:
    """A spring loses 15 %: the run that shows it sends the event, and the next one does not."""

    def events() -> list[dict[str, Any]]:
        wanted = {"filter": {"event": {"name": ["modetune.structure.changed"]}}}
        found: list[dict[str, Any]] = api_of(served.home).post("/events/filter", wanted)["events"]
        return found

    for night, k1 in enumerate((1.0, 0.85, 0.8501)):
        end, _ = served.update(served.bench.campaign({**TRUTH, "k1": k1 * TRUTH["k1"]}))
        name = served.newest()["state_name"]
        assert name.startswith("Changed: k1 -" if night else "Converged, "), name
        assert not night or name.endswith("; converged, with reservations")
        assert end.found.news is (night == 1)
    assert eventually(events)
    (event,) = events()
    assert event["resource"]["prefect.resource.id"] == "modetune.structure.chain"
    assert event["payload"]["drift"].startswith("Changed: k1 -1")
    assert event["payload"]["drift_details"]["changes"][0]["step"] is True


def test_edges_lead_from_modes_by_columns_and_the_step_to_the_next_modes(served: Served) -> None:
    campaign = served.bench.campaign(TRUTH, sensitivity=DIFFERENCES)
    _, tasks = served.update(campaign)
    ids = {task["name"]: task["id"] for task in tasks}
    by_name = {task["name"]: upstream(task) for task in tasks}
    columns = {f"iteration 0 / sensitivity {name}" for name in TRUTH}
    modal, step = ids["iteration 0 / modal"], "iteration 1 / step"
    assert all(by_name[name] == {modal} for name in columns)
    assert by_name[step] == {modal, *(ids[name] for name in columns)}
    assert by_name["iteration 1 / modal"] == {ids[step]}
    again = served.update(campaign, "again")[1]
    assert states(again, "iteration 0 / modal") == {"Cached": 1}
    assert states(again, "sensitivity") == {"Cached": states(tasks, "sensitivity").total()}


def test_skipped_columns_and_those_without_a_job_say_so(served: Served) -> None:
    skipping = served.bench.campaign(TRUTH, sensitivity=DIFFERENCES, update=settings(e2=0.02))
    end, tasks = served.update(skipping)
    spared = sum(item.sensitivity_skipped for item in end.found.record.iterations)
    assert spared >= 1
    assert states(tasks, "sensitivity")["Skipped"] == spared * len(TRUTH)
    energies = served.bench.campaign(TRUTH, sensitivity=SensitivitySection(method="strain_energy"))
    _, tasks = served.update(energies, "energies")
    assert set(states(tasks, "sensitivity")) == {"Derived"}


def test_what_fails_and_what_is_not_tried_are_not_green(served: Served) -> None:
    served.bench.script(dict.fromkeys(range(2, 50), "killed"))
    error, tasks = served.update(served.bench.campaign(TRUTH, sensitivity=DIFFERENCES))
    assert isinstance(error, SolverCrashed)
    assert states(tasks, "iteration 0 / modal") == {"Completed": 1}
    assert set(states(tasks, "sensitivity")) == {"Failed"}
    served.bench.script(dict.fromkeys(range(1, 50), "killed"))
    campaign = served.bench.campaign(TRUTH)
    (served.bench.folder / "runs.log").unlink()
    (served.bench.folder / "store").rename(served.bench.folder / "first")
    _, tasks = served.update(replace(campaign), "failed")
    assert set(states(tasks, "modal")) == {"Failed"}


def test_a_study_inside_a_users_flow_uses_its_runner(
    served: Served, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from prefect import flow
    from prefect.task_runners import ThreadPoolTaskRunner

    from modetune.flows.jobs.prefect_server import use_server
    from modetune.flows.server.flows import update
    from modetune.flows.server.prefect_client import prefect_client

    shutil.copytree(SIX_MASS, tmp_path / "six_mass")
    monkeypatch.setenv("MODETUNE_STORE", str(tmp_path / "six"))
    begun: list[str] = []

    class OneByOne(ThreadPoolTaskRunner[Any]):
        def __init__(self) -> None:
            super().__init__(max_workers=1)

        def duplicate(self) -> OneByOne:
            return OneByOne()

        def submit(self, task: Any, *given: Any, **named: Any) -> Any:
            begun.append(task.task_run_name())
            return super().submit(task, *given, **named)

    @flow(task_runner=OneByOne())  # type: ignore[arg-type]
    def nightly() -> Any:
        return update(tmp_path / "six_mass" / "campaign.yaml", return_state=True)

    server = use_server(start=False)
    assert server is not None
    with closing(server), prefect_client(server.settings()):
        nightly()
    assert any(name.endswith("modal") for name in begun)
    run = next(run for run in served.runs() if run["name"] == "six-mass")
    assert (run["state_name"], run["parent_task_run_id"] is None) == ("Converged, trusted", False)
    assert {task["name"] for task in served.tasks(run["id"])} >= set(begun)


def test_updates_of_a_fleet_are_flows_inside_its_own(
    served: Served, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("MODETUNE_STORE", str(tmp_path / "six"))
    for name in ("north", "south"):
        shutil.copytree(SIX_MASS, tmp_path / name, ignore=shutil.ignore_patterns("__py*"))
        file = tmp_path / name / "campaign.yaml"
        file.write_text(file.read_text().replace("name: six-mass", f"name: fleet-{name}"))
    seen = {run["id"] for run in served.runs()}
    given = {"of": [tmp_path / "*" / "campaign.yaml"], "runs": tmp_path / "runs", "update": True}
    end = carried_out(find_study("fleet"), given, Watcher())
    new = {run["name"]: run for run in served.runs() if run["id"] not in seen}
    assert set(new) == {"fleet", "fleet-north", "fleet-south"}
    assert (end.exit_code, new["fleet"]["state_name"]) == (0, "2 structures: 2 learning")
    for name in ("fleet-north", "fleet-south"):
        assert new[name]["state_name"] == "Converged, trusted"
        assert new[name]["parent_task_run_id"] is not None
        assert new[name]["tags"] == ["modetune"]  # so that it is marked as crashed when it dies
        # Their store is one: what one of them has solved is no task of the other.
        tasks = [task["name"] for task in served.tasks(new[name]["id"])]
        assert any(task.startswith("iteration ") for task in tasks)


def test_ctrl_c_in_a_study_ends_the_users_flow_too(served: Served) -> None:
    from prefect import flow

    from modetune.flows.jobs.prefect_server import use_server
    from modetune.flows.server.flows import Handed, handing, update
    from modetune.flows.server.prefect_client import prefect_client

    class Interrupting(Watcher):
        def working(self, text: str) -> None:
            raise KeyboardInterrupt

    reached: list[str] = []

    @flow
    def nightly() -> None:
        reached.append("update")
        update("campaign.yaml", return_state=True)
        reached.append("next")

    server = use_server(start=False)
    assert server is not None
    with closing(server), prefect_client(server.settings()), handing(Handed(Interrupting())):
        with pytest.raises(KeyboardInterrupt):
            nightly()
    assert reached == ["update"]
    run = next(run for run in served.runs() if run["state"]["message"] == "stopped by the user")
    assert run["state_type"] == "CANCELLED"


def test_workers_of_a_dask_cluster_run_the_same_tasks(
    served: Served, tmp_path: Path, server_base: Path
) -> None:
    pytest.importorskip("prefect_dask", reason="prefect-dask is not installed (extra `cluster`)")
    shutil.copytree(SIX_MASS, tmp_path / "six")
    found = []
    for engine in ("dask", "local"):
        ended = subprocess.run(
            [
                *(sys.executable, "-m", "modetune", "update", "campaign.yaml", "--json"),
                *("--set", f"run.engine={engine}", "--runs", engine),
            ],
            cwd=tmp_path / "six",
            env={**os.environ, "MODETUNE_STORE": str(tmp_path / engine)},
            capture_output=True,
            text=True,
            timeout=200,
            check=False,
        )
        assert ended.returncode == 0, ended.stderr
        assert "Finished in state" not in ended.stderr  # Prefect's log, from a worker
        found.append(json.loads(ended.stdout)["parameters"])
    assert found[0] == found[1]
    newest = sorted(served.runs(), key=lambda run: str(run["expected_start_time"]))[-2:]
    on_dask, on_threads = (served.tasks(run["id"]) for run in newest)
    assert states(on_dask, "modal") == states(on_threads, "modal") == {"Completed": 5}
    assert {task["name"] for task in on_dask} == {task["name"] for task in on_threads}
