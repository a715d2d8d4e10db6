"""The database of the shared Prefect server: its size, and the removal of what is old in it.

Prefect removes old rows itself (`prefect.server.services.db_vacuum`): events, and finished flow
runs with their task runs, states, logs and artifacts, in many small transactions. The shared server
runs that service when it starts and then each hour; `retention_settings` switches it on. `prune`
runs the same functions at once, in this process and while the server works. What a kill leaves, the
next pass removes. Runs that have not finished, deployments and schedules always stay.

SQLite uses freed space for new rows and returns none to the disk. `compact` returns it, while no
process uses the server: its writers would have to wait.
"""

from __future__ import annotations

import asyncio
import json
import os
import sqlite3
from collections.abc import Callable, Mapping
from contextlib import closing
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

from modetune.core.errors import CampaignError, StorageUnavailable

#: Days after which the shared server removes a finished run; 0 keeps all runs.
KEEP_VARIABLE = "MODETUNE_SERVER_KEEP_DAYS"
KEEP_DAYS = 30.0
DAY_S = 86400.0
#: The shortest retention that Prefect allows.
LEAST_S = 3600.0
#: Days after which events are removed, at most: as by Prefect, and of heartbeats, which are most.
EVENT_DAYS, HEARTBEAT_DAYS = 7.0, 1.0
#: Rows of a transaction: one of 1,000 holds up other writers for some 0.1 s.
BATCH = 1000
#: Tables that grow with each run.
TABLES = (
    "flow_run", "flow_run_state", "task_run", "task_run_state", "log", "artifact",
    "artifact_collection", "events", "event_resources",
)  # fmt: skip
#: Seconds that a statement waits for another writer.
PATIENCE_S = 60.0
#: Bytes of free pages, and their share of the file, from which it is compacted.
LEAST_FREE, FREE_SHARE = 1 << 22, 0.25

#: Finished runs, as Prefect selects them, those inside them, and what belongs to them.
FINISHED = "end_time < :before AND state_type IN ('COMPLETED', 'FAILED', 'CRASHED', 'CANCELLED')"
OUTER = f"SELECT id FROM flow_run WHERE parent_task_run_id IS NULL AND {FINISHED}"
OLD_RUNS = f"""
    SELECT id FROM flow_run WHERE {FINISHED} AND (parent_task_run_id IS NULL OR
    parent_task_run_id IN (SELECT id FROM task_run WHERE flow_run_id IN ({OUTER})))
"""
OLD_TASKS = f"SELECT id FROM task_run WHERE flow_run_id IN ({OLD_RUNS})"
OLD_EVENTS = """
    occurred < :events_before
    OR (occurred < :beats_before AND {} IN (SELECT id FROM events WHERE event = :beat))
"""
OLD_ROWS: Mapping[str, str] = {
    "flow_run": f"id IN ({OLD_RUNS})",
    "flow_run_state": f"flow_run_id IN ({OLD_RUNS})",
    "task_run": f"flow_run_id IN ({OLD_RUNS})",
    "task_run_state": f"task_run_id IN ({OLD_TASKS})",
    "log": f"flow_run_id IN ({OLD_RUNS})",
    "artifact": f"flow_run_id IN ({OLD_RUNS})",
    "events": OLD_EVENTS.format("id"),
    "event_resources": OLD_EVENTS.format("event_id"),
}
BEAT = "prefect.flow-run.heartbeat"


@dataclass(frozen=True, slots=True)
class Pruned:
    """What was removed from a database, or would be.

    rows: by table; size, size_after: bytes of its files. compacted: whether free space went back to
    the disk; otherwise new rows use it.
    """

    database: Path
    rows: Mapping[str, int]
    size: int
    size_after: int
    compacted: bool = False


def database_of(home: Path) -> Path:
    """Return the path of the shared server's database."""
    return home / "prefect" / "prefect.db"


def keep_s() -> float:
    """Return the age in seconds at which the server removes runs, 0 for never.

    Raises CampaignError.
    """
    text = os.environ.get(KEEP_VARIABLE, str(KEEP_DAYS))
    try:
        days = float(text)
    except ValueError:
        days = -1.0
    if days != 0.0 and not 1.0 <= days <= 36500.0:
        raise CampaignError(
            f"{KEEP_VARIABLE} is {text!r}: expected days from 1 to 36500, or 0 to keep all runs"
        )
    return days * DAY_S


def retention_settings(older_s: float) -> dict[str, str]:
    """Return the settings with which a Prefect server removes what is older; 0: only events."""
    chosen = {
        "PREFECT_SERVER_SERVICES_DB_VACUUM_ENABLED": "events,flow_runs" if older_s else "events",
        "PREFECT_SERVER_SERVICES_DB_VACUUM_BATCH_SIZE": str(BATCH),
        "PREFECT_SERVER_SERVICES_DB_VACUUM_EVENT_RETENTION_OVERRIDES": json.dumps(
            {BEAT: HEARTBEAT_DAYS * DAY_S}
        ),
        "PREFECT_SERVER_EVENTS_RETENTION_PERIOD": f"PT{_events_s(older_s):.0f}S",
    }
    if older_s:
        chosen["PREFECT_SERVER_SERVICES_DB_VACUUM_RETENTION_PERIOD"] = f"{older_s:.0f}"
    return chosen


