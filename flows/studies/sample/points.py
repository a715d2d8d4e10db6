"""Solving parameter sets: modes of a campaign's model there, and the residuals they leave.

Where a reduced model holds between the bounds (`flows/updating/reduced_model`) it gives many sets,
at some milliseconds each. Else sets are ordinary modal jobs, which go through the evaluator, its
store, limits and retries, so that what was solved once is never solved again. Without measured
shapes a set's modes are tracked from the nearest set that has been paired already, beginning at the
campaign's start. Over long ways modes that approach each other may be mistaken for each other.
Sets that fit the test are those that were not, so further ones are tracked from these, and those
near the posterior that do not fit once more when it is known which do: a few sets there with two
modes exchanged are holes in what is learned, that no spline goes through.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass

import numpy as np

from modetune.core.correlation.pairing import LostMode
from modetune.core.errors import CampaignError, ModetuneError
from modetune.core.modes import Floats, Integers
from modetune.core.updating.responses.response import Residual
from modetune.flows.campaign.campaign import Campaign
from modetune.flows.studies.sample.surrogate import Training
from modetune.flows.updating.evaluation import MOST_KNOWN, Evaluation
from modetune.flows.updating.evaluator import Evaluator
from modetune.flows.updating.matrices import one_thread

logger = logging.getLogger(__name__)

#: The residual of a point without modes, in standard deviations of the test: such sets are
#: as good as impossible.
IMPOSSIBLE = 1e3
#: What a squared misfit may be above the least one of all for modes to be tracked from there.
NEARLY = 50.0
#: Of the sets asked for, the share that may fail.
MOST_FAILED = 0.5


@dataclass(frozen=True, slots=True)
class SolvedPoints:
    """Sets that could be solved: their residuals and their jobs."""

    training: Training
    keys: tuple[str, ...]


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
                    row[:] = standardised(item)
        return values

    def residuals(self, points: Floats) -> Floats:
        """As `features`: these are the residual itself."""
        return self.features(points)


class PointSolver:
    """Solves parameter sets of one campaign and keeps those that modes are tracked from."""

    def __init__(self, campaign: Campaign, evaluator: Evaluator) -> None:
        self.campaign = campaign
        self.evaluator = evaluator
        self.failures: list[str] = []
        self.known: list[Evaluation] = []
        self._misfits: list[float] = []

    @property
    def residual(self) -> Residual:
        """Of the first set that was solved."""
        return self.known[0].residual

    def reduced(self) -> ReducedFeatures | None:
        """The residual by a reduced model between the bounds, modes tracked from the sets solved so
        far; None where there is none."""
        within = self.evaluator.within(self.campaign, self.known[0], in_full=False)
        if within is None:
            return None
        named = response_names(self.known[0])
        return ReducedFeatures(self.campaign, within, self.known, *named)

    def solve(
        self, title: str, points: Floats, around: int = 0, grows: bool = True
    ) -> SolvedPoints:
        """Residuals at points (n, n_parameters); sets that fail are left out with a warning.

        around: so many sets at least, those that fit best, are those that modes are tracked from,
        all of them where it is 0; grows: whether these too. Raises CampaignError where more than
        half fail; SolverError, ModesError where all do; StoreError.
        """
        failed: list[ModetuneError] = []
        keys: list[str] = []
        places: list[int] = []
        values: list[Floats] = []
        for place, item in enumerate(self._evaluated(title, points, around, grows)):
            if isinstance(item, ModetuneError):
                failed.append(item)
                continue
            self._join(item)
            keys.append(item.key)
            places.append(place)
            values.append(standardised(item))
        self._tell(failed, len(points))
        responses, names = response_names(self.known[0])
        rows = np.array(values).reshape(-1, responses.size)
        training = Training(points[places], rows, responses, names)
        return SolvedPoints(training, tuple(keys))

    def fitting(
        self, least: int, more: Sequence[Evaluation] = ()
    ) -> tuple[list[Evaluation], float]:
        """So many sets at least that fit best, of those that are known and more, and the largest
        squared misfit that counts as such."""
        sets = [*self.known, *more]
        fits = np.array([*self._misfits, *map(misfit, more)])
        reach = float(max(np.sort(fits)[:least].max(), fits.min() + NEARLY))
        return [item for item, fit in zip(sets, fits.tolist(), strict=True) if fit <= reach], reach

    def _evaluated(
        self, title: str, points: Floats, around: int, grows: bool
    ) -> Iterator[Evaluation | ModetuneError]:
        """Evaluations at points in turn, or why there is none. Those that do not fit the test near
        others that do are tracked once more, from these."""
        known = self.fitting(around)[0] if around else self.known
        found = self.evaluator.points(title, points, known, grows, in_full=False)
        if not around:
            yield from found
            return
        items = list(found)
        fitting, reach = self.fitting(around, [i for i in items if isinstance(i, Evaluation)])
        for item in items:
            if isinstance(item, Evaluation) and misfit(item) > reach:
                with suppress(LostMode):
                    again = self.evaluator.tracked(item, fitting)
                    item = min(item, again, key=misfit)
            yield item

    def _join(self, item: Evaluation) -> None:
        """Keep a set for modes to be tracked from; of too many the one that fits worst goes."""
        self.known.append(item)
        self._misfits.append(misfit(item))
        if len(self.known) > MOST_KNOWN:
            worst = 1 + int(np.argmax(self._misfits[1:]))
            del self.known[worst], self._misfits[worst]

    def _tell(self, failed: Sequence[ModetuneError], asked: int) -> None:
        self.failures += map(str, failed)
        if failed:
            said = "1 set is" if len(failed) == 1 else f"{len(failed)} sets are"
            logger.warning("%s left out of %d, the first because: %s", said, asked, failed[0])
        if len(failed) == asked:
            raise failed[0]
        if len(failed) > MOST_FAILED * asked:
            raise CampaignError(
                f"{len(failed)} of {asked} solver runs gave no residual, the first because: "
                f"{failed[0]}\nnarrow the parameters' bounds"
            )


def standardised(evaluation: Evaluation) -> Floats:
    """Entries of a residual that take part, in standard deviations of the test, (n_residuals,).

    A surrogate knows that
    a shape moves on a curve, so its entries have their measured deviation alone, without what the
    residual adds for a linear model's sake.
    """
    found = evaluation.residual
    used = found.weights > 0.0
    return np.asarray(found.independent(found.values)[used] / np.sqrt(found.noise[used]))


def misfit(evaluation: Evaluation) -> float:
    """Of a set: the sum of squares of its standardised residual."""
    values = standardised(evaluation)
    return float(values @ values)


def response_names(evaluation: Evaluation) -> tuple[Integers, tuple[str, ...]]:
    """Which response each entry of a standardised residual is of, and what they are called."""
    found = evaluation.residual
    names = [name for block in found.blocks for name in block.names]
    there, responses = np.unique(found.owners()[found.weights > 0.0], return_inverse=True)
    return responses.astype(np.int64), tuple(names[place] for place in there.tolist())
