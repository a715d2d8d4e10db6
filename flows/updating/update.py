"""Updating of a campaign's model, from its file to its run folder: `modetune update`.

`update: {start: last}` starts from the parameters at the end of the previous run. They are carried
over as values of the deck's quantities, so the start is the same even if the deck's values were
replaced in between. If nothing has changed since that run, its start is used again: the store then
has every job, and an update that ended without e1 is not continued a little further every night.

Updating from several starts shows whether the answer depends on the start. The campaign's own start
comes first; the others are a Latin hypercube within the bounds, each with its own stratum in every
parameter. All updates share one store and one engine and run in parallel. The best end is the
campaign's answer; `starts.py` separates the local minima. The run folder keeps each update's record
as starts/NN.h5. The campaign's own record has its initial model, then the best start and the
iterations from there, whose results are all in the store. If the matrices are known for all values,
all searches run on reduced models within one update.
"""

from __future__ import annotations

import logging
import os
import socket
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor, as_completed
from contextlib import contextmanager
from contextvars import copy_context
from dataclasses import dataclass, field, replace
from functools import reduce
from logging.handlers import RotatingFileHandler
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from modetune.core.errors import (
    CampaignError,
    CampaignRunning,
    ModesError,
    SolverError,
    StoreDamaged,
)
from modetune.core.modes import Floats, MeasuredModes
from modetune.core.storage.campaign_record import (
    CampaignRecord,
    IterationRecord,
    RunCounts,
    is_same_run,
    read_record,
    write_record,
)
from modetune.core.storage.files import check_writable, remove_parts, storage_errors
from modetune.core.storage.locks import FileLock
from modetune.core.storage.upgrade import RUN_LOCK
from modetune.core.updating.trust import UNCONFIRMED, StartSpread, with_concerns, with_spread
from modetune.flows.campaign.campaign import Campaign
from modetune.flows.campaign.case import Case
from modetune.flows.campaign.schema import STORE_REMEDY
from modetune.flows.campaign.solvers import untested_capabilities
from modetune.flows.campaign.units import unit_doubt
from modetune.flows.diagnosis.causes import cause_sentences, causes
from modetune.flows.diagnosis.findings import Finding
from modetune.flows.jobs.campaign_engine import job_engine, solving_engine
from modetune.flows.jobs.engine import JobEngine
from modetune.flows.jobs.job import Job
from modetune.flows.jobs.run_log import logged_to
from modetune.flows.jobs.tasks import study_run
from modetune.flows.report.iteration_tables import iteration_row
from modetune.flows.report.report_file import PAGE, draw_report
from modetune.flows.updating.diagnosis import checked
from modetune.flows.updating.evaluation import Evaluation, Matrix
from modetune.flows.updating.evaluator import Evaluator, evaluator_of
from modetune.flows.updating.forecast import Forecast, Forecaster, Progress, Unwatched
from modetune.flows.updating.holdout import held_out
from modetune.flows.updating.loop import End, Foresight, Loop, Trial
from modetune.flows.updating.mode_source import CAMPAIGNS_OWN, UPDATING, campaign_analysis
from modetune.flows.updating.poses import settled
from modetune.flows.updating.record import (
    CampaignRun,
    campaign_record,
    shown_field,
    unfinished_record,
)
from modetune.flows.updating.reduced_model import ByMatrices, finder_of
from modetune.flows.updating.run_history import RunHistory
from modetune.flows.updating.sensitivities import not_linear
from modetune.flows.updating.starts import (
    FoundMinima,
    OtherStarts,
    StartEnd,
    drawn_starts,
    end_of,
    failed,
    minima_by_slopes,
)

logger = logging.getLogger(__name__)

LOG = "campaign.log"
SHAPES_LEFT_OUT = (
    "The measured shapes are not compared (`residuals.shape_weight`); they may tell these apart."
)
#: Size in bytes at which a new log begins; one previous log is kept.
LONGEST = 8 << 20


class _LogFile(RotatingFileHandler):
    """A log file whose errors (a full disk) do not stop the campaign, and that stays closed.

    A thread that found the handler before its removal may still hand it a message, for which the
    base class opens the file again.
    """

    ended = False

    def emit(self, record: logging.LogRecord) -> None:
        if not self.ended:
            super().emit(record)

    def close(self) -> None:
        self.ended = True
        super().close()

    def handleError(self, record: logging.LogRecord) -> None:
        pass


