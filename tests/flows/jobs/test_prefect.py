"""Prefect's side of campaigns: what its pages show, deployments, schedules, and starts."""

from __future__ import annotations

import fcntl
import json
import logging
import os
import re
import shutil
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from modetune.flows.jobs.server_limits import LEASE_S

from modetune.core.errors import CampaignRunning
from modetune.core.modes import MeasuredModes
from modetune.core.parameters import Parameter
from modetune.core.updating.criteria import Tolerances
from modetune.flows.campaign.campaign import Campaign
from modetune.flows.jobs import prefect_server as process
from modetune.flows.updating import artifacts
from modetune.flows.updating.running import job_engine, update_campaign
from modetune.flows.updating.starting import is_unchanged, read_earlier, start_of
from tests.command_line import run_command
from tests.eventually import eventually
from tests.flows.conftest import Bench, ChainDeck, Watcher, api_of, recased

SIX_MASS = Path(__file__).resolve().parents[3] / "configs" / "six_mass"
TRUTH = {"k1": 1.2, "k4": 0.9}
#: A later test of the same structure.
AGED = {"k1": 1.1, "k4": 0.85}


def ran(bench: Bench, campaign: Campaign, watcher: Watcher) -> Any:
    return update_campaign(campaign, bench.folder / "run", watcher).record


def from_last(campaign: Campaign) -> Campaign:
    return replace(campaign, update=campaign.update.model_copy(update={"start": "last"}))


def test_a_key_of_a_sheet_is_one_that_prefect_takes() -> None:
    assert artifacts.sheet_key("GARTEUR_wing.v2", "mac") == "garteur-wing-v2-mac"


def test_sheets_show_rounded_numbers_bounds_and_standard_errors(
    bench: Bench, watcher: Watcher
) -> None:
    record = ran(bench, bench.campaign(TRUTH, shapes=True), watcher)
    sheets = {sheet.key: sheet for sheet in artifacts.result_sheets(record, bench.folder)}
    assert set(sheets) == {
        f"chain-{kind}" for kind in ("frequencies", "parameters", "record", "mac")
    }
    assert all(re.fullmatch(r"[a-z0-9-]+", key) for key in sheets)
    first = json.loads(str(sheets["chain-parameters"].data))[0]
    assert (first["parameter"], first["parameter now"]) == ("k1", "1.2")
    assert first["bounds"] == "0.3, 3"
    assert float(first["standard error, of deck, %"]) > 0.0
    modes = json.loads(str(sheets["chain-frequencies"].data))
    assert [row["test mode"] for row in modes] == ["1", "2", "3", "4", "5"]
    assert list(modes[0])[:3] == [
        "test mode",
        "test, Hz",
        "before, Hz",
    ]  # columns stay in this order
    assert str(bench.folder / "campaign.h5") in str(sheets["chain-record"].data)
    picture = str(sheets["chain-mac"].data)
    assert picture.startswith("![MAC](data:image/png;base64,iVBOR")
    assert len(picture) < artifacts.LARGEST_PICTURE + 100


def test_there_is_no_mac_picture_where_no_shapes_were_measured(
    bench: Bench, watcher: Watcher
) -> None:
    record = ran(bench, bench.campaign(TRUTH), watcher)
    assert not any("mac" in sheet.key for sheet in artifacts.result_sheets(record, bench.folder))


def test_progress_is_the_tolerance_over_the_largest_error_and_ends_at_100(
    bench: Bench, watcher: Watcher
) -> None:
    record = ran(bench, bench.campaign(TRUTH), watcher)
    start = record.iterations[0]
    half = Tolerances(frequency=0.5 * start.worst_error, mac=0.0)
    assert artifacts.progress_sheets("chain", half, [start])[0].data == pytest.approx(50.0)
    done = artifacts.progress_sheets("chain", Tolerances(1e-8, 0.0), record.iterations)
    assert done[0].data == 100.0
    rows = json.loads(str(done[1].data))
    assert [row["iteration"] for row in rows] == [item.number for item in record.iterations]


def test_a_second_run_of_the_same_campaign_is_unchanged_and_costs_nothing(
    bench: Bench, watcher: Watcher
) -> None:
    campaign = from_last(bench.campaign(TRUTH))
    first = ran(bench, campaign, watcher)
    cost = bench.runs()
    earlier = read_earlier(bench.folder / "run")
    assert earlier is not None
    assert is_unchanged(campaign, job_engine(campaign), earlier)
    again = ran(bench, campaign, watcher)
    assert bench.runs() == cost
    assert again.updated.tolist() == first.updated.tolist()


