"""Where updates from several starts ended: in one place or in several, and which fit as well.

Ends that differ by no more than the measurements leave open (three standard errors; where updating
ended before the least misfit, as if frequencies were measured as loosely as e1 judges them) are one
place. At the least misfit another place fits as well where its misfit is no more above the
answer's than noise makes it in 99 of 100 cases (a chi-square of as many degrees of freedom as
there are parameters), or than a tenth; before the least misfit, where it meets e1 too.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy
from scipy.sparse.csgraph import connected_components

from modetune.core.algebra.eigen import DENSE
from modetune.core.errors import ModelError, ModesError, SolverError
from modetune.core.modes import Floats, Integers
from modetune.core.planning.latin_hypercube import latin_hypercube
from modetune.core.storage.campaign_record import CampaignRecord
from modetune.core.updating.reduced_basis import unreduced
from modetune.core.updating.trust import StartSpread
from modetune.flows.campaign.campaign import Campaign
from modetune.flows.updating.evaluation import CaseEvaluation, Evaluation
from modetune.flows.updating.evaluator import Evaluator
from modetune.flows.updating.loop import ITERATIONS, Foresight, Loop, Silent
from modetune.flows.updating.matrices import MatrixSource, one_thread
from modetune.flows.updating.mode_source import (
    CAMPAIGNS_OWN,
    REDUCED,
    BySolver,
    CaseState,
    ModeFinder,
)
from modetune.flows.updating.reduced_model import ByMatrices, ReducedModes
from modetune.flows.updating.sensitivities import UnlikeMatrices

logger = logging.getLogger(__name__)

#: Standard errors by which two ends may differ and still be one place.
SAME_ERRORS = 3.0
#: ... and the least difference, relative to the deck, that makes two places.
SAME_LEAST = 0.01
#: An end whose misfit is no more than this times the answer's fits as well.
AS_WELL = 1.1
#: ... or that is above it by no more than noise leaves above in this share of all cases.
LEVEL = 0.01
#: Starts in all, the campaign's own among them.
TRIED = 12
#: ... where fewer values are left to judge by than there are parameters: second answers that fit
#: are common then, and one of a twelfth of the starts is found by 63 others in 99 % of all cases.
MANY = 64


@dataclass(frozen=True, slots=True)
class StartEnd:
    """How the update from one start ended.

    updated: (n_parameters,), None where it failed; least: whether that is the least misfit; error:
    that broke it off; record: None where it never got to one; by: what it was found by, where not
    by the campaign's own modes.
    """

    start: Floats
    updated: Floats | None = None
    misfit: float = np.inf
    status: str = ""
    least: bool = False
    error: SolverError | ModesError | None = None
    record: CampaignRecord | None = None
    by: str = ""

    @property
    def outcome(self) -> str:
        if self.updated is None:
            return f"failed: {str(self.error).splitlines()[0]}"
        return f"{self.status} ({self.by})" if self.by else self.status

    @property
    def rank(self) -> tuple[int, float]:
        """Lowest first: those that meet e1, those that ended, by their misfit."""
        if self.updated is None:
            return 2, np.inf
        return int(self.status != "converged"), self.misfit

    def fits_as_well(self, answer: StartEnd) -> bool:
        """Whether it fits the test as well as the answer."""
        if self.updated is None or answer.updated is None:
            return False
        if self.least and answer.least:
            noise = float(scipy.special.chdtri(self.updated.size, LEVEL))
            return self.misfit <= max(AS_WELL * answer.misfit, answer.misfit + noise)
        if self.rank[0] == 0 or answer.rank[0] == 0:
            return self.rank[0] == answer.rank[0]
        return self.misfit <= AS_WELL * answer.misfit


@dataclass(slots=True)
class StartEnds:
    """How the updates from several starts ended, the campaign's own first; more may join them.

    tolerated: (n_parameters,), by how much values may differ in one place.
    """

    ends: list[StartEnd]
    tolerated: Floats

    @property
    def updated(self) -> Floats:
        """(n_starts, n_parameters), NaN where an update failed."""
        none = np.full(self.tolerated.size, np.nan)
        return np.array([none if end.updated is None else end.updated for end in self.ends])

    def places(self, chosen: int = 0) -> Integers:
        """Number of the place of each end, 0 being that of the chosen one; -1 where it failed."""
        ranks = [end.rank for end in self.ends]
        ended = np.flatnonzero([rank[0] < 2 for rank in ranks])
        scaled = self.updated[ended] / self.tolerated
        apart = np.abs(np.nan_to_num(scaled[:, None] - scaled)).max(axis=2)
        _, labels = connected_components(apart <= 1.0, directed=False)
        order = sorted(range(ended.size), key=lambda n: (ended[n] != chosen, ranks[int(ended[n])]))
        names = {
            label: number
            for number, label in enumerate(dict.fromkeys(int(labels[place]) for place in order))
        }
        minima = np.full(len(ranks), -1, dtype=np.int64)
        minima[ended] = [names[int(label)] for label in labels]
        return minima


def end_of(start: Floats, record: CampaignRecord) -> StartEnd:
    """The end of a start whose update has a record."""
    least = record.trust is not None and record.trust.ended == "least misfit"
    return StartEnd(
        start, record.updated, record.best.residual.misfit, record.status, least, record=record
    )


def drawn_starts(campaign: Campaign, n: int) -> Floats:
    """The campaign's own start and others, (n, n_parameters): a Latin hypercube within the bounds,
    with one stratum for each in every parameter."""
    parameters, seed = campaign.parameters, campaign.update.seed
    draws = latin_hypercube(n - 1, len(parameters), np.random.default_rng(seed))
    others = parameters.lower + draws * (parameters.upper - parameters.lower)
    return np.vstack([campaign.start, others])


def chosen_end(ends: Sequence[StartEnd]) -> int:
    """Which end is the answer. Raises the first start's error where all failed."""
    chosen = min(range(len(ends)), key=lambda number: ends[number].rank)
    if ends[chosen].updated is None:
        raise next(end.error for end in ends if end.error is not None)
    return chosen


