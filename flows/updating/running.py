"""Running a campaign from its file to its run folder: the Python API behind `modetune update`."""

from __future__ import annotations

import logging
import os
import threading
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import replace
from pathlib import Path

from modetune.core.errors import CampaignRunning
from modetune.core.storage.files import check_writable, storage_errors
from modetune.core.storage.locks import FileLock
from modetune.core.storage.record import CampaignRecord
from modetune.flows.campaign.campaign import Campaign, cores
from modetune.flows.campaign.schema import STORE_REMEDY
from modetune.flows.campaign.self_test import not_confirmed
from modetune.flows.campaign.site import server_home
from modetune.flows.campaign.units import unit_doubt
from modetune.flows.jobs.engine import JobEngine, Ledger
from modetune.flows.jobs.job import Plans
from modetune.flows.jobs.limits import CORES, Limit, MachineLimits
from modetune.flows.jobs.policy import Policy
from modetune.flows.jobs.scratch import remove_abandoned
from modetune.flows.jobs.slurm import on_slurm
from modetune.flows.jobs.store_files import in_use
from modetune.flows.jobs.watching import JobWatcher, displayed
from modetune.flows.jobs.work import Executes, Execution, ThreadExecution
from modetune.flows.report.drawing import draw_report
from modetune.flows.updating.campaign_log import campaign_log, log_iterations
from modetune.flows.updating.evaluators import engine_of, evaluator_of
from modetune.flows.updating.forecast import Forecast, Forecaster
from modetune.flows.updating.prefect import Pages, PagesProgress
from modetune.flows.updating.run import CampaignRun
from modetune.flows.updating.sensitivities import not_linear
from modetune.flows.updating.starting import is_unchanged, read_earlier, start_of, with_first_cost
from modetune.flows.updating.unfinished import unfinished_record
from modetune.flows.updating.updating import Progress, Updating

logger = logging.getLogger(__name__)


def job_engine(campaign: Campaign, watcher: JobWatcher | None = None) -> JobEngine:
    """The engine that solves the jobs of a campaign's first case, and tells a watcher of them."""
    run, solver = campaign.run, campaign.cases[0].solver
    remove_abandoned(campaign.store)
    limits = [Limit(CORES, max(cores(), 0 if run.here else campaign.threads), campaign.threads)]
    if solver.program.name in run.licences:
        limits.append(Limit(solver.program.name, run.licences[solver.program.name], 1))
    engine = JobEngine(
        plans=Plans(solver),
        store=campaign.store,
        policy=Policy(
            timeout_s=run.timeout_s,
            stopped=run.retries.stopped,
            timeout=run.retries.timeout,
            no_result=run.retries.no_result,
            licence_pause_s=run.licence_pause_s,
            licence_wait_s=run.licence_wait_s,
            disk_bytes=round(1e9 * run.disk_gb),
            licence_messages=run.licence_messages,
            memory_bytes=round(1e9 * (run.memory_gb or 0.0)),
            single_factors=campaign.cases[0].single_factors,
        ),
        threads=campaign.threads,
        keep_jobs=run.keep_jobs,
        cancelled=threading.Event(),
        counter=MachineLimits(server_home() / "limits" if run.here else None),
        limits=tuple(limits),
        ledger=Ledger(),
        watcher=displayed(watcher),
    )
    return on_slurm(engine, run.slurm, campaign.name) if run.engine == "slurm" else engine


def is_same(campaign: Campaign, folder: Path) -> bool:
    """Whether nothing has changed since the run that left its record in a run folder."""
    earlier = read_earlier(folder)
    return earlier is not None and is_unchanged(campaign, job_engine(campaign), earlier)