@contextmanager
def campaign_log(campaign: Campaign, folder: Path) -> Iterator[None]:
    """Write the messages of modetune's loggers to the campaign's run folder."""
    file = _LogFile(folder / LOG, maxBytes=LONGEST, backupCount=1, encoding="utf-8", delay=True)
    file.setFormatter(logging.Formatter("%(asctime)s %(levelname)-7s %(message)s"))
    terminal = logging.StreamHandler()  # as Python does without handlers
    terminal.setLevel(logging.WARNING)
    heard, run = logging.getLogger("modetune").hasHandlers(), study_run()
    with logged_to([file] if heard else [file, terminal], lambda: run):
        try:
            host = f"{socket.gethostname()}, process {os.getpid()}"
            logger.info("campaign %s (%s) on %s", campaign.name, campaign.file, host)
            names = ", ".join(dict.fromkeys(case.solver.program.name for case in campaign.cases))
            logger.info("solver %s, version %s", names, campaign.solver_version())
            yield
        except BaseException as error:
            text = f"ended with {type(error).__name__}: {error}"
            file.handle(logging.LogRecord(__name__, logging.ERROR, "", 0, text, None, None))
            raise


def log_iterations(record: CampaignRecord, logged: int) -> int:
    """Log the iterations after the first `logged` of a record; return the new number logged."""
    for item in record.iterations[logged:]:
        row = iteration_row(item)
        logger.info(
            "iteration %d: largest frequency error %.2f %%, lowest MAC %.3f, %d + %d runs, %d "
            "cached, %.1f s; %s",
            row.iteration, 100.0 * row.largest_error, row.least_mac, row.modal_runs,
            row.sensitivity_runs, row.reused, row.wall_s, row.decision or "evaluated",
        )  # fmt: skip
    return len(record.iterations)


@dataclass(frozen=True, slots=True)
class EarlierRun:
    """Inputs and end of a finished run, from its record.

    test: numbers, frequencies, shapes, nodes and components as measured. started, updated:
    parameters by name; updated ones are values of the deck's quantities. record: the whole record.
    """

    campaign_text: str
    settings: str
    test: tuple[NDArray[Any], ...]
    modal_key: str
    started: dict[str, float]
    updated: dict[str, float]
    record: CampaignRecord


def read_earlier(folder: Path) -> EarlierRun | None:
    """Return the previous run in this folder, or None; warn if its record is unreadable."""
    path = folder / "campaign.h5"
    if not path.exists():
        return None
    try:
        record = read_record(path)
    except (CampaignError, StoreDamaged) as error:
        logger.warning("the record of the previous run cannot be read: %s", error)
        return None
    names, first = record.parameters.names, record.iterations[0]
    ends = record.parameters.assigned(record.updated)
    values = [p.number(deck, v) for (p, v), deck in zip(ends, record.deck_values, strict=True)]
    return EarlierRun(
        campaign_text=record.campaign_text,
        settings="\n".join(record.settings),
        test=_test_arrays(record.test),
        modal_key=first.modal_key,
        started=dict(zip(names, first.parameters.tolist(), strict=True)),
        updated=dict(zip(names, values, strict=False)),
        record=record,
    )


def with_first_cost(record: CampaignRecord, earlier: EarlierRun | None) -> CampaignRecord:
    """Return the record with runs and times of the previous run if the store had all jobs.

    So a record states the cost of computing the results, not of reading them from the store. What
    confirmed an answer later is added to the cost of finding it.
    """
    if earlier is None:
        return record
    then = earlier.record
    confirmed = then.unconfirmed and not record.unconfirmed
    if (record.runs.modal or record.runs.sensitivity) and not confirmed:
        return record
    # The modes of an answer that was confirmed later are other ones.
    answer = record.best.number if confirmed else -1
    keys = [
        [item.modal_key for item in one.iterations if item.number != answer]
        for one in (then, record)
    ]
    if keys[0] != keys[1] or len(then.iterations) != len(record.iterations):
        return record
    iterations = tuple(
        replace(item, runs=old.runs.plus(item.runs), wall_s=old.wall_s + item.wall_s)
        if item.number == answer
        else replace(item, runs=old.runs, wall_s=old.wall_s)
        for item, old in zip(record.iterations, then.iterations, strict=True)
    )
    runs, wall_s = then.runs, then.wall_s
    if confirmed:
        runs, wall_s = runs.plus(record.runs), wall_s + record.wall_s
    return replace(record, runs=runs, wall_s=wall_s, iterations=iterations)


