"""The forecast of a campaign's cost: core-minutes, licence-minutes and time, from earlier jobs.

The cost of a job is the median of stored results of the same model and type of analysis. If there
are none, results of earlier states of the deck are used, found by the model's name. The number of
iterations is unknown, so the forecast has the cost of the next iteration and an upper limit: all
iterations, each with a new sensitivity.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

from modetune.core.storage.campaign_record import IterationRecord
from modetune.core.storage.keys import Json
from modetune.flows.campaign.campaign import Campaign
from modetune.flows.jobs.engine import JobEngine
from modetune.flows.jobs.execution import Work
from modetune.flows.jobs.job import Job, analysis_kind
from modetune.flows.jobs.limits import CORES
from modetune.flows.jobs.lookup import NEWEST, MedianCost, job_costs, parallel_time
from modetune.flows.report.tables import json_object
from modetune.flows.updating.evaluator import evaluator_of

#: Number of newest results to read after an iteration.
NEWEST_LATER = 20
#: Parameter change for separating the jobs of each iteration from jobs that run once.
ELSEWHERE = 1.001


@dataclass(frozen=True, slots=True)
class Cost:
    """The cost of several jobs; unknown: number of jobs of unknown cost, not in the sums."""

    jobs: int
    unknown: int
    core_s: float
    licence_s: float
    wall_s: float

    def plus(self, other: Cost, times: int = 1) -> Cost:
        return Cost(
            self.jobs + times * other.jobs,
            self.unknown + times * other.unknown,
            self.core_s + times * other.core_s,
            self.licence_s + times * other.licence_s,
            self.wall_s + times * other.wall_s,
        )


@dataclass(frozen=True, slots=True)
class Forecast:
    """The forecast of a campaign.

    coming: cost of the first iteration, zero once it is done. further: maximum cost of each later
    iteration. iterations: their maximum number. last: cost of the solver run that confirms modes
    from stored matrices, zero if each iteration runs the solver.
    """

    coming: Cost
    further: Cost
    iterations: int
    last: Cost

    @property
    def most(self) -> Cost:
        return self.coming.plus(self.further, self.iterations).plus(self.last)

    @property
    def known(self) -> bool:
        """Return whether the cost of every job is known."""
        return self.most.unknown == 0


NOTHING = Cost(0, 0, 0.0, 0.0, 0.0)


class Progress(Protocol):
    """The watcher of a study; these methods do nothing."""

    def keep(self, folder: Path) -> None:
        """Also write the progress of the jobs to a file in a run folder."""
        return

    def forecast(self, forecast: Any) -> None:
        """Take note of the forecast of the remaining jobs, at the start and later."""
        return

    def working(self, text: str) -> None:
        """Take note of the computation in progress."""
        return

    def iteration(self, record: IterationRecord) -> None:
        """Take note of a complete iteration."""
        return

    def page(self, address: str) -> None:
        """Take note of the address at which Prefect shows the run."""
        return


#: What a user's function gets at each complete iteration.
OnIteration = Callable[[IterationRecord], object]


class Watched(Progress):
    """Shows what another watcher shows, and calls a function at each complete iteration."""

    def __init__(self, progress: Progress, call: OnIteration) -> None:
        self.progress, self.call = progress, call

    def keep(self, folder: Path) -> None:
        self.progress.keep(folder)

    def forecast(self, forecast: Any) -> None:
        self.progress.forecast(forecast)

    def working(self, text: str) -> None:
        self.progress.working(text)

    def page(self, address: str) -> None:
        self.progress.page(address)

    def iteration(self, record: IterationRecord) -> None:
        self.progress.iteration(record)
        self.call(record)


class Unwatched(Progress):
    """A watcher that does nothing."""


class Forecaster(Progress):
    """Passes the progress of a campaign on, with a forecast after each iteration."""

    def __init__(
        self,
        campaign: Campaign,
        engine: JobEngine,
        progress: Progress,
        tell: Callable[[Forecast], None],
    ) -> None:
        self.progress = progress
        self.tell = tell
        self._campaign = campaign
        self._engine = engine
        evaluator = evaluator_of(campaign, engine)
        # With matrices, jobs run at the start and one at the end, for any number of iterations.
        most = campaign.update.max_iterations
        self._iterations = most if evaluator.steps_run else 0
        start, elsewhere = campaign.start, ELSEWHERE * campaign.start
        first = _jobs(evaluator.planned(start, alone=most == 0))
        self._last = _jobs(evaluator.confirming(elsewhere if most else start))
        self._digest = engine.plans.model_digest()
        self._prices: dict[str, MedianCost] = {}
        self._missing = [job for job in first if engine.key(job) not in engine.store]
        self._further = [job for job in _jobs(evaluator.planned(elsewhere)) if job not in first]
        self.first = self._forecast(self._missing, 0)
        tell(self.first)

    def working(self, text: str) -> None:
        self.progress.working(text)

    def iteration(self, record: IterationRecord) -> None:
        self.progress.iteration(record)
        self.tell(self._forecast([], record.number))

    def _forecast(self, coming: Sequence[Job], number: int) -> Forecast:
        newest = NEWEST_LATER if self._prices else NEWEST
        self._prices |= job_costs(self._engine, self._digest, newest)
        price = job_cost(self._engine, self._prices, self._campaign.parallel)
        return Forecast(
            coming=price(coming),
            further=price(self._further),
            iterations=max(self._iterations - number, 0),
            last=price(self._last),
        )


def _jobs(works: Sequence[Work]) -> list[Job]:
    """Return the jobs of several pieces of work, each once."""
    jobs: list[Job] = []
    for work in works:
        jobs += [job for job in work.jobs if job not in jobs]
    return jobs


def job_cost(
    engine: JobEngine, prices: Mapping[str, MedianCost], parallel: int
) -> Callable[[Sequence[Job]], Cost]:
    """Return a function that estimates the cost of jobs, this many in parallel."""
    licences = sum(limit.taken for limit in engine.limits if limit.name != CORES)

    def cost(jobs: Sequence[Job]) -> Cost:
        found = [prices.get(analysis_kind(job.analysis)) for job in jobs]
        known = [price for price in found if price is not None]
        return Cost(
            jobs=len(jobs),
            unknown=len(found) - len(known),
            core_s=sum(price.core_s for price in known),
            licence_s=licences * sum(price.wall_s for price in known),
            wall_s=parallel_time([price.wall_s for price in known], parallel),
        )

    return cost


def cost_text(cost: Cost) -> str:
    """Return a cost as text."""
    number = f"{cost.jobs} job{'' if cost.jobs == 1 else 's'}"
    if cost.jobs == 0:
        return "nothing to run"
    if cost.unknown == cost.jobs:
        return f"{number} of unknown cost (no job of this type is stored yet)"
    licences = f", {_minutes(cost.licence_s)} licence-minutes" if cost.licence_s else ""
    without = f", without {cost.unknown} of unknown cost" if cost.unknown else ""
    return (
        f"{number}, {_minutes(cost.core_s)} core-minutes{licences}, {_time(cost.wall_s)}{without}"
    )


def forecast_text(forecast: Forecast) -> str:
    """Return a forecast as one line."""
    texts = [f"first iteration {cost_text(forecast.coming)}"]
    further = NOTHING.plus(forecast.further, forecast.iterations)
    if further.jobs:
        n = forecast.iterations
        up_to = f"up to {n} more iterations" if n > 1 else "one more iteration"
        texts.append(f"{up_to} at most {cost_text(further)}")
    elif forecast.iterations:
        texts.append("further iterations nothing to run")
    if forecast.last.jobs:
        texts.append(f"the solver's own run at the end {cost_text(forecast.last)}")
    return f"forecast: {'; '.join(texts)}"


def told_forecast(forecast: Forecast) -> dict[str, Json]:
    """Return a forecast as JSON; an unknown cost is null."""
    return json_object(
        forecast,
        "known",
        first_iteration=_told(forecast.coming),
        each_further=_told(forecast.further),
        further_iterations=forecast.iterations,
        last_run=_told(forecast.last),
        most=_told(forecast.most),
    )


def _told(cost: Cost) -> dict[str, Json]:
    known = cost.unknown == 0
    return json_object(
        cost,
        "jobs",
        jobs_of_unknown_cost=cost.unknown,
        core_minutes=round(cost.core_s / 60.0, 4) if known else None,
        licence_minutes=round(cost.licence_s / 60.0, 4) if known else None,
        wall_s=round(cost.wall_s, 3) if known else None,
    )


def _minutes(seconds: float) -> str:
    return f"{seconds / 60.0:.2g}" if seconds < 600.0 else f"{seconds / 60.0:.0f}"


def _time(seconds: float) -> str:
    if seconds < 90.0:
        return f"about {seconds:.0f} s"
    return (
        f"about {seconds / 60.0:.0f} min" if seconds < 5400.0 else f"about {seconds / 3600:.1f} h"
    )
