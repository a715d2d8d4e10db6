"""Campaigns that Prefect starts: by a schedule, from its pages, or from its command line.

A deployment holds where the campaign file, its settings and its run folders are; the run reads
the file anew each time. Import this only after `server.use_server()`: Prefect reads its settings
when it is imported.
"""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import httpx
from prefect import flow
from prefect import serve as prefect_serve
from prefect.client.orchestration import get_client
from prefect.client.schemas.actions import WorkPoolCreate
from prefect.client.schemas.objects import (
    ConcurrencyLimitConfig,
    ConcurrencyLimitStrategy,
    State,
)
from prefect.deployments.runner import RunnerDeployment
from prefect.exceptions import ObjectNotFound, PrefectException
from prefect.logging.handlers import APILogHandler
from prefect.schedules import Cron
from prefect.states import Completed, Failed
from prefect.types.entrypoint import EntrypointType
from prefect.workers.process import ProcessWorker

from modetune.core.errors import CampaignRunning, ModetuneError
from modetune.core.record import CampaignRecord, IterationRecord
from modetune.flows.campaign import Campaign, load_campaign
from modetune.flows.display import iteration_line
from modetune.flows.execution.prefect import ended_state
from modetune.flows.running import job_engine
from modetune.flows.server.process import use_server
from modetune.flows.server.starting import is_unchanged, read_earlier
from modetune.flows.trust.starts import update_from_starts

logger = logging.getLogger(__name__)

#: A limit that is none, for workers that must count what they run.
UNLIMITED = 1000


@dataclass(frozen=True, slots=True)
class Schedule:
    """When a deployed campaign starts: a cron line and its time zone, or only when asked."""

    cron: str | None
    timezone: str


@flow(name="update", flow_run_name="{name}", persist_result=False)
def update(name: str, campaign_file: str, settings: list[str], runs: str) -> State[Any]:
    """A deployed campaign.

    name: of the campaign, and of the flow run; settings: KEY.KEY=VALUE over the campaign file;
    runs: the folder of run folders.
    """
    with _shown_log():
        try:
            return _update(load_campaign(Path(campaign_file), settings), Path(runs))
        except CampaignRunning as error:
            return Completed(name="Already running", message=str(error))
        except ModetuneError as error:
            logger.error("%s", error)
            return Failed(message=str(error))


def _update(campaign: Campaign, runs: Path) -> State[Any]:
    folder = runs / campaign.name
    earlier = read_earlier(folder)
    same = earlier is not None and is_unchanged(campaign, job_engine(campaign), earlier)
    record = update_from_starts(campaign, folder, LogProgress(), use_server()).record
    if same and not record.runs.modal + record.runs.sensitivity:
        return Completed(name="Unchanged", message=_unchanged(record))
    return ended_state(record)


def _unchanged(record: CampaignRecord) -> str:
    return (
        "nothing changed since the run before: no solver run, all "
        f"{record.runs.reused} results from the store; still {record.status.replace('_', ' ')}: "
        f"{record.reason}"
    )


class LogProgress:
    """Progress as lines of the log, which the page of the flow run shows."""

    def working(self, text: str) -> None:
        logger.info("%s", text)

    def iteration(self, record: IterationRecord) -> None:
        logger.info("%s", iteration_line(record))


@contextmanager
def _shown_log() -> Iterator[None]:
    """Our own log lines on the page of the flow run, and there only."""
    ours, handler = logging.getLogger("modetune"), APILogHandler()
    before = ours.level, ours.propagate
    ours.addHandler(handler)
    ours.setLevel(logging.INFO)
    ours.propagate = False
    try:
        yield
    finally:
        ours.setLevel(before[0])
        ours.propagate = before[1]
        ours.removeHandler(handler)


def campaign_deployment(
    campaign: Campaign, runs: Path, name: str, schedule: Schedule, pool: str | None
) -> RunnerDeployment:
    """A campaign's deployment: of a work pool's workers, or of the process that serves it.

    A run that would start while another one of the deployment is under way is cancelled. Raises
    ModetuneError where the schedule is none.
    """
    try:
        deployment = update.to_deployment(
            name,
            schedule=Cron(schedule.cron, timezone=schedule.timezone) if schedule.cron else None,
            parameters={
                "name": campaign.name,
                "campaign_file": str(campaign.file.resolve()),
                "settings": list(campaign.settings),
                "runs": str(runs.resolve()),
            },
            description=f"modetune campaign `{campaign.file.resolve()}`",
            tags=["modetune"],
            work_pool_name=pool,
            concurrency_limit=ConcurrencyLimitConfig(
                limit=1, collision_strategy=ConcurrencyLimitStrategy.CANCEL_NEW
            ),
            entrypoint_type=EntrypointType.MODULE_PATH,
        )
    except ValueError as error:
        if schedule.cron is None:
            raise
        raise ModetuneError(
            f"the schedule {schedule.cron!r} in time zone {schedule.timezone!r} is none; "
            "expected five fields and a place, e.g. --cron '0 2 * * *' --timezone Europe/Berlin"
        ) from error
    assert isinstance(deployment, RunnerDeployment)  # awaited only where a loop is running
    return deployment


def deploy(deployment: RunnerDeployment, pool: str) -> None:
    """Put a deployment on the server, with a pool of processes where there is none of that name.

    Raises ModetuneError.
    """
    with _server_errors():
        with get_client(sync_client=True) as client:
            try:
                client.read_work_pool(pool)
            except ObjectNotFound:
                template = ProcessWorker.get_default_base_job_template()
                client.create_work_pool(
                    WorkPoolCreate(name=pool, type="process", base_job_template=template)
                )
        deployment.apply(work_pool_name=pool)


def serve(deployment: RunnerDeployment) -> None:
    """Start a deployment's runs from this process until it is ended. Raises ModetuneError."""
    with _server_errors():
        prefect_serve(deployment, print_starting_message=False, limit=1)


def work(pool: str, limit: int | None, once: bool) -> None:
    """Run what is due in a pool of processes until this process is ended.

    limit: flow runs at the same time; once: only what is due now. Raises ModetuneError.
    """
    with _server_errors():
        if once and limit is None:
            limit = UNLIMITED
        worker = ProcessWorker(work_pool_name=pool, limit=limit, create_pool_if_not_found=True)
        asyncio.run(_work_once(worker) if once else worker.start(printer=_say_nothing))


async def _work_once(worker: ProcessWorker) -> None:
    """Run what is due to its end. Prefect's own way of it hides that the server failed, and may
    end before a run has started."""
    async with worker:
        await worker.sync_with_backend()
        await worker.get_and_submit_flow_runs()
        while worker.limiter.borrowed_tokens:
            await asyncio.sleep(0.1)


def _say_nothing(*told: object, **style: object) -> None:
    """Prefect's workers tell of themselves; the command line says what there is to say."""


@contextmanager
def _server_errors() -> Iterator[None]:
    """Failures of the server, or of reaching it, as one sentence."""
    try:
        yield
    except (httpx.HTTPError, PrefectException) as error:
        first = str(error).strip().partition("\n")[0] or type(error).__name__
        raise ModetuneError(f"Prefect's server did not take the request: {first}") from error
