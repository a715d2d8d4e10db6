"""What is old in the shared server's database goes, all else stays; its file shrinks."""

from __future__ import annotations

import json
import os
import signal
import sqlite3
import subprocess
import sys
from contextlib import closing
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any
from uuid import uuid4

import pytest

from modetune.core.errors import CampaignError
from modetune.flows.jobs import server_database as rows
from modetune.flows.jobs.prefect_server import FOREIGN, HOME_VARIABLE, machine_home
from modetune.flows.jobs.server_client import ServerClient
from tests.command_line import run_command
from tests.flows.conftest import api_of

OLD = timedelta(days=40)
#: The command, killed after it has removed runs and before it removes what was theirs.
KILLED = f"""
import os, sys
from modetune.flows.cli.main import main
from modetune.flows.jobs import server_database
honest = server_database._pruned
def pruned(*given):
    from prefect.server.services import db_vacuum
    db_vacuum._batch_delete = lambda *_: os.kill(os.getpid(), {signal.SIGKILL:d})
    return honest(*given)
server_database._pruned = pruned
sys.argv[0] = "modetune"
main()
"""


def made_run(client: ServerClient, flow: str, state: str, inside: str | None = None) -> str:
    """Make a run in a state, with a log line, an artifact and a task; inside: a task of another."""
    content = {"flow_id": flow, "state": {"type": state}, "parent_task_run_id": inside}
    run = str(client.post("/flow_runs/", content)["id"])
    line = {"name": "a", "level": 20, "message": "b", "flow_run_id": run,
            "timestamp": datetime.now(UTC).isoformat()}  # fmt: skip
    client.post("/logs/", [line])
    client.post("/artifacts/", {"key": "a", "type": "text", "data": run, "flow_run_id": run})
    task = {"flow_run_id": run, "task_key": "t", "dynamic_key": "0", "state": {"type": "COMPLETED"}}
    client.post("/task_runs/", task)
    return run


def age(database: Path, runs: list[str]) -> None:
    """Date the times of runs back."""
    with closing(sqlite3.connect(database, 60.0)) as connection, connection:
        for run in runs:
            for name in ("start_time", "end_time", "expected_start_time"):
                times = connection.execute(f"SELECT {name} FROM flow_run WHERE id = ?", (run,))
                (before,) = times.fetchone()
                if before is not None:
                    after = str(datetime.fromisoformat(before) - OLD)
                    connection.execute(f"UPDATE flow_run SET {name} = ? WHERE id = ?", (after, run))


def kept(database: Path, table: str, runs: list[str]) -> set[str]:
    column = "id" if table == "flow_run" else "flow_run_id"
    with closing(sqlite3.connect(database, 60.0)) as connection:
        found = connection.execute(f"SELECT {column} FROM {table}").fetchall()
    return {str(one) for (one,) in found} & set(runs)


def test_finished_runs_of_long_ago_go_with_all_that_is_theirs(server_base: Path) -> None:
    home = machine_home(server_base)
    database, client = rows.database_of(home), api_of(home)
    flow = str(client.post("/flows/", {"name": "of years"})["id"])
    deployment = str(client.post("/deployments/", {"name": "nightly", "flow_id": flow})["id"])
    old = [made_run(client, flow, state) for state in ("COMPLETED", "FAILED", "CRASHED")]
    # A fleet's runs are inside another one.
    (task,) = client.post("/task_runs/filter", {"flow_runs": {"id": {"any_": old[:1]}}})
    old.append(made_run(client, flow, "COMPLETED", task["id"]))
    busy = [made_run(client, flow, state) for state in ("RUNNING", "PENDING", "SCHEDULED")]
    fresh = [made_run(client, flow, "COMPLETED")]
    age(database, old + busy)
    environment = {name: "" for name in FOREIGN} | {HOME_VARIABLE: str(server_base)}

    def run(program: tuple[str, str], *options: str) -> subprocess.CompletedProcess[str]:
        return subprocess.run(
            [sys.executable, *program, "server", "prune", "--older", "30d", "--json", *options],
            env={**os.environ, **environment},
            capture_output=True,
            text=True,
            check=False,
        )

    def prune(*options: str) -> dict[str, Any]:
        said = run(("-m", "modetune"), *options)
        assert said.returncode == 0, said.stderr
        return dict(json.loads(said.stdout))

    would = prune("--dry-run")["removed"]
    assert kept(database, "flow_run", old) == set(old)
    counts = dict.fromkeys(("flow_run", "flow_run_state", "task_run", "log", "artifact"), 4)
    assert {name: would[name] for name in counts} == counts
    removed = prune()["removed"]
    assert {name: removed[name] for name in counts} == counts
    for table in ("flow_run", "task_run", "log", "artifact"):
        assert kept(database, table, old + busy + fresh) == {*busy, *fresh}
    newest = client.post("/artifacts/latest/filter", {"artifacts": {"key": {"any_": ["a"]}}})
    assert [item["flow_run_id"] for item in newest] == fresh
    assert client.get(f"/deployments/{deployment}")["name"] == "nightly"
    lost = [made_run(client, flow, "COMPLETED")]
    age(database, lost)
    assert run(("-c", KILLED)).returncode == -signal.SIGKILL
    assert kept(database, "flow_run", lost) == set()
    assert kept(database, "log", lost) == set(lost)
    prune()
    for table in ("log", "artifact"):
        assert kept(database, table, lost) == set()
    for one in busy:
        client.post(f"/flow_runs/{one}/set_state", {"state": {"type": "CANCELLED"}, "force": True})