def test_new_test_data_starts_from_the_last_updated_parameters_when_asked(
    bench: Bench, watcher: Watcher
) -> None:
    first = ran(bench, from_last(bench.campaign(TRUTH)), watcher)
    changed = bench.campaign(AGED)
    earlier = read_earlier(bench.folder / "run")
    assert earlier is not None
    assert not is_unchanged(changed, job_engine(changed), earlier)
    assert start_of(changed, job_engine(changed), earlier).start.tolist() == [1.0, 1.0]
    second = ran(bench, from_last(changed), watcher)
    assert second.iterations[0].parameters == pytest.approx(first.updated, rel=1e-12)
    assert second.updated == pytest.approx([1.1, 0.85], rel=1e-6)
    cost = bench.runs()
    third = ran(bench, from_last(changed), watcher)  # nothing changed: the same start once more
    assert bench.runs() == cost
    assert third.iterations[0].parameters.tolist() == second.iterations[0].parameters.tolist()


def test_the_last_values_are_kept_where_the_deck_was_replaced_by_the_updated_one(
    bench: Bench, watcher: Watcher
) -> None:
    first = ran(bench, bench.campaign(TRUTH), watcher)

    class Updated(ChainDeck):
        """Its deck has the updated values."""

        def deck_value(self, parameter: Parameter) -> float:
            return super().deck_value(parameter) * TRUTH[parameter.name]

    solver = replace(bench.solver(), deck=Updated())
    campaign = recased(from_last(bench.campaign(AGED)), solver=solver)
    earlier = read_earlier(bench.folder / "run")
    begin = start_of(campaign, job_engine(campaign), earlier).start
    assert begin == pytest.approx(first.updated / np.array([1.2, 0.9]), rel=1e-12)


def test_a_start_outside_the_bounds_is_brought_onto_them(bench: Bench, watcher: Watcher) -> None:
    ran(bench, bench.campaign(TRUTH), watcher)
    narrow = from_last(bench.campaign(AGED, bounds=(0.95, 1.15)))
    begin = start_of(narrow, job_engine(narrow), read_earlier(bench.folder / "run")).start
    assert begin.tolist() == [1.15, 0.95]


def test_a_parameter_that_is_new_starts_at_its_initial_value(
    bench: Bench, watcher: Watcher
) -> None:
    ran(bench, bench.campaign({"k1": 1.2}), watcher)
    wider = from_last(bench.campaign(TRUTH))
    begin = start_of(wider, job_engine(wider), read_earlier(bench.folder / "run")).start
    assert begin == pytest.approx([1.2, 1.0], rel=1e-6)


def test_a_record_that_cannot_be_read_is_told_and_the_deck_is_the_start(
    bench: Bench, watcher: Watcher, caplog: pytest.LogCaptureFixture
) -> None:
    (bench.folder / "run").mkdir()
    (bench.folder / "run" / "campaign.h5").write_bytes(b"half a file")
    with caplog.at_level(logging.WARNING, logger="modetune"):
        record = ran(bench, from_last(bench.campaign(TRUTH)), watcher)
    assert "cannot be read" in caplog.text
    assert record.iterations[0].parameters.tolist() == [1.0, 1.0]


def test_a_test_that_measured_more_modes_is_a_change(bench: Bench, watcher: Watcher) -> None:
    campaign = bench.campaign(TRUTH)
    ran(bench, campaign, watcher)
    earlier = read_earlier(bench.folder / "run")
    assert earlier is not None
    numbers = (1, 2, 3, 4)
    fewer = recased(campaign, test=MeasuredModes(numbers, bench.measured(TRUTH, numbers, False)))
    assert not is_unchanged(fewer, job_engine(fewer), earlier)


def test_a_campaign_under_way_is_an_error_of_its_own(bench: Bench, watcher: Watcher) -> None:
    (bench.folder / "run").mkdir()
    with (bench.folder / "run" / ".lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        with pytest.raises(CampaignRunning, match="under way"):
            ran(bench, bench.campaign(TRUTH), watcher)


class Site:
    """A folder with the six-mass campaign, and the shared server below a base."""

    def __init__(self, folder: Path, base: Path) -> None:
        self.folder = folder
        self.base = base
        self.home = process.machine_home(base)
        for file in SIX_MASS.iterdir():
            if file.is_file():
                shutil.copyfile(file, folder / file.name)

    def run(self, *arguments: str, **environment: str) -> subprocess.CompletedProcess[str]:
        return subprocess.run(
            [sys.executable, "-m", "modetune", *arguments],
            cwd=self.folder,
            capture_output=True,
            text=True,
            timeout=200,
            check=False,
            env={
                **os.environ,
                process.HOME_VARIABLE: str(self.base),
                "MODETUNE_NO_PREFECT": "0",
                **environment,
            },
        )

    def ask(self, path: str, content: object = None) -> Any:
        """What the server answers to a request."""
        api = api_of(self.home)
        return api.get(path) if content is None else api.post(path, content)

    def run_deployed(self) -> Any:
        """Ask for a run of the deployment, let a worker do what is due, and give the flow run."""
        deployment = self.ask("/deployments/name/update/six-mass")
        asked = self.ask(
            f"/deployments/{deployment['id']}/create_flow_run", {"state": {"type": "SCHEDULED"}}
        )
        worked = self.run("worker", "--once")
        assert worked.returncode == 0, worked.stderr
        assert worked.stdout == ""
        assert "prefect" not in worked.stderr.lower()
        return self.ask(f"/flow_runs/{asked['id']}")


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory, server_base: Path) -> Site:
    return Site(tmp_path_factory.mktemp("site"), server_base)


