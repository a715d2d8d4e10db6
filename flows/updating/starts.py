"""The search for distinct local minima from several starts, and the choice of the best one.

The starts are the campaign's own and a Latin hypercube within the bounds. Where modes come from
matrices, all searches run on reduced models, in milliseconds a point and without solver runs:

    from each start    run the campaign's loop, then polish its end (`core/updating/minima`)
    at each end        if it is a saddle, search on both sides along its negative curvature
    between ends       one minimum or two: compute the misfit on a relaxed path, pairing modes again
    at the best end    find exchanges of its values with the same misfit

If reduced models find a minimum far from the point that they were made at, its modes are computed
with all unknowns, and the search is repeated with a reduced model made there. Without matrices the
solver runs only the starts that the campaign requests, and the sensitivities at two ends predict
the misfit between them.

**Choice.** The best end has the lowest objective of the campaign, prior included. Within a
difference of 6.6 (chi-square, 1 degree of freedom, 1 %; multiplied by the ratio of the remaining
misfit to noise) an end that meets e1 comes first, then the one with the lower misfit of all
measured frequencies and shapes, each at its deviation, even if its weight is zero.
"""

from __future__ import annotations

import hashlib
import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import TypeVar

import numpy as np

from modetune.core.algebra.eigen import DENSE
from modetune.core.correlation.pairing import Pairing
from modetune.core.errors import ModelError, ModesError, NotComputed, SolverError
from modetune.core.modes import Floats, Integers
from modetune.core.planning.latin_hypercube import latin_hypercube
from modetune.core.storage.campaign_record import CampaignRecord
from modetune.core.storage.keys import Json
from modetune.core.updating.minima import (
    NO_ENDS,
    RISE,
    SAME,
    Misfit,
    MisfitAt,
    SearchEnds,
    beyond_saddle,
    equal,
    exchange,
    exchanges,
    joined,
    minima_of,
    polished,
)
from modetune.core.updating.parameter_steps import breach
from modetune.core.updating.reduced_basis import unreduced
from modetune.core.updating.responses.response import Residual, with_values
from modetune.core.updating.trust import NEGLIGIBLE, StartSpread
from modetune.flows.campaign.campaign import Campaign
from modetune.flows.campaign.matrix_plan import unsuitable
from modetune.flows.updating.evaluation import CaseEvaluation, Evaluation, Matrix
from modetune.flows.updating.evaluator import Evaluator
from modetune.flows.updating.loop import ITERATIONS, Foresight, Loop, Trial, Watcher
from modetune.flows.updating.matrices import MatrixSource
from modetune.flows.updating.mode_source import (
    CAMPAIGNS_OWN,
    REDUCED,
    BySolver,
    CaseState,
    ModeFinder,
)
from modetune.flows.updating.reduced_model import CONFIRMED, ByMatrices, ReducedModes
from modetune.flows.updating.sensitivities import UnlikeMatrices
from modetune.flows.updating.step import objective, objective_slopes

logger = logging.getLogger(__name__)
T = TypeVar("T")

#: The title of the searches' work.
STARTS = "starts"
#: Increase this number when the same models give other ends.
VERSION = 1
#: Number of starts, including the campaign's own.
TRIED = 12
#: ... if there are fewer spare measured values than parameters: other minima are then common, and
#: 63 more starts find one that attracts a twelfth of them in 99 % of all cases.
MANY = 64
#: Number of ends whose curvature is computed.
CURVED = 8
#: Standard errors by which ends of one minimum may differ; if they differ more, it is a valley.
SCATTER = 3.0
#: Up to this number of elements, stored matrices are used for other starts even if the solver
#: computes the modes: factors of so small a model take seconds and little memory.
SMALL = 10_000
#: Errors of one point that do not stop the campaign.
FAILED = (SolverError, ModesError, ModelError)
#: Kinds of response whose data `data_misfit` takes from the pairs.
OF_PAIRS = ("frequencies", "shapes", "mac")