@pytest.mark.parametrize(
    ("older_days", "kinds", "period", "events"),
    [
        (30.0, {"events", "flow_runs", "orphans"}, 30.0, 7.0),
        (2.0, {"events", "flow_runs", "orphans"}, 2.0, 2.0),
        (0.0, {"events"}, 90.0, 7.0),
    ],
)
def test_prefect_understands_the_settings(
    older_days: float,
    kinds: set[str],
    period: float,
    events: float,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Without an age Prefect's own 90 days stand for runs, which are then not removed."""
    from prefect.settings import Settings

    for name, value in rows.retention_settings(older_days * rows.DAY_S).items():
        monkeypatch.setenv(name, value)
    server = Settings().server
    found = server.services.db_vacuum
    assert found.enabled_vacuum_types == kinds
    assert found.retention_period == timedelta(days=period)
    assert found.event_retention_overrides == {rows.BEAT: timedelta(days=1)}
    assert server.events.retention_period == timedelta(days=events)


def test_an_age_is_valid_or_refused(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    assert rows.keep_s() == 30.0 * rows.DAY_S
    monkeypatch.setenv(rows.KEEP_VARIABLE, "0")
    assert rows.keep_s() == 0.0
    for text in ("a month", "-1", "0.01", "nan"):
        monkeypatch.setenv(rows.KEEP_VARIABLE, text)
        with pytest.raises(CampaignError, match="expected days from 1 to 36500"):
            rows.keep_s()
    environment = {HOME_VARIABLE: str(tmp_path), "PREFECT_API_URL": ""}
    said = run_command(tmp_path, "server", "prune", "--older", "5min", **environment)
    assert (said.returncode, "more than an hour" in said.stderr) == (2, True)
    said = run_command(tmp_path, "server", "prune", "--older", "2d", **environment)
    assert (said.returncode, "nothing to prune" in said.stderr) == (2, True)
    environment["PREFECT_API_URL"] = "http://127.0.0.1:1/api"
    said = run_command(tmp_path, "server", "prune", "--older", "2d", **environment)
    assert (said.returncode, "prunes itself if PREFECT_SERVER_SERVICES" in said.stderr) == (2, True)


def test_free_space_goes_back_to_the_disk_where_it_is_much(tmp_path: Path) -> None:
    database = tmp_path / "prefect.db"
    with closing(sqlite3.connect(database)) as connection, connection:
        connection.execute("PRAGMA journal_mode = WAL")
        connection.execute("CREATE TABLE log (id, text)")
        lines = [(str(uuid4()), "x" * 4000) for _ in range(2 * rows.LEAST_FREE // 4000)]
        connection.executemany("INSERT INTO log VALUES (?, ?)", lines)
    size = database.stat().st_size
    assert not rows.compact(database)
    with closing(sqlite3.connect(database)) as connection, connection:
        connection.execute("DELETE FROM log WHERE id > ?", (lines[10][0],))
        connection.execute("DELETE FROM log WHERE rowid % 10")
    assert database.stat().st_size >= size
    assert rows.compact(database)
    assert database.stat().st_size < 0.5 * size
    assert not rows.compact(tmp_path / "nothing.db")