def start_spread(campaign: Campaign, found: StartEnds, chosen: int) -> StartSpread:
    """Where the updates ended, and what fits as well as the answer.

    chosen: the end that is the answer, unless the campaign's own start led to the same place.
    """
    ends, updated, minima = found.ends, found.updated, found.places(chosen)
    if minima[0] == 0 and ends[0].rank[0] == ends[chosen].rank[0]:
        chosen = 0  # the same place: the campaign's own start leads there too
    rivals, differ = [], set()
    for number, end in enumerate(ends):
        if minima[number] > 0 and end.fits_as_well(ends[chosen]):
            rivals.append(int(minima[number]))
            apart = np.abs(updated[number] - updated[chosen]) > found.tolerated
            differ |= set(np.flatnonzero(apart).tolist())
    return StartSpread(
        starts=np.stack([end.start for end in ends]),
        updated=updated,
        misfits=np.array([np.nan if end.updated is None else end.misfit for end in ends]),
        outcomes=tuple(end.outcome for end in ends),
        minima=minima,
        rivals=tuple(sorted(set(rivals))),
        differ=tuple(campaign.parameters.names[place] for place in sorted(differ)),
        chosen=chosen,
        seed=campaign.update.seed,
    )


def tolerated(campaign: Campaign, answer: CampaignRecord) -> Floats:
    """By how much parameters (n_parameters,) may differ in one place.

    Where updating ended as soon as e1 was met, its ends scatter as if frequencies were measured as
    loosely as e1 judges them.
    """
    loose = 1.0
    if answer.trust is None or answer.trust.ended != "least misfit":
        weighting, asked = campaign.weighting, campaign.tolerances.frequency
        known = weighting.frequency_deviations[weighting.frequencies_used]
        loose = asked / float(known.min(initial=asked))
    errors = SAME_ERRORS * loose * answer.standard_errors
    return np.asarray(np.fmax(SAME_LEAST, errors))


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

    def __init__(
        self, campaign: Campaign, evaluator: Evaluator, foresight: Foresight | None
    ) -> None:
        self.campaign = campaign
        self.evaluator = evaluator
        self.foresight = foresight
        #: The cases on the newest reduced models, and where these led so far, by start.
        self._states: list[CaseState] = []
        self._known: dict[bytes, StartEnd] = {}

    def seek(self, record: CampaignRecord) -> None:
        """What `tried` will want of reduced models that are there, before the solver has confirmed
        where the update ended."""
        states = [] if self.foresight is None else self.foresight.states
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
        foresight = self.foresight
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
        if self.foresight is not None:
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
        foresight = self.foresight if evaluator is self.evaluator else None
        if by:
            update = update.model_copy(update={"max_iterations": ITERATIONS})
        inner = replace(self.campaign, begin=tuple(begin.tolist()), update=update)
        try:
            end = Loop(inner, evaluator, Silent(), confirms=False, foresight=foresight).run()
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
        return state.finder.around(part, state.analysis)
    if not isinstance(state.finder, BySolver):
        return state.finder
    source = MatrixSource(state.engine, state.campaign.parameters, state.campaign.sensitivity.step)
    given = source.matrices(part.theta, range(part.theta.size))
    if given.base.nodes.size > DENSE:
        finder = ByMatrices(state.campaign, state.engine, source, state.finder)
        return finder.around(part, state.analysis)
    modes = part.modal.modes
    seen = state.case.solver.deck.observation(given.base, modes.nodes, modes.components)
    return ReducedModes(unreduced(given, _shift(part), seen.matrix), part, part.key)


def _shift(part: CaseEvaluation) -> float:
    """Below the spectrum by a tenth of the first elastic eigenvalue, (rad/s)^2."""
    return -0.1 * float(part.modal.eigenvalues[part.modal.n_rigid])


def _worth_a_look(found: StartEnds, every: bool = False) -> list[int]:
    """Return places other than the update's that seem to fit as well or better, or all."""
    own = found.ends[0]
    return sorted(
        {
            at
            for end, at in zip(found.ends, found.places(), strict=True)
            if at > 0 and (every or end.fits_as_well(own) or end.rank < own.rank)
        }
    )
