"""A dry run: the jobs that a campaign would run, without running them.

The updating loop is deterministic, so it is replayed while the store has every job. At the first
missing one the replay ends and reports the jobs of that iteration: those in the store, those that
would run, and for each of these the nearest stored result with the differences.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path

from modetune.core.errors import NotComputed, NotStored
from modetune.core.storage.campaign_record import CampaignRecord, IterationRecord
from modetune.flows.campaign.campaign import Campaign
from modetune.flows.jobs.campaign_engine import job_engine
from modetune.flows.jobs.engine import JobEngine
from modetune.flows.jobs.execution import Done, Execution, Work
from modetune.flows.jobs.job import NOMINAL, Job
from modetune.flows.jobs.job_difference import (
    JobDescription,
    Nearest,
    Text,
    Texts,
    deck_text,
    job_of_note,
    load_text,
)
from modetune.flows.jobs.lookup import Explanation, nearest
from modetune.flows.updating.evaluator import evaluator_of
from modetune.flows.updating.forecast import Unwatched
from modetune.flows.updating.update import Updating, read_earlier, start_of


@dataclass(frozen=True, slots=True)
class PlannedJob:
    """A job of an iteration and what it is for.

    asked: what it would be run for, None where the store has its result; nearest: of a job that
    would be run, where anything is stored.
    """

    iteration: str
    name: str
    job: Job
    key: str
    asked: JobDescription | None
    nearest: Nearest | None = None

    @property
    def stored(self) -> bool:
        return self.asked is None


@dataclass(frozen=True, slots=True)
class DryRun:
    """What a campaign would do.

    answered: jobs of all iterations before that the store answers; iterations: those replayed;
    jobs: of the iteration where the store's answers end, empty where they last to the campaign's
    end; ended: its record then.
    """

    answered: int
    iterations: tuple[IterationRecord, ...]
    jobs: tuple[PlannedJob, ...]
    ended: CampaignRecord | None

    @property
    def runs(self) -> tuple[PlannedJob, ...]:
        """The jobs that would be run first."""
        return tuple(item for item in self.jobs if not item.stored)


class Replay(Execution):
    """An execution that takes results from the store, and keeps which jobs would have to run.

    answered: results that the store had; planned: the first jobs that would run.
    """

    def __init__(self, engine: JobEngine) -> None:
        super().__init__(engine)
        self.answered = 0
        self.planned: list[PlannedJob] = []

    def run(self, iteration: str, works: Sequence[Work]) -> list[Done]:
        """Outcomes from the store. Raises NotStored where a job has none."""
        pieces = [
            [
                planned_job(piece.engine or self.engine, iteration, piece.name, job)
                for job in piece.jobs
            ]
            for piece in works
        ]
        jobs = [item for piece in pieces for item in piece]
        if not all(item.stored for item in jobs):
            self.planned = _each_once(jobs)
            raise NotStored(f"{iteration} would run jobs")
        self.answered += len(jobs)
        return super().run(iteration, works)


def planned_job(engine: JobEngine, iteration: str, name: str, job: Job) -> PlannedJob:
    """A job and whether the store has its result."""
    key = engine.key(job)
    if key in engine.store:
        return PlannedJob(iteration, name, job, key, None)
    asked = job_of_note(key, engine.note(job), engine.plans.plan(job).asked)
    return PlannedJob(iteration, name, job, key, asked)


def dry_run(campaign: Campaign, folder: Path) -> DryRun:
    """Replay a campaign on its store and return the first jobs that would run.

    folder: its run folder, where a run before may have left its record. Raises SolverMissing
    (keys hold the solver's version), ModelError, ModesError, StoreError.
    """
    engine = replace(job_engine(campaign), may_run=False)
    campaign = start_of(campaign, engine, read_earlier(folder))
    while True:
        replay = Replay(engine)
        evaluator = evaluator_of(campaign, engine, execution=replay)
        updating = Updating(campaign, evaluator, Unwatched(), lambda record: None)
        ended = None
        try:
            ended = updating.run()
        except NotComputed:  # the next results are computed here; no solver run is known yet
            break
        except NotStored:
            if not replay.planned:  # a damaged entry was set aside: once more, without it
                continue
        break
    asked = [item.asked for item in replay.planned if item.asked]
    found = {
        job.key: near
        for job, near in zip(asked, nearest(engine.store, asked, _texts(engine)), strict=True)
    }
    jobs = tuple(replace(item, nearest=found.get(item.key)) for item in replay.planned)
    return DryRun(replay.answered, tuple(updating.iterations), jobs, ended)


def explain_unrun(campaign: Campaign, start: str) -> Explanation | None:
    """The job of a campaign whose key starts so and that would be run next, if there is one."""
    for item in dry_run(campaign, Path("runs") / campaign.name).runs:
        if item.key.startswith(start):
            return Explanation(item.key, "not run", item.asked, None, None, None, "", item.nearest)
    return None


def _texts(engine: JobEngine) -> Texts:
    """Texts of decks: this campaign's own, and those that the store keeps, each read once."""
    known: dict[str, Text | None] = {}

    def text(digest: str) -> Text | None:
        if digest not in known and digest == engine.plans.model_digest():
            with suppress(OSError):  # no room for a temporary copy: the explanation is shorter
                known[digest] = deck_text(engine.plans.plan(NOMINAL).rendered)
        if digest not in known:
            known[digest] = load_text(engine.store, digest)
        return known[digest]

    return text


def _each_once(jobs: Sequence[PlannedJob]) -> list[PlannedJob]:
    """The jobs without those that an earlier one of the same key makes."""
    first: dict[str, PlannedJob] = {}
    for item in jobs:
        first.setdefault(item.key, item)
    return list(first.values())