@dataclass(frozen=True, slots=True)
class StartEnd:
    """The end of a search.

    start: (n_parameters,), NaN if the search began at another end. updated: (n_parameters,), None
    if it failed. misfit: the campaign's objective. data_misfit: chi-square of all measured data.
    agrees: e1 is met. saddle: a saddle, from which other searches continued. evaluation: on reduced
    models. record: of an update by the solver.
    """

    start: Floats
    updated: Floats | None = None
    misfit: float = np.inf
    data_misfit: float = np.inf
    agrees: bool = False
    outcome: str = ""
    saddle: bool = False
    error: SolverError | ModesError | ModelError | None = None
    evaluation: Evaluation | None = None
    record: CampaignRecord | None = None

    @property
    def place(self) -> Floats:
        """Return the logarithms of the updated values, (n_parameters,)."""
        assert self.updated is not None
        return np.asarray(np.log(self.updated))


def failed(start: Floats, error: SolverError | ModesError | ModelError) -> StartEnd:
    """Return the end of a search that failed."""
    return StartEnd(start, error=error, outcome=f"failed: {str(error).splitlines()[0]}")


def end_of(campaign: Campaign, start: Floats, record: CampaignRecord) -> StartEnd:
    """Return the end of an update from its record, with its minimum misfit by linear estimate."""
    best, slopes = record.best, _last_sensitivity(record)
    here = objective(campaign, record.updated, best.residual, _factor(record))
    if record.trust is not None and slopes.size:
        ahead = with_values(best.residual, best.residual.values - slopes @ record.trust.remaining)
        there = record.updated + record.trust.remaining
        here = min(here, objective(campaign, there, ahead, _factor(record)))
    return StartEnd(
        start,
        record.updated,
        here,
        data_misfit(campaign, best.frequency_errors, best.pairing, best.residual),
        record.status == "converged",
        record.status,
        record=record,
    )


def data_misfit(campaign: Campaign, errors: Floats, pairing: Pairing, residual: Residual) -> float:
    """Return the chi-square of all measured data of the pairs, each at its deviation.

    errors: (n_pairs,), relative, of frequencies. A shape of n entries whose deviation is s
    contributes n (1 - MAC) / s^2. Other responses contribute what is used of them.
    """
    test, measured = campaign.test.modes, pairing.measured
    own = campaign.weighting.modes(measured)
    total = float(np.sum((errors / own.frequency_deviations) ** 2))
    mac = pairing.judged_mac
    seen = np.isfinite(mac)
    entries = np.count_nonzero(test.mode_shapes[:, measured[seen]], axis=0)
    total += float(np.sum(entries * (1.0 - mac[seen]) / own.shape_deviations[seen] ** 2))
    kinds = [np.full(block.size, block.kind in OF_PAIRS) for block in residual.blocks]
    others = ~np.concatenate([np.zeros(0, dtype=bool), *kinds])
    squares = residual.potential * residual.independent(residual.values) ** 2
    return total + float(squares[others].sum())


def drawn_starts(campaign: Campaign, n: int) -> Floats:
    """Return n starts, (n, n_parameters): the campaign's own, then a Latin hypercube in the bounds.

    Each of the others has its own stratum in every parameter.
    """
    parameters, seed = campaign.parameters, campaign.update.seed
    draws = latin_hypercube(n - 1, len(parameters), np.random.default_rng(seed))
    others = parameters.lower + draws * (parameters.upper - parameters.lower)
    return np.vstack([campaign.start, others])


def best_end(ends: Sequence[StartEnd]) -> int:
    """Return the position of the best end, preferring the first if it is as good.

    Raises the first error if all searches failed.
    """
    lowest = min(end.misfit for end in ends)
    if not np.isfinite(lowest):
        raise next(end.error for end in ends if end.error is not None)
    rise = RISE * _times_noise(min(ends, key=lambda end: end.misfit))
    near = [n for n, end in enumerate(ends) if end.misfit <= lowest + rise and not end.saddle]
    agreeing = [n for n in near if ends[n].agrees] or near
    least = min(ends[n].data_misfit for n in agreeing)
    # Ignore differences below the accuracy of reduced models.
    alike = [n for n in agreeing if ends[n].data_misfit <= least + 0.1 + 1e-3 * least]
    return 0 if 0 in alike else min(alike, key=lambda n: ends[n].misfit)