def is_unchanged(campaign: Campaign, engine: JobEngine, earlier: EarlierRun) -> bool:
    """Return whether campaign, settings, test, deck and solver are those of the previous run."""
    if (campaign.text, "\n".join(campaign.settings)) != (earlier.campaign_text, earlier.settings):
        return False
    now = _test_arrays(campaign.test)
    if not all(np.array_equal(one, then) for one, then in zip(now, earlier.test, strict=True)):
        return False
    # The key of the first modes depends on everything in the deck and the solver.
    analysis = campaign_analysis(campaign)
    if engine.key(Job(earlier.started, analysis)) == earlier.modal_key:
        return True
    started = np.array([earlier.started[name] for name in campaign.parameters.names])
    finder = finder_of(campaign, engine, UPDATING, campaign)
    if not isinstance(finder, ByMatrices) or finder.works(started, analysis):
        return False
    return finder.stored().key(started, analysis) == earlier.modal_key


def start_of(campaign: Campaign, engine: JobEngine, earlier: EarlierRun | None) -> Campaign:
    """Return the campaign with the start that `update.start` selects."""
    if campaign.update.start == "deck":
        return campaign
    if earlier is None:
        logger.info("there is no previous run to start from; starting from the deck")
        return campaign
    if is_unchanged(campaign, engine, earlier):
        names = campaign.parameters.names
        return replace(campaign, begin=tuple(earlier.started[name] for name in names))
    begin = []
    for item in campaign.parameters.parameters:
        deck_value = campaign.deck_value(item)
        value = earlier.updated.get(item.name, np.nan)
        relative = item.relative_to(deck_value, value)
        known = np.isfinite(relative)
        begin.append(float(np.clip(relative, item.lower, item.upper)) if known else item.initial)
    logger.info("starting from the parameters at the end of the previous run")
    return replace(campaign, begin=tuple(begin))


def _test_arrays(test: MeasuredModes) -> tuple[NDArray[Any], ...]:
    modes = test.modes
    return (
        np.array(test.numbers),
        modes.frequencies_hz,
        modes.mode_shapes,
        modes.nodes,
        modes.components,
    )


