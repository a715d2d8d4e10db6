"""Many sets: by a reduced model that holds between the bounds, where matrices are there.

The model grows until its worst set agrees with the full solution there (`core/updating/
reduced_range`); a set for which its estimate is still not good enough is solved in full. The
solver's own run at the worst set says whether all this is to be believed. It is made once, for
whatever is asked within the bounds: a screening's is the one that sampling finds in the store.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from concurrent.futures import Future
from dataclasses import dataclass, field, replace

import numpy as np

from modetune.adapters.solver import ModalAnalysis
from modetune.core.errors import ModelError, ModesError
from modetune.core.modes import Floats
from modetune.core.updating.reduced_range import RangeUse, ReducedRange, range_sets
from modetune.core.updating.responses.response import MatricesAt
from modetune.core.updating.results import ModalResult
from modetune.flows.campaign.campaign import Campaign
from modetune.flows.jobs.execution import Done
from modetune.flows.jobs.watching import doing
from modetune.flows.jobs.work import meanwhile
from modetune.flows.updating.by_matrices import ByMatrices, reduced_columns
from modetune.flows.updating.evaluation import CaseEvaluation, Evaluation, Point
from modetune.flows.updating.evaluator import Evaluator
from modetune.flows.updating.finders import REDUCED, Columns, ModeFinder
from modetune.flows.updating.foresight import BELIEVED
from modetune.flows.updating.loop import CONFIRMED
from modetune.flows.updating.semi_analytic import UnlikeMatrices

logger = logging.getLogger(__name__)


@dataclass(slots=True)
class Tally:
    """Sets that a range was asked for, those that were solved in full, and the largest estimate
    of the others."""

    sets: int = 0
    in_full: int = 0
    estimate: float = 0.0


@dataclass(frozen=True, slots=True)
class ByRange(ModeFinder):
    """Modes by a reduced model for a range of values, and by the matrices where it may be off.

    key: of the range; around: an evaluated set, whose degrees of freedom the range has. worst:
    (n_parameters,), the last set of the range that was solved in full. in_full: whether the
    matrices, whose jobs went before the range, stand in where it may be off; else its estimate
    alone tells so.
    """

    key: str
    range: ReducedRange
    around: CaseEvaluation
    matrices: ByMatrices
    worst: Floats
    in_full: bool = True
    name: str = REDUCED
    cheap: bool = True
    tally: Tally = field(default_factory=Tally)

    def modes(
        self, theta: Floats, analysis: ModalAnalysis, done: Sequence[Done]
    ) -> tuple[str, ModalResult]:
        found = self._reduced(theta, analysis.n_modes)
        self.tally.sets += 1
        self.tally.in_full += found is None
        return found or self.matrices.modes(theta, analysis, done)

    def assembled(self, theta: Floats) -> MatricesAt:
        return self.matrices.assembled(theta)

    def columns(self, point: Point, analysis: ModalAnalysis, done: Sequence[Done]) -> Columns:
        return reduced_columns(self.range.model, point)

    def _reduced(self, theta: Floats, n_modes: int) -> tuple[str, ModalResult] | None:
        """By the range; None where it may be off by more than what confirms a set."""
        known = self.around.modal
        if not self.in_full:
            n_modes = min(n_modes, known.modes.n_modes)
        if n_modes > known.modes.n_modes:
            return None
        try:
            eigenvalues, shapes, off = self.range.modes(
                self.matrices.source.written(theta), n_modes
            )
        except ModesError as error:
            if not self.in_full:
                raise
            logger.debug("not by the range: %s", error)
            return None
        if off > CONFIRMED and self.in_full:
            return None
        self.tally.estimate = max(self.tally.estimate, off)
        modes = known.modes
        return self.key, ModalResult.of_shapes(
            eigenvalues, shapes, modes.nodes, modes.components, 0.5 * eigenvalues, known.n_rigid
        )


class ReducedRanges:
    """Reduced models that hold between the bounds, one a case, made when first asked for."""

    def __init__(self, evaluator: Evaluator) -> None:
        self.evaluator = evaluator
        self._finders: list[ByRange] = []
        self._confirming: tuple[Evaluation, Future[Evaluation | None]] | None = None
        self._confirmed: tuple[str, float, str] | None = None
        self._refused = False

    @property
    def asked(self) -> float:
        """What frequencies may be off by, relative."""
        return BELIEVED * min(self.evaluator.campaign.tolerances.frequency, CONFIRMED)

    @property
    def use(self) -> RangeUse | None:
        """How sets were evaluated so, and what confirmed it; None where none was."""
        if self._confirmed is None:
            return None
        ranges = [finder.range for finder in self._finders]
        tallies = [finder.tally for finder in self._finders]
        return RangeUse(
            sets=max(tally.sets for tally in tallies),
            vectors=max(own.size for own in ranges),
            solutions=sum(1 + len(own.solved) for own in ranges),
            asked=self.asked,
            error=max(float(own.errors[-1]) for own in ranges),
            estimate=max(tally.estimate for tally in tallies),
            in_full=sum(tally.in_full for tally in tallies),
            solver=self._confirmed[0],
            apart=self._confirmed[1],
            where=self._confirmed[2],
        )

    def within(
        self, campaign: Campaign, around: Evaluation, in_full: bool = True, ahead: bool = False
    ) -> Evaluator | None:
        """What evaluates sets of a campaign within the bounds, another test of the same models
        among them; None where a case has no such model, or the solver does not confirm it.

        around: an evaluated set of the evaluator's own campaign; in_full: whether sets at which
        the reduced model may be off are solved in full; ahead: sets may be evaluated while the
        solver confirms the model, and are to be believed if it `stands`.
        """
        if not self._finders and not self._refused:
            self._finders = self._made(around)
            self._refused = not self._finders or not self._asked(around)
        if not ahead:
            self.stands()
        return None if self._refused else self._evaluator(campaign, in_full)

    def stands(self) -> bool:
        """Whether the solver confirms the frequencies where they were worst; its run is awaited."""
        if self._confirming is not None:
            (there, run), self._confirming = self._confirming, None
            self._refused = not self._agrees(there, run.result())
        return not self._refused

    def _evaluator(self, campaign: Campaign, in_full: bool = True) -> Evaluator:
        """The evaluator's cases on the ranges, as this campaign compares them or judges by them."""
        pairs = zip(self.evaluator.used, self._finders, strict=True)
        named = {pair[0].case.name: pair for pair in pairs}
        states = [*self.evaluator.aside]
        states += [
            replace(
                state,
                case=case,
                campaign=campaign.alone(case),
                finder=replace(finder, in_full=in_full),
                analysis=ModalAnalysis(state.case.n_modes, state.case.nodes),
            )
            for case in campaign.cases
            if case.name in named
            for state, finder in [named[case.name]]
        ]
        return Evaluator(campaign, states, self.evaluator.execution)

    def _asked(self, around: Evaluation) -> bool:
        """Whether the solver can be asked about the frequencies where they were worst; it is."""
        place = max(range(len(self._finders)), key=lambda n: self._finders[n].range.errors[-1])
        finder, state = self._finders[place], self.evaluator.used[place]
        theta = around.theta.copy()
        theta[state.columns] = finder.worst
        (there,) = self._evaluator(self.evaluator.campaign).points("range", theta[None], [around])
        for item in self._finders:
            item.tally.sets = item.tally.in_full = 0
        if not isinstance(there, Evaluation):
            logger.info("the reduced model cannot be confirmed: %s", there)
            return False
        self._confirming = there, meanwhile("confirm", lambda: self.evaluator.confirmed(0, there))
        return True

    def _agrees(self, there: Evaluation, confirmed: Evaluation | None) -> bool:
        """Whether the solver's frequencies are those of the reduced model."""
        assert confirmed is not None
        apart = float(np.max(np.abs(confirmed.errors - there.errors)))
        if apart > CONFIRMED:
            self.evaluator.refuted(there, apart)
            return False
        names = self.evaluator.campaign.parameters.names
        where = ", ".join(
            f"{n} {value:.4g}" for n, value in zip(names, there.theta.tolist(), strict=True)
        )
        self._confirmed = confirmed.solved_by, apart, where
        return True

    def _made(self, known: Evaluation) -> list[ByRange]:
        """A reduced model between the bounds in each case; none where a case has none."""
        found: list[ByRange] = []
        bounds = self.evaluator.campaign.parameters
        thetas = range_sets(bounds.lower, bounds.upper)
        for state, part in zip(self.evaluator.used, known.parts, strict=True):
            if not isinstance(state.finder, ByMatrices):
                return []
            own = np.array([state.own(theta) for theta in thetas])
            analysis = ModalAnalysis(state.case.n_modes, state.case.nodes)
            self.evaluator.carry_out("range", state.finder.works(part.theta, analysis), state)
            try:
                with doing("range"):
                    modes = state.finder.stored()
                    made = modes.over(part.point, own, analysis, self.asked, self._told)
            except (UnlikeMatrices, ModelError) as error:
                state.finder = state.finder.instead(error)
                return []
            except ModesError as error:
                logger.info("no reduced model between the bounds: %s", error)
                return []
            written = np.array([state.finder.source.written(theta) for theta in own])
            apart = np.abs(written - made[1].solved[-1]).sum(axis=1)
            found.append(ByRange(*made, part, state.finder, own[int(np.argmin(apart))]))
        return found

    def _told(self, solutions: int, error: float) -> None:
        self.evaluator.tell(
            f"reduced model: {solutions} full solutions, error {error:.0e}, asked {self.asked:.0e}"
        )
