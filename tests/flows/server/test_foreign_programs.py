"""Whoever may write to the server can start studies, but no program, and reaches no other file."""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx
import pytest

from modetune.core.errors import CampaignError
from modetune.flows.jobs import prefect_server as process
from modetune.flows.server.permission import check_request, check_settings
from modetune.flows.studies.catalogue import find_study
from tests.flows.server.site import GOOD, Site


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Site]:
    site = Site(tmp_path_factory.mktemp("site"))
    yield site
    site.end_started()
    process.stop_server(site.home)


def request(site: Site, method: str, path: str, content: object) -> int:
    """The status of the server's answer to a request of somebody who may write to it."""
    settings = site.prefect()
    name, _, password = settings["PREFECT_API_AUTH_STRING"].partition(":")
    with httpx.Client(
        base_url=settings["PREFECT_API_URL"], auth=(name, password), trust_env=False, timeout=30.0
    ) as client:
        token = client.get("/csrf-token", params={"client": "x"}).json()["token"]
        headers = {"Prefect-Csrf-Token": token, "Prefect-Csrf-Client": "x"}
        for _ in range(30):  # as Prefect's own clients do while its database is busy
            status = client.request(method, path, json=content, headers=headers).status_code
            if status != httpx.codes.SERVICE_UNAVAILABLE:
                break
            time.sleep(1.0)
        return status


def attacks(site: Site, sentinel: Path) -> list[tuple[str, str, Any]]:
    """Requests that bring a program, which would make the sentinel."""
    script = site.folder / "foreign.py"
    script.write_text(f"open({str(sentinel)!r}, 'w')\ndef flow(**parameters): pass\n")
    shell = {"prefect.deployments.steps.run_shell_script": {"script": f"touch {sentinel}"}}
    command = f"touch {sentinel}"
    variables = {"command": command, "env": {"BASH_ENV": str(script), "PYTHONSTARTUP": str(script)},
                 "working_dir": str(site.folder), "name": "x", "labels": {"x": "y"}}  # fmt: skip
    template = {
        "job_configuration": {"command": command, "env": {"PYTHONPATH": str(site.folder)}},
        "variables": {"type": "object", "properties": {"command": {"default": command}}},
    }
    deployment = f"/deployments/{site.deployment()['id']}"
    pool = "/work_pools/modetune"
    return [
        ("PATCH", deployment, {"pull_steps": [shell]}),
        ("PATCH", deployment, {"entrypoint": f"{script}:flow"}),
        ("PATCH", deployment, {"path": str(site.folder)}),
        ("PATCH", deployment, {"parameter_openapi_schema": {"type": "object"}}),
        ("PATCH", deployment, {"enforce_parameter_schema": False}),
        ("PATCH", deployment, {"infra_overrides": variables}),
        ("PATCH", deployment, {"job_variables": variables}),
        ("PATCH", pool, {"base_job_template": template}),
        ("PATCH", deployment, {"job_variables": variables}),  # which the template now allows
        ("POST", f"{deployment}/create_flow_run",
         {"state": {"type": "SCHEDULED"}, "job_variables": variables}),
    ]  # fmt: skip


def test_nothing_that_the_server_has_brings_a_program(site: Site, tmp_path: Path) -> None:
    """Each change is made, or refused by the server, and a run still is a study."""
    sentinel = tmp_path / "owned"
    statuses = [request(site, *attack) for attack in attacks(site, sentinel)]
    assert statuses[-1] == 201  # a run with a command of its own, which the template allows now
    assert site.deployment()["pull_steps"]  # the server has taken the changes
    assert "touch" in json.dumps(site.ask("/work_pools/modetune")["base_job_template"])
    (brought,) = site.ask("/flow_runs/filter", {})
    assert brought["job_variables"]["command"] == f"touch {sentinel}"
    assert site.end(brought["id"])["state_name"] in GOOD
    assert site.end(site.due())["state_name"] in GOOD
    assert not sentinel.exists()


def failed(site: Site, **parameters: object) -> str:
    """The message of a run with these parameters, which must fail in one sentence."""
    found = site.end(site.due("update/six-mass", **parameters))
    assert found["state_type"] == "FAILED", found["state"]
    return str(found["state"]["message"])


def test_a_run_with_a_refused_parameter_fails_in_one_sentence(site: Site, tmp_path: Path) -> None:
    sentinel = tmp_path / "owned"
    command = json.dumps({"solver": "command", "command": {"run": ["touch", str(sentinel)]}})
    assert "model" in failed(site, settings=[f"model={command}"])
    assert "outside the folders" in failed(site, campaign_file="/etc/passwd")
    assert "has no parameter 'command'" in failed(site, command=f"touch {sentinel}")
    assert not sentinel.exists()


def test_a_flow_that_is_no_study_fails_in_one_sentence(site: Site) -> None:
    flow = site.ask("/flows/", {"name": "foreign"})["id"]
    content = {
        "name": "x",
        "flow_id": flow,
        "work_pool_name": "modetune",
        "entrypoint": "os.system",
    }
    assert request(site, "POST", "/deployments/", content) in (200, 201)
    found = site.end(site.due("foreign/x"))
    assert found["state_type"] == "FAILED"
    assert found["state"]["message"].startswith("'foreign' is not a study")