@dataclass
class Updating:
    """A campaign in progress; `run` completes it.

    around: an evaluation from which the modes of the start are tracked.
    """

    campaign: Campaign
    evaluator: Evaluator
    progress: Progress
    save: Callable[[CampaignRecord], None]  # while it is in progress
    around: Evaluation | None = None
    matrix: Matrix | None = None
    counted: RunCounts = field(default_factory=RunCounts)

    def __post_init__(self) -> None:
        self.foresight = Foresight(self.evaluator) if self.evaluator.reducible else None
        self.iterations: list[IterationRecord] = []
        self.kept: list[Evaluation] = []
        self.started = self.lap = time.monotonic()

    def run(self) -> CampaignRecord:
        """Update until e1 holds, nothing more is gained, or the iterations are used up."""
        campaign, evaluator = self.campaign, self.evaluator
        others = OtherStarts(campaign, evaluator, self.foresight)

        def seek() -> None:
            if self.kept[-1].agrees(campaign.tolerances):
                others.seek(self._record("converged", ""), self.kept[-1])

        evaluator.idle, idle = seek, evaluator.idle
        end = self._loop(campaign, around=self.around)
        evaluator.idle, self.matrix = idle, end.matrix
        tried = others.tried(self._record(end.status, end.reason), end.last)
        if tried is not None and tried.moves:
            end = self._from(tried)
        held = held_out(self.evaluator, self.kept[0], self.kept[-1])
        record = checked(replace(self._record(end.status, end.reason), held_out=held))
        record = self._with_causes(record)
        if not self._confirms and record.trust and not evaluator.is_solvers(self.kept[-1]):
            reason = f"{record.reason}; `modetune confirm` lets the solver confirm it"
            trust = with_concerns(record.trust, UNCONFIRMED)
            record = replace(record, reason=reason, trust=trust)
        if tried is not None and record.trust is not None:
            spread = tried.spread(record)
            trust = with_spread(record.trust, spread)
            if spread.rivals and any(_leaves_out_shapes(case) for case in campaign.used):
                trust = replace(trust, notes=(*trust.notes, SHAPES_LEFT_OUT))
            record = replace(record, trust=trust)
        at_bounds = self.campaign.parameters.at_bounds(record.updated)
        if at_bounds:
            record = replace(record, reason=f"{record.reason}; on a bound: {', '.join(at_bounds)}")
        return record

    def _with_causes(self, record: CampaignRecord) -> CampaignRecord:
        """Return the record with possible causes if a model-form error is suspected."""
        if record.trust is None or record.trust.times_noise == 0.0:
            return record
        found: list[Finding] = []
        first = 0
        for at, part in zip(self.evaluator.used, self.kept[-1].parts, strict=True):
            slopes = np.full((len(at.case.measured.numbers), len(self.campaign.parameters)), np.nan)
            rows = part.pairing.measured
            if self.matrix is not None:
                slopes[rows] = self.matrix.values[first : first + rows.size]
            first += rows.size
            found += causes(at.case, part.whole, slopes)
        return replace(record, trust=with_concerns(record.trust, *cause_sentences(found)))

    def _from(self, tried: FoundMinima) -> End:
        """Continue from the best end."""
        campaign = replace(self.campaign, begin=tuple(tried.better.tolist()))
        title, number = "another start fits better", self.iterations[-1].number + 1
        end = self._loop(campaign, first=number, title=title)
        self.matrix = end.matrix
        return replace(end, reason=f"{end.reason}; the best of {tried.n_starts} starts")

    def _loop(self, campaign: Campaign, **where: Any) -> End:
        """Update from the campaign's start; where: the start of a `Loop`."""
        return Loop(
            campaign,
            self.evaluator,
            self,
            confirms=self._confirms,
            foresight=self.foresight,
            **where,
        ).run()

    @property
    def _confirms(self) -> bool:
        return self.campaign.update.confirm != "later"

    def working(self, text: str) -> None:
        self.progress.working(text)

    def noted(
        self,
        number: int,
        evaluation: Evaluation,
        trial: Trial | None,
        newest: Matrix | None,
        decision: str,
        accepted: bool,
        skipped: bool,
    ) -> None:
        """Add an evaluated point to the record."""
        step, matrix = (trial.by.step, trial.by.matrix) if trial else (None, None)
        now, parameters = time.monotonic(), self.campaign.parameters
        runs, wall_s = self.evaluator.runs.since(self.counted), now - self.lap
        self.counted, self.lap = self.evaluator.runs, now
        record = IterationRecord(
            number=number,
            parameters=evaluation.theta,
            step=step.change if step else np.zeros(len(parameters)),
            computed=evaluation.seen,
            pairing=evaluation.pairing,
            frequency_errors=evaluation.errors,
            residual=evaluation.residual,
            sensitivity=matrix.values if matrix else np.zeros((0, len(parameters))),
            sensitivity_methods=matrix.methods_had if matrix else (),
            sensitivity_keys=matrix.keys if matrix else (),
            sensitivity_age=matrix.age if matrix else 0,
            sensitivity_skipped=skipped,
            slope=trial.slope if trial else np.nan,
            accepted=accepted,
            decision=decision,
            regularisation=step.regularisation if step else np.nan,
            condition=step.condition if step else np.nan,
            modal_key=evaluation.key,
            runs=runs,
            wall_s=wall_s,
            field=shown_field(self.campaign, evaluation),
            solved_by=evaluation.solved_by,
        )
        self.iterations.append(record)
        self.matrix = newest
        if accepted:
            self.kept = [*self.kept[:1], evaluation]
        self.progress.iteration(record)
        self.save(self._record("running", ""))

    def confirmed(self, evaluation: Evaluation) -> None:
        """Replace the modes of the last accepted point by the solver's own."""
        place = max(n for n, record in enumerate(self.iterations) if record.accepted)
        before, runs = self.iterations[place], self.evaluator.runs
        apart = float(np.max(np.abs(evaluation.errors - before.frequency_errors)))
        text = f"confirmed by {evaluation.solved_by}: frequencies within {apart:.1e}"
        now = time.monotonic()
        self.iterations[place] = replace(
            before,
            computed=evaluation.seen,
            pairing=evaluation.pairing,
            frequency_errors=evaluation.errors,
            residual=evaluation.residual,
            modal_key=evaluation.key,
            decision="; ".join(filter(None, (before.decision, text))),
            runs=before.runs.plus(runs.since(self.counted)),
            wall_s=before.wall_s + now - self.lap,
            field=shown_field(self.campaign, evaluation),
            solved_by=evaluation.solved_by,
        )
        self.counted, self.lap = runs, now
        self.kept[-1] = evaluation
        self.progress.working(text)
        self.save(self._record("running", ""))

    def _record(self, status: str, reason: str) -> CampaignRecord:
        return campaign_record(
            self.campaign,
            self.iterations,
            self.matrix,
            status,
            reason,
            self.evaluator.runs,
            time.monotonic() - self.started,
            None if status == "running" else self.kept[-1],
        )