def _times_noise(best: StartEnd) -> float:
    """Return the ratio of the remaining misfit to measurement noise at the best end, at least 1.

    A modelling error makes differences between misfits less significant by this ratio (Birge).
    """
    found = best.record.best if best.record is not None else best.evaluation
    if found is None or best.updated is None:
        return 1.0
    freedom = found.residual.n_independent - best.updated.size
    return max(1.0, best.data_misfit / freedom) if freedom > 0 else 1.0


@dataclass(frozen=True, slots=True)
class FoundMinima:
    """The ends of all searches and their minima.

    The first `n_starts` ends belong to the starts, the campaign's own first; the others come from
    saddles or exchanges. labels: (n_ends,), the number of each end's minimum in order of misfit, -1
    for none. moves: the best end differs from the end of the campaign's own update.
    """

    campaign: Campaign
    ends: tuple[StartEnd, ...]
    n_starts: int
    labels: Integers
    chosen: int
    moves: bool

    @classmethod
    def of(cls, campaign: Campaign, kept: SearchEnds) -> FoundMinima:
        """Return what `kept` keeps."""
        lost = np.isnan(kept.updated).any(axis=1)
        ends = tuple(
            StartEnd(start, None if gone else updated, float(misfit), outcome=outcome)
            for start, updated, misfit, outcome, gone in zip(
                kept.starts, kept.updated, kept.misfits, kept.outcomes, lost, strict=True
            )
        )
        return cls(campaign, ends, kept.n_starts, kept.labels, kept.chosen, kept.moves)

    @property
    def kept(self) -> SearchEnds:
        """Return what the record and later runs need of them."""
        none = np.full(len(self.campaign.parameters), np.nan)
        return SearchEnds(
            starts=np.array([end.start for end in self.ends]),
            updated=np.array([none if end.updated is None else end.updated for end in self.ends]),
            misfits=np.array([end.misfit for end in self.ends]),
            outcomes=tuple(end.outcome for end in self.ends),
            labels=self.labels,
            n_starts=self.n_starts,
            chosen=self.chosen,
            moves=self.moves,
        )

    @property
    def better(self) -> Floats:
        """Return the parameters of the best end, (n_parameters,)."""
        updated = self.ends[self.chosen].updated
        assert updated is not None
        return updated

    def spread(self, answer: CampaignRecord) -> StartSpread:
        """Return the summary of all ends for the record of the answer."""
        ends, chosen, labels = list(self.ends), self.chosen, self.labels
        names = np.array(self.campaign.parameters.names)
        own = replace(ends[chosen], updated=answer.updated)
        ends[chosen] = own
        none = np.full(names.size, np.nan)
        updated = np.array([none if end.updated is None else end.updated for end in ends])
        # The answer's minimum is the first.
        order = [labels[chosen], *(n for n in range(labels.max() + 1) if n != labels[chosen])]
        minima = np.array([order.index(label) if label >= 0 else -1 for label in labels])
        good = np.array([end.misfit <= own.misfit + RISE for end in ends])
        errors = np.where(np.isfinite(answer.standard_errors), answer.standard_errors, 0.0)
        apart = np.maximum(NEGLIGIBLE, SCATTER * errors)
        valley = updated[good & (minima == 0)]
        extent = np.vstack([valley.min(axis=0), valley.max(axis=0)])
        rivals, exchanged, differ = [], [], np.zeros(names.size, dtype=bool)
        for number in range(1, minima.max() + 1):
            members = np.flatnonzero(good & (minima == number))
            if members.size == 0:
                continue
            rivals.append(number)
            there = ends[int(members[0])]
            differ |= np.abs(updated[members[0]] - own.updated) > NEGLIGIBLE
            if exchange(own.place, there.place) is not None and _alike(own, there):
                exchanged.append(number)
        return StartSpread(
            starts=np.stack([end.start for end in ends]),
            updated=updated,
            misfits=np.array([end.misfit if end.updated is not None else np.nan for end in ends]),
            outcomes=tuple(end.outcome for end in ends),
            minima=minima.astype(np.int64),
            rivals=tuple(rivals),
            differ=tuple(names[differ].tolist()),
            chosen=chosen,
            seed=self.campaign.update.seed,
            n_starts=self.n_starts,
            exchanged=tuple(exchanged),
            extent=extent,
            valley=tuple(names[extent[1] - extent[0] > apart].tolist()),
        )


