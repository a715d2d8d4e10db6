"""Where updates from several starts ended: in one place or in several, and which fit as well.

Ends that differ by no more than the measurements leave open (three standard errors; where updating
ended before the least misfit, as if frequencies were measured as loosely as e1 judges them) are one
place. At the least misfit another place fits as well where its misfit is no more above the
answer's than noise makes it in 99 of 100 cases (a chi-square of as many degrees of freedom as
there are parameters), or than a tenth; before the least misfit, where it meets e1 too.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy
from scipy.sparse.csgraph import connected_components

from modetune.core.errors import ModesError, SolverError
from modetune.core.modes import Floats, Integers
from modetune.core.planning.latin_hypercube import latin_hypercube
from modetune.core.storage.record import CampaignRecord
from modetune.core.updating.trust import StartSpread
from modetune.flows.campaign.campaign import Campaign

#: Standard errors by which two ends may differ and still be one place.
SAME_ERRORS = 3.0
#: ... and the least difference, relative to the deck, that makes two places.
SAME_LEAST = 0.01
#: An end whose misfit is no more than this times the answer's fits as well.
AS_WELL = 1.1
#: ... or that is above it by no more than noise leaves above in this share of all cases.
LEVEL = 0.01


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
    so that each has a stratum of its own in every parameter."""
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
