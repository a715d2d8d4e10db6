"""Which computed mode answers which measured one, by the campaign's rules.

Pairs named by hand come first and keep to the computed shape that they were given. The rest is
paired as `core/correlation/pairing` does, but for pairs that cannot be: whose frequencies lie
further apart than the parameters' bounds can bring together (`core/parameters`), with what a model
may be wrong beyond its parameters where shapes tell them. Modes that have no partner in the first
model are left out of all that follow, if the rules say so.

Without shapes the order of frequencies is all that there is, and a mode that test or model lacks
shifts all above it. Such pairs are not certain: one that the bounds cannot bring together, and one
whose neighbour is far nearer, measured beside the ratio that most pairs have in common.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from modetune.core.correlation.pairing import (
    LOST_MAC,
    LostMode,
    Pairing,
    close_modes,
    cluster_mac,
    mac_or_zero,
    pair_by_order,
    pair_by_shape,
    pair_by_tracking,
    without_rounding,
)
from modetune.core.errors import ModesError
from modetune.core.modes import Floats, Integers, MeasuredModes, ModeSet, common_dofs

#: Factor of a frequency that a model may be wrong by, beyond what its parameters' bounds allow.
MODEL_ERROR = 1.4
#: A neighbour is far nearer than the partner where its distance is less than this share of the
#: partner's, ...
FAR_NEARER = 0.25
#: ... and the partner is further away than this, relative: twice what first models are off.
FAR = 0.1
#: Fewer pairs than this have no ratio in common.
FEW = 3


class UncertainPairs(ModesError):
    """Pairs by the order of frequencies that are not certain, and not named by hand."""

    exit_code = 2


class NotAmongComputed(LostMode):
    """A mode that was named by hand is not among the computed ones."""

    exit_code = 2


@dataclass(frozen=True, slots=True)
class PairRules:
    """by_hand: numbers of test modes, and of the elastic modes of the first model (from 1) that
    answer them; drop: whether modes without a partner are left out; reach: least and largest
    factor by which the bounds can change a frequency of the first model."""

    by_hand: Mapping[int, int] = field(default_factory=dict)
    drop: bool = False
    reach: tuple[float, float] = (0.0, np.inf)

    @property
    def widest(self) -> tuple[float, float]:
        """Factors beyond which shapes make no pair."""
        return self.reach[0] / MODEL_ERROR, self.reach[1] * MODEL_ERROR


def first_pairing(
    test: MeasuredModes,
    seen: ModeSet,
    rules: PairRules,
    resolution: float | Floats,
    others_hz: Floats,
    drop: bool = False,
    lost_mac: float = LOST_MAC,
) -> Pairing:
    """The pairs of the first model.

    seen: its elastic modes as the test's sensors see them; resolution: relative distance of
    frequencies that the test can split; others_hz: as in `pair_by_order`; drop: whether modes
    without a partner are left out now; lost_mac: as in `pair_by_shape`. Raises LostMode,
    ModesError.
    """
    hand = _by_hand(test, seen, rules)
    rows, columns = _free(test, seen, hand)
    measured, computed = test.modes.select(rows), seen.select(columns)
    if not rows.size:
        return hand
    if test.has_shapes:
        rest = pair_by_shape(
            measured, computed, lost_mac, _of(resolution, rows), rules.widest, drop
        )
    else:
        rest = _by_order(measured, computed, others_hz, rules.reach, drop)
    return _joined(hand, _placed(rest, rows, columns))


def next_pairing(
    test: MeasuredModes,
    seen: ModeSet,
    elastic: ModeSet,
    before: tuple[Pairing, ModeSet],
    rules: PairRules,
    resolution: float | Floats,
) -> Pairing:
    """The pairs of a later model, of the test modes that have been paired before.

    elastic: its elastic modes; those before are tracked where both are known (matrices tell
    translations alone, a solver rotations too). Raises LostMode, ModesError.
    """
    pairing, previous = before
    if previous.n_dof != elastic.n_dof:
        rows_before, rows_now = common_dofs(previous, elastic)
        previous, elastic = previous.rows(rows_before), elastic.rows(rows_now)
    if not test.has_shapes:
        return pair_by_tracking(pairing, previous, elastic)
    by_hand = np.isin([test.numbers[row] for row in pairing.measured], list(rules.by_hand))
    hand = _some(pairing, np.flatnonzero(by_hand))
    if hand.measured.size:
        tracked = pair_by_tracking(hand, previous, elastic)
        hand = _compared(test, seen, tracked.measured, tracked.computed, tracked.reasons)
    rows = pairing.measured[~by_hand]
    if not rows.size:
        return hand
    columns = np.setdiff1d(np.arange(seen.n_modes), hand.computed)
    low, high = rules.reach
    rest = pair_by_shape(
        test.modes.select(rows),
        seen.select(columns),
        resolution=_of(resolution, rows),
        reach=(low / high / MODEL_ERROR, high / max(low, 1e-300) * MODEL_ERROR),
    )
    return _joined(hand, _placed(rest, rows, columns))


def uncertain_pairs(
    test: MeasuredModes, computed: ModeSet, pairing: Pairing, rules: PairRules
) -> dict[int, str]:
    """Why pairs by the order of frequencies are not certain, by number of the test's mode.

    Those named by hand are; so are all where shapes were measured.
    """
    if test.has_shapes:
        return {}
    found: dict[int, str] = {}
    own = computed.frequencies_hz[pairing.computed]
    wanted = test.modes.frequencies_hz[pairing.measured]
    common = float(np.median(own / wanted)) if own.size >= FEW else 1.0
    for row, column, hz, test_hz in zip(
        pairing.measured.tolist(), pairing.computed.tolist(), own, wanted, strict=True
    ):
        number = test.numbers[row]
        if number in rules.by_hand:
            continue
        if beyond(test_hz, hz, rules.reach):
            found[number] = (
                f"{test_hz:.4g} Hz measured and {hz:.4g} Hz computed, {reach_text(hz, rules.reach)}"
            )
            continue
        away = np.abs(computed.frequencies_hz / (common * test_hz) - 1.0)
        nearest = int(np.argmin(away))
        if nearest != column and away[column] > FAR and away[nearest] < FAR_NEARER * away[column]:
            found[number] = (
                f"{test_hz:.4g} Hz measured and {hz:.4g} Hz computed (elastic mode {column + 1}), "
                f"while elastic mode {nearest + 1} at {computed.frequencies_hz[nearest]:.4g} Hz is "
                "far nearer"
            )
    return found


def beyond(test_hz: float, hz: float, reach: tuple[float, float]) -> bool:
    """Whether a computed frequency cannot be brought to a measured one."""
    return not reach[0] * hz <= test_hz <= reach[1] * hz


def reach_text(hz: float, reach: tuple[float, float]) -> str:
    """What a computed frequency may become, in words."""
    return f"which the parameters' bounds let become {reach[0] * hz:.4g} to {reach[1] * hz:.4g} Hz"


def _of(resolution: float | Floats, rows: Integers) -> float | Floats:
    """That of some of the test's modes."""
    return resolution if isinstance(resolution, float) else resolution[rows]