def _alike(one: StartEnd, other: StartEnd) -> bool:
    """Return whether two misfits are equal within the accuracy of reduced models and updating."""
    return abs(one.misfit - other.misfit) <= 0.1 + 1e-3 * one.misfit


def minima_by_slopes(campaign: Campaign, ends: Sequence[StartEnd]) -> FoundMinima:
    """Return the minima among updates by the solver.

    The sensitivities at two ends predict the misfit between them."""
    chosen = best_end(ends)

    def predicted(one: StartEnd, shares: Floats, way: Floats) -> Floats:
        assert one.record is not None
        found, slopes = one.record.best.residual, _last_sensitivity(one.record)
        rows = found.independent(slopes) @ way
        values = found.independent(found.values)[:, None] - rows[:, None] * shares
        return np.asarray(found.weights @ values**2)

    def one_minimum(first: int, second: int) -> bool:
        a, b = ends[first], ends[second]
        assert a.record is not None
        assert b.record is not None
        if _last_sensitivity(a.record).size == 0 or _last_sensitivity(b.record).size == 0:
            return False
        way, shares = b.record.updated - a.record.updated, np.linspace(0.0, 1.0, 11)
        ahead, back = predicted(a, shares, way), predicted(b, 1.0 - shares, -way)
        between = (1.0 - shares) * ahead + shares * back
        return bool(between.max() <= max(between[0], between[-1]) + RISE)

    places = [end.start if end.updated is None else end.place for end in ends]
    labels = minima_of(places, np.array([end.misfit for end in ends]), one_minimum)
    return FoundMinima(campaign, tuple(ends), len(ends), labels, chosen, chosen > 0)


def _last_sensitivity(record: CampaignRecord) -> Floats:
    """Return the newest sensitivity of a record; empty if its rows are not those of the end."""
    size = record.best.residual.values.size
    had = [item.sensitivity for item in record.iterations if len(item.sensitivity) == size]
    return had[-1] if had and size else np.zeros((0, 0))


def _factor(record: CampaignRecord) -> float:
    """The regularisation of the last step."""
    return record.best.regularisation


class SurrogateMisfit(Misfit):
    """The objective of a campaign on reduced models, over log parameters.

    known: evaluations from which modes are tracked; the pairs with the lowest misfit are used.
    """

    def __init__(
        self, campaign: Campaign, evaluator: Evaluator, factor: float, *known: Evaluation | None
    ) -> None:
        self.campaign, self.evaluator, self.factor, self.known = campaign, evaluator, factor, known
        own = campaign.parameters
        self.lower = np.log(np.maximum(own.lower, np.finfo(np.float64).tiny))
        self.upper = np.log(own.upper)

    def value(self, x: Floats) -> float:
        return self._value(self.evaluation(x))

    def sample(self, x: Floats) -> MisfitAt | None:
        best = self.evaluation(x)
        matrix = best and _unless_failed(partial(self.evaluator.matrix, STARTS, best))
        if not (best and matrix):
            return None
        gradient, curvature = objective_slopes(
            self.campaign, best.theta, best.residual, matrix.values, self.factor
        )
        theta = best.theta
        return MisfitAt(self._value(best), theta * gradient, theta[:, None] * curvature * theta)

    def evaluation(self, x: Floats) -> Evaluation | None:
        """Return the evaluation at a point with the pairs that have the lowest misfit."""
        at = partial(self.evaluator.evaluate, STARTS, np.exp(x), alone=True)
        tried = [_unless_failed(partial(at, previous=before)) for before in self.known]
        return min((item[0] for item in tried if item), key=self._value, default=None)

    def _value(self, found: Evaluation | None) -> float:
        if found is None:
            return np.inf
        return objective(self.campaign, found.theta, found.residual, self.factor)