def test_a_deployed_campaign_runs_once_and_says_when_nothing_changed(site: Site) -> None:
    deployed = site.run("deploy", "campaign.yaml", "--json")
    assert deployed.returncode == 0, deployed.stderr
    told = json.loads(deployed.stdout)
    assert (told["deployment"], told["pool"]) == ("update/six-mass", "modetune")
    first = site.run_deployed()
    assert (first["name"], first["state_name"]) == ("six-mass", "Converged")
    found = site.ask("/artifacts/filter", {"artifacts": {"flow_run_id": {"any_": [first["id"]]}}})
    assert {item["key"] for item in found} == {
        f"six-mass-{kind}"
        for kind in ("progress", "iterations", "frequencies", "parameters", "mac", "record")
    }
    logs = site.ask("/logs/filter", {"logs": {"flow_run_id": {"any_": [first["id"]]}}})
    assert any("iteration 1" in line["message"] for line in logs)
    second = site.run_deployed()
    assert second["state_name"] == "Unchanged"
    assert "no solver run" in second["state"]["message"]
    with h5py.File(site.folder / "runs" / "six-mass" / "campaign.h5") as file:
        assert file["runs"].attrs["modal"] == 5  # what the campaign cost, not the second run of it


def test_a_screening_is_a_flow_of_its_own_with_a_task_a_point_and_its_tables(site: Site) -> None:
    said = site.run("screen", "campaign.yaml", "--method", "lhs", "--points", "10", "--json")
    assert said.returncode == 0, said.stderr
    runs: list[Any] = []

    def ended() -> bool:
        runs[:] = site.ask("/flow_runs/filter", {"flows": {"name": {"any_": ["screen"]}}})
        return any(run["state_type"] == "COMPLETED" for run in runs)

    assert eventually(ended)
    (run,) = runs
    assert (run["name"], run["state_name"]) == ("six-mass", "Completed")
    assert run["state"]["message"].startswith("proposed: k")
    of_run = {"flow_runs": {"id": {"any_": [run["id"]]}}, "limit": 200}

    def points() -> list[str]:
        tasks = site.ask("/task_runs/filter", of_run)
        return [task["name"] for task in tasks if task["name"].startswith("points of the design")]

    assert eventually(lambda: len(points()) == 10)
    found = site.ask("/artifacts/filter", {"artifacts": {"flow_run_id": {"any_": [run["id"]]}}})
    wanted = "six-mass-latin-hypercube-standardised-regression-of-frequencies"
    assert wanted in {item["key"] for item in found}


