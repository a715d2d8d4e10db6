"""Updating from several starts: whether the answer depends on where it began.

The campaign's own start comes first, the others are a Latin hypercube within the bounds: each has
a stratum of its own in every parameter. All updates share one store and one engine, so what two of
them ask for is solved once; they run side by side, the campaign's parallel jobs shared out among
them. The best end is the campaign's answer. Ends that differ by no more than e1 and the
measurements leave open are one place; another place that fits as well is a rival.

Each update's record stays in the run folder as starts/NN.h5. The campaign's own record goes from
its initial model straight to the best start and on along that update, which the store answers.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.sparse.csgraph import connected_components

from modetune.core.errors import ModesError, SolverError
from modetune.core.modes import Floats, Integers
from modetune.core.storage.record import CampaignRecord, IterationRecord, RunCounts
from modetune.core.storage.record_file import write_record
from modetune.core.updating.trust import StartSpread, with_spread
from modetune.flows.campaign.campaign import Campaign
from modetune.flows.jobs.engine import JobEngine
from modetune.flows.jobs.work import Executes, ThreadExecution
from modetune.flows.report.drawing import draw_report
from modetune.flows.updating.evaluators import evaluator_of
from modetune.flows.updating.finders import CAMPAIGNS_OWN
from modetune.flows.updating.forecast import Forecast
from modetune.flows.updating.prefect import Pages
from modetune.flows.updating.run import CampaignRun
from modetune.flows.updating.running import solving_engine, update_campaign
from modetune.flows.updating.starting import read_earlier, start_of
from modetune.flows.updating.updating import Progress, Updating

logger = logging.getLogger(__name__)

#: Standard errors by which two ends may differ and still be one place.
SAME_ERRORS = 3.0
#: ... and the least difference, relative to the deck, that makes two places.
SAME_LEAST = 0.01
#: An end whose misfit is no more than this times the answer's fits as well.
AS_WELL = 1.1


@dataclass(frozen=True, slots=True)
class StartEnd:
    """How the update from one start ended.

    record: None where it never got to one; error: that broke it off.
    """

    start: Floats
    record: CampaignRecord | None
    error: SolverError | ModesError | None

    @property
    def outcome(self) -> str:
        if self.record is None or self.error is not None:
            return f"failed: {str(self.error).splitlines()[0]}"
        return self.record.status

    @property
    def rank(self) -> tuple[int, float]:
        """Lowest first: those that meet e1, those that ended, by their misfit."""
        if self.record is None or self.error is not None:
            return 2, np.inf
        return int(self.record.status != "converged"), self.record.best.residual.misfit


class _Quiet:
    """Watches an update whose iterations are not shown, and keeps its newest record."""

    def __init__(self) -> None:
        self.record: CampaignRecord | None = None

    def working(self, text: str) -> None:
        pass

    def iteration(self, record: IterationRecord) -> None:
        pass

    def save(self, record: CampaignRecord) -> None:
        self.record = record


def update_from_starts(
    campaign: Campaign,
    folder: Path,
    progress: Progress,
    pages: Pages | None = None,
    forecast: Callable[[Forecast], None] | None = None,
    executes: Executes | None = None,
) -> CampaignRun:
    """Update a campaign's model from as many starts as it asks for.

    From one start this is `update_campaign`, whose arguments and errors these are. Where updates
    from some starts fail the others stand; raises where all fail.
    """
    n = campaign.update.starts
    if n == 1:
        return update_campaign(campaign, folder, progress, pages, forecast, executes)
    from scipy.stats import qmc  # takes a third of a second, which one start need not wait for

    campaign.solver_version()
    began = time.monotonic()
    with solving_engine(campaign) as engine:
        own = start_of(campaign, engine, read_earlier(folder))
        draws = qmc.LatinHypercube(len(own.parameters), rng=campaign.update.seed).random(n - 1)
        lower, upper = own.parameters.lower, own.parameters.upper
        starts = np.vstack([own.start, lower + draws * (upper - lower)])
        ends = _run_starts(own, engine, starts, progress)
        spent = replace(
            _counted(ends), core_s=engine.ledger.core_s, licence_s=engine.ledger.licence_s
        )
    for earlier in (folder / "starts").glob("*.h5"):
        earlier.unlink()  # of a run with more starts, or others
    for number, end in enumerate(ends):
        if end.record is not None:
            write_record(folder / "starts" / f"{number:02d}.h5", end.record)
    spread = start_spread(campaign, ends)
    settings = own.update.model_copy(update={"start": "deck", "starts": 1})
    best = replace(
        own,
        update=settings,
        begin=tuple(starts[spread.chosen].tolist()),
        report=own.report.model_copy(update={"page": False}),  # drawn below, of all starts
    )
    run = update_campaign(best, folder, progress, pages, forecast, executes)
    record = replace(_joined(run.record, ends, spread, spent), wall_s=time.monotonic() - began)
    write_record(folder / "campaign.h5", record)
    if campaign.report.page:
        progress.working("drawing the report")
        run = replace(run, page=draw_report(record, folder))
    return replace(run, record=record)


def _run_starts(
    campaign: Campaign, engine: JobEngine, starts: Floats, progress: Progress
) -> list[StartEnd]:
    """Updates from all starts, side by side. Raises what is not a start's own failure."""
    beside = min(campaign.parallel, len(starts))
    share = max(1, campaign.parallel // beside)
    progress.working(f"updates from {len(starts)} starts")
    with ThreadPoolExecutor(beside, thread_name_prefix="modetune-start") as pool:
        try:
            futures = [pool.submit(_run_start, campaign, engine, start, share) for start in starts]
            for done, _ in enumerate(as_completed(futures), start=1):
                progress.working(f"updates from {len(starts)} starts: {done} ended")
            return [future.result() for future in futures]
        except BaseException:
            engine.cancelled.set()  # jobs of other threads end with the campaign
            pool.shutdown(wait=False, cancel_futures=True)
            raise


def _run_start(campaign: Campaign, engine: JobEngine, start: Floats, share: int) -> StartEnd:
    campaign = replace(campaign, begin=tuple(start.tolist()))
    evaluator = evaluator_of(campaign, engine, ThreadExecution(engine, share))
    quiet = _Quiet()
    try:
        return StartEnd(start, Updating(campaign, evaluator, quiet, quiet.save).run(), None)
    except (SolverError, ModesError) as error:
        if isinstance(error, CAMPAIGNS_OWN):
            engine.cancelled.set()
            raise
        logger.warning("an update from another start failed: %s", error)
        return StartEnd(start, quiet.record, error)


def start_spread(campaign: Campaign, ends: list[StartEnd]) -> StartSpread:
    """Where the updates ended, which is the answer, and what fits as well.

    Raises the first start's error where all failed.
    """
    chosen = min(range(len(ends)), key=lambda number: ends[number].rank)
    answer = ends[chosen].record
    if ends[chosen].error is not None or answer is None:
        raise next(end.error for end in ends if end.error is not None)
    n = len(campaign.parameters)
    updated, misfits = np.full((len(ends), n), np.nan), np.full(len(ends), np.nan)
    for number, end in enumerate(ends):
        if end.record is not None and end.error is None:
            updated[number], misfits[number] = end.record.updated, end.record.best.residual.misfit
    tolerated = _tolerated(campaign, answer)
    minima = _places(updated / tolerated, [end.rank for end in ends])
    if minima[0] == 0 and ends[0].rank[0] == ends[chosen].rank[0]:
        chosen = 0  # the same place: the campaign's own start leads there too
    rivals, differ = [], set()
    for number, end in enumerate(ends):
        if minima[number] > 0 and _as_well(end, ends[chosen]):
            rivals.append(int(minima[number]))
            apart = np.abs(updated[number] - updated[chosen]) > tolerated
            differ |= set(np.flatnonzero(apart).tolist())
    return StartSpread(
        starts=np.stack([end.start for end in ends]),
        updated=updated,
        misfits=misfits,
        outcomes=tuple(end.outcome for end in ends),
        minima=minima,
        rivals=tuple(sorted(set(rivals))),
        differ=tuple(campaign.parameters.names[place] for place in sorted(differ)),
        chosen=chosen,
        seed=campaign.update.seed,
    )


def _tolerated(campaign: Campaign, answer: CampaignRecord) -> Floats:
    """By how much parameters (n_parameters,) may differ in one place.

    Updating ends as soon as e1 is met, so its ends scatter as if frequencies were measured as
    loosely as e1 judges them.
    """
    weighting = campaign.weighting
    known = weighting.frequency_deviations[weighting.frequencies_used]
    least = float(known.min(initial=campaign.tolerances.frequency))
    loose = campaign.tolerances.frequency / least
    errors = SAME_ERRORS * loose * answer.standard_errors
    return np.asarray(np.fmax(SAME_LEAST, errors))


def _places(scaled: Floats, ranks: list[tuple[int, float]]) -> Integers:
    """Number of the place of each end, 0 being that of the best; -1 where there is none.

    scaled: (n_starts, n_parameters), ends over the difference that makes another place.
    """
    ended = np.flatnonzero([rank[0] < 2 for rank in ranks])
    apart = np.abs(np.nan_to_num(scaled[ended, None] - scaled[None, ended])).max(axis=2)
    _, labels = connected_components(apart <= 1.0, directed=False)
    order = sorted(range(ended.size), key=lambda place: ranks[int(ended[place])])
    names = {
        label: number
        for number, label in enumerate(dict.fromkeys(int(labels[place]) for place in order))
    }
    minima = np.full(len(ranks), -1, dtype=np.int64)
    minima[ended] = [names[int(label)] for label in labels]
    return minima


def _as_well(end: StartEnd, answer: StartEnd) -> bool:
    if end.rank[0] == 0 or answer.rank[0] == 0:
        return end.rank[0] == answer.rank[0]
    return end.rank[1] <= AS_WELL * answer.rank[1]


def _counted(ends: list[StartEnd]) -> RunCounts:
    runs = RunCounts()
    for end in ends:
        if end.record is not None:
            runs = runs.plus(end.record.runs)
    return runs


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
