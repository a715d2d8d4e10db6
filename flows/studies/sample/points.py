"""Points of a sampling: the modes of a campaign's model there, and the residuals.

A reduced model that holds between the bounds (`flows/updating/reduced_model`) evaluates a point in
milliseconds. Otherwise points are ordinary modal jobs of the evaluator with its store, limits and
retries. Without measured shapes, modes are tracked from the nearest paired point, beginning at the
campaign's start. Over long distances, tracking can confuse modes that approach each other. Points
that fit the test have correct pairs, so further points are tracked from them, and badly fitting
points near the posterior are tracked again once these are known: a few points with exchanged modes
would be discontinuities that no spline can follow.
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

logger = logging.getLogger(__name__)

#: The residual of a point without modes, in standard deviations of the test: such sets are
#: as good as impossible.
IMPOSSIBLE = 1e3
#: What a squared misfit may be above the least one of all for modes to be tracked from there.
NEARLY = 50.0
#: Of the sets asked for, the share that may fail.
MOST_FAILED = 0.5


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
    ) -> tuple[Training, tuple[str, ...]]:
        """Return residuals at points (n, n_parameters), and their keys; warn of those that fail.

        around: minimum number of best-fitting points from which to track modes, 0 for all known
        points. grows: add the new points to them. Raises CampaignError if more than half fail;
        SolverError, ModesError if all do; StoreError.
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
        return Training(points[places], rows, responses, names), tuple(keys)

    def fitting(
        self, least: int, more: Sequence[Evaluation] = ()
    ) -> tuple[list[Evaluation], float]:
        """Return at least `least` best-fitting points, and their largest squared misfit."""
        sets = [*self.known, *more]
        fits = np.array([*self._misfits, *map(misfit, more)])
        reach = float(max(np.sort(fits)[:least].max(), fits.min() + NEARLY))
        return [item for item, fit in zip(sets, fits.tolist(), strict=True) if fit <= reach], reach

    def _evaluated(
        self, title: str, points: Floats, around: int, grows: bool
    ) -> Iterator[Evaluation | ModetuneError]:
        """Yield evaluations or errors; badly fitting points are tracked again from good ones."""
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
        """Add a point from which modes are tracked, and drop the worst one above the limit."""
        self.known.append(item)
        self._misfits.append(misfit(item))
        if len(self.known) > MOST_KNOWN:
            worst = 1 + int(np.argmax(self._misfits[1:]))
            del self.known[worst], self._misfits[worst]

    def _tell(self, failed: Sequence[ModetuneError], asked: int) -> None:
        self.failures += map(str, failed)
        if failed:
            n_failed = len(failed)
            logger.warning("%d of %d points failed; first error: %s", n_failed, asked, failed[0])
        if len(failed) == asked:
            raise failed[0]
        if len(failed) > MOST_FAILED * asked:
            raise CampaignError(
                f"{len(failed)} of {asked} points failed; first error: {failed[0]}\n"
                "narrow the parameters' bounds"
            )


def standardised(evaluation: Evaluation) -> Floats:
    """Return the used entries of a residual in standard deviations of the test, (n_residuals,).

    Shapes have only their measured deviation, without the part that the residual adds for a linear
    model, because a surrogate follows the curve of a shape.
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
