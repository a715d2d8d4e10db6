"""The choice of parameters to update, with a reason for each candidate.

Four questions in turn, so that each candidate has one reason:

1. Does the test depend on it? Over its bounds it must change the responses by more than their
   standard deviation. The root of the sum of squares over the used modes is the parameter's
   *importance*, in standard deviations of the test.
2. Does it duplicate another? Of candidates with collinear weighted sensitivity columns, the one
   with the longest column stays.
3. Does it help? Forward selection takes those that reduce the residual most, until the next would
   gain too little.
4. If a number of parameters was requested, QR with pivoting adds those most independent of the
   chosen ones. It chooses alone if there is no residual to reduce.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from modetune.core.modes import Floats
from modetune.core.updating.subset import (
    COLLINEAR,
    LEAST_GAIN,
    collinear_groups,
    column_cosines,
    forward_selection,
    qr_order,
)

#: Minimum importance, in standard deviations of the test.
LEAST_IMPORTANCE = 1.0
#: Shares below this, 1e-6 %, are printed as 0.
LEAST_SHOWN = 1e-8


@dataclass(frozen=True, slots=True)
class CandidateParameters:
    """What is known of the candidates.

    names; importance: (n_parameters,), standard deviations of the test; loudest: (n_parameters,),
    what each moves most, for people; missing: why a sensitivity was unavailable, empty where it
    was there. weighted: (n_residuals, n_parameters), weighted_residual: (n_residuals,), as
    `core/updating/subset` requires them. lower, upper: (n_parameters,), how far each may move, in
    its standard deviations.
    """

    names: tuple[str, ...]
    importance: Floats
    loudest: tuple[str, ...]
    missing: tuple[str, ...]
    weighted: Floats
    weighted_residual: Floats
    lower: Floats
    upper: Floats


@dataclass(frozen=True, slots=True)
class ParameterVerdict:
    """The outcome for a candidate. rank: place among the chosen from 1, 0 if rejected."""

    name: str
    rank: int
    reason: str

    @property
    def chosen(self) -> bool:
        return self.rank > 0


@dataclass(frozen=True, slots=True)
class ChosenParameters:
    """A verdict a candidate in the campaign's order, and what led to them.

    ranking: (n_parameters,), positions by importance. groups: positions of collinear columns.
    misfits: (n_chosen + 1,), what is left of the residual before and after each that forward
    selection chose, as share of the first.
    """

    verdicts: tuple[ParameterVerdict, ...]
    ranking: tuple[int, ...]
    groups: tuple[tuple[int, ...], ...]
    misfits: tuple[float, ...]

    @property
    def chosen(self) -> tuple[str, ...]:
        """Names of the chosen parameters in the order in which they were chosen."""
        chosen = [verdict for verdict in self.verdicts if verdict.chosen]
        return tuple(item.name for item in sorted(chosen, key=lambda item: item.rank))


def choose_parameters(candidates: CandidateParameters, most: int | None = None) -> ChosenParameters:
    """Return a verdict for every candidate.

    most: number of parameters to choose; fewer if the test cannot distinguish that many.
    """
    reasons: dict[int, str] = {}
    alive = _seen(candidates, reasons)
    groups, apart = _apart(candidates, alive, reasons)
    order, misfits = _helpful(candidates, apart, most, reasons)
    ranks = {place: rank for rank, place in enumerate(order, start=1)}
    verdicts = tuple(
        ParameterVerdict(name, ranks.get(place, 0), reasons[place])
        for place, name in enumerate(candidates.names)
    )
    ranking = tuple(np.argsort(-candidates.importance, kind="stable").tolist())
    return ChosenParameters(verdicts, ranking, groups, misfits)


def percent(share: float) -> str:
    """Return a share in per cent as text; rounding errors are 0."""
    return f"{100 * share:.3g}" if share >= LEAST_SHOWN else "0"


def _seen(candidates: CandidateParameters, reasons: dict[int, str]) -> list[int]:
    """Return positions of the candidates on which the test depends."""
    alive = []
    for place, value in enumerate(candidates.importance.tolist()):
        if candidates.missing[place]:
            reasons[place] = f"its sensitivity is unavailable: {candidates.missing[place]}"
        elif value < LEAST_IMPORTANCE or not candidates.weighted[:, place].any():
            most = f"; most {candidates.loudest[place]}" if value > 0.0 else ""
            reasons[place] = (
                f"insensitive: over its bounds it changes the responses by {value:.2g} standard "
                f"deviations of the test{most}"
            )
        else:
            alive.append(place)
    return alive


def _apart(
    candidates: CandidateParameters, alive: list[int], reasons: dict[int, str]
) -> tuple[tuple[tuple[int, ...], ...], list[int]]:
    """Return collinear groups among these candidates, and the remaining ones."""
    if not alive:
        return (), []
    columns = candidates.weighted[:, alive]
    found = collinear_groups(columns, COLLINEAR)
    groups = tuple(tuple(alive[member] for member in group) for group in found)
    lengths, cosines = np.linalg.norm(columns, axis=0), column_cosines(columns)
    kept: list[int] = []
    for column in np.argsort(-lengths, kind="stable").tolist():
        like = [k for k in kept if abs(cosines[k, column]) >= COLLINEAR - 1e-12]
        if not like:
            kept.append(column)
            continue
        nearest = max(like, key=lambda k: abs(cosines[k, column]))
        reasons[alive[column]] = (
            f"collinear with {candidates.names[alive[nearest]]} (cosine "
            f"{cosines[nearest, column]:+.3f}): the test determines only a combination "
            "of the two"
        )
    return groups, sorted(alive[column] for column in kept)


def _helpful(
    candidates: CandidateParameters, apart: list[int], most: int | None, reasons: dict[int, str]
) -> tuple[list[int], tuple[float, ...]]:
    """Return positions of the chosen in order, and the misfits along forward selection."""
    if not apart:
        return [], ()
    columns = candidates.weighted[:, apart]
    chosen, misfits = forward_selection(
        columns,
        candidates.weighted_residual,
        LEAST_GAIN,
        most,
        candidates.lower[apart],
        candidates.upper[apart],
    )
    first = float(misfits[0])
    shares = misfits / first if first > 0.0 else np.zeros(1)
    order = [apart[column] for column in chosen.tolist()]
    for step, place in enumerate(order):
        reasons[place] = (
            f"reduces the squared residual from {percent(shares[step])} % to "
            f"{percent(shares[step + 1])} % of the initial one"
        )
    if most is not None or not order:
        order += _independent(candidates, apart, order, most, reasons)
    for place in apart:
        if place not in order:
            reasons[place] = (
                f"not among the {most} requested"
                if most is not None and len(order) == most
                else f"not needed: it would reduce the squared residual by less than "
                f"{100 * LEAST_GAIN:g} % of the initial one"
            )
    return order, tuple(shares.tolist())


def _independent(
    candidates: CandidateParameters,
    apart: list[int],
    order: list[int],
    most: int | None,
    reasons: dict[int, str],
) -> list[int]:
    """Return more candidates, the most independent ones first."""
    others = [place for place in apart if place not in order]
    if not others:
        return []
    columns = candidates.weighted[:, others]
    if order:
        basis = np.linalg.qr(candidates.weighted[:, order])[0]
        columns = columns - basis @ (basis.T @ columns)
    lengths = np.linalg.norm(candidates.weighted[:, others], axis=0)
    found = qr_order(columns) if columns.any() else None
    room = len(others) if most is None else most - len(order)
    more = []
    for step in range(min(room, found.rank if found else 0)):
        assert found is not None
        column = int(found.order[step])
        share = float(found.added[step] / lengths[column])
        if share < 1e-6:  # rounding of a column that lies in the others' span
            break
        more.append(others[column])
        reasons[others[column]] = (
            f"{100 * share:.3g} % of its column is independent of the ones before it"
        )
    return more
