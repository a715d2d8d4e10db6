"""A dry run: the jobs that a campaign would run, without running them.

The updating loop is deterministic, so it can be replayed as long as the store has every job. At the
first missing job the replay ends and lists the jobs of that iteration: those that are cached and
those that would run.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from modetune.core.errors import NotComputed, NotStored
from modetune.core.storage.campaign_record import CampaignRecord, IterationRecord
from modetune.flows.campaign.campaign import Campaign
from modetune.flows.jobs.campaign_engine import job_engine
from modetune.flows.jobs.engine import JobEngine
from modetune.flows.jobs.execution import Done, Execution, Work
from modetune.flows.jobs.job import Job
from modetune.flows.jobs.job_description import JobDescription, job_of_note
from modetune.flows.jobs.lookup import Explanation
from modetune.flows.updating.evaluator import evaluator_of
from modetune.flows.updating.forecast import Unwatched
from modetune.flows.updating.update import Updating, read_earlier, start_of


@dataclass(frozen=True, slots=True)
class PlannedJob:
    """A job of an iteration and its description.

    asked: the description of a job that would run, None if it is cached.
    """

    iteration: str
    name: str
    job: Job
    key: str
    asked: JobDescription | None

    @property
    def stored(self) -> bool:
        return self.asked is None


@dataclass(frozen=True, slots=True)
class DryRun:
    """The jobs that a campaign would run.

    answered: number of cached jobs of the replayed iterations. iterations: those replayed. jobs:
    of the first iteration with a missing result, empty if the whole campaign is cached. ended: the
    campaign's record in that case.
    """

    answered: int
    iterations: tuple[IterationRecord, ...]
    jobs: tuple[PlannedJob, ...]
    ended: CampaignRecord | None

    @property
    def runs(self) -> tuple[PlannedJob, ...]:
        """Return the jobs that would run first."""
        return tuple(item for item in self.jobs if not item.stored)


class Replay(Execution):
    """An execution that reads results from the store and records the jobs that would run.

    answered: number of cached results. planned: the jobs of the first incomplete iteration.
    """

    def __init__(self, engine: JobEngine) -> None:
        super().__init__(engine)
        self.answered = 0
        self.planned: list[PlannedJob] = []

    def run(self, iteration: str, works: Sequence[Work]) -> list[Done]:
        """Return outcomes from the store. Raises NotStored if a job has none."""
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
    """Return a job with its description, None if the store has its result."""
    key = engine.key(job)
    if key in engine.store:
        return PlannedJob(iteration, name, job, key, None)
    asked = job_of_note(key, engine.note(job), engine.plans.plan(job).asked)
    return PlannedJob(iteration, name, job, key, asked)


def dry_run(campaign: Campaign, folder: Path) -> DryRun:
    """Replay a campaign on its store and return the first jobs that would run.

    folder: its run folder, which may contain the record of a previous run. Raises SolverMissing
    (keys contain the solver's version), ModelError, ModesError, StoreError.
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
            if not replay.planned:  # a damaged entry was set aside: replay again without it
                continue
        break
    return DryRun(replay.answered, tuple(updating.iterations), tuple(replay.planned), ended)


def explain_unrun(campaign: Campaign, start: str) -> Explanation | None:
    """Return the campaign's next job whose key has this start, or None."""
    for item in dry_run(campaign, Path("runs") / campaign.name).runs:
        if item.key.startswith(start):
            return Explanation(item.key, "not run", item.asked, None, None, None, "")
    return None


def _each_once(jobs: Sequence[PlannedJob]) -> list[PlannedJob]:
    """Return the jobs without repetitions of a key."""
    first: dict[str, PlannedJob] = {}
    for item in jobs:
        first.setdefault(item.key, item)
    return list(first.values())
