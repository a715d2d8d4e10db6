"""Solving parameter sets: ordinary modal jobs of a campaign, and the residuals they leave.

Jobs go through the engine with its store, limits and retries, so that what was solved once is never
solved again. Without measured shapes a set's modes are tracked from the nearest set that has been
paired already, beginning at the campaign's start.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from modetune.adapters.solver import ModalAnalysis
from modetune.core.errors import CampaignError, ModetuneError, SolverError
from modetune.core.modes import Floats, Integers
from modetune.core.pairing import LostMode
from modetune.core.record import RunCounts
from modetune.core.residual import Residual
from modetune.core.results import ModalResult
from modetune.flows.campaign import Campaign
from modetune.flows.evaluation import Evaluation, compare
from modetune.flows.evaluator import CAMPAIGNS_OWN, WIDENINGS, outcomes_count
from modetune.flows.execution.engine import Job, JobEngine
from modetune.flows.execution.work import Execution, Work
from modetune.flows.posterior.surrogate import Training

logger = logging.getLogger(__name__)

#: Of the sets asked for, the share that may fail.
MOST_FAILED = 0.5


@dataclass(frozen=True, slots=True)
class Solved:
    """Sets that could be solved: their residuals, their jobs, and which of those asked for."""

    training: Training
    keys: tuple[str, ...]
    places: Integers


class PointSolver:
    """Solves parameter sets of one campaign and counts what it cost."""

    def __init__(self, campaign: Campaign, engine: JobEngine, execution: Execution) -> None:
        self.campaign = campaign
        self.engine = engine
        self.execution = execution
        self.runs = RunCounts()
        self.failures: list[str] = []
        # Shapes of the whole surface, which a report shows, would fill the store for nothing.
        self._analysis = ModalAnalysis(campaign.n_modes, campaign.nodes, ())
        self._paired: list[Evaluation] = []

    def solve(self, title: str, points: Floats) -> Solved:
        """Residuals at points (n, n_parameters); sets that fail are left out with a warning.

        Raises CampaignError where more than half fail; SolverError, ModesError where all do;
        StoreError.
        """
        found: dict[int, Evaluation] = {}
        failed: dict[int, ModetuneError] = {}
        wanted, analysis = list(range(points.shape[0])), self._analysis
        for _ in range(WIDENINGS + 1):
            lost = self._round(title, points, wanted, analysis, found, failed)
            if not lost:
                break
            wanted = sorted(lost)
            analysis = replace(analysis, n_modes=analysis.n_modes + max(4, analysis.n_modes // 2))
        failed.update(lost)
        self._tell(points.shape[0], failed)
        places = sorted(found)
        return Solved(
            self._training([found[place] for place in places]),
            tuple(found[place].key for place in places),
            np.array(places, dtype=np.int64),
        )

    def _round(
        self,
        title: str,
        points: Floats,
        wanted: Sequence[int],
        analysis: ModalAnalysis,
        found: dict[int, Evaluation],
        failed: dict[int, ModetuneError],
    ) -> dict[int, ModetuneError]:
        """Solve and pair these sets; those whose modes were not all found are returned."""
        names = self.campaign.parameters
        jobs = [Job(names.values(points[place]), analysis) for place in wanted]
        works = [Work("modal", (job,)) for job in jobs]
        lost: dict[int, ModetuneError] = {}
        solved: dict[int, tuple[str, Job]] = {}
        done = self.execution.run(title, works)
        for place, job, outcome in zip(wanted, jobs, done, strict=True):
            if not isinstance(outcome, ModetuneError):
                self.runs = self.runs.plus(outcomes_count("modal", outcome))
                solved[place] = outcome[0].key, job
            elif isinstance(outcome, SolverError) and not isinstance(outcome, CAMPAIGNS_OWN):
                failed[place] = outcome
            else:
                raise outcome
        while solved:
            place = self._next(points, list(solved))
            key, job = solved.pop(place)
            try:
                found[place] = self._pair(points[place], key, job)
            except LostMode as error:
                lost[place] = error
        return lost

    def _next(self, points: Floats, places: list[int]) -> int:
        """The set that is nearest to one that has been paired: modes are tracked step by step."""
        if not self._paired:
            return places[0]
        known = np.stack([evaluation.theta for evaluation in self._paired])
        apart = np.abs(points[places][:, None] - known[None]) / self._width
        return places[int(np.argmin((apart**2).sum(axis=2).min(axis=1)))]

    def _pair(self, theta: Floats, key: str, job: Job) -> Evaluation:
        modal = self.engine.result(job)
        assert isinstance(modal, ModalResult)
        previous = None
        if self._paired:
            apart = [(((theta - other.theta) / self._width) ** 2).sum() for other in self._paired]
            previous = self._paired[int(np.argmin(apart))]
        evaluation = compare(self.campaign, theta, key, modal, previous)
        self._paired.append(evaluation)
        return evaluation

    @property
    def _width(self) -> Floats:
        return self.campaign.parameters.upper - self.campaign.parameters.lower

    def _tell(self, asked: int, failed: dict[int, ModetuneError]) -> None:
        for error in failed.values():
            logger.warning("a solver run is left out: %s", error)
            self.failures.append(str(error))
        if len(failed) == asked:
            raise next(iter(failed.values()))
        if len(failed) > MOST_FAILED * asked:
            raise CampaignError(
                f"{len(failed)} of {asked} solver runs gave no residual, the first because: "
                f"{next(iter(failed.values()))}\nnarrow the parameters' bounds"
            )

    def _training(self, found: Sequence[Evaluation]) -> Training:
        responses, names = response_names(self.campaign, found[0] if found else self._paired[0])
        values = [standardised(self.campaign, evaluation.residual) for evaluation in found]
        return Training(
            points=np.array([item.theta for item in found]).reshape(-1, self._width.size),
            values=np.array(values).reshape(-1, responses.size),
            responses=responses,
            names=names,
        )


def standardised(campaign: Campaign, residual: Residual) -> Floats:
    """Entries of a residual that take part, in standard deviations of the test, (n_residuals,).

    Frequencies where they have a weight, then shapes pair by pair where these have one. A
    surrogate knows that a shape moves on a curve, so its entries have their measured deviation
    alone, without what the residual adds for a linear model's sake.
    """
    weighting, n = campaign.weighting, residual.n_frequencies
    parts = []
    if weighting.frequency_weight > 0.0:
        parts.append(residual.values[:n] / (2.0 * weighting.frequency_deviation))
    shapes = residual.values[n:]
    if shapes.size:
        parts.append(shapes * np.sqrt(shapes.size / n) / weighting.shape_deviation)
    return np.concatenate(parts)


def response_names(campaign: Campaign, evaluation: Evaluation) -> tuple[Integers, tuple[str, ...]]:
    """Which response each entry of a standardised residual is of, and what they are called."""
    residual = evaluation.residual
    numbers = [campaign.test.numbers[place] for place in evaluation.pairing.measured.tolist()]
    n, names, responses = residual.n_frequencies, [], []
    if campaign.weighting.frequency_weight > 0.0:
        names += [f"frequency of mode {number}" for number in numbers]
        responses += list(range(n))
    each = (residual.values.size - n) // n
    if each:
        responses += [len(names) + pair for pair in range(n) for _ in range(each)]
        names += [f"shape of mode {number}" for number in numbers]
    return np.array(responses, dtype=np.int64), tuple(names)