def test_a_deployed_campaign_that_is_running_is_not_started_twice(site: Site) -> None:
    site.run("deploy", "campaign.yaml")
    folder = site.folder / "runs" / "six-mass"
    folder.mkdir(parents=True, exist_ok=True)
    with (folder / ".lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        run = site.run_deployed()
    assert (run["state_type"], run["state_name"]) == ("COMPLETED", "Already running")


def test_a_deployed_campaign_that_was_spoilt_since_fails_with_its_reason(site: Site) -> None:
    site.run("deploy", "campaign.yaml")
    good = (site.folder / "campaign.yaml").read_text()
    (site.folder / "campaign.yaml").write_text(good.replace("elset: k2", "elset: none"))
    try:
        run = site.run_deployed()
    finally:
        (site.folder / "campaign.yaml").write_text(good)
    assert run["state_type"] == "FAILED"
    assert "campaign.yaml, line" in run["state"]["message"]


def test_a_schedule_puts_runs_on_the_server(site: Site) -> None:
    said = site.run("deploy", "campaign.yaml", "--cron", "0 2 * * *", "--name", "nightly")
    assert "modetune worker --pool modetune" in said.stdout
    deployment = site.ask("/deployments/name/update/nightly")
    runs: list[Any] = []
    deadline = time.monotonic() + 60.0
    while not runs and time.monotonic() < deadline:  # the scheduler looks every few seconds
        time.sleep(0.2)
        runs = site.ask(
            "/flow_runs/filter", {"flow_runs": {"deployment_id": {"any_": [deployment["id"]]}}}
        )
    assert runs
    assert all(item["expected_start_time"][11:16] == "02:00" for item in runs)


@pytest.mark.parametrize(
    "schedule", [["--cron", "0 2 * *"], ["--cron", "0 2 * * *", "--timezone", "Mars/Base"]]
)
def test_a_schedule_that_is_none_is_one_sentence(site: Site, schedule: list[str]) -> None:
    for command in ("deploy", "serve"):
        result = site.run(command, "campaign.yaml", *schedule)
        assert result.returncode == 2
        assert result.stderr.startswith("modetune: the schedule ")
        assert result.stderr.count("\n") == 1


def test_a_server_that_does_not_answer_is_one_sentence(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(process, "NAMED_PATIENCE_S", 0.1)
    Site(tmp_path, tmp_path)
    result = run_command(
        tmp_path, "deploy", "campaign.yaml", PREFECT_API_URL="http://127.0.0.1:9/api"
    )
    assert result.returncode == 2
    assert result.stderr.startswith("modetune: http://127.0.0.1:9/api, named by PREFECT_API_URL")
    assert result.stderr.count("\n") == 1


HOLDERS = """
import os, sys, threading
from pathlib import Path
from modetune.flows.jobs.limits import CORES, Limit, MachineLimits
from modetune.flows.jobs.server_limits import ServerLimits
limits = (Limit("scripted", 1, 1), Limit(CORES, 2, 1))
# Two machines: each has slots of its own, only the server counts the licence for both.
url = os.environ["PREFECT_API_URL"]
counters = [ServerLimits(MachineLimits(Path(sys.argv[1]) / name), url) for name in ("a", "b")]
now, most, guard, tries = 0, 0, threading.Lock(), []
def work(counter):
    global now, most
    for _ in range(3):
        with counter.held(limits, tries.append):
            with guard:
                now += 1
                most = max(most, now)
            threading.Event().wait(0.05)  # long enough for the other to ask
            with guard:
                now -= 1
threads = [threading.Thread(target=work, args=(counter,)) for counter in counters]
for thread in threads: thread.start()
for thread in threads: thread.join()
print(most, now)
"""


def test_a_licence_is_counted_by_the_server_for_all_machines(site: Site) -> None:
    assert site.run("server", "status").returncode == 0
    address = process.read_address(site.home)
    assert address is not None
    login = process.read_login(site.home)
    held = subprocess.run(
        [sys.executable, "-c", HOLDERS, str(site.folder / "limits")],
        env={**os.environ, "PREFECT_API_URL": address.url, "PREFECT_API_AUTH_STRING": login},
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    assert held.stdout.split() == ["1", "0"], held.stderr
    kept = site.ask("/v2/concurrency_limits/filter", {})
    assert [(item["name"], item["limit"]) for item in kept if item["name"] == "scripted"] == (
        [("scripted", 1)]
    )


HOLDER = """
import os, sys
from pathlib import Path
from modetune.flows.jobs.limits import Limit, MachineLimits
from modetune.flows.jobs.server_limits import ServerLimits
from modetune.flows.updating.prefect import Pages
pages = Pages("holder")
url = os.environ["PREFECT_API_URL"]
counter = ServerLimits(MachineLimits(Path(sys.argv[1])), url, pages.licence)
with counter.held((Limit("killed", 1, 1),), print):
    print("taken", flush=True)
    sys.stdin.read()
"""


def test_a_licence_of_a_killed_campaign_is_free_at_once(site: Site) -> None:
    """The process beside the campaign gives back what it heard of; the lease lasts a minute."""
    assert site.run("server", "status").returncode == 0
    address = process.read_address(site.home)
    assert address is not None
    login = process.read_login(site.home)
    campaign = subprocess.Popen(
        [sys.executable, "-c", HOLDER, str(site.folder / "limits")],
        env={**os.environ, "PREFECT_API_URL": address.url, "PREFECT_API_AUTH_STRING": login},
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )
    with campaign:
        assert campaign.stdout is not None
        assert campaign.stdout.readline() == "taken\n"
        assert site.ask("/v2/concurrency_limits/killed")["active_slots"] == 1
        campaign.kill()
        killed = time.monotonic()
    while site.ask("/v2/concurrency_limits/killed")["active_slots"]:
        assert time.monotonic() - killed < LEASE_S - 10.0
        time.sleep(0.2)


def test_without_the_server_the_machines_own_limits_hold(tmp_path: Path) -> None:
    held = subprocess.run(
        [sys.executable, "-c", HOLDERS.replace('("a", "b")', '("a", "a")'), str(tmp_path)],
        env={**os.environ, "PREFECT_API_URL": "http://127.0.0.1:9/api"},
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    assert held.stdout.split() == ["1", "0"], held.stderr
    assert "licences are counted on this machine alone" in held.stderr