def _unless_failed(compute: Callable[[], T]) -> T | None:
    """Return what is computed at one point, None if that fails there only."""
    try:
        return compute()
    except CAMPAIGNS_OWN:
        raise
    except FAILED:
        return None


class Lowest(Watcher):
    """The watcher of a loop that keeps the point with the lowest objective."""

    def __init__(self, misfit: SurrogateMisfit) -> None:
        self.misfit = misfit
        self.found: Evaluation | None = None

    def noted(
        self,
        number: int,
        evaluation: Evaluation,
        trial: Trial | None,
        newest: Matrix | None,
        decision: str,
        accepted: bool,
        skipped: bool,
    ) -> None:
        of, broken = (
            self.misfit._value,
            breach(evaluation.residual.values, evaluation.residual.limits),
        )
        if not broken.any() and of(evaluation) < of(self.found):
            self.found = evaluation


class Search:
    """Searches on one set of reduced models.

    states: the cases on them; factor: the regularisation of the campaign's last step.
    """

    def __init__(
        self, campaign: Campaign, states: Sequence[CaseState], like: Evaluator, factor: float
    ) -> None:
        cases = tuple(state.case for state in states)
        update = campaign.update.model_copy(update={"max_iterations": ITERATIONS})
        self.campaign = replace(campaign, update=update, cases=cases)
        self.evaluator = Evaluator(self.campaign, states, like.execution)
        self.factor = factor
        #: The campaign's own end, polished, to which most other searches lead.
        self.own: StartEnd | None = None

    def misfit(self, *known: Evaluation | None) -> SurrogateMisfit:
        return SurrogateMisfit(self.campaign, self.evaluator, self.factor, *known)

    def end(self, start: Floats, begin: Floats) -> StartEnd:
        """Return the end of a search that begins at a point."""
        inner = replace(self.campaign, begin=tuple(begin.tolist()))
        lowest = Lowest(self.misfit(None))
        try:
            status = Loop(inner, self.evaluator, lowest, confirms=False).run().status
        except FAILED as error:
            if isinstance(error, CAMPAIGNS_OWN):
                raise
            if lowest.found is None:
                return failed(start, error)
            status = "lost a mode"
        if lowest.found is None:
            return failed(start, ModesError("no point is within the limits of responses"))
        return self.settled(start, lowest.found, f"{status} ({REDUCED})")

    def settled(self, start: Floats, found: Evaluation, outcome: str) -> StartEnd:
        """Return the polished end near an evaluation."""
        # Without shapes modes may have been tracked to wrong pairs: pair them again as well.
        misfit = self.misfit(found, *((None,) if not self.campaign.test.has_shapes else ()))
        if not np.isfinite(found.residual.limits).any():
            known = None if self.own is None else (self.own.place, self.own.misfit)
            place, _ = polished(misfit, np.log(found.theta), known)
            if self.own is not None and known is not None and place is known[0]:
                return replace(self.own, start=start, outcome=outcome)
            found = misfit.evaluation(place) or found
        return StartEnd(
            start,
            found.theta,
            misfit._value(found),
            data_misfit(self.campaign, found.errors, found.pairing, found.residual),
            found.agrees(self.campaign.tolerances),
            outcome,
            evaluation=found,
        )

    def beyond(self, end: StartEnd, places: Sequence[Floats]) -> list[StartEnd]:
        """Return the ends of searches from points on both sides of a saddle."""
        found = []
        for place in places:
            there = self.end(np.full(place.size, np.nan), np.exp(place))
            if there.misfit < end.misfit - 0.01 - 1e-4 * end.misfit:
                found.append(replace(there, outcome=f"{there.outcome}, from a saddle"))
        return found

    def without_saddles(self, ends: Sequence[StartEnd]) -> list[StartEnd]:
        """Return the ends, with those of searches that continue from saddles.

        A search continues from a high saddle only while no end meets e1.
        """
        ends, curved = list(ends), list[StartEnd]()
        lowest, agrees = min(end.misfit for end in ends), any(end.agrees for end in ends)
        for number, end in enumerate(ends):  # grows
            known = [item for item in curved if _near(item, end)]
            if end.evaluation is None or np.isfinite(end.evaluation.residual.limits).any():
                continue
            if not known and len(curved) < CURVED:
                places = beyond_saddle(self.misfit(end.evaluation), end.place)
                matters = number == 0 or not agrees or end.misfit <= lowest + RISE
                more = self.beyond(end, places) if matters else []
                curved.append(replace(end, saddle=bool(more) or (bool(places) and not matters)))
                known = curved[-1:]
                ends += more
            ends[number] = replace(end, saddle=bool(known) and known[0].saddle)
        return ends

    def with_exchanges(self, ends: Sequence[StartEnd]) -> list[StartEnd]:
        """Return the ends, with exchanges of the best one that no search has found."""
        ends = list(ends)
        best = ends[best_end(ends)]
        if best.evaluation is None:
            return ends
        known = []
        for end in ends:
            order = None if end.updated is None else exchange(best.place, end.place)
            if order is not None and equal(best.misfit, end.misfit) and not _near(end, best):
                known.append(order)
        for place in exchanges(self.misfit(best.evaluation, None), best.place, known):
            found = self.misfit(best.evaluation, None).evaluation(place)
            if found is not None:
                none = np.full(place.size, np.nan)
                there = self.settled(none, found, "exchange of the best values")
                if not any(_near(there, end) for end in ends):
                    ends.append(there)
        return ends

    def one_minimum(self, one: StartEnd, other: StartEnd) -> bool:
        """Return whether two ends belong to one minimum."""
        return joined(self.misfit(one.evaluation, other.evaluation), one.place, other.place)