def _leaves_out_shapes(case: Case) -> bool:
    return case.test.has_shapes and not case.needs("shapes")


def is_same(campaign: Campaign, folder: Path) -> bool:
    """Return whether nothing has changed since the run whose record is in a run folder."""
    earlier = read_earlier(folder)
    return earlier is not None and is_unchanged(campaign, job_engine(campaign), earlier)


def update_campaign(
    campaign: Campaign,
    folder: Path,
    progress: Progress,
    forecast: Callable[[Forecast], None] | None = None,
    joined: Callable[[CampaignRecord], CampaignRecord] = lambda record: record,
) -> CampaignRun:
    """Update a campaign's model and leave record, report and updated deck in its run folder.

    forecast: is called before the start and after each iteration with what is still to come.
    joined: makes the final record, with what other updates found.
    Raises SolverError, ModesError, StoreError.
    """
    campaign.solver_version()  # a missing solver is reported before anything starts
    campaign.store.check_usable(STORE_REMEDY)
    check_writable(folder, "name another place for run folders with --runs")
    with FileLock(folder / RUN_LOCK) as lock:
        if not lock.take():
            raise CampaignRunning(
                f"another run of this campaign is in progress in {folder}; wait for it, or name "
                "another place for run folders with --runs"
            )
        remove_parts(folder)
        with campaign_log(campaign, folder), solving_engine(campaign) as engine:
            return _update(campaign, engine, folder, progress, forecast, joined)


def _update(
    campaign: Campaign,
    engine: JobEngine,
    folder: Path,
    progress: Progress,
    forecast: Callable[[Forecast], None] | None,
    joined: Callable[[CampaignRecord], CampaignRecord],
) -> CampaignRun:
    earlier, history = (
        read_earlier(folder),
        RunHistory(folder, campaign.run.keep, campaign.monitoring),
    )
    if earlier is not None:
        history.recover(earlier.record)
    campaign = start_of(campaign, engine, earlier)
    # Results of an earlier run stay until this one has finished.
    unfinished, logged = folder / "campaign.unfinished.h5", 0

    def keep(record: CampaignRecord) -> None:
        nonlocal logged
        ended = record.status != "running"
        write(with_first_cost(record, earlier) if ended else record)
        logged = log_iterations(record, logged)

    if campaign.sensitivity.method == "auto":
        solvers = [case.solver for case in campaign.cases]
        texts = [tell(solver) for solver in solvers for tell in (not_linear, untested_capabilities)]
        for text in dict.fromkeys(filter(None, texts)):
            logger.warning("%s", text)
    for case in campaign.cases:
        doubt = "" if "units" in case.accepted else unit_doubt(case.units, case.solver)
        if doubt:
            logger.warning("%s; `model.checks: [units]` accepts that", doubt)
    # There is no forecast for several models.
    if len(campaign.cases) > 1:
        forecast = None
    forecaster = Forecaster(campaign, engine, progress, forecast) if forecast else None
    evaluator = evaluator_of(campaign, engine)
    with unfinished_record(unfinished) as write:
        record = joined(Updating(campaign, evaluator, forecaster or progress, keep).run())
        record, drift = history.concluded(record)
        keep(record)
    if record.drift:
        logger.info("structure: %s", record.drift)
    logger.info("%s: %s", record.status, record.reason)
    values = campaign.parameters.values(record.updated)
    deck = campaign.write_updated(values, folder / "updated")
    whole, page = with_first_cost(record, earlier), folder / PAGE
    drawn = page.is_file() and earlier is not None and is_same_run(whole, earlier.record)
    with storage_errors(unfinished):
        if campaign.report.page and not drawn:
            page.unlink(missing_ok=True)  # a kill leaves no report of the run before
        unfinished.replace(folder / "campaign.h5")
    if campaign.report.page and not drawn:
        progress.working("drawing the report")
        shown = draw_report(whole, folder)
    else:
        shown = page if campaign.report.page else None
    news = history.is_news(record)
    history.add(record, shown)
    first = forecaster.first if forecaster else None
    return CampaignRun(record, folder, deck, first, shown, drift=drift, news=news)


