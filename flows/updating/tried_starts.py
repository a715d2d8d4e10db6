"""Other starts where sets cost little: those that were asked for, and some without being asked.

Once an update has ended its parameters are sought from other starts within the bounds too, on the
model itself where it is small matrices, else on reduced models around the answer: milliseconds a
set. What they find elsewhere that fits as well, or better, is then updated with the campaign's own
modes, and only what holds there is told. Of starts that were asked for so is whatever they find
elsewhere, and where they fail: far from the answer a reduced model may err by more than the test.
One that is made there is as good there as the other is at the answer: where the two lead back to
that one after the other, this is the end.
A better place becomes the answer, which the solver confirms as it does any other; where matrices
stand in for its modes it was asked about them at the update's own end.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace

from modetune.core.algebra.eigen import DENSE
from modetune.core.errors import ModelError, ModesError, SolverError
from modetune.core.modes import Floats
from modetune.core.storage.record import CampaignRecord
from modetune.core.updating.reduced_basis import unreduced
from modetune.core.updating.trust import StartSpread
from modetune.flows.campaign.campaign import Campaign
from modetune.flows.updating.asked import CaseState
from modetune.flows.updating.by_matrices import ByMatrices, ByReduced
from modetune.flows.updating.evaluation import CaseEvaluation, Evaluation
from modetune.flows.updating.evaluator import Evaluator
from modetune.flows.updating.finders import CAMPAIGNS_OWN, REDUCED, BySolver, ModeFinder
from modetune.flows.updating.foresight import ITERATIONS, Unnoted
from modetune.flows.updating.loop import Loop
from modetune.flows.updating.matrix_source import MatrixSource
from modetune.flows.updating.semi_analytic import UnlikeMatrices
from modetune.flows.updating.small_matrices import one_thread
from modetune.flows.updating.start_ends import (
    StartEnd,
    StartEnds,
    drawn_starts,
    end_of,
    start_spread,
    tolerated,
)

logger = logging.getLogger(__name__)

#: Starts in all, the campaign's own among them.
TRIED = 12
#: ... where fewer values are left to judge by than there are parameters: second answers that fit
#: are common then, and one of a twelfth of the starts is found by 63 others in 99 % of all cases.
MANY = 64


@dataclass(frozen=True, slots=True)
class TriedStarts:
    """What other starts led to; the first end is the campaign's own."""

    campaign: Campaign
    ends: tuple[StartEnd, ...]
    chosen: int

    @property
    def better(self) -> Floats:
        """The end of the chosen start, (n_parameters,)."""
        updated = self.ends[self.chosen].updated
        assert updated is not None
        return updated

    def spread(self, answer: CampaignRecord) -> StartSpread:
        """Where they ended, answer being the record of what was chosen."""
        ends = list(self.ends)
        own = end_of(ends[self.chosen].start, answer)
        ends[self.chosen] = replace(ends[self.chosen], updated=own.updated, misfit=own.misfit)
        return start_spread(
            self.campaign, StartEnds(ends, tolerated(self.campaign, answer)), self.chosen
        )