def _near(one: StartEnd, other: StartEnd) -> bool:
    if one.updated is None or other.updated is None:
        return False
    return float(np.abs(one.place - other.place).max()) <= SAME


class OtherStarts:
    """The search from other starts of a campaign that is being updated with this evaluator."""

    def __init__(
        self, campaign: Campaign, evaluator: Evaluator, foresight: Foresight | None
    ) -> None:
        self.campaign = campaign
        self.evaluator = evaluator
        self.foresight = foresight
        #: The reduced models of the ends below, by start.
        self._states: list[CaseState] = []
        self._ends: dict[bytes, StartEnd] = {}

    def seek(self, record: CampaignRecord, last: Evaluation) -> None:
        """Search on reduced models while the solver confirms the end of the update.

        Arguments are those of `tried`, which finds the same ends without this.
        """
        states = [] if self.foresight is None else self.foresight.states
        if states and self._wanted:
            self._ended(self._search(states, record), states, record, last)

    def tried(self, record: CampaignRecord, last: Evaluation) -> FoundMinima | None:
        """Return the minima after an update has ended; None if there is no search.

        record: of the update; last: its end.
        """
        if not self._wanted:
            return None
        states = self._reduced_states(last)
        if not states:
            return None

        def compute() -> SearchEnds:
            found = self._found(states, record, last)
            return NO_ENDS if found is None else found.kept

        responses = (item for part in last.parts for item in part.responses)
        if any(item.kind == "own" for item in responses):  # a user's function may change
            return self._found(states, record, last)
        try:
            kept = states[0].engine.derived(self._asked(states, record, last), compute, SearchEnds)
        except NotComputed:  # a dry run keeps nothing
            kept = compute()
        return FoundMinima.of(self.campaign, kept) if kept.n_starts else None

    def _asked(self, states: list[CaseState], record: CampaignRecord, last: Evaluation) -> Json:
        """Return what the ends follow from: models, campaign and test, and the update's end."""
        test, residual = self.campaign.test.modes, last.residual
        arrays = [test.frequencies_hz, test.mode_shapes, last.theta, last.errors, residual.values]
        arrays += [residual.weights, residual.limits, self.campaign.start]
        arrays.append(np.array([_factor(record)]))  # NaN before the first step
        numbers = hashlib.sha256(b"".join(np.ascontiguousarray(one).tobytes() for one in arrays))
        models = [item.finder.key for item in states if isinstance(item.finder, ReducedModes)]
        return {
            "ends of searches": VERSION,
            "models": [*models, last.key],
            "campaign": self.campaign.text,
            "settings": list(self.campaign.settings),
            "numbers": numbers.hexdigest(),
            "status": record.status,
            "starts": self._number(record),
        }

    def _found(
        self, states: list[CaseState], record: CampaignRecord, last: Evaluation
    ) -> FoundMinima | None:
        search = self._search(states, record)
        ends = self._ended(search, states, record, last)
        if not ends:
            return None
        own = ends[0]
        n_starts = len(ends)
        ends = search.with_exchanges(search.without_saddles(ends))
        searches = [search] * len(ends)
        labels = self._labels(ends, searches)
        exact = all(isinstance(item.finder, ReducedModes) and item.finder.exact for item in states)
        if not exact and self._looked(ends, searches, labels, last):
            labels = self._labels(ends, searches)
        chosen, converged = best_end(ends), record.status == "converged"
        if converged and labels[chosen] == labels[0]:
            chosen = 0  # good enough: the distance to the minimum is reported
        here = objective(self.campaign, last.theta, last.residual, _factor(record))
        moves = chosen > 0 or (not converged and here > own.misfit + RISE)
        return FoundMinima(self.campaign, tuple(ends), n_starts, labels, chosen, moves)

    @property
    def _wanted(self) -> bool:
        update = self.campaign.update
        return update.starts != 1 and update.max_iterations > 0 and not self.campaign.fields

    def _search(self, states: list[CaseState], record: CampaignRecord) -> Search:
        return Search(self.campaign, states, self.evaluator, _factor(record))

    def _own(self, search: Search, record: CampaignRecord, last: Evaluation) -> StartEnd | None:
        """Return the campaign's own end, polished; None if reduced models do not give its modes."""
        found = search.misfit(last).evaluation(np.log(last.theta))
        if found is None or float(np.max(np.abs(found.errors - last.errors))) > CONFIRMED:
            logger.info("no other starts are tried: matrices differ from the solver's model")
            return None
        return search.settled(self.campaign.start, found, record.status)

    def _ended(
        self, search: Search, states: list[CaseState], record: CampaignRecord, last: Evaluation
    ) -> list[StartEnd]:
        """Return the ends of all starts, the campaign's own first; none without its modes."""
        own = search.own = self._own(search, record, last)
        if own is None:
            return []
        ends = [own, *self._from_starts(search, states, record)]
        if len(ends) == self._number(record):
            return ends
        lowest = min(end.misfit for end in ends)
        others = [end for end in ends if end.misfit <= lowest + RISE and not _near(end, own)]
        if all(search.one_minimum(own, end) for end in others):
            ends = [own, *self._from_starts(search, states, record, every=True)]
        return ends

    def _number(self, record: CampaignRecord) -> int:
        """Return the number of starts."""
        scarce = record.trust is None or record.trust.freedom < len(self.campaign.parameters)
        return self.campaign.update.starts or (MANY if scarce else TRIED)

    def _from_starts(
        self, search: Search, states: list[CaseState], record: CampaignRecord, every: bool = False
    ) -> list[StartEnd]:
        """Return the ends of the starts other than the campaign's own: first a few, then more."""
        if self._states is not states:
            self._states, self._ends = states, {}
        n = self._number(record)
        few = n if every or self.campaign.update.starts else min(n, TRIED)
        starts = drawn_starts(self.campaign, n)[1:few]
        for start in starts:
            if start.tobytes() not in self._ends:
                self._ends[start.tobytes()] = search.end(start, start)
        return [self._ends[start.tobytes()] for start in starts]

    def _labels(self, ends: Sequence[StartEnd], searches: Sequence[Search]) -> Integers:
        """Return the number of each end's minimum."""

        def one_minimum(first: int, second: int) -> bool:
            return searches[max(first, second)].one_minimum(ends[first], ends[second])

        places = [end.start if end.updated is None else end.place for end in ends]
        values = np.array([np.inf if end.saddle else end.misfit for end in ends])
        return minima_of(places, values, one_minimum)

    def _looked(
        self, ends: list[StartEnd], searches: list[Search], labels: Integers, last: Evaluation
    ) -> bool:
        """Search again at other minima that fit as well or better, on models made there.

        Return whether there were any.
        """
        any_looked = False
        for number in range(labels.max() + 1):
            members = [n for n in np.flatnonzero(labels == number).tolist()]
            best = min(members, key=lambda n: ends[n].misfit)
            if number == labels[0] or ends[best].misfit > ends[0].misfit + RISE:
                continue
            any_looked = True
            begin = ends[best].updated
            assert begin is not None
            try:
                there = _in_full(self.evaluator, begin, last)
                states = _reduced_around(self.evaluator, there)
            except FAILED as error:
                if isinstance(error, CAMPAIGNS_OWN):
                    raise
                states = []
            for n in members if not states else ():
                ends[n] = replace(ends[n], misfit=np.inf, outcome="not confirmed by the full model")
            if states:
                search = Search(self.campaign, states, self.evaluator, searches[best].factor)
                looked = search.end(ends[best].start, begin)
                for n in members:
                    ends[n] = replace(looked, start=ends[n].start)
                    searches[n] = search
        return any_looked

    def _reduced_states(self, last: Evaluation) -> list[CaseState]:
        """Return the cases on reduced models; none if a case has no such model.

        Small matrices are solved in full, larger ones are reduced around an evaluation. Where modes
        come from stored matrices, the newest reduced models exist after the first step.
        """
        foresight = self.foresight
        if foresight is None:
            served = all(_served(state) for state in self.evaluator.used)
            return _reduced_around(self.evaluator, last) if served else []
        if foresight.states or not self.campaign.update.starts:
            return foresight.states
        # The solver's confirmation has only the modes that are compared.
        return _reduced_around(self.evaluator, _in_full(self.evaluator, last.theta, last))


