"""Running a campaign from its file to its run folder: the Python API behind `modetune update`."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

from modetune.core.errors import CampaignRunning
from modetune.core.record import CampaignRecord
from modetune.core.record_file import write_record
from modetune.core.store import check_writable, locked, storage_errors
from modetune.flows.campaign import Campaign, cores
from modetune.flows.deck_texts import keep_text
from modetune.flows.evaluators import evaluator_of
from modetune.flows.execution.engine import JobEngine, Ledger, Policy
from modetune.flows.execution.limits import CORES, Limit, MachineLimits
from modetune.flows.execution.slurm import on_slurm
from modetune.flows.execution.work import Execution, ThreadExecution
from modetune.flows.forecast import Forecast, Forecaster
from modetune.flows.report.drawing import draw_report
from modetune.flows.schema import STORE_REMEDY
from modetune.flows.server.process import SharedServer, answers, server_home
from modetune.flows.server.starting import read_earlier, start_of
from modetune.flows.updating import Progress, Updating

logger = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class CampaignRun:
    """A campaign's end: its record, its folder, the updated deck and the report's page there.

    forecast: what it was expected to cost, where that was asked for.
    """

    record: CampaignRecord
    folder: Path
    updated_deck: Path
    forecast: Forecast | None = None
    page: Path | None = None


def job_engine(campaign: Campaign) -> JobEngine:
    """The engine that solves a campaign's jobs."""
    run, name = campaign.run, campaign.solver.name
    limits = [Limit(CORES, max(cores(), 0 if run.here else campaign.threads), campaign.threads)]
    if name in run.licences:
        limits.append(Limit(name, run.licences[name], 1))
    engine = JobEngine(
        solver=campaign.solver,
        store=campaign.store,
        policy=Policy(
            timeout_s=run.timeout_s,
            stopped=run.retries.stopped,
            timeout=run.retries.timeout,
            no_result=run.retries.no_result,
            licence_pause_s=run.licence_pause_s,
            licence_wait_s=run.licence_wait_s,
        ),
        threads=campaign.threads,
        keep_jobs=run.keep_jobs,
        cancelled=threading.Event(),
        counter=MachineLimits(server_home() / "limits" if run.here else None),
        limits=tuple(limits),
        ledger=Ledger(),
    )
    return on_slurm(engine, run.slurm, campaign.name) if run.engine == "slurm" else engine


def update_campaign(
    campaign: Campaign,
    folder: Path,
    progress: Progress,
    server: SharedServer | None = None,
    forecast: Callable[[Forecast], None] | None = None,
) -> CampaignRun:
    """Update a campaign's model and leave record and updated deck in its run folder.

    server: a server to show the run on as Prefect flow, which is waited for while the first job
    runs; without one, or where it does not answer, plain threads do the same.
    forecast: is told before the start and after each iteration what is still to come.
    Raises SolverError, ModesError, StoreError.
    """
    campaign.solver.version()  # a missing solver is told before anything else starts
    check_writable(campaign.store.folder, STORE_REMEDY)
    check_writable(folder, "name another place for run folders with --runs")
    with (folder / ".lock").open("w") as lock:
        if not locked(lock):
            raise CampaignRunning(
                f"another run of this campaign is under way in {folder}; wait for it, or name "
                "another place for run folders with --runs"
            )
        with solving_engine(campaign) as engine:
            return _update(campaign, engine, folder, progress, server, forecast)


@contextmanager
def solving_engine(campaign: Campaign) -> Iterator[JobEngine]:
    """The engine that solves a campaign's jobs where the campaign wants them to run."""
    if campaign.run.engine != "dask":
        yield job_engine(campaign)
        return
    from modetune.flows.execution.dask import on_dask

    with on_dask(campaign, job_engine) as engine:
        yield engine


def _update(
    campaign: Campaign,
    engine: JobEngine,
    folder: Path,
    progress: Progress,
    server: SharedServer | None,
    forecast: Callable[[Forecast], None] | None,
) -> CampaignRun:
    campaign = start_of(campaign, engine, read_earlier(folder))
    # What an earlier run left stays until this one has come to its end.
    unfinished = folder / "campaign.unfinished.h5"
    try:
        server = _answering(server, campaign, engine, progress)
        run: Callable[[Updating], CampaignRecord] = Updating.run
        execution: Execution = ThreadExecution(engine, campaign.parallel)
        if server is not None:
            engine = _counted(engine, campaign, server)
            execution, run = _as_flow(engine, campaign, folder)
        # What several models cost side by side nobody has worked out yet.
        if campaign.configurations:
            forecast = None
        forecaster = Forecaster(campaign, engine, progress, forecast) if forecast else None
        updating = Updating(
            campaign, evaluator_of(campaign, engine, execution), forecaster or progress,
            lambda record: write_record(unfinished, record),
        )  # fmt: skip
        record = run(updating)
    except BaseException:
        engine.cancelled.set()  # jobs of other threads end with the campaign
        raise
    for item in (each.campaign for each in campaign.configurations) or (campaign,):
        keep_text(item.store, item.solver)
    values = campaign.parameters.values(record.updated)
    deck = campaign.solver.write_updated(values, folder / "updated")
    with storage_errors(unfinished):
        unfinished.replace(folder / "campaign.h5")
    if campaign.report.page:
        progress.working("drawing the report")
        page = draw_report(record, folder)
    else:
        page = None
    return CampaignRun(record, folder, deck, forecaster.first if forecaster else None, page)


def _answering(
    server: SharedServer | None, campaign: Campaign, engine: JobEngine, progress: Progress
) -> SharedServer | None:
    """The server once it answers, None with a warning where it does not in good time.

    While a server of modetune's own starts, the first job runs.
    """
    if server is None or answers(server.address.url):
        return server
    if server.shared and not campaign.configurations:
        evaluator = evaluator_of(campaign, engine, ThreadExecution(engine, campaign.parallel))
        first = evaluator.first_job(campaign.start)
        if first is not None:
            engine.begin(first)
    progress.working("waiting for Prefect's server")
    if server.wait():
        return server
    where = f"its log is in {server.home}" if server.shared else server.address.shown
    logger.warning("Prefect's server does not answer (%s); going on without", where)
    return None


def _counted(engine: JobEngine, campaign: Campaign, server: SharedServer) -> JobEngine:
    """The engine, its licences counted by a server that other machines may use too."""
    if server.shared or not campaign.run.here:
        return engine
    from modetune.flows.execution.server_limits import on_server

    return replace(engine, counter=on_server(engine.counter, engine.limits))


def _as_flow(
    engine: JobEngine, campaign: Campaign, folder: Path
) -> tuple[Execution, Callable[[Updating], CampaignRecord]]:
    """How the campaign runs as a Prefect flow."""
    from modetune.flows.execution.prefect import PrefectExecution, run_as_flow

    return PrefectExecution(engine, campaign.parallel), partial(run_as_flow, folder=folder)