def _events_s(older_s: float) -> float:
    """Return the age at which events are removed where runs are removed at another."""
    return min(older_s or EVENT_DAYS * DAY_S, EVENT_DAYS * DAY_S)


def prunable(database: Path, older_s: float) -> Pruned:
    """Return what `prune` would remove. Raises StorageUnavailable."""
    now = datetime.now(UTC).replace(tzinfo=None)
    events_s = _events_s(older_s)
    ages = {
        "before": older_s,
        "events_before": events_s,
        "beats_before": min(HEARTBEAT_DAYS * DAY_S, events_s),
    }
    times = {name: str(now - timedelta(seconds=age)) for name, age in ages.items()}
    which = (
        OLD_ROWS if older_s else {name: OLD_ROWS[name] for name in ("events", "event_resources")}
    )
    selections = [(table, f"{table} WHERE {rows}") for table, rows in which.items()]
    size = size_of(database)
    return Pruned(database, _counted(database, selections, times | {"beat": BEAT}), size, size)


def _counted(
    database: Path, selections: list[tuple[str, str]], values: Mapping[str, str]
) -> dict[str, int]:
    """Return how many rows each selection has. Raises StorageUnavailable."""
    try:
        with closing(_connected(database)) as connection:
            return {
                table: int(connection.execute(f"SELECT count(*) FROM {rows}", values).fetchone()[0])
                for table, rows in selections
            }
    except sqlite3.Error as error:
        raise _unusable(database, error) from error


def prune(database: Path, older_s: float, working: Callable[[str], None]) -> Pruned:
    """Remove what is older from the database of a server, which may be running; 0: only events.

    Prefect may be a client of that server. Raises StorageUnavailable.
    """
    size, every = size_of(database), [(table, table) for table in TABLES]
    before = _counted(database, every, {})
    try:
        asyncio.run(_pruned(database, older_s, working))
    except Exception as error:  # of SQLAlchemy, of its driver and of Prefect: each has its own tree
        raise _unusable(database, error) from error
    after = _counted(database, every, {})
    rows = {table: max(0, before[table] - after[table]) for table in TABLES}
    return Pruned(database, rows, size, size_of(database))


def check_age(older_s: float) -> None:
    """Refuse an age that Prefect does not allow. Raises CampaignError."""
    if older_s <= LEAST_S:
        raise CampaignError("runs are kept for more than an hour: expected --older 2h, 30d, ...")


async def _pruned(database: Path, older_s: float, working: Callable[[str], None]) -> None:
    """Run the functions of Prefect's service in turn."""
    from prefect.server.database import provide_database_interface
    from prefect.server.services import db_vacuum
    from prefect.settings import temporary_settings

    chosen: dict[Any, Any] = {
        "server.database.connection_url": f"sqlite+aiosqlite:///{database}",
        "server.services.db_vacuum.retention_period": timedelta(
            seconds=older_s or KEEP_DAYS * DAY_S
        ),
        "server.services.db_vacuum.batch_size": BATCH,
        "server.services.db_vacuum.event_retention_overrides": {
            BEAT: timedelta(days=HEARTBEAT_DAYS)
        },
        "server.events.retention_period": timedelta(seconds=_events_s(older_s)),
    }
    with temporary_settings(chosen):
        db = provide_database_interface()
        runs = -1
        # A finished run inside another one is old enough to go once that one has gone.
        while older_s and runs != (
            runs := _counted(database, [("flow_run", "flow_run")], {})["flow_run"]
        ):
            working("removing finished flow runs with their tasks, logs and artifacts")
            await db_vacuum.vacuum_old_flow_runs(db=db)
        working("removing events")
        await db_vacuum.vacuum_events_with_retention_overrides(db=db)
        await db_vacuum.vacuum_old_events(db=db)
        working("removing what a killed pass has left")
        await db_vacuum.vacuum_orphaned_logs(db=db)
        await db_vacuum.vacuum_orphaned_artifacts(db=db)
        await db_vacuum.vacuum_stale_artifact_collections(db=db)


def compact(database: Path) -> bool:
    """Return free space to the disk if there is much; return whether the file was compacted.

    A full disk, or a writer that does not end, leaves the file as it is.
    """
    try:
        with closing(_connected(database, "rw")) as connection:
            free, pages, page = (
                int(connection.execute(f"PRAGMA {name}").fetchone()[0])
                for name in ("freelist_count", "page_count", "page_size")
            )
            if free * page < LEAST_FREE or free < FREE_SHARE * pages:
                return False
            connection.execute("VACUUM")
            connection.execute("PRAGMA wal_checkpoint(TRUNCATE)")
            return True
    except sqlite3.Error:
        return False


def _connected(database: Path, mode: str = "ro") -> sqlite3.Connection:
    return sqlite3.connect(f"{database.as_uri()}?mode={mode}", PATIENCE_S, uri=True)


def size_of(database: Path) -> int:
    """Return the bytes of the database and of its log of changes."""
    files = (database, database.with_name(f"{database.name}-wal"))
    return sum(file.stat().st_size for file in files if file.exists())


def _unusable(database: Path, error: Exception) -> StorageUnavailable:
    text = str(error).partition("\n")[0]  # SQLAlchemy adds an address
    return StorageUnavailable(
        f"{database} could not be pruned ({type(error).__name__}: {text}); what was removed "
        "before stays removed: repeat the command when the database can be written"
    )
