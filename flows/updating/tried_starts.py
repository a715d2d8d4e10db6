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
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

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
    drawn_starts,
    end_of,
    places,
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
        return start_spread(self.campaign, ends, self.chosen, tolerated(self.campaign, answer))


@dataclass(slots=True)
class Sought:
    """Where reduced models led from other starts so far, by start; states: the cases on them."""

    states: list[CaseState] = field(default_factory=list)
    ends: dict[bytes, StartEnd] = field(default_factory=dict)


def seek_starts(
    campaign: Campaign, evaluator: Evaluator, record: CampaignRecord, sought: Sought
) -> None:
    """What `try_starts` will want of reduced models that are there, before the solver has confirmed
    where the update ended."""
    states = [] if evaluator.foresight is None else evaluator.foresight.states
    if states and _wanted(campaign, record):
        _ends_on(states, campaign, evaluator, record, sought)


def try_starts(
    campaign: Campaign,
    evaluator: Evaluator,
    record: CampaignRecord,
    last: Evaluation,
    sought: Sought,
) -> TriedStarts | None:
    """Seek the parameters from other starts after an update has ended.

    record: of the update; last: the evaluation it ended on; sought: what is known already. None
    where sets cost too much, the iterations are used up, or the campaign asks for one start alone.
    """
    if not _wanted(campaign, record):
        return None
    asked = campaign.update.starts
    states = reduced_states(evaluator, last, asked) if evaluator.sets_cost_little else []
    if not states:
        return None
    inner = Evaluator(campaign, states, evaluator.execution, evaluator.ledger)
    ends, allowed = _ends_on(states, campaign, evaluator, record, sought)
    starts = [end.start for end in ends]
    if asked:
        ends = [
            _updated(campaign, evaluator, end.start, end.start, "") if end.updated is None else end
            for end in ends
        ]
    for place in _worth_a_look(ends, allowed, every=asked is not None):
        members = [n for n, at in enumerate(_places(ends, allowed)) if at == place]
        best = min(members, key=lambda n: ends[n].rank)
        found = ends[best].updated
        assert found is not None
        looked = _looked_at(campaign, evaluator, inner, starts[best], found, last, ends[0], allowed)
        for n in members:
            ends[n] = replace(looked, start=starts[n])
    chosen = min(range(len(ends)), key=lambda n: ends[n].rank)
    if ends[0].fits_as_well(ends[chosen]):
        chosen = 0
    return TriedStarts(campaign, tuple(ends), chosen)


def _wanted(campaign: Campaign, record: CampaignRecord) -> bool:
    asked = campaign.update.starts
    ended = record.status != "max_iterations" and campaign.update.max_iterations > 0
    return asked != 1 and bool(ended or asked)


def _ends_on(
    states: list[CaseState],
    campaign: Campaign,
    evaluator: Evaluator,
    record: CampaignRecord,
    sought: Sought,
) -> tuple[list[StartEnd], Floats]:
    """The campaign's own end and where reduced models lead from others, and by how much values
    may differ in one place, (n_parameters,)."""
    if sought.states is not states:
        sought.states, sought.ends = states, {}
    asked = campaign.update.starts
    scarce = record.trust is None or record.trust.freedom < len(campaign.parameters)
    starts = drawn_starts(campaign, asked or (MANY if scarce else TRIED))
    ends, allowed = [end_of(starts[0], record)], tolerated(campaign, record)
    inner = Evaluator(campaign, states, evaluator.execution, evaluator.ledger)
    with one_thread():
        for start in starts[1:]:
            mark = start.tobytes()
            if mark not in sought.ends:
                sought.ends[mark] = _updated(campaign, inner, start, start, REDUCED)
            ends.append(sought.ends[mark])
            if not asked and len(ends) >= TRIED and _worth_a_look(ends, allowed):
                break
    return ends, allowed


def reduced_states(
    evaluator: Evaluator, last: Evaluation, asked: int | None = None
) -> list[CaseState]:
    """The evaluator's cases on models of a few unknowns; none where one of them has no such model.

    Matrices are solved whole where they are few, else reduced around an evaluation; where modes
    come from stored matrices the newest reduced models are at hand, once a step was taken. asked:
    how many starts were asked for, for which they are made where they are not.
    """
    if evaluator.foresight is not None:
        if evaluator.foresight.states or not asked:
            return evaluator.foresight.states
        # The solver's own, which confirmed it, have no more modes than are compared.
        last = _in_full(evaluator, last.theta, last)
    return _reduced_around(evaluator, last)


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


def _looked_at(
    campaign: Campaign,
    evaluator: Evaluator,
    inner: Evaluator,
    start: Floats,
    found: Floats,
    known: Evaluation,
    own: StartEnd,
    allowed: Floats,
) -> StartEnd:
    """Where updating ends from what reduced models around the answer (inner) found elsewhere."""
    if evaluator.foresight is not None:
        try:
            states = _reduced_around(evaluator, _in_full(evaluator, found, known))
        except (SolverError, ModesError) as error:
            if isinstance(error, CAMPAIGNS_OWN):
                raise
            states = []
        beside = Evaluator(campaign, states, evaluator.execution, evaluator.ledger)
        for each in (beside, inner) if states else ():
            with one_thread():
                end = _updated(campaign, each, start, found, REDUCED)
            if each is inner and _places([own, end], allowed)[1] == 0:
                return end
            if each is beside and end.updated is not None:
                found = end.updated
    return _updated(campaign, evaluator, start, found, "")


def _updated(
    campaign: Campaign, evaluator: Evaluator, start: Floats, begin: Floats, by: str
) -> StartEnd:
    """Where updating ends from a set."""
    update = campaign.update
    if by:
        update = update.model_copy(update={"max_iterations": ITERATIONS})
    inner = replace(campaign, begin=tuple(begin.tolist()), update=update)
    try:
        end = Loop(inner, evaluator, Unnoted(), confirms=False).run()
    except (SolverError, ModesError) as error:
        if isinstance(error, CAMPAIGNS_OWN):
            raise
        return StartEnd(start, error=error)
    least = end.status in ("converged", "stationary")
    misfit = end.last.residual.misfit
    return StartEnd(start, end.last.theta, misfit, end.status, least, by=by)


def _places(ends: Sequence[StartEnd], allowed: Floats) -> list[int]:
    n = allowed.size
    updated = np.array([np.full(n, np.nan) if e.updated is None else e.updated for e in ends])
    return [int(at) for at in places(updated / allowed, [end.rank for end in ends], 0)]


def _worth_a_look(ends: Sequence[StartEnd], allowed: Floats, every: bool = False) -> list[int]:
    """Places beside the update's own that seem to fit as well, or better, or every one."""
    own = ends[0]
    return sorted(
        {
            at
            for end, at in zip(ends, _places(ends, allowed), strict=True)
            if at > 0 and (every or end.fits_as_well(own) or end.rank < own.rank)
        }
    )
