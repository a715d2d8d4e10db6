"""The database of the shared Prefect server over years: its growth, and what pruning takes.

Updates of the six masses, then small flows of three tasks, run on a shared server of their own.
Rows of these updates are copied with other identities and dates of two months ago, until the wanted
number is there. `modetune server prune` removes them while the server is in use, and compacts the
file after that.

    python -m benchmarks.prefect_rows [--campaigns 10] [--flows 2000] [--rows 300000]

Prints one JSON object a step, and the seconds of the server's longest answer while rows go.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import sqlite3
import subprocess
import sys
import tempfile
import threading
import time
import uuid
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from datetime import datetime, timedelta
from pathlib import Path
from typing import Any

from tests.flows.server.site import SIX_MASS

from modetune.flows.campaign.site import HOME_VARIABLE, server_home
from modetune.flows.jobs.prefect_server import SharedServer, shared_server, stop_server
from modetune.flows.jobs.server_database import TABLES, database_of
from modetune.flows.server.prefect_client import prefect_client
from modetune.flows.server.run import carried_out
from modetune.flows.studies.catalogue import find_study
from modetune.flows.updating.forecast import Unwatched

#: Days by which copies are older than their originals.
OLDER_DAYS = 60
#: How many small flows run at the same time.
PARALLEL = 4


def main() -> None:
    """Run, seed and prune; print the figures."""
    parser = argparse.ArgumentParser(prog="benchmarks.prefect_rows")
    parser.add_argument("--campaigns", type=int, default=10)
    parser.add_argument("--flows", type=int, default=2000)
    parser.add_argument("--rows", type=int, default=300_000)
    chosen = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="modetune-") as folder:
        os.environ[HOME_VARIABLE] = folder
        server = shared_server()
        try:
            server.wait()
            database = database_of(server_home())
            _state("empty", database)
            began = time.monotonic()
            campaigns(Path(folder) / "six_mass", chosen.campaigns)
            _state(f"{chosen.campaigns} campaigns", database, began)
            began = time.monotonic()
            flows(server, chosen.flows)
            _state(f"{chosen.flows} flows", database, began)
            seeded = seed(database, chosen.rows)
            _state(f"{seeded} seeded rows", database)
            pruned(server)
            _state("pruned", database)
        finally:
            server.close()
        _show({"compacting": _prune()})
        _state("compacted", database)
        stop_server(server_home())


def campaigns(folder: Path, count: int) -> None:
    """Update the six masses so often: the first time with all jobs, then from the store."""
    shutil.copytree(SIX_MASS, folder)
    os.environ["MODETUNE_STORE"] = str(folder / "store")
    asked = {"campaign_file": folder / "campaign.yaml", "runs": folder / "runs"}
    for _ in range(count):
        end = carried_out(find_study("update"), asked, Unwatched())
        assert not end.remark, end.remark


def flows(server: SharedServer, count: int) -> None:
    """Run so many small flows."""
    with prefect_client(server.settings()):
        from prefect import flow, task

        @task
        def one(number: int) -> int:
            return number

        @flow
        def small() -> int:
            return sum(one(number) for number in range(3))

        with ThreadPoolExecutor(PARALLEL) as pool:
            for number, found in enumerate(pool.map(lambda _: small(), range(count)), 1):
                assert found == 3
                if number % 500 == 0:
                    _show({"flows": number})


def seed(database: Path, rows: int) -> int:
    """Copy the rows of the finished runs until there are so many; return their number."""
    connection = sqlite3.connect(database, 60.0)
    connection.execute("PRAGMA foreign_keys = OFF")
    with closing(connection):
        found = {table: _rows(connection, table) for table in TABLES if "collection" not in table}
        identities = [row["id"] for items in found.values() for row in items]
        seeded = 0
        while seeded < rows:
            new = {identity: str(uuid.uuid4()) for identity in identities}
            for table, items in found.items():
                copies = [_copy(row, new) for row in items[: rows - seeded]]
                if copies:
                    places = ", ".join("?" * len(copies[0]))
                    with connection:
                        connection.executemany(f"INSERT INTO {table} VALUES ({places})", copies)
                seeded += len(copies)
        return seeded


def _rows(connection: sqlite3.Connection, table: str) -> list[dict[str, Any]]:
    """Return all rows of runs of campaigns, and their events."""
    campaign = "SELECT id FROM flow_run WHERE tags LIKE '%modetune%'"
    which = {
        "flow_run": f"id IN ({campaign})",
        "task_run_state": "task_run_id IN (SELECT id FROM task_run "
        f"WHERE flow_run_id IN ({campaign}))",
        "events": "occurred < (SELECT max(end_time) FROM flow_run WHERE tags LIKE '%modetune%')",
        "event_resources": "occurred < (SELECT max(end_time) FROM flow_run WHERE tags LIKE "
        "'%modetune%')",
    }.get(table, f"flow_run_id IN ({campaign})")
    cursor = connection.execute(f"SELECT * FROM {table} WHERE {which}")
    names = [item[0] for item in cursor.description]
    return [dict(zip(names, row, strict=True)) for row in cursor]


def _copy(row: dict[str, Any], new: dict[str, str]) -> list[Any]:
    """Return the values of a row with other identities and an earlier date."""
    return [
        _older(new.get(value, value) if isinstance(value, str) else value) for value in row.values()
    ]


def _older(value: Any) -> Any:
    if not isinstance(value, str) or len(value) != 26 or value[4] != "-" or value[10] != " ":
        return value
    return str(datetime.fromisoformat(value) - timedelta(days=OLDER_DAYS))


def pruned(server: SharedServer) -> None:
    """Prune by the command, and ask the server for its runs meanwhile."""
    waits: list[float] = []
    over = threading.Event()

    def ask() -> None:
        while not over.wait(0.5):
            began = time.monotonic()
            server.client.post("/flow_runs/filter", {"limit": 1}, 120.0)
            waits.append(time.monotonic() - began)

    watcher = threading.Thread(target=ask)
    watcher.start()
    found = _prune()
    over.set()
    watcher.join()
    _show({"longest_answer_s": round(max(waits), 2), "pruning": found})


def _prune() -> dict[str, Any]:
    """Run the command; return what it prints, and its seconds."""
    began = time.monotonic()
    command = [sys.executable, "-m", "modetune", "server", "prune", "--older", "30d", "--json"]
    said = subprocess.run(command, capture_output=True, text=True, check=True)
    return {"seconds": round(time.monotonic() - began, 1), **json.loads(said.stdout)}


def _show(figures: dict[str, Any]) -> None:
    sys.stdout.write(f"{json.dumps(figures)}\n")
    sys.stdout.flush()


def _state(what: str, database: Path, began: float | None = None) -> None:
    """Print the size of the database and the rows of its tables."""
    with closing(sqlite3.connect(f"{database.as_uri()}?mode=ro", uri=True)) as connection:
        rows = {
            table: connection.execute(f"SELECT count(*) FROM {table}").fetchone()[0]
            for table in TABLES
        }
    files = (database, database.with_name(f"{database.name}-wal"))
    size = sum(file.stat().st_size for file in files if file.exists())
    took = {} if began is None else {"seconds": round(time.monotonic() - began, 1)}
    sums = {"size_mb": round(size / 1e6, 1), "all_rows": sum(rows.values())}
    _show({"state": what, **sums, **took, "rows": rows})


if __name__ == "__main__":
    main()
