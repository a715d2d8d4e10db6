"""The engine that solves the jobs of a campaign: its store, runner, limits, and model."""

from __future__ import annotations

import os
import threading
import uuid
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import lru_cache

from modetune.core.errors import CampaignError
from modetune.core.storage.store import Store
from modetune.flows.campaign.campaign import Campaign, cores, load_campaign
from modetune.flows.campaign.case import Case
from modetune.flows.campaign.site import server_home
from modetune.flows.campaign.sketch import open_model
from modetune.flows.jobs.engine import JobEngine
from modetune.flows.jobs.job import Job, Plans
from modetune.flows.jobs.limits import CORES, Limit, Limits, MachineLimits
from modetune.flows.jobs.policy import Policy
from modetune.flows.jobs.progress import current_display
from modetune.flows.jobs.runner import (
    Attempt,
    Costs,
    PoolRunner,
    StoredResult,
    Tries,
    WorkerRequest,
    end_event,
)
from modetune.flows.jobs.slurm import SlurmLauncher, srun_options
from modetune.flows.jobs.store_files import in_use, remove_abandoned
from modetune.flows.jobs.tasks import StudyRun, Tasks, study_run, use_run


def job_engine(campaign: Campaign) -> JobEngine:
    """Return the engine for a campaign's first case, on the runner of the current study."""
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
        costs=Costs(),
        tasks=Tasks(
            PoolRunner(campaign.parallel) if study is None else study.runner, current_display()
        ),
        order=_order(campaign, study is not None and study.licences),
    )
    return _on_slurm(engine, campaign) if run.engine == "slurm" else engine


def _on_slurm(engine: JobEngine, campaign: Campaign) -> JobEngine:
    """Return an engine whose jobs Slurm runs under the campaign's name. Raises SolverMissing."""
    policy, slurm = engine.policy, campaign.run.slurm
    asked = engine.threads, policy.timeout_s, engine.limits
    return replace(
        engine,
        launcher=SlurmLauncher(srun_options(slurm, campaign.name, *asked, os.environ)),
        counter=MachineLimits(None),
        # Slurm limits the running time; this limit ends a job that stays in the queue.
        policy=replace(policy, timeout_s=policy.timeout_s + policy.licence_wait_s),
    )


def engine_of(engine: JobEngine, campaign: Campaign, case: Case) -> JobEngine:
    """Return a campaign's engine for the model of one of its cases."""
    if case.solver is engine.solver:
        return engine
    solver, name = case.solver, case.solver.program.name
    limits = [limit for limit in engine.limits if limit.name == CORES]
    if name in campaign.run.licences:
        limits.append(Limit(name, campaign.run.licences[name], 1))
    policy = replace(engine.policy, single_factors=case.single_factors)
    model = next(n for n, item in enumerate(campaign.cases) if item.solver is solver)
    order = engine.order and replace(engine.order, model=model)
    return replace(engine, plans=Plans(solver), limits=tuple(limits), policy=policy, order=order)


def _counted_by_prefect(counter: Limits) -> Limits:
    from modetune.flows.jobs.prefect_limits import PrefectLimits

    return PrefectLimits(counter)


def _order(campaign: Campaign, licences: bool) -> WorkerRequest:
    return WorkerRequest(
        run=uuid.uuid4().hex,
        file=campaign.file.resolve(),
        settings=campaign.settings,
        store=campaign.store.folder.resolve(),
        threads=campaign.threads,
        model=0,
        licences=licences,
        make=worker_attempts,
    )


def worker_attempts(order: WorkerRequest, costs: Costs) -> Attempt:
    """Return, in a worker process, the function that attempts jobs and adds their costs."""
    engine = replace(_engine_elsewhere(order), costs=costs)

    def attempt(job: Job, key: str, tries: Tries) -> StoredResult:
        if engine.key(job) != key:
            raise CampaignError(
                f"a Dask worker got a different job key from {order.file}: it has "
                f"{engine.program.name} {engine.program.version()}; use the same solver version, "
                "deck and campaign on all machines"
            )
        return engine.attempt(job, key, tries)

    return attempt


@lru_cache(maxsize=8)
def _engine_elsewhere(order: WorkerRequest) -> JobEngine:
    file, settings = order.file, list(order.settings)
    try:
        campaign = load_campaign(file, settings)
    except CampaignError:
        campaign = open_model(file, settings)  # a deck alone, or a campaign without a test
    campaign = replace(campaign, store=Store(order.store))
    engine = engine_of(job_engine(campaign), campaign, campaign.cases[order.model])
    if order.licences:
        engine = replace(engine, counter=_counted_by_prefect(engine.counter))
    return replace(engine, threads=order.threads, cancelled=end_event(order.run))


@contextmanager
def _runner(campaign: Campaign) -> Iterator[None]:
    """Use the campaign's Dask cluster unless the study already has a runner."""
    if study_run() is not None or campaign.run.engine != "dask":
        yield
        return
    from modetune.flows.jobs.dask_cluster import dask_runner

    with dask_runner(campaign.run.dask, campaign.threads, campaign.parallel) as runner:
        with use_run(StudyRun(runner)):
            yield


@contextmanager
def solving_engine(campaign: Campaign) -> Iterator[JobEngine]:
    """Open a campaign's engine; no stored result is removed while it is open.

    An exception cancels the jobs of all threads.
    """
    with in_use(campaign.store), _runner(campaign):
        engine = job_engine(campaign)
        try:
            yield engine
        except BaseException:
            engine.cancelled.set()
            raise
