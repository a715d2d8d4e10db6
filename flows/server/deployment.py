"""Studies of campaigns that a Prefect server starts: by a schedule, from its pages, or when asked.

A deployment holds where the campaign file, its settings and its run folders are, and which study it
is with its options; the run reads the file anew each time. Its work pool is of a type of its own,
whose runs have no settings at all: no command, environment, image or entry point. What runs is
`modetune`'s own (`worker.py`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from modetune.core.errors import ModetuneError
from modetune.flows.campaign.campaign import Campaign
from modetune.flows.jobs.heartbeats import TAG
from modetune.flows.jobs.prefect_api import PrefectApi, ServerRefused

#: The type of pools whose runs are campaigns and nothing else.
POOL_TYPE = "modetune"
#: A run can set nothing of how it is run.
TEMPLATE = {
    "job_configuration": {"program": "modetune"},  # the server requires one that is not empty
    "variables": {"type": "object", "properties": {}, "additionalProperties": False},
}
#: What a server answers where there is none of a name, and where it cannot use what it was sent.
ABSENT, UNUSABLE = 404, 422


@dataclass(frozen=True, slots=True)
class Schedule:
    """When a deployed campaign starts: a cron line and its time zone, or only when asked."""

    cron: str | None
    timezone: str


def deploy(
    api: PrefectApi,
    campaign: Campaign,
    study: tuple[str, Sequence[str]],
    runs: Path,
    name: str,
    schedule: Schedule,
    pool: str,
) -> str:
    """Put a study of a campaign on a server, to be run by a pool's workers; its identity there.

    study: its name, which is that of the flow, and its options.

    A run that would start while another one of the deployment is under way is cancelled. Raises
    ModetuneError, where the schedule is none.
    """
    make_pool(api, pool)
    when = {"cron": schedule.cron, "timezone": schedule.timezone}
    deployment = {
        "flow_id": api.post("/flows/", {"name": study[0]})["id"],
        "name": name,
        "schedules": [{"schedule": when, "active": True}] if schedule.cron else [],
        "paused": False,
        "parameters": {
            "name": campaign.name,
            "campaign_file": str(campaign.file.resolve()),
            "settings": list(campaign.settings),
            "runs": str(runs.resolve()),
            "study": study[0],
            "options": list(study[1]),
        },
        "description": f"modetune {' '.join((study[0], *study[1]))} `{campaign.file.resolve()}`",
        "tags": [TAG],
        "work_pool_name": pool,
        "concurrency_limit": 1,
        "concurrency_options": {"collision_strategy": "CANCEL_NEW"},
    }
    try:
        return str(api.post("/deployments/", deployment)["id"])
    except ServerRefused as error:
        if schedule.cron is None or error.status != UNUSABLE:
            raise
        raise ModetuneError(
            f"the schedule {schedule.cron!r} in time zone {schedule.timezone!r} is none; "
            "expected five fields and a place, e.g. --cron '0 2 * * *' --timezone Europe/Berlin"
        ) from error


def make_pool(api: PrefectApi, pool: str) -> None:
    """A work pool for campaigns. Raises ModetuneError where one of another type has the name."""
    try:
        found = api.get(f"/work_pools/{pool}")["type"]
    except ServerRefused as error:
        if error.status != ABSENT:
            raise
        made = {"name": pool, "type": POOL_TYPE, "base_job_template": TEMPLATE}
        api.post("/work_pools/", made)
        return
    if found != POOL_TYPE:
        raise ModetuneError(
            f"work pool {pool} is of type {found}, whose runs may bring programs of their own; "
            f"expected type {POOL_TYPE}: delete that pool on the server, or name another with "
            "--pool"
        )


def pause(api: PrefectApi, deployment: str) -> None:
    """Start no more runs of a deployment. Raises ServerRefused."""
    api.post(f"/deployments/{deployment}/pause_deployment", {})
