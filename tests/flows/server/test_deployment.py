"""Deployments are Prefect's: their form, schedules and runs; a campaign is run once at a time."""

from __future__ import annotations

import fcntl
import json
from collections.abc import Iterator
from pathlib import Path

import h5py
import pytest

from modetune.flows.jobs import prefect_server as process
from tests.command_line import run_command
from tests.eventually import eventually
from tests.flows.server.site import PATIENCE_S, RUN, WORKER, Site


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory, server_base: Path) -> Iterator[Site]:
    site = Site(tmp_path_factory.mktemp("site"), server_base)
    yield site
    site.end_started()
    site.kill(WORKER, RUN)


def test_a_deployed_campaign_runs_and_reports_when_nothing_changed(site: Site) -> None:
    deployed = site.run("server", "deploy", "campaign.yaml", "--json")
    assert deployed.returncode == 0, deployed.stderr
    summary = json.loads(deployed.stdout)
    assert (summary["deployment"], summary["pool"]) == ("update/six-mass", "modetune")
    run = site.due()
    worked = site.run("server", "worker", "--once")
    assert (worked.returncode, worked.stdout) == (0, ""), worked.stderr
    first = site.state(run)
    assert (first["name"], first["state_name"]) == ("six-mass", "Converged, trusted")
    of_run = {"flow_run_id": {"any_": [first["id"]]}}
    found = site.ask("/artifacts/filter", {"artifacts": of_run})
    assert {item["key"] for item in found} == {
        f"six-mass-{kind}"
        for kind in ("progress", "iterations", "frequencies", "parameters", "mac", "record")
    }
    logs = site.ask("/logs/filter", {"logs": of_run})
    assert any("iteration 1" in line["message"] for line in logs)
    second = site.end(site.due())
    assert second["state_name"] == "Unchanged, trusted"
    assert "no solver run" in second["state"]["message"]
    with h5py.File(site.folder / "runs" / "six-mass" / "campaign.h5") as file:
        assert file["runs"].attrs["modal"] == 5  # the campaign's cost, not that of its second run


def test_a_deployment_has_a_form_and_is_run_with_another_setting(site: Site) -> None:
    """What "Custom run" of its page and `prefect deployment run` need."""
    line = "screen --method morris --points 4"
    assert site.run("server", "deploy", "campaign.yaml", "--study", line).returncode == 0
    deployment = site.deployment("screen/six-mass")
    assert deployment["parameters"]["method"] == "morris"
    assert deployment["enforce_parameter_schema"]
    form = deployment["parameter_openapi_schema"]["properties"]
    assert {"campaign_file", "settings", "runs", "method", "points"} <= set(form)
    assert "lhs" in form["method"]["enum"]
    assert deployment["entrypoint"] == "modetune.flows.server.flows.screen"
    found = site.end(site.due("screen/six-mass", method="lhs", points=6))
    assert found["parameters"]["method"] == "lhs"
    assert found["state_type"] == "COMPLETED", found["state"]


def test_a_deployed_campaign_that_is_running_is_not_started_twice(site: Site) -> None:
    folder = site.folder / "runs" / "six-mass"
    folder.mkdir(parents=True, exist_ok=True)
    with (folder / ".lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        run = site.end(site.due())
    assert (run["state_type"], run["state_name"]) == ("COMPLETED", "Already running")


def test_a_deployed_campaign_that_is_broken_later_fails_with_its_reason(site: Site) -> None:
    good = (site.folder / "campaign.yaml").read_text()
    (site.folder / "campaign.yaml").write_text(good.replace("elset: k2", "elset: none"))
    try:
        run = site.end(site.due())
    finally:
        (site.folder / "campaign.yaml").write_text(good)
    assert (run["name"], run["state_type"]) == ("six-mass", "FAILED")
    assert "campaign.yaml, line" in run["state"]["message"]


def test_a_schedule_puts_runs_on_the_server(site: Site) -> None:
    deployed = site.run(
        "server", "deploy", "campaign.yaml", "--cron", "0 2 * * *", "--name", "nightly"
    )
    assert "modetune server worker --pool modetune" in deployed.stdout
    deployment = site.deployment("update/nightly")
    assert deployment["concurrency_options"]["collision_strategy"] == "CANCEL_NEW"
    of_deployment = {"flow_runs": {"deployment_id": {"any_": [deployment["id"]]}}}
    assert eventually(lambda: site.ask("/flow_runs/filter", of_deployment))
    runs = site.ask("/flow_runs/filter", of_deployment)
    assert all(item["expected_start_time"][11:16] == "02:00" for item in runs)


def test_serve_deploys_and_works_until_it_is_ended(site: Site) -> None:
    server = site.start(
        "server", "serve", "campaign.yaml", "--cron", "0 2 * * *", "--name", "served"
    )
    assert eventually(lambda: server.poll() is not None or _is_deployed(site), PATIENCE_S)
    assert server.poll() is None, server.communicate()[1]
    run = site.due("update/served")
    found, _ = site.wait(run, lambda run: run["state_type"] == "COMPLETED")
    assert found["state_name"] in ("Converged, trusted", "Unchanged, trusted")
    server.terminate()
    text = server.communicate(timeout=60.0)[1]
    assert (server.returncode, "the schedule is paused" in text) == (130, True)
    assert site.deployment("update/served")["paused"]


def _is_deployed(site: Site) -> bool:
    found = site.ask("/deployments/filter", {"deployments": {"name": {"any_": ["served"]}}})
    return bool(found)


@pytest.mark.parametrize(
    "schedule", [["--cron", "0 2 * *"], ["--cron", "0 2 * * *", "--timezone", "Mars/Base"]]
)
def test_a_schedule_that_is_not_valid_is_one_sentence(site: Site, schedule: list[str]) -> None:
    for command in ("deploy", "serve"):
        words = ("server", command, "campaign.yaml", *schedule)
        result = run_command(
            site.folder, *words, MODETUNE_HOME=str(site.base), MODETUNE_NO_PREFECT="0"
        )
        assert result.returncode == 2
        assert result.stderr.startswith("modetune: the schedule ")
        assert result.stderr.count("\n") == 1


def test_a_server_that_does_not_answer_is_one_sentence(
    site: Site, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(process, "CONFIGURED_PATIENCE_S", 0.1)
    result = run_command(
        site.folder, "server", "deploy", "campaign.yaml", PREFECT_API_URL="http://127.0.0.1:9/api"
    )
    assert result.returncode == 2
    assert result.stderr.startswith("modetune: http://127.0.0.1:9/api, named by PREFECT_API_URL")
    assert result.stderr.count("\n") == 1