# What a request may name


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    folder = tmp_path / "allowed"
    folder.mkdir()
    (folder / "campaign.yaml").write_text("name: x\n")
    (tmp_path / "secret.yaml").write_text("name: y\n")
    (folder / "link.yaml").symlink_to(tmp_path / "secret.yaml")
    (folder / "links").symlink_to(tmp_path)
    return folder


def asked(folder: Path, study: str = "screen", **parameters: object) -> dict[str, Any]:
    given = {"campaign_file": str(folder / "campaign.yaml"), "runs": str(folder / "runs")}
    return check_request(find_study(study), {**given, **parameters}, [folder])


@pytest.mark.parametrize(
    ("name", "path"),
    [
        ("campaign_file", "../secret.yaml"),
        ("campaign_file", "link.yaml"),
        ("campaign_file", "links/secret.yaml"),
        ("campaign_file", "/etc/passwd"),
        ("campaign_file", "../allowed-too/campaign.yaml"),
        ("runs", "../runs"),
        ("runs", "links/runs"),
        ("out", "../design.csv"),
        ("out", "links/design.csv"),
        ("figures", "/tmp/figures"),
        ("page", "../page.html"),
    ],
)
def test_a_path_outside_the_folders_is_refused(folder: Path, name: str, path: str) -> None:
    with pytest.raises(CampaignError, match="outside the folders"):
        asked(folder, **{name: str(folder / path)})


def test_paths_below_the_folders_are_taken(folder: Path) -> None:
    checked = asked(folder, out=str(folder / "design.csv"), method="morris")
    assert checked["out"] == str(folder / "design.csv")
    with pytest.raises(CampaignError, match="outside the folders"):
        check_request(find_study("screen"), checked, [])


@pytest.mark.parametrize(
    "setting",
    [
        "model.solver=command",
        "model.solver='command'",
        "model.solver: command",
        " model.solver =command",
        "model={solver: command}",
        "model.solver=[command]",
        "model.solver=foreign",
        "model.command.run=[touch, x]",
        "model.deck=/etc/passwd",
        "test.modes=/etc/passwd",
        "test.repeats=[/etc/passwd]",
        "test={modes: /etc/passwd}",
        "configurations=[{name: a}]",
        "store=/tmp/x",
        "run={engine: slurm}",
        "run.engine=slurm",
        "run.slurm.options=[--prolog=x]",
        "run.slurm={options: [--prolog=x]}",
        "run.dask.prologue=[touch x]",
        "run.dask.directives=[x]",
        "run.dask.scheduler=tcp://x:1",
        "run.licence_messages=[x]",
        "unknown=1",
        "",
    ],
)
def test_a_setting_that_names_a_program_or_a_file_is_refused(setting: str) -> None:
    with pytest.raises(CampaignError, match="is not open to runs that a server starts"):
        check_settings([setting])


def test_settings_of_the_method_are_taken() -> None:
    check_settings(
        ["update.e2=0.01", "update={e2: 0.01}", "model.solver=calculix", "run.parallel=2",
         "test.use=[1, 2]", "sensitivity.method=auto", "report.page=false"]
    )  # fmt: skip


def test_a_deck_may_not_be_run_by_any_command(folder: Path) -> None:
    with pytest.raises(CampaignError, match="is not open"):
        check_request(
            find_study("modes"), {"model": str(folder / "x.bdf"), "solver": "command"}, [folder]
        )


def test_deploy_refuses_such_a_setting_at_once(site: Site) -> None:
    refused = site.run(
        "server", "deploy", "campaign.yaml", "--set", "run.slurm.options=[--prolog=x]"
    )
    assert refused.returncode == 2
    assert "'run.slurm.options' is not open" in refused.stderr
    assert refused.stderr.count("\n") == 1


def test_prefects_own_command_deploys_the_example(site: Site) -> None:
    """`prefect deploy --all` with configs/prefect.yaml, in a folder of campaigns."""
    example = Path(__file__).resolve().parents[3] / "configs" / "prefect.yaml"
    folder = site.folder / "team"
    folder.mkdir()
    (folder / "prefect.yaml").write_text(
        example.read_text().replace("/srv/campaigns/six_mass", str(site.folder))
    )
    made = site.program(
        sys.executable, "-m", "prefect", "--no-prompt", "deploy", "--all",
        "--prefect-file", str(folder / "prefect.yaml"),
        **site.prefect(),
    )  # fmt: skip
    assert made.returncode == 0, made.stdout + made.stderr
    nightly = site.deployment("update/six-mass-nightly")
    assert nightly["schedules"][0]["schedule"]["timezone"] == "Europe/Berlin"
    assert nightly["work_pool_name"] == "modetune"
    assert nightly["tags"] == ["modetune"]
    screening = site.deployment("screen/six-mass-screening")
    assert screening["parameters"]["method"] == "morris"
    choices = screening["parameter_openapi_schema"]["properties"]["method"]["enum"]
    assert "morris" in choices
    found = site.end(site.due("screen/six-mass-screening", method="lhs", points=6))
    assert found["state_type"] == "COMPLETED", found["state"]