def update_campaign(
    campaign: Campaign,
    folder: Path,
    progress: Progress,
    pages: Pages | None = None,
    forecast: Callable[[Forecast], None] | None = None,
    executes: Executes | None = None,
) -> CampaignRun:
    """Update a campaign's model and leave record and updated deck in its run folder.

    pages: on a Prefect server, that show the run; the caller tells them its end.
    forecast: is told before the start and after each iteration what is still to come.
    executes: carries out the jobs of an iteration; threads unless told.
    Raises SolverError, ModesError, StoreError.
    """
    campaign.solver_version()  # a missing solver is told before anything else starts
    check_writable(campaign.store.folder, STORE_REMEDY)
    check_writable(folder, "name another place for run folders with --runs")
    with FileLock(folder / ".lock") as lock:
        if not lock.take():
            raise CampaignRunning(
                f"another run of this campaign is under way in {folder}; wait for it, or name "
                "another place for run folders with --runs"
            )
        with campaign_log(campaign, folder), solving_engine(campaign, pages) as engine:
            return _update(campaign, engine, folder, progress, pages, forecast, executes)


@contextmanager
def solving_engine(campaign: Campaign, watcher: JobWatcher | None = None) -> Iterator[JobEngine]:
    """The engine that solves a campaign's jobs where the campaign says; the store keeps what it has
    meanwhile, and jobs of other threads end with what is done in here."""
    made: AbstractContextManager[JobEngine] = nullcontext(job_engine(campaign))
    if campaign.run.engine == "dask":
        from modetune.flows.updating.dask import on_dask

        made = on_dask(campaign, job_engine)
    with in_use(campaign.store), made as engine:
        try:
            yield replace(engine, watcher=displayed(watcher))
        except BaseException:
            engine.cancelled.set()
            raise


def _update(
    campaign: Campaign,
    engine: JobEngine,
    folder: Path,
    progress: Progress,
    pages: Pages | None,
    forecast: Callable[[Forecast], None] | None,
    executes: Executes | None,
) -> CampaignRun:
    earlier = read_earlier(folder)
    campaign = start_of(campaign, engine, earlier)
    # What an earlier run left stays until this one has come to its end.
    unfinished, logged = folder / "campaign.unfinished.h5", 0

    def keep(record: CampaignRecord) -> None:
        nonlocal logged
        ended = record.status != "running"
        write(with_first_cost(record, earlier) if ended else record)
        logged = log_iterations(record, logged)

    if pages is not None:
        engine = _counted(engine, campaign, pages)
        progress = PagesProgress(progress, pages, campaign.tolerances)
    execution: Execution = ThreadExecution(engine, campaign.parallel)
    if executes is not None:
        execution = executes(engine, campaign.parallel)
    if campaign.sensitivity.method == "auto":
        solvers = [case.solver for case in campaign.cases]
        told = [tell(solver) for solver in solvers for tell in (not_linear, not_confirmed)]
        for said in dict.fromkeys(filter(None, told)):
            logger.warning("%s", said)
    for case in campaign.cases:
        doubt = "" if "units" in case.accepted else unit_doubt(case.units, case.solver)
        if doubt:
            logger.warning("%s; `model.checks: [units]` accepts that", doubt)
    # What several models cost side by side nobody has worked out yet.
    if len(campaign.cases) > 1:
        forecast = None
    forecaster = Forecaster(campaign, engine, progress, forecast) if forecast else None
    evaluator = evaluator_of(campaign, engine, execution)
    with unfinished_record(unfinished) as write:
        record = Updating(campaign, evaluator, forecaster or progress, keep).run()
    logger.info("%s: %s", record.status, record.reason)
    for case in campaign.cases:
        engine_of(engine, campaign, case).keep_text()
    values = campaign.parameters.values(record.updated)
    deck = campaign.write_updated(values, folder / "updated")
    with storage_errors(unfinished):
        unfinished.replace(folder / "campaign.h5")
    if campaign.report.page:
        progress.working("drawing the report")
        page = draw_report(with_first_cost(record, earlier), folder)
    else:
        page = None
    return CampaignRun(record, folder, deck, forecaster.first if forecaster else None, page)


def _counted(engine: JobEngine, campaign: Campaign, pages: Pages) -> JobEngine:
    """The engine, its licences counted by a server of the user's own, which other machines may use
    too."""
    url = os.environ.get("PREFECT_API_URL")
    if not url or not campaign.run.here:
        return engine
    from modetune.flows.jobs.server_limits import ServerLimits

    return replace(engine, counter=ServerLimits(engine.counter, url, pages.licence))
