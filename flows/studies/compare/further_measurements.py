"""Which further measurement would tell two models apart: unmeasured modes and unmeasured places.

Two models predict a value that differs by D standard deviations of its measurement. If one of them
is right, the measurement adds D^2 / 2 to the ln Bayes factor on average (less where misfits are
larger than noise: D^2 / (2 s^2)), at most: the parameters of the other one may adapt. Candidates
are modes that both models have and the test lacks, up to 1.5 times the highest measured frequency,
and the motion in the measured modes of nodes without a sensor. The deviations are those of the test
(`residuals`).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import linear_sum_assignment

from modetune.core.correlation.pairing import mac_or_zero
from modetune.core.modes import Floats, Integers, ModeSet, common_dofs, dof_name
from modetune.flows.campaign.campaign import Campaign
from modetune.flows.campaign.case import Case
from modetune.flows.updating.evaluation import CaseEvaluation, Evaluation

#: Highest frequency of a candidate mode over the highest measured one.
RANGE = 1.5
#: Smallest MAC of the same mode of two models.
SAME_MODE = 0.5
#: Measurements that are proposed, of modes and of places each.
PROPOSED = 5


@dataclass(frozen=True, slots=True)
class FurtherMeasurement:
    """A measurement that distinguishes two models.

    best, second: what they predict, in Hz, or in units of the shape's root mean square at the
    sensors. deviations: difference in standard deviations of the measurement; log_bayes_factor:
    what it adds on average, at most.
    """

    what: str
    unit: str
    best: float
    second: float
    deviations: float
    log_bayes_factor: float


def further_measurements(
    best: tuple[Campaign, Evaluation], second: tuple[Campaign, Evaluation], scale: float
) -> tuple[FurtherMeasurement, ...]:
    """Return the measurements that distinguish two models, the best first.

    scale: by what chi-squares are divided.
    """
    found = []
    cases = zip(best[0].used, best[1].parts, second[1].parts, strict=True)
    deviation = best[0].residuals.of_others("frequency_deviation")
    for case, one, other in cases:
        found += _modes(case, one, other, deviation, scale)[:PROPOSED]
        found += _places(case, one, other, scale)[:PROPOSED]
    return tuple(sorted(found, key=lambda item: -item.deviations))


def _gain(deviations: float, scale: float) -> float:
    return 0.5 * deviations**2 / scale


def _modes(
    case: Case, one: CaseEvaluation, other: CaseEvaluation, deviation: float, scale: float
) -> list[FurtherMeasurement]:
    """Return the modes that both models have and the test lacks."""
    highest = RANGE * float(case.test.modes.frequencies_hz.max())
    sides = [_unmeasured(part, highest) for part in (one, other)]
    (mine, a), (its, b) = ((side, side.frequencies_hz) for side in sides)
    if not (a.size and b.size):
        return []
    rows, columns = common_dofs(mine, its)
    if rows.size >= 2:
        likeness = mac_or_zero(mine.mode_shapes[rows], its.mode_shapes[columns])
        pairs = zip(*linear_sum_assignment(-likeness), strict=True)
        matched = [(i, j) for i, j in pairs if likeness[i, j] >= SAME_MODE]
    else:
        matched = [(n, n) for n in range(min(a.size, b.size))]
    found = []
    for i, j in matched:
        distance = abs(a[i] - b[j]) / (0.5 * (a[i] + b[j])) / deviation
        text = case.of(f"frequency of an unmeasured mode near {a[i]:.4g} Hz")
        gain = _gain(float(distance), scale)
        found.append(
            FurtherMeasurement(text, "Hz", float(a[i]), float(b[j]), float(distance), gain)
        )
    return sorted(found, key=lambda item: -item.deviations)


def _unmeasured(part: CaseEvaluation, highest: float) -> ModeSet:
    """Return the elastic modes without a measured partner, up to a frequency."""
    elastic = part.whole.elastic
    taken = part.pairing.computed.tolist()
    taken += [] if part.held_out is None else part.held_out.computed.tolist()
    free = [
        place
        for place, hz in enumerate(elastic.frequencies_hz.tolist())
        if place not in taken and hz <= highest
    ]
    return elastic.select(np.array(free, dtype=np.int64))


def _places(
    case: Case, one: CaseEvaluation, other: CaseEvaluation, scale: float
) -> list[FurtherMeasurement]:
    """Return translations of nodes without a sensor, by how differently the models move there."""
    if not case.test.has_shapes:
        return []
    shared = sorted(set(one.pairing.measured.tolist()) & set(other.pairing.measured.tolist()))
    modes = np.array(shared, dtype=np.int64)
    one_whole, one_rms = _scaled(case, one, modes)
    other_whole, other_rms = _scaled(case, other, modes)
    rows, columns = common_dofs(one_whole, other_whole)
    nodes, components = one_whole.nodes[rows], one_whole.components[rows]
    free = (components <= 3) & ~np.isin(nodes, case.sensors.model_nodes)
    if not free.any():
        return []
    rows, columns, nodes, components = rows[free], columns[free], nodes[free], components[free]
    a = np.real(one_whole.mode_shapes[rows]) / one_rms
    b = np.real(other_whole.mode_shapes[columns]) / other_rms
    distances = np.abs(a - b) / case.weighting.shape_deviations[modes]
    totals = np.sqrt(np.sum(distances**2, axis=1))
    found = []
    for place in np.argsort(-totals, kind="stable")[:PROPOSED].tolist():
        mode = int(np.argmax(distances[place]))
        dof = dof_name((int(nodes[place]), int(components[place])))
        number = case.test.numbers[shared[mode]]
        found.append(
            FurtherMeasurement(
                case.of(f"sensor at {dof}, most in mode {number}"),
                "of rms",
                float(a[place, mode]),
                float(b[place, mode]),
                float(totals[place]),
                _gain(float(totals[place]), scale),
            )
        )
    return found


def _scaled(case: Case, part: CaseEvaluation, modes: Integers) -> tuple[ModeSet, Floats]:
    """Return a model's shapes of test modes, and their signed rms at the sensors, as the test's."""
    order = {place: n for n, place in enumerate(part.pairing.measured.tolist())}
    columns = part.pairing.computed[[order[place] for place in modes.tolist()]]
    rows, seen_rows = common_dofs(case.test.modes, part.seen)
    measured = np.real(case.test.modes.mode_shapes[np.ix_(rows, modes)])
    seen = np.real(part.seen.mode_shapes[np.ix_(seen_rows, columns)])
    # The model's shape times this is the test's; over the rms of the test's, it is that over rms.
    factors = np.sum(measured * seen, axis=0) / np.sum(seen**2, axis=0)
    sizes = np.sqrt(np.mean(measured**2, axis=0))
    return part.whole.elastic.select(columns), sizes / factors