def update_from_starts(
    campaign: Campaign,
    folder: Path,
    progress: Progress,
    forecast: Callable[[Forecast], None] | None = None,
) -> CampaignRun:
    """Update a campaign's model from the number of starts that it requests.

    Arguments and errors are those of `update_campaign`, which is called for a single start and
    tries the others itself if evaluations are cheap. Raises if all starts fail.
    """
    campaign = settled(campaign)
    n = campaign.update.starts or 1
    if n == 1:
        return update_campaign(campaign, folder, progress, forecast)
    if _cost_little(campaign):
        try:
            return update_campaign(campaign, folder, progress, forecast)
        except ModesError as error:  # of the campaign's own start: the others run separately
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
        costs = engine.costs
        spent = replace(counted, core_s=costs.core_s, licence_s=costs.licence_s)
    for earlier in (folder / "starts").glob("*.h5"):
        earlier.unlink()  # of a run with more starts, or others
    for number, end in enumerate(ends):
        if end.record is not None:
            write_record(folder / "starts" / f"{number:02d}.h5", end.record)
    found = minima_by_slopes(own, ends)
    answer = ends[found.chosen].record
    assert answer is not None
    spread = found.spread(answer)
    settings = own.update.model_copy(update={"start": "deck", "starts": 1})
    best = replace(own, update=settings, begin=tuple(starts[spread.chosen].tolist()))

    def joined(record: CampaignRecord) -> CampaignRecord:
        whole = _joined(record, ends, spread, spent)
        return replace(whole, wall_s=time.monotonic() - began)

    return update_campaign(best, folder, progress, forecast, joined)


def _cost_little(campaign: Campaign) -> bool:
    """Return whether evaluations are cheap after the first one."""
    engine = job_engine(campaign)
    return evaluator_of(campaign, engine).sets_cost_little


def _run_starts(
    campaign: Campaign, engine: JobEngine, starts: Floats, progress: Progress
) -> list[StartEnd]:
    """Run the updates from all starts in parallel. Raises errors of the whole campaign."""
    beside = min(campaign.parallel, len(starts))
    jobs = {
        job.identity
        for work in evaluator_of(campaign, engine).planned(campaign.start)
        for job in work.jobs
    }
    progress.working(
        f"updates from {len(starts)} starts, each of at most {campaign.update.max_iterations} "
        f"iterations of up to {len(jobs)} solver runs"
    )
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
        run = Updating(own, evaluator, Unwatched(), records.append, around).run()
        return end_of(own, start, run)
    except (SolverError, ModesError) as error:
        if isinstance(error, CAMPAIGNS_OWN):
            engine.cancelled.set()
            raise
        logger.warning("an update from another start failed: %s", error)
        return replace(failed(start, error), record=records[-1] if records else None)


def _paired_once(campaign: Campaign) -> bool:
    """Return whether modes are paired at the campaign's own start and tracked from there."""
    return any(case.rules.by_hand or case.rules.drop for case in campaign.used)


def _joined(
    record: CampaignRecord, ends: list[StartEnd], spread: StartSpread, spent: RunCounts
) -> CampaignRecord:
    """Return the record of the best update, with the cost and the outcomes of all starts.

    It begins with the campaign's own initial model, if that could be evaluated.
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
