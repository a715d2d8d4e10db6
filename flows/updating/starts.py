"""Updating from several starts: whether the answer depends on where it began.

The campaign's own start comes first, the others are a Latin hypercube within the bounds: each has
a stratum of its own in every parameter. All updates share one store and one engine, so what two of
them ask for is solved once; they run side by side, the campaign's parallel jobs shared out among
them. The best end is the campaign's answer. Ends that differ by no more than e1 and the
measurements leave open are one place; another place that fits as well is a rival.

Each update's record stays in the run folder as starts/NN.h5. The campaign's own record goes from
its initial model straight to the best start and on along that update, which the store answers.
Where sets cost little all of this is a matter of one update (`tried_starts.py`).
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor, as_completed
from contextvars import copy_context
from dataclasses import replace
from functools import reduce
from pathlib import Path

from modetune.core.errors import ModesError, SolverError
from modetune.core.modes import Floats
from modetune.core.storage.record import CampaignRecord, RunCounts
from modetune.core.storage.record_file import write_record
from modetune.core.updating.trust import StartSpread, with_spread
from modetune.flows.campaign.campaign import Campaign
from modetune.flows.jobs.engine import JobEngine
from modetune.flows.report.drawing import draw_report
from modetune.flows.updating.evaluators import evaluator_of
from modetune.flows.updating.finders import CAMPAIGNS_OWN
from modetune.flows.updating.forecast import Forecast
from modetune.flows.updating.poses import settled
from modetune.flows.updating.run import CampaignRun
from modetune.flows.updating.running import job_engine, solving_engine, update_campaign
from modetune.flows.updating.start_ends import (
    StartEnd,
    StartEnds,
    chosen_end,
    drawn_starts,
    end_of,
    start_spread,
    tolerated,
)
from modetune.flows.updating.starting import read_earlier, start_of
from modetune.flows.updating.updating import Progress, Unwatched, Updating

logger = logging.getLogger(__name__)


def update_from_starts(
    campaign: Campaign,
    folder: Path,
    progress: Progress,
    forecast: Callable[[Forecast], None] | None = None,
) -> CampaignRun:
    """Update a campaign's model from as many starts as it asks for.

    From one start this is `update_campaign`, whose arguments and errors these are, and which looks
    at the others too where sets cost little. Where updates from some starts fail the others stand;
    raises where all fail.
    """
    campaign = settled(campaign)
    n = campaign.update.starts or 1
    if n == 1:
        return update_campaign(campaign, folder, progress, forecast)
    if _cost_little(campaign):
        try:
            return update_campaign(campaign, folder, progress, forecast)
        except ModesError as error:  # of the campaign's own start: the others go by themselves
            logger.warning("the update from the campaign's own start failed: %s", error)
    campaign.solver_version()
    began = time.monotonic()
    with solving_engine(campaign) as engine:
        own = start_of(campaign, engine, read_earlier(folder))
        starts = drawn_starts(own, n)
        ends = _run_starts(own, engine, starts, progress)
        counted = reduce(
            RunCounts.plus, (end.record.runs for end in ends if end.record), RunCounts()
        )
        ledger = engine.ledger
        spent = replace(counted, core_s=ledger.core_s, licence_s=ledger.licence_s)
    for earlier in (folder / "starts").glob("*.h5"):
        earlier.unlink()  # of a run with more starts, or others
    for number, end in enumerate(ends):
        if end.record is not None:
            write_record(folder / "starts" / f"{number:02d}.h5", end.record)
    chosen = chosen_end(ends)
    answer = ends[chosen].record
    assert answer is not None
    spread = start_spread(own, StartEnds(ends, tolerated(own, answer)), chosen)
    settings = own.update.model_copy(update={"start": "deck", "starts": 1})
    best = replace(
        own,
        update=settings,
        begin=tuple(starts[spread.chosen].tolist()),
        report=own.report.model_copy(update={"page": False}),  # drawn below, of all starts
    )
    run = update_campaign(best, folder, progress, forecast)
    record = replace(_joined(run.record, ends, spread, spent), wall_s=time.monotonic() - began)
    write_record(folder / "campaign.h5", record)
    if campaign.report.page:
        progress.working("drawing the report")
        run = replace(run, page=draw_report(record, folder))
    return replace(run, record=record)


def _cost_little(campaign: Campaign) -> bool:
    """Whether sets cost little beside the first of them."""
    engine = job_engine(campaign)
    return evaluator_of(campaign, engine).sets_cost_little


def _run_starts(
    campaign: Campaign, engine: JobEngine, starts: Floats, progress: Progress
) -> list[StartEnd]:
    """Updates from all starts, side by side. Raises what is not a start's own failure."""
    beside = min(campaign.parallel, len(starts))
    progress.working(f"updates from {len(starts)} starts")
    with ThreadPoolExecutor(beside, thread_name_prefix="modetune-start") as pool:
        try:
            futures = [
                pool.submit(
                    copy_context().run,
                    _run_start,
                    campaign,
                    replace(engine, tasks=engine.tasks.of_part(f"start {number}")),
                    start,
                )
                for number, start in enumerate(starts, start=1)
            ]
            for done, _ in enumerate(as_completed(futures), start=1):
                progress.working(f"updates from {len(starts)} starts: {done} ended")
            return [future.result() for future in futures]
        except BaseException:
            engine.cancelled.set()  # jobs of other threads end with the campaign
            pool.shutdown(wait=False, cancel_futures=True)
            raise


def _run_start(campaign: Campaign, engine: JobEngine, start: Floats) -> StartEnd:
    own = replace(campaign, begin=tuple(start.tolist()))
    around = None
    records: list[CampaignRecord] = []
    try:
        if _paired_once(campaign) and start.tolist() != campaign.start.tolist():
            first = evaluator_of(campaign, engine)
            around = first.evaluate(0, campaign.start, None, alone=True)[0]
        evaluator = evaluator_of(own, engine)
        return end_of(start, Updating(own, evaluator, Unwatched(), records.append, around).run())
    except (SolverError, ModesError) as error:
        if isinstance(error, CAMPAIGNS_OWN):
            engine.cancelled.set()
            raise
        logger.warning("an update from another start failed: %s", error)
        return StartEnd(start, error=error, record=records[-1] if records else None)


def _paired_once(campaign: Campaign) -> bool:
    """Whether pairs are those of the campaign's own start, and tracked from there."""
    return any(case.rules.by_hand or case.rules.drop for case in campaign.used)


def _joined(
    record: CampaignRecord, ends: list[StartEnd], spread: StartSpread, spent: RunCounts
) -> CampaignRecord:
    """The record of the best update with what all starts cost and showed.

    It begins with the campaign's own initial model, where that could be evaluated.
    """
    iterations, own = record.iterations, ends[0].record
    if spread.chosen > 0 and own is not None:
        initial, first = own.iterations[0], iterations[0]
        jump = replace(
            first,
            step=first.parameters - initial.parameters,
            decision=f"start {spread.chosen + 1} of {len(ends)}, drawn within the bounds",
        )
        later = (jump, *iterations[1:])
        iterations = (initial, *(replace(item, number=item.number + 1) for item in later))
    trust = None if record.trust is None else with_spread(record.trust, spread)
    total = record.runs.plus(spent)
    reason = f"{record.reason}; the best of {len(ends)} starts"
    return replace(record, iterations=iterations, trust=trust, runs=total, reason=reason)
