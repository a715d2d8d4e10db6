"""Running a screening: the Python API behind `modetune screen`.

The points of the design are ordinary modal jobs of the campaign: they go through the same engine,
under the same limits, retries and licences, and their results stay in the store. So a screening
that was stopped goes on where it was, and the same one again starts no solver.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from modetune.adapters.solver import ModalAnalysis
from modetune.core.errors import CampaignError, ModesError, ModetuneError, SolverError
from modetune.core.modes import Floats
from modetune.core.pairing import LostMode
from modetune.core.record import RunCounts
from modetune.core.results import ModalResult
from modetune.core.store import check_writable
from modetune.flows.campaign import Campaign
from modetune.flows.evaluating import Matrix
from modetune.flows.evaluation import Evaluation, compare
from modetune.flows.evaluator import CAMPAIGNS_OWN, WIDENINGS, Evaluator, outcomes_count
from modetune.flows.execution.engine import Job, JobEngine, JobOutcome
from modetune.flows.execution.work import Done, ThreadExecution, Work
from modetune.flows.running import solving_engine
from modetune.flows.schema import STORE_REMEDY
from modetune.flows.screening.choice import Candidates, choose_parameters
from modetune.flows.screening.design import Design, Method, make_design
from modetune.flows.screening.importance import importance, loudest
from modetune.flows.screening.indices import Indices, design_indices
from modetune.flows.screening.local import local_sensitivity
from modetune.flows.screening.record import LocalSensitivity, Responses, Screening

logger = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class ScreeningRequest:
    """What is asked for.

    points: solver runs of the design at most, about ten a parameter where None; levels: of a
    parameter in morris and factorial; choose: how many parameters are proposed.
    """

    method: Method = "local"
    points: int | None = None
    seed: int = 1
    levels: int | None = None
    choose: int | None = None


class ScreeningProgress(Protocol):
    """Who watches a screening."""

    def working(self, text: str) -> None:
        """What is being computed now."""
        ...

    def points(self, done: int, total: int, ran: int, failed: int) -> None:
        """How many points of the design are done, ran the solver, and failed."""
        ...


def screen_campaign(
    campaign: Campaign, request: ScreeningRequest, progress: ScreeningProgress
) -> Screening:
    """Screen a campaign's parameters within their bounds.

    Points that fail are left out as the method allows. Raises CampaignError (a design that cannot
    be), SolverError, ModesError (too few points are left), StoreError.
    """
    started = time.monotonic()
    if campaign.configurations:
        raise CampaignError(
            "screen takes one model and one test; this campaign has several configurations, so "
            "screen each by a campaign file of its own"
        )
    # One stream for the points and one for the analysis, so that either stays if the other changes.
    at_points, at_indices = np.random.default_rng(request.seed).spawn(2)
    parameters = campaign.parameters
    design = make_design(request.method, parameters.lower, parameters.upper, at_points,
                         request.points, request.levels)  # fmt: skip
    version = campaign.solver.version()  # a missing solver is told before anything else starts
    check_writable(campaign.store.folder, STORE_REMEDY)
    with solving_engine(campaign) as engine, _ended(engine):
        progress.working("deck's values, sensitivities")
        evaluator = Evaluator(campaign, engine, ThreadExecution(engine, campaign.parallel))
        nominal, matrix = evaluator.evaluate(0, parameters.initial, None, alone=False)
        assert matrix is not None
        points = _Points(campaign, engine, evaluator.analysis, nominal, progress)
        responses = points.solve(design.points)
        runs = replace(evaluator.runs.plus(points.runs), core_s=engine.ledger.core_s,
                       licence_s=engine.ledger.licence_s)  # fmt: skip
    local = local_sensitivity(campaign, nominal, matrix)
    found = None
    if request.method != "local":
        found = design_indices(design, _relative(responses, nominal), at_indices)
    return _screening(campaign, request, design, nominal, matrix, responses, local, found, runs,
                      version, time.monotonic() - started)  # fmt: skip


@contextmanager
def _ended(engine: JobEngine) -> Iterator[None]:
    """Jobs of other threads end with the screening."""
    try:
        yield
    except BaseException:
        engine.cancelled.set()
        raise


def _screening(
    campaign: Campaign, request: ScreeningRequest, design: Design, nominal: Evaluation,
    matrix: Matrix, responses: Responses, local: LocalSensitivity, found: Indices | None,
    runs: RunCounts, version: str, wall_s: float,
) -> Screening:  # fmt: skip
    values = importance(campaign, design, local, found)
    parameters, start = campaign.parameters, nominal.theta
    allowed = [
        (bound - start) / parameters.standard_deviations
        for bound in (parameters.lower, parameters.upper)
    ]
    candidates = Candidates(
        campaign.parameters.names, values, loudest(campaign, design, local, found), local.missing,
        local.weighted, local.weighted_residual, *allowed,
    )  # fmt: skip
    pairing = nominal.pairing
    return Screening(
        name=campaign.name,
        seed=request.seed,
        solver=campaign.solver.name,
        solver_version=version,
        units=campaign.units,
        campaign_text=campaign.text,
        names=campaign.parameters.names,
        deviations=campaign.parameters.standard_deviations,
        numbers=tuple(campaign.test.numbers[place] for place in pairing.measured.tolist()),
        test_hz=campaign.test.modes.frequencies_hz[pairing.measured],
        nominal_hz=nominal.seen.frequencies_hz[pairing.computed],
        nominal_mac=pairing.judged_mac,
        design=design,
        responses=responses,
        local=local,
        indices=found,
        importance=values,
        choice=choose_parameters(candidates, request.choose),
        runs=runs,
        wall_s=wall_s,
        wanted=request.choose or 0,
    )


def _relative(responses: Responses, nominal: Evaluation) -> Floats:
    """Responses of the analysis, (n_points, n_responses): f / f_nominal - 1, and MAC."""
    here = nominal.seen.frequencies_hz[nominal.pairing.computed]
    return np.hstack([responses.frequencies_hz / here - 1.0, responses.mac])


class _Points:
    """The points of a design on their way through the solver; counts what they cost."""

    def __init__(
        self,
        campaign: Campaign,
        engine: JobEngine,
        analysis: ModalAnalysis,
        nominal: Evaluation,
        progress: ScreeningProgress,
    ) -> None:
        self.campaign = campaign
        self.engine = engine
        self.analysis = analysis
        self.nominal = nominal
        self.progress = progress
        self.runs = RunCounts()
        self.done = self.ran = self.failed = 0  # of one pass over points

    def solve(self, points: Floats) -> Responses:
        """The responses at (n_points, n_parameters); lost modes widen the computed range."""
        n, n_modes = len(points), len(self.campaign.test.numbers)
        shaped = n_modes if self.campaign.test.has_shapes else 0
        frequencies, macs = np.full((n, n_modes), np.nan), np.full((n, shaped), np.nan)
        failures, keys = [""] * n, [""] * n
        waiting = list(range(n))
        for widening in range(WIDENINGS + 1):
            lost = []
            for place, done in zip(waiting, self._run(points[waiting]), strict=True):
                try:
                    keys[place], found = self._compared(points[place], done)
                except (SolverError, ModesError) as error:
                    if isinstance(error, CAMPAIGNS_OWN):
                        raise
                    failures[place] = str(error)
                    if isinstance(error, LostMode):
                        lost.append(place)
                    continue
                failures[place] = ""
                frequencies[place] = found.seen.frequencies_hz[found.pairing.computed]
                macs[place] = found.pairing.judged_mac[:shaped]
            lost = [place for place in lost if not self._has_all(points[place])]
            if not lost or widening == WIDENINGS:
                break
            wider = self.analysis.n_modes + max(4, self.analysis.n_modes // 2)
            logger.warning(
                "a mode is lost at %d point%s; widening the range to %d modes there",
                len(lost), "" if len(lost) == 1 else "s", wider,
            )  # fmt: skip
            self.analysis, waiting = replace(self.analysis, n_modes=wider), lost
        return Responses(frequencies, macs, tuple(failures), tuple(keys))

    def _run(self, points: Floats) -> list[Done]:
        def told(done: Done) -> None:
            self._count(done)
            self.progress.points(self.done, len(points), self.ran, self.failed)

        if not len(points):
            return []
        self.done = self.ran = self.failed = 0
        self.progress.working("points of the design")
        execution = ThreadExecution(self.engine, self.campaign.parallel, told)
        work = [Work(f"point {n}", (self._job(point),)) for n, point in enumerate(points, start=1)]
        return execution.run("screening", work)

    def _count(self, done: Done) -> None:
        self.done += 1
        if isinstance(done, ModetuneError):
            self.failed += 1
        else:
            counts = outcomes_count("modal", done)
            self.ran += counts.modal
            self.runs = self.runs.plus(counts)

    def _job(self, point: Floats) -> Job:
        return Job(self.campaign.parameters.values(point), self.analysis)

    def _has_all(self, point: Floats) -> bool:
        """Whether a solved point had all modes there are, so that no wider range holds more."""
        result = self.engine.result(self._job(point))
        assert isinstance(result, ModalResult)
        few = result.modes.frequencies_hz.size < self.analysis.n_modes
        return few and self.campaign.solver.name == "matrices"

    def _compared(self, point: Floats, done: Done) -> tuple[str, Evaluation]:
        outcome = _outcome(done)
        result = self.engine.result(self._job(point))
        assert isinstance(result, ModalResult)
        return outcome.key, compare(self.campaign, point, outcome.key, result, self.nominal)


def _outcome(done: Done) -> JobOutcome:
    if isinstance(done, ModetuneError):
        raise done
    return done[0]
