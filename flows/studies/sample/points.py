"""Solving parameter sets: modes of a campaign's model there, and the residuals they leave.

Where a reduced model holds between the bounds (`flows/updating/by_range`) it gives the residual
itself at any set, in a millisecond or two. Else sets are ordinary modal jobs,
which go through the evaluator, its store, limits and retries, so that what was solved once is never
solved again. Without measured shapes a set's modes are tracked from the nearest set that has been
paired already, beginning at the campaign's start.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from modetune.core.errors import CampaignError, ModetuneError
from modetune.core.modes import Floats, Integers
from modetune.core.updating.residual import measurement_variances
from modetune.flows.campaign.campaign import Campaign
from modetune.flows.studies.sample.surrogate import Training, worst_of
from modetune.flows.updating.evaluation import Evaluation
from modetune.flows.updating.evaluator import Evaluator
from modetune.flows.updating.small_matrices import one_thread

logger = logging.getLogger(__name__)

#: What stands for a residual that cannot be had, in standard deviations of the test: such sets are
#: as good as impossible.
IMPOSSIBLE = 1e3
#: Of the sets asked for, the share that may fail.
MOST_FAILED = 0.5


@dataclass(frozen=True, slots=True)
class SolvedPoints:
    """Sets that could be solved: their residuals, their jobs, and which of those asked for."""

    training: Training
    keys: tuple[str, ...]
    places: Integers


@dataclass(frozen=True, slots=True)
class ReducedFeatures:
    """The residual at any set by a reduced model, in standard deviations of the test.

    evaluator: of sets between the bounds; known: evaluated ones, from which modes are tracked;
    responses, names: as of `Training`.
    """

    campaign: Campaign
    evaluator: Evaluator
    known: Sequence[Evaluation]
    responses: Integers
    names: tuple[str, ...]

    def features(self, points: Floats) -> Floats:
        """(n, n_residuals) at points (n, n_parameters), all alike where one cannot be had."""
        values = np.full((len(points), self.responses.size), IMPOSSIBLE)
        with one_thread():
            found = self.evaluator.points("samples", points, self.known)
            for row, item in zip(values, found, strict=True):
                if isinstance(item, Evaluation):
                    row[:] = standardised(self.campaign, item)
        return values

    def errors(self, rows: NDArray[np.bool_]) -> Floats:
        """Of what was learned from other sets: nothing was, (n_responses,)."""
        return np.full(len(self.names), np.nan)

    def missed(self, truth: Training) -> Floats:
        """Errors at full solutions, (n_responses,), root mean square over these."""
        apart = self.features(truth.points) - truth.values
        return worst_of(apart, self.responses, len(self.names))


class PointSolver:
    """Solves parameter sets of one campaign and keeps those that modes are tracked from."""

    def __init__(self, campaign: Campaign, evaluator: Evaluator) -> None:
        self.campaign = campaign
        self.evaluator = evaluator
        self.failures: list[str] = []
        self._known: list[Evaluation] = []

    def reduced(self) -> ReducedFeatures | None:
        """The residual by a reduced model between the bounds, beginning at the sets solved so far;
        None where there is none."""
        ranges = self.evaluator.ranges
        within = ranges.within(self.campaign, self._known[0], in_full=False) if ranges else None
        if within is None:
            return None
        named = response_names(self.campaign, self._known[0])
        return ReducedFeatures(self.campaign, within, self._known, *named)

    def solve(self, title: str, points: Floats) -> SolvedPoints:
        """Residuals at points (n, n_parameters); sets that fail are left out with a warning.

        Raises CampaignError where more than half fail; SolverError, ModesError where all do;
        StoreError.
        """
        found = list(self.evaluator.points(title, points, self._known, grows=True))
        self._tell([item for item in found if isinstance(item, ModetuneError)], len(found))
        sets = {n: item for n, item in enumerate(found) if isinstance(item, Evaluation)}
        self._known += sets.values()
        return SolvedPoints(
            self._training(list(sets.values())),
            tuple(item.key for item in sets.values()),
            np.array(list(sets), dtype=np.int64),
        )

    def _tell(self, failed: Sequence[ModetuneError], asked: int) -> None:
        for error in failed:
            logger.warning("a solver run is left out: %s", error)
            self.failures.append(str(error))
        if len(failed) == asked:
            raise failed[0]
        if len(failed) > MOST_FAILED * asked:
            raise CampaignError(
                f"{len(failed)} of {asked} solver runs gave no residual, the first because: "
                f"{failed[0]}\nnarrow the parameters' bounds"
            )

    def _training(self, found: Sequence[Evaluation]) -> Training:
        responses, names = response_names(self.campaign, found[0] if found else self._known[0])
        values = [standardised(self.campaign, evaluation) for evaluation in found]
        return Training(
            points=np.array([item.theta for item in found]).reshape(
                -1, len(self.campaign.parameters)
            ),
            values=np.array(values).reshape(-1, responses.size),
            responses=responses,
            names=names,
        )


def standardised(campaign: Campaign, evaluation: Evaluation) -> Floats:
    """Entries of a residual that take part, in standard deviations of the test, (n_residuals,).

    Frequencies that have a weight, then shapes that have one, pair by pair. A surrogate knows that
    a shape moves on a curve, so its entries have their measured deviation alone, without what the
    residual adds for a linear model's sake.
    """
    case, found = campaign.case, evaluation.residual
    variances = measurement_variances(
        case.test.modes, evaluation.seen, evaluation.pairing, case.weighting
    )
    used = found.weights > 0.0
    return np.asarray(found.values[used] / np.sqrt(variances[used]))


def response_names(campaign: Campaign, evaluation: Evaluation) -> tuple[Integers, tuple[str, ...]]:
    """Which response each entry of a standardised residual is of, and what they are called."""
    found, numbers = evaluation.residual, campaign.case.test.numbers
    called = [numbers[place] for place in evaluation.pairing.measured.tolist()]
    names = [f"{kind} of mode {number}" for kind in ("frequency", "shape") for number in called]
    n, used = len(called), found.weights > 0.0
    owners = np.append(np.arange(n), n + np.repeat(np.arange(n), (used.size - n) // n))[used]
    there, responses = np.unique(owners, return_inverse=True)
    return responses.astype(np.int64), tuple(names[place] for place in there.tolist())