def _by_hand(test: MeasuredModes, seen: ModeSet, rules: PairRules) -> Pairing:
    named = {number: mode for number, mode in rules.by_hand.items() if number in test.numbers}
    for number, mode in named.items():
        row = test.numbers.index(number)
        if mode > seen.n_modes:
            nearest = int(np.argmin(np.abs(seen.frequencies_hz - test.modes.frequencies_hz[row])))
            raise NotAmongComputed(
                f"test.pairs: {{{number}: {mode}}}: the model has {seen.n_modes} computed elastic "
                f"modes, the last at {seen.frequencies_hz.max():.4g} Hz; the nearest to the "
                f"test's {test.modes.frequencies_hz[row]:.4g} Hz is elastic mode {nearest + 1} at "
                f"{seen.frequencies_hz[nearest]:.4g} Hz"
            )
    rows = np.array([test.numbers.index(number) for number in named], dtype=np.int64)
    columns = np.array(list(named.values()), dtype=np.int64) - 1
    return _compared(test, seen, rows, columns, ("named by hand",) * rows.size)


def _compared(
    test: MeasuredModes, seen: ModeSet, rows: Integers, columns: Integers, why: Sequence[str]
) -> Pairing:
    """Given pairs with their MAC."""
    macs, spaces = np.full(rows.size, np.nan), np.full(rows.size, np.nan)
    if test.has_shapes and rows.size:
        rows_m, rows_c = common_dofs(test.modes, seen)
        shapes_m = test.modes.mode_shapes[rows_m][:, rows]
        shapes_c = without_rounding(seen.mode_shapes[rows_c])
        macs = np.diagonal(mac_or_zero(shapes_m, shapes_c[:, columns])).copy()
        for pair, column in enumerate(columns.tolist()):
            cluster = shapes_c[:, close_modes(seen.frequencies_hz, column)]
            spaces[pair] = cluster_mac(shapes_m[:, [pair]], cluster)
    return Pairing(rows, columns, macs, spaces, tuple(why))


def _by_order(
    measured: ModeSet, computed: ModeSet, others_hz: Floats, reach: tuple[float, float], drop: bool
) -> Pairing:
    """Pairs by order; with drop without those that the bounds cannot bring together, one by one."""
    kept = np.arange(measured.n_modes)
    while True:
        kept_modes = measured.select(kept)
        if drop and kept.size + np.size(others_hz) > computed.n_modes:
            kept = kept[np.argsort(kept_modes.frequencies_hz)[: max(0, kept.size - 1)]]
            continue
        found = pair_by_order(kept_modes, computed, others_hz)
        ratio = kept_modes.frequencies_hz / computed.frequencies_hz[found.computed]
        out = np.flatnonzero((ratio < reach[0]) | (ratio > reach[1]))
        if not drop or not out.size:
            return replace(found, measured=kept)
        worst = out[np.argmax(np.abs(np.log(ratio[out])))]
        kept = np.delete(kept, worst)


def _free(test: MeasuredModes, seen: ModeSet, hand: Pairing) -> tuple[Integers, Integers]:
    return (
        np.setdiff1d(np.arange(test.modes.n_modes), hand.measured),
        np.setdiff1d(np.arange(seen.n_modes), hand.computed),
    )


def _placed(pairing: Pairing, rows: Integers, columns: Integers) -> Pairing:
    """A pairing of some modes among all."""
    return replace(pairing, measured=rows[pairing.measured], computed=columns[pairing.computed])


def _some(pairing: Pairing, which: Integers) -> Pairing:
    return Pairing(
        pairing.measured[which],
        pairing.computed[which],
        pairing.mac[which],
        pairing.subspace_mac[which],
        tuple(pairing.reasons[place] for place in which.tolist()),
    )


def _joined(first: Pairing, second: Pairing) -> Pairing:
    """The pairs of both in the order of the test's modes."""
    both = Pairing(
        np.concatenate([first.measured, second.measured]),
        np.concatenate([first.computed, second.computed]),
        np.concatenate([first.mac, second.mac]),
        np.concatenate([first.subspace_mac, second.subspace_mac]),
        first.reasons + second.reasons,
    )
    return _some(both, np.argsort(both.measured, kind="stable"))
