"""What is asked of a case: its modes at a parameter set, and from where they are tracked."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import scipy

from modetune.adapters.solver import ModalAnalysis
from modetune.core.algebra.factor_room import factor_room
from modetune.core.correlation.matching import NotAmongComputed
from modetune.core.correlation.pairing import LostMode, Pairing
from modetune.core.modes import Floats, Integers, mode_name
from modetune.core.updating.results import ModalResult
from modetune.flows.campaign.campaign import Campaign
from modetune.flows.campaign.case import Case
from modetune.flows.jobs.engine import JobEngine
from modetune.flows.jobs.execution import Done, Work
from modetune.flows.updating.evaluation import CaseEvaluation, Evaluation, compare
from modetune.flows.updating.finders import UNFIT, ModeFinder

logger = logging.getLogger(__name__)

#: How often the computed range is widened in search of a lost mode.
WIDENINGS = 1
#: Sets that modes are tracked from at most: the nearest of so many is near, and they fill memory.
MOST_KNOWN = 400


@dataclass(slots=True, eq=False)
class CaseState:
    """A case under evaluation.

    campaign: the one that the case would make alone; columns: positions of its parameters among
    all; engine: of its model; analysis: what its modal runs are asked for by now.
    """

    case: Case
    campaign: Campaign
    columns: Integers
    engine: JobEngine
    finder: ModeFinder
    analysis: ModalAnalysis

    def own(self, theta: Floats) -> Floats:
        """The case's own parameters among all."""
        return theta[self.columns]

    def compared(
        self,
        theta: Floats,
        key: str,
        modal: ModalResult,
        before: CaseEvaluation | None,
        solved_by: str,
        drop: bool = False,
    ) -> CaseEvaluation:
        """Modes at the case's own parameters beside its test: `compare`."""
        matrices = self.finder.assembled(theta) if self.case.needs("matrices") else None
        with factor_room(self.engine.room):
            return compare(self.case, theta, key, modal, before, solved_by, drop, matrices)

    def named(self, work: Work) -> Work:
        """A piece of work under the case's name, for its engine."""
        return Work(self.case.of(work.name), work.jobs, work.engine or self.engine)


@dataclass(slots=True, eq=False)
class AskedModes:
    """A case at a parameter set, on its way to an evaluation; widened: how often so far."""

    point: int
    state: CaseState
    theta: Floats
    analysis: ModalAnalysis
    widened: int = 0

    def widen(self, error: LostMode, there: int) -> bool:
        """Ask for more modes; false where it is of no use.

        there: modes that were found; a model of a few unknowns has no more than it gave.
        """
        few = there < self.analysis.n_modes
        if self.widened == WIDENINGS or few or not error.above:
            return False
        self.widened += 1
        n_modes = self.analysis.n_modes + max(4, self.analysis.n_modes // 2)
        self.analysis = replace(self.analysis, n_modes=n_modes)
        logger.info("%s; widening the range to %d modes", error, n_modes)
        return True

    def answered(
        self, done: Sequence[Done], before: CaseEvaluation | None
    ) -> CaseEvaluation | None:
        """The case's evaluation, from what became of its work; None where it is to be asked again.

        before: that of the set that modes are tracked from.
        """
        state = self.state
        try:
            key, modal = state.finder.modes(self.theta, self.analysis, done)
        except UNFIT as error:
            state.finder = state.finder.instead(error)
            return None
        try:
            part = self.compared(key, modal, before)
        except LostMode as error:
            if self.widen(error, modal.modes.n_modes):
                return None
            if isinstance(error, NotAmongComputed):
                raise
            if before is not None or not state.case.rules.drop:
                raise _lost(error) from error
            part = self.compared(key, modal, before, drop=True)
        if before is None:
            _tell_dropped(state.case, part.pairing)
        return part

    def compared(
        self, key: str, modal: ModalResult, before: CaseEvaluation | None, drop: bool = False
    ) -> CaseEvaluation:
        """Modes that were found beside those of the test. Raises LostMode."""
        state = self.state
        return state.compared(self.theta, key, modal, before, state.finder.name, drop)


@dataclass(slots=True)
class ModeTrack:
    """Evaluation points that modes are tracked from, where the test has no shapes: the nearest one.

    width: (n_parameters,), what distances are measured by; grows: whether new sets join them, till
    there are MOST_KNOWN.
    """

    width: Floats
    known: list[Evaluation]
    grows: bool
    _places: Floats = field(default_factory=lambda: np.zeros((0, 0)))

    def next(self, thetas: Floats, waiting: Sequence[int]) -> int:
        """The waiting set that is nearest to one that is known, where the known grow by it."""
        if not (self.known and self.grows) or len(waiting) == 1:
            return waiting[0]
        return waiting[int(np.argmin(self._distances(thetas[list(waiting)]).min(axis=1)))]

    def nearest(self, theta: Floats) -> Evaluation | None:
        """The known set that is nearest to a set."""
        if len(self.known) < 2:
            return self.known[0] if self.known else None
        return self.known[int(np.argmin(self._distances(theta[None])))]

    def join(self, evaluation: Evaluation) -> None:
        """A new set, which others may be tracked from."""
        if self.grows and len(self.known) < MOST_KNOWN:
            self.known.append(evaluation)

    def _distances(self, thetas: Floats) -> Floats:
        if len(self._places) != len(self.known):
            self._places = np.stack([evaluation.theta for evaluation in self.known]) / self.width
        return np.asarray(
            scipy.spatial.distance.cdist(thetas / self.width, self._places, "sqeuclidean")
        )


#: A piece of work of a case.
Piece = tuple[CaseState, Work]
#: What became of pieces by what they are, for those that are asked for again.
Ahead = dict[tuple[object, ...], Done]


def _lost(error: LostMode) -> LostMode:
    """A lost mode with what the campaign can say of it."""
    return LostMode(
        f"{error}; `test.unmatched: drop` updates without it, and `test.pairs` names its partner "
        "by hand (see `modetune check`)"
    )


def _tell_dropped(case: Case, pairing: Pairing) -> None:
    """Warn of the modes that are left out."""
    for row in np.setdiff1d(np.arange(case.test.modes.n_modes), pairing.measured).tolist():
        logger.warning(
            "%s at %.4g Hz has no partner among the computed modes and is left out "
            "(test.unmatched: drop): nothing is compared with it",
            mode_name(case.test.numbers[row], case.name),
            case.test.modes.frequencies_hz[row],
        )