def _served(state: CaseState) -> bool:
    """Return whether the store has a case's matrices for all values, so no solver run is needed."""
    finder, solver = state.finder, state.case.solver
    if not isinstance(finder, BySolver) or solver.deck.summary.matrices is not None:
        return True
    parameters = state.campaign.parameters
    every, method = range(len(parameters)), state.campaign.sensitivity.method
    return (
        solver.deck.summary.n_elements <= SMALL
        and unsuitable(solver, parameters.parameters, method) is None
        and finder.source.everywhere
        and not finder.source.jobs(state.campaign.start, every)
    )


def _in_full(evaluator: Evaluator, theta: Floats, known: Evaluation) -> Evaluation:
    """Return a point evaluated with the campaign's own modes. Raises as `Evaluator.evaluate`."""
    (found,) = evaluator.points(STARTS, theta[None], [known])
    if not isinstance(found, Evaluation):
        raise found
    return found


def _reduced_around(evaluator: Evaluator, last: Evaluation) -> list[CaseState]:
    """Return the evaluator's cases on reduced models around an evaluation.

    Empty if a case has no such model."""
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
    """Return the modes of a matrix model: in full if it is small, else from a reduced model."""
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
    whole = unreduced(given, _shift(part), seen.matrix)
    return ReducedModes(whole, part, part.key, exact=True)


def _shift(part: CaseEvaluation) -> float:
    """Return a shift below the spectrum by a tenth of the first elastic eigenvalue, (rad/s)^2."""
    return -0.1 * float(part.modal.eigenvalues[part.modal.n_rigid])
