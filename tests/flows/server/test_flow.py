"""The update as a flow of Prefect's own engine, inside a pipeline, on a server of the test's."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

SIX_MASS = Path(__file__).resolve().parents[3] / "configs" / "six_mass"
#: A pipeline of one's own round two updates; then what its server says of their tasks.
PIPELINE = """
import json, sys
from prefect import flow
from prefect.testing.utilities import prefect_test_harness
from modetune.flows.server.flow import update_flow

@flow(persist_result=False)
def nightly():
    states = [
        update_flow("campaign.yaml", ["report.page=false", *more], return_state=True)
        for more in ([], [], ["update.e2=10.0", "sensitivity.between=keep"], ["name=a b"])
    ]
    return [(state.type.value, state.name, state.message or "") for state in states]

with prefect_test_harness(server_startup_timeout=120):
    ended = nightly()
    from prefect.client.orchestration import get_client
    with get_client(sync_client=True) as client:
        runs = client.read_flow_runs()
        tasks = [
            (run.name, task.name, task.state.type.value, task.state.name)
            for run in runs for task in client.read_task_runs()
            if task.flow_run_id == run.id
        ]
    print(json.dumps({"ended": ended, "tasks": tasks}))
"""


@pytest.fixture(scope="module")
def said(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    folder = tmp_path_factory.mktemp("pipeline")
    for name in ("campaign.yaml", "six_mass.yaml", "measured.csv"):
        shutil.copy(SIX_MASS / name, folder / name)
    environment = {
        key: value for key, value in os.environ.items() if not key.startswith("PREFECT_")
    }
    environment |= {
        "PREFECT_HOME": str(folder / "prefect"),
        "PREFECT_SERVER_ANALYTICS_ENABLED": "false",
        "DO_NOT_TRACK": "1",
        "MODETUNE_STORE": str(folder / "store"),
    }
    ended = subprocess.run(
        [sys.executable, "-c", PIPELINE],
        cwd=folder,
        env=environment,
        capture_output=True,
        text=True,
        check=False,
        timeout=280,
    )
    assert ended.returncode == 0, ended.stderr[-3000:]
    found: dict[str, Any] = json.loads(ended.stdout.splitlines()[-1])
    return found


def test_an_update_in_a_pipeline_ends_in_its_campaigns_status(said: dict[str, Any]) -> None:
    first, again, _, wrong = said["ended"]
    assert first[:2] == again[:2] == ["COMPLETED", "Converged"]
    assert "e1 is met" in first[2]
    assert wrong[0] == "FAILED"
    assert "name" in wrong[2]  # the campaign's own sentence, with file and line


def test_every_piece_is_a_task_with_a_name_and_a_state(said: dict[str, Any]) -> None:
    states = {(name, state) for _, name, _, state in said["tasks"]}
    assert ("iteration 0 / modal", "Completed") in states
    assert ("iteration 0 / modal", "Cached") in states  # the second update ran nothing
    assert any(name.startswith("iteration 0 / sensitivity k1") for name, _ in states)


def test_what_e2_skips_is_shown_as_skipped(said: dict[str, Any]) -> None:
    skipped = [name for _, name, _, state in said["tasks"] if state == "Skipped"]
    assert any("sensitivity k1" in name for name in skipped)
    pieces = [item for item in said["tasks"] if item[1].startswith("iteration")]
    assert {kind for _, _, kind, _ in pieces} == {"COMPLETED"}
