"""Studies of campaigns that a Prefect server starts: by a schedule, from its pages, or when asked.

A deployment is Prefect's own: a flow of the fixed table, default parameters (the campaign's path,
settings, the folder of run folders, the study's options) and their schema, so that its page shows a
form. The run reads the campaign file again each time. Its pool is of the type `modetune`, whose
workers take nothing else from the server (`worker.py`).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any
from zoneinfo import ZoneInfo

import httpx
from prefect.client.orchestration import get_client
from prefect.client.schemas.objects import ConcurrencyLimitConfig, ConcurrencyLimitStrategy
from prefect.client.schemas.schedules import CronSchedule
from prefect.deployments.runner import RunnerDeployment
from prefect.types.entrypoint import EntrypointType

from modetune.core.errors import ModetuneError
from modetune.flows.jobs.heartbeats import TAG
from modetune.flows.server.flows import find_flow
from modetune.flows.server.permission import check_settings
from modetune.flows.server.worker import make_pool
from modetune.flows.studies.study import Study


@dataclass(frozen=True, slots=True)
class Schedule:
    """When a deployed campaign starts: a cron line and its time zone, or only when asked."""

    cron: str | None
    timezone: str

    def prefect(self) -> CronSchedule | None:
        """Return it as Prefect's. Raises ModetuneError where either is not valid."""
        if self.cron is None:
            return None
        try:
            ZoneInfo(self.timezone)
            return CronSchedule(cron=self.cron, timezone=self.timezone)
        except (ValueError, LookupError, OSError) as error:
            raise ModetuneError(
                f"the schedule {self.cron!r} in time zone {self.timezone!r} is not valid; expected "
                "five fields and a place, e.g. --cron '0 2 * * *' --timezone Europe/Berlin"
            ) from error


def deploy(
    study: Study, parameters: Mapping[str, Any], name: str, schedule: Schedule, pool: str
) -> str:
    """Put a study on the server that Prefect is a client of, for a pool's workers; return its id.

    parameters: its typed ones, checked. A run that would start while another one of the deployment
    is under way is cancelled. Raises ModetuneError.
    """
    check_settings(parameters.get("settings") or [])
    when = schedule.prefect()
    try:
        make_pool(pool)
        deployment = find_flow(study.name).to_deployment(
            name,
            schedules=[when] if when else None,
            parameters=dict(parameters),
            description=study.help,
            tags=[TAG],
            work_pool_name=pool,
            concurrency_limit=ConcurrencyLimitConfig(
                limit=1, collision_strategy=ConcurrencyLimitStrategy.CANCEL_NEW
            ),
            entrypoint_type=EntrypointType.MODULE_PATH,
        )
        assert isinstance(deployment, RunnerDeployment)  # a coroutine in an event loop only
        return str(deployment.apply())
    except httpx.HTTPError as error:
        raise ModetuneError(f"Prefect's server did not take the deployment: {error}") from error


def pause(deployment: str) -> None:
    """Start no more runs of a deployment."""
    with get_client(sync_client=True) as client:
        client.pause_deployment(deployment)
