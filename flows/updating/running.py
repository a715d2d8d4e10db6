"""Running a campaign from its file to its run folder: the Python API behind `modetune update`."""

from __future__ import annotations

import logging
import threading
import uuid
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import lru_cache
from pathlib import Path

from modetune.core.errors import CampaignError, CampaignRunning
from modetune.core.storage.files import check_writable, storage_errors
from modetune.core.storage.locks import FileLock
from modetune.core.storage.record import CampaignRecord
from modetune.core.storage.store import Store
from modetune.flows.campaign.campaign import Campaign, cores, load_campaign
from modetune.flows.campaign.schema import STORE_REMEDY
from modetune.flows.campaign.site import server_home
from modetune.flows.campaign.sketch import looked_at
from modetune.flows.campaign.solvers import not_confirmed
from modetune.flows.campaign.units import unit_doubt
from modetune.flows.jobs.engine import JobEngine
from modetune.flows.jobs.job import Job, Plans
from modetune.flows.jobs.limits import CORES, Limit, Limits, MachineLimits
from modetune.flows.jobs.policy import Policy
from modetune.flows.jobs.scratch import remove_abandoned
from modetune.flows.jobs.slurm import on_slurm
from modetune.flows.jobs.store_files import in_use
from modetune.flows.jobs.tasks import StudyRun, Tasks, running_with, study_run
from modetune.flows.jobs.watching import current_display
from modetune.flows.jobs.work import Attempt, Ledger, Order, PoolRunner, Solved, Tries, run_end
from modetune.flows.report.drawing import draw_report
from modetune.flows.updating.campaign_log import campaign_log, log_iterations
from modetune.flows.updating.evaluators import engine_of, evaluator_of
from modetune.flows.updating.forecast import Forecast, Forecaster
from modetune.flows.updating.run import CampaignRun
from modetune.flows.updating.sensitivities import not_linear
from modetune.flows.updating.starting import is_unchanged, read_earlier, start_of, with_first_cost
from modetune.flows.updating.unfinished import unfinished_record
from modetune.flows.updating.updating import Progress, Updating

logger = logging.getLogger(__name__)


def job_engine(campaign: Campaign) -> JobEngine:
    """The engine that solves the jobs of a campaign's first case, on the runner of the study."""
    run, solver, study = campaign.run, campaign.cases[0].solver, study_run()
    remove_abandoned(campaign.store)
    limits = [Limit(CORES, max(cores(), 0 if run.here else campaign.threads), campaign.threads)]
    if solver.program.name in run.licences:
        limits.append(Limit(solver.program.name, run.licences[solver.program.name], 1))
    counter: Limits = MachineLimits(server_home() / "limits" if run.here else None)
    licences = study is not None and study.licences and run.here
    if licences:
        counter = _counted_by_prefect(counter)
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
        cancelled=threading.Event() if study is None else study.cancellation(),
        counter=counter,
        limits=tuple(limits),
        ledger=Ledger(),
        tasks=Tasks(
            PoolRunner(campaign.parallel) if study is None else study.runner, current_display()
        ),
        order=_order(campaign, study is not None and study.licences),
    )
    return on_slurm(engine, run.slurm, campaign.name) if run.engine == "slurm" else engine


def _counted_by_prefect(counter: Limits) -> Limits:
    from modetune.flows.jobs.prefect_limits import PrefectLimits

    return PrefectLimits(counter)


def _order(campaign: Campaign, licences: bool) -> Order:
    """What a process on another machine needs to solve jobs of the campaign's first case."""
    return Order(
        run=uuid.uuid4().hex,
        file=campaign.file.resolve(),
        settings=campaign.settings,
        store=campaign.store.folder.resolve(),
        threads=campaign.threads,
        model=0,
        licences=licences,
        make=attempts_elsewhere,
    )


def attempts_elsewhere(order: Order, ledger: Ledger) -> Attempt:
    """In another process: what tries the jobs of an order, its costs on a ledger."""
    engine = replace(_engine_elsewhere(order), ledger=ledger)

    def attempt(job: Job, key: str, tries: Tries) -> Solved:
        if engine.key(job) != key:
            raise CampaignError(
                f"a Dask worker makes another job of {order.file} than was asked for: it has "
                f"{engine.program.name} {engine.program.version()}; solver version, deck and "
                "campaign must be the same on all machines"
            )
        return engine.attempt(job, key, tries)

    return attempt


@lru_cache(maxsize=8)
def _engine_elsewhere(order: Order) -> JobEngine:
    file, settings = order.file, list(order.settings)
    try:
        campaign = load_campaign(file, settings)
    except CampaignError:
        campaign = looked_at(file, settings)  # a deck alone, or a campaign without a test
    campaign = replace(campaign, store=Store(order.store))
    engine = engine_of(job_engine(campaign), campaign, campaign.cases[order.model])
    if order.licences:
        engine = replace(engine, counter=_counted_by_prefect(engine.counter))
    return replace(engine, threads=order.threads, cancelled=run_end(order.run))


@contextmanager
def _runner(campaign: Campaign) -> Iterator[None]:
    """The runner that the campaign asks for, where no study has entered one."""
    if study_run() is not None or campaign.run.engine != "dask":
        yield
        return
    from modetune.flows.jobs.dask_cluster import dask_runner

    with dask_runner(campaign.run.dask, campaign.threads, campaign.parallel) as runner:
        with running_with(StudyRun(runner)):
            yield


def is_same(campaign: Campaign, folder: Path) -> bool:
    """Whether nothing has changed since the run that left its record in a run folder."""
    earlier = read_earlier(folder)
    return earlier is not None and is_unchanged(campaign, job_engine(campaign), earlier)


def update_campaign(
    campaign: Campaign,
    folder: Path,
    progress: Progress,
    forecast: Callable[[Forecast], None] | None = None,
) -> CampaignRun:
    """Update a campaign's model and leave record and updated deck in its run folder.

    forecast: is called before the start and after each iteration with what is still to come.
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
        with campaign_log(campaign, folder), solving_engine(campaign) as engine:
            return _update(campaign, engine, folder, progress, forecast)


@contextmanager
def solving_engine(campaign: Campaign) -> Iterator[JobEngine]:
    """The engine that solves a campaign's jobs where the campaign says. The store keeps what it has
    in here, and jobs of other threads end when this is broken off."""
    with in_use(campaign.store), _runner(campaign):
        engine = job_engine(campaign)
        try:
            yield engine
        except BaseException:
            engine.cancelled.set()
            raise


def _update(
    campaign: Campaign,
    engine: JobEngine,
    folder: Path,
    progress: Progress,
    forecast: Callable[[Forecast], None] | None,
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
    evaluator = evaluator_of(campaign, engine)
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