class OtherStarts:
    """The search from other starts of a campaign, whose update the evaluator serves."""

    def __init__(self, campaign: Campaign, evaluator: Evaluator) -> None:
        self.campaign = campaign
        self.evaluator = evaluator
        #: The cases on the newest reduced models, and where these led so far, by start.
        self._states: list[CaseState] = []
        self._known: dict[bytes, StartEnd] = {}

    def seek(self, record: CampaignRecord) -> None:
        """What `tried` will want of reduced models that are there, before the solver has confirmed
        where the update ended."""
        states = [] if self.evaluator.foresight is None else self.evaluator.foresight.states
        if states and self._wanted(record):
            self._ends_on(states, record)

    def tried(self, record: CampaignRecord, last: Evaluation) -> TriedStarts | None:
        """Seek the parameters from other starts after an update has ended.

        record: of the update; last: the evaluation it ended on. None where sets cost too much, the
        iterations are used up, or the campaign asks for one start alone.
        """
        if not self._wanted(record):
            return None
        asked = self.campaign.update.starts
        states = self._reduced_states(last) if self.evaluator.sets_cost_little else []
        if not states:
            return None
        found = self._ends_on(states, record)
        ends = found.ends
        if asked:
            ends[:] = [
                self._updated(self.evaluator, end.start, end.start) if end.updated is None else end
                for end in ends
            ]
        for place in _worth_a_look(found, every=asked is not None):
            members = [n for n, at in enumerate(found.places()) if at == place]
            best = min(members, key=lambda n: ends[n].rank)
            looked = self._looked_at(ends[best], found, last)
            for n in members:
                ends[n] = replace(looked, start=ends[n].start)
        chosen = min(range(len(ends)), key=lambda n: ends[n].rank)
        if ends[0].fits_as_well(ends[chosen]):
            chosen = 0
        return TriedStarts(self.campaign, tuple(ends), chosen)

    def _wanted(self, record: CampaignRecord) -> bool:
        update = self.campaign.update
        ended = record.status != "max_iterations" and update.max_iterations > 0
        return update.starts != 1 and bool(ended or update.starts)

    def _ends_on(self, states: list[CaseState], record: CampaignRecord) -> StartEnds:
        """The campaign's own end and where reduced models lead from others."""
        if self._states is not states:
            self._states, self._known = states, {}
        campaign, asked = self.campaign, self.campaign.update.starts
        scarce = record.trust is None or record.trust.freedom < len(campaign.parameters)
        starts = drawn_starts(campaign, asked or (MANY if scarce else TRIED))
        found = StartEnds([end_of(starts[0], record)], tolerated(campaign, record))
        inner = self._on(states)
        with one_thread():
            for start in starts[1:]:
                mark = start.tobytes()
                if mark not in self._known:
                    self._known[mark] = self._updated(inner, start, start, REDUCED)
                found.ends.append(self._known[mark])
                if not asked and len(found.ends) >= TRIED and _worth_a_look(found):
                    break
        return found

    def _reduced_states(self, last: Evaluation) -> list[CaseState]:
        """The cases on models of a few unknowns; none where one of them has no such model.

        Matrices are solved whole where they are few, else reduced around an evaluation; where modes
        come from stored matrices the newest reduced models are at hand, once a step was taken. For
        starts that were asked for they are made where they are not.
        """
        foresight = self.evaluator.foresight
        if foresight is None:
            return _reduced_around(self.evaluator, last)
        if foresight.states or not self.campaign.update.starts:
            return foresight.states
        # The solver's own, which confirmed it, have no more modes than are compared.
        return _reduced_around(self.evaluator, _in_full(self.evaluator, last.theta, last))

    def _looked_at(self, found: StartEnd, beside: StartEnds, known: Evaluation) -> StartEnd:
        """Where updating ends from what reduced models around the answer found elsewhere."""
        assert found.updated is not None
        begin = found.updated
        if self.evaluator.foresight is not None:
            try:
                there = _in_full(self.evaluator, begin, known)
                states = _reduced_around(self.evaluator, there)
            except (SolverError, ModesError) as error:
                if isinstance(error, CAMPAIGNS_OWN):
                    raise
                states = []
            if states:
                with one_thread():
                    end = self._updated(self._on(states), found.start, begin, REDUCED)
                    begin = begin if end.updated is None else end.updated
                    end = self._updated(self._on(self._states), found.start, begin, REDUCED)
                if StartEnds([beside.ends[0], end], beside.tolerated).places()[1] == 0:
                    return end
        return self._updated(self.evaluator, found.start, begin)

    def _on(self, states: list[CaseState]) -> Evaluator:
        """What evaluates sets on reduced models."""
        return Evaluator(self.campaign, states, self.evaluator.execution)

    def _updated(
        self, evaluator: Evaluator, start: Floats, begin: Floats, by: str = ""
    ) -> StartEnd:
        """Where updating ends from a set."""
        update = self.campaign.update
        if by:
            update = update.model_copy(update={"max_iterations": ITERATIONS})
        inner = replace(self.campaign, begin=tuple(begin.tolist()), update=update)
        try:
            end = Loop(inner, evaluator, Unnoted(), confirms=False).run()
        except (SolverError, ModesError) as error:
            if isinstance(error, CAMPAIGNS_OWN):
                raise
            return StartEnd(start, error=error)
        least = end.status in ("converged", "stationary")
        misfit = end.last.residual.misfit
        return StartEnd(start, end.last.theta, misfit, end.status, least, by=by)


def _in_full(evaluator: Evaluator, theta: Floats, known: Evaluation) -> Evaluation:
    """A set by the campaign's own modes. Raises what keeps it from having any."""
    (found,) = evaluator.points("starts", theta[None], [known])
    if not isinstance(found, Evaluation):
        raise found
    return found


def _reduced_around(evaluator: Evaluator, last: Evaluation) -> list[CaseState]:
    """The evaluator's cases on models of few unknowns around an evaluation; none where a case has
    no such model."""
    states = []
    for state, part in zip(evaluator.used, last.parts, strict=True):
        try:
            finder = _reduced(state, part)
        except (UnlikeMatrices, ModelError, ModesError) as error:
            logger.info("no other starts are tried: %s", error)
            return []
        states.append(replace(state, case=replace(state.case, held_out=None), finder=finder))
    return states


def _reduced(state: CaseState, part: CaseEvaluation) -> ModeFinder:
    """Modes of a model of matrices: of all unknowns where they are few, else reduced."""
    if isinstance(state.finder, ByMatrices):
        return ByReduced(state.finder.stored().reduced(part.point, state.analysis), part)
    if not isinstance(state.finder, BySolver):
        return state.finder
    source = MatrixSource(state.engine, state.campaign.parameters, state.campaign.sensitivity.step)
    given = source.matrices(part.theta, range(part.theta.size))
    if given.base.nodes.size > DENSE:
        finder = ByMatrices(state.campaign, state.engine, source, state.finder)
        return ByReduced(finder.stored().reduced(part.point, state.analysis), part)
    modes = part.modal.modes
    seen = state.case.solver.deck.observation(given.base, modes.nodes, modes.components)
    return ByReduced(unreduced(given, _shift(part), seen.matrix), part)


def _shift(part: CaseEvaluation) -> float:
    """Below the spectrum by a tenth of the first elastic eigenvalue, (rad/s)^2."""
    return -0.1 * float(part.modal.eigenvalues[part.modal.n_rigid])


def _worth_a_look(found: StartEnds, every: bool = False) -> list[int]:
    """Places beside the update's own that seem to fit as well, or better, or every one."""
    own = found.ends[0]
    return sorted(
        {
            at
            for end, at in zip(found.ends, found.places(), strict=True)
            if at > 0 and (every or end.fits_as_well(own) or end.rank < own.rank)
        }
    )
