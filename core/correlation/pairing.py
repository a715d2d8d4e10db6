"""Pairing: which computed mode corresponds to which measured one.

With measured shapes, pairs are the one-to-one assignment that maximises the sum of MAC (the
Hungarian method), with the relative frequency difference as tie-break. Without them the first
pairing takes the computed elastic modes in the order of frequency. Later pairings are tracked:
without measured shapes each pair stays with the computed mode whose shape continues the one paired
before, whatever its place in the order has become.

**Close modes** rotate within their common space at the slightest change of the model, so a single
MAC says little there. A measured shape is assigned to a cluster of close computed modes by the
angle between it and their space, and counts as found there even if no single member resembles it;
the MAC decides which member it is paired with. Measured modes that the test cannot split (their
frequencies are closer than they were measured) may have rotated too: the MAC of their partners is
that of both spaces, and close partners are taken in the order of frequency, unless shapes identify
each clearly and the frequencies are not one and the same.

**The campaign's rules.** Pairs named by hand come first and keep the computed shape that they were
given. Impossible pairs are excluded: their frequencies lie further apart than the parameters'
bounds can bring together (`core/parameters`), with an allowance for model error where shapes were
measured. Modes without a partner in the first model are left out of everything that follows, if
the rules say so.

Without shapes only the order of frequencies is available, and a mode that test or model lacks
shifts all above it. Such a pair is uncertain where the bounds cannot bring it together, and where a
neighbour is far nearer, measured relative to the ratio that most pairs have in common.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from modetune.core.assignment import least_cost
from modetune.core.correlation.correlation import Shapes, mac, subspace_macs
from modetune.core.errors import ModesError
from modetune.core.modes import (
    CLOSE,
    Floats,
    Integers,
    MeasuredModes,
    ModeSet,
    close_sets,
    common_dofs,
)

#: Below this MAC a pair is not a pair (the usual limit for "uncorrelated" is 0.2 to 0.4).
LOST_MAC = 0.3
#: A computed mode whose largest motion at the sensors is below this share of the largest of all
#: modes is at rest there. Of modes of one modal mass a test sees none 100 dB below the others, and
#: what a solver prints of such a motion (a roll about the line of the sensors) is rounding: 5e-7 on
#: a beam of solids with sensors along its middle.
AT_REST = 1e-5
#: The same share for modes of unknown scale.
ROUNDING = 1e-7
#: Modes whose frequencies differ by less than this share are a cluster.
CLUSTER = 0.015
#: How much a relative frequency difference of 100 % weighs against a MAC of 1 as tie-break.
FREQUENCY_TIE_BREAK = 0.05
#: Singular values of members' shapes at the sensors below this share of the largest: the sensors
#: see fewer directions than there are members.
UNSEEN = 1e-3
#: Share of the distance that a test can split, up to which measured frequencies are one.
FINE = 0.1
#: MAC from which each member of a cluster is identified by its own shape.
CLEAR = 0.9
#: Weight of a member's own MAC, relative to that of the angle to the space of its cluster.
OWN_SHARE = 0.1
#: Relative distance of measured frequencies that a test can split, by default.
RESOLUTION = 0.002
#: Factor of a frequency that a model may be wrong by, beyond what its parameters' bounds allow.
MODEL_ERROR = 1.4
#: A neighbour is far nearer than the partner where its distance is less than this share of the
#: partner's, ...
FAR_NEARER = 0.25
#: ... and the partner is further away than this, relative: twice what first models are off.
FAR = 0.1
#: Fewer pairs than this have no ratio in common.
FEW = 3


@dataclass(frozen=True, slots=True)
class Pairing:
    """One-to-one pairs of measured and computed modes.

    measured, computed: (n_pairs,), positions in the two mode sets.
    mac: (n_pairs,), MAC of each pair at the common sensors, NaN where no shape was measured; of
    modes that the test cannot split, of their space with that of the measured shapes.
    subspace_mac: (n_pairs,), the same against the whole cluster of close computed modes.
    reasons: why each pair is one.
    """

    measured: Integers
    computed: Integers
    mac: Floats
    subspace_mac: Floats
    reasons: tuple[str, ...]

    @property
    def judged_mac(self) -> Floats:
        """The larger of both: close modes turn within their space, and that is not an error."""
        return np.fmax(self.mac, self.subspace_mac)


def alone(modes: Integers) -> Pairing:
    """Modes (n_modes,), positions in a set, each its own pair, where nothing was measured."""
    unknown = np.full(modes.size, np.nan)
    return Pairing(np.arange(modes.size), modes, unknown, unknown, ("",) * modes.size)


class LostMode(ModesError):
    """A measured mode has no counterpart among the computed ones: compute more of them.

    above: whether it may lie above those that were computed.
    """

    def __init__(self, message: str, above: bool = True) -> None:
        self.above = above
        super().__init__(message)


def pair_by_shape(
    measured: ModeSet,
    computed: ModeSet,
    lost_mac: float = LOST_MAC,
    resolution: float | Floats = RESOLUTION,
    reach: tuple[float, float] = (0.0, np.inf),
    drop: bool = False,
) -> Pairing:
    """Pair every measured mode with one computed mode by MAC at the common sensors.

    resolution: relative distance of frequencies that the test can split; reach: least and largest
    ratio of a measured to a computed frequency of a pair; drop: leave out modes that are lost.
    Raises LostMode where fewer modes were computed than measured, or where a measured shape is
    found neither in its partner nor in the cluster around it; ModesError without common sensors.
    """
    if not drop:
        _enough(measured, computed)
    rows_m, rows_c = common_dofs(measured, computed)
    if rows_m.size == 0:
        raise ModesError("no sensor of the test is a node of the model's results")
    shapes_m = measured.mode_shapes[rows_m]
    shapes_c = without_rounding(computed.rows(rows_c))
    table = mac_or_zero(shapes_m, shapes_c)
    likeness = _likeness(table, shapes_m, shapes_c, computed.frequencies_hz)
    apart = np.abs(computed.frequencies_hz[None, :] / measured.frequencies_hz[:, None] - 1.0)
    cost = -(likeness - FREQUENCY_TIE_BREAK * np.minimum(apart, 1.0))
    ratios = measured.frequencies_hz[:, None] / computed.frequencies_hz[None, :]
    impossible = (ratios < reach[0]) | (ratios > reach[1])
    kept, columns = least_cost(np.where(impossible, 1.0, cost))
    macs, spaces = _cluster_macs(measured, computed, kept, columns, table, resolution)
    reasons, lost = [], np.zeros(kept.size, dtype=np.bool_)
    for pair, (row, column) in enumerate(zip(kept.tolist(), columns.tolist(), strict=True)):
        lost[pair] = max(macs[pair], spaces[pair]) < lost_mac or (
            impossible[row, column] and lost_mac >= 0.0
        )
        if lost[pair] and not drop:
            owners = np.full(computed.n_modes, -1)
            owners[columns] = kept
            owners[column] = -1
            raise _lost(
                measured, computed, row, table[row], impossible[row], owners, lost_mac, reach
            )
        cluster = close_modes(computed.frequencies_hz, column)
        reasons.append(_reason(macs[pair], spaces[pair], row, column, table, cluster))
    return Pairing(
        kept[~lost].astype(np.int64),
        columns[~lost].astype(np.int64),
        macs[~lost],
        spaces[~lost],
        tuple(reason for reason, out in zip(reasons, lost.tolist(), strict=True) if not out),
    )


def _cluster_macs(
    measured: ModeSet,
    computed: ModeSet,
    kept: Integers,
    columns: Integers,
    table: Floats,
    resolution: float | Floats,
) -> tuple[Floats, Floats]:
    """MAC of each pair, alone and in the space of its cluster, (n_pairs,) each.

    kept, columns: (n_pairs,), positions of the pairs' modes; close columns are put in the order of
    frequency, in place, where the test cannot split their modes.
    """
    rows_m, rows_c = common_dofs(measured, computed)
    shapes_m = measured.mode_shapes[rows_m][:, kept]
    shapes_c = without_rounding(computed.rows(rows_c))
    macs, spaces = table[kept, columns], np.zeros(kept.size)
    for pair, column in enumerate(columns.tolist()):
        cluster = close_modes(computed.frequencies_hz, column)
        if cluster.size > 1:
            spaces[pair] = _space_or_zero(shapes_m[:, pair], shapes_c[:, cluster])
        else:  # the space of one shape
            spaces[pair] = macs[pair]
    widths = np.broadcast_to(resolution, measured.frequencies_hz.shape)[kept]
    for unsplit in close_sets(measured.frequencies_hz[kept], widths):
        if unsplit.size < 2:
            continue
        wanted_hz = measured.frequencies_hz[kept[unsplit]]
        one = len(close_sets(wanted_hz, FINE * widths[unsplit])) == 1
        if one or macs[unsplit].min() < CLEAR:
            columns[unsplit] = _in_order(wanted_hz, computed.frequencies_hz, columns[unsplit])
        for members in close_sets(computed.frequencies_hz[columns[unsplit]], CLOSE):
            pairs = unsplit[members]
            own = cluster_mac(shapes_c[:, columns[pairs]], shapes_m[:, unsplit])
            macs[pairs], spaces[pairs] = own, own
    return macs, spaces


def _lost(
    measured: ModeSet,
    computed: ModeSet,
    row: int,
    macs: Floats,
    impossible: NDArray[np.bool_],
    owners: Integers,
    lost_mac: float,
    reach: tuple[float, float],
) -> LostMode:
    """Why a measured mode has no partner. macs, impossible: (n_computed,), of its row; owners:
    (n_computed,), the other measured mode that each computed one is paired with, -1 without."""
    wanted, hz = float(measured.frequencies_hz[row]), computed.frequencies_hz
    possible = np.where(impossible | (owners >= 0), 0.0, macs)
    text = (
        f"the measured mode at {wanted:.4g} Hz is not among the {hz.size} computed modes, to "
        f"{hz.max():.4g} Hz: the best MAC left for it is {possible.max():.2f}, at least "
        f"{lost_mac:.2f} is needed"
    )
    best = int(np.argmax(macs))
    if owners[best] >= 0 and macs[best] >= lost_mac:
        text += (
            f"; the computed mode at {hz[best]:.4g} Hz, with MAC {macs[best]:.2f}, is the pair of "
            f"the measured mode at {measured.frequencies_hz[owners[best]]:.4g} Hz"
        )
    elif impossible[best] and macs[best] >= lost_mac:
        text += (
            f"; the computed mode at {hz[best]:.4g} Hz, with MAC {macs[best]:.2f}, is no pair, as "
            f"the parameters' bounds and a model's error let it become {reach[0] * hz[best]:.4g} "
            f"to {reach[1] * hz[best]:.4g} Hz"
        )
    text += "; check sensor nodes and directions, or compute more modes"
    return LostMode(text, above=wanted > reach[0] * hz.max())


def _likeness(table: Floats, shapes_m: Shapes, shapes_c: Shapes, frequencies_hz: Floats) -> Floats:
    """MAC of measured shapes with the clusters of computed modes, (n_measured, n_computed).

    Of a single mode it is the MAC (table). A space of as many modes as there are sensors resembles
    every shape, so it shows nothing.
    """
    likeness = table.copy()
    near = np.abs(frequencies_hz / frequencies_hz[:, None] - 1.0) <= CLUSTER
    for column in np.flatnonzero(near.sum(axis=1) > 1).tolist():
        cluster = np.flatnonzero(near[column])
        if cluster.size < shapes_c.shape[0]:
            spaces = _spaces_or_zero(shapes_m, shapes_c[:, cluster])
            likeness[:, column] += (1.0 - OWN_SHARE) * (spaces - table[:, column])
    return likeness


def _in_order(wanted_hz: Floats, frequencies_hz: Floats, columns: Integers) -> Integers:
    """Partners (n,) of measured modes that are not split, close ones in the order of frequency."""
    placed = columns.copy()
    ranks = np.argsort(wanted_hz, kind="stable")
    for members in close_sets(frequencies_hz[columns], CLOSE):
        own = ranks[np.isin(ranks, members)]
        by_frequency = np.argsort(frequencies_hz[columns[members]], kind="stable")
        placed[own] = columns[members][by_frequency]
    return placed


def pair_by_order(measured: ModeSet, computed: ModeSet, others_hz: ArrayLike = ()) -> Pairing:
    """Pair the measured modes, in ascending frequency, with the lowest computed ones.

    others_hz: frequencies of measured modes that are not to be paired, yet have their place in the
    order. For tests without shapes: the analyst's statement that no mode was missed.
    """
    _enough(measured, computed)
    known = np.concatenate([measured.frequencies_hz, np.asarray(others_hz, dtype=np.float64)])
    order = np.argsort(known, kind="stable")
    ranks = np.argsort(order, kind="stable")[: measured.n_modes]
    if ranks.max(initial=0) >= computed.n_modes:
        raise LostMode(
            f"the measured mode at {known[ranks.argmax()]:.4g} Hz is number {ranks.max() + 1} in "
            f"the order of frequency, but there are {computed.n_modes} computed elastic modes: "
            "compute more modes"
        )
    by_frequency = np.argsort(computed.frequencies_hz, kind="stable")
    unknown = np.full(measured.n_modes, np.nan)
    reasons = tuple(
        f"no shape was measured: elastic mode {rank + 1} in the order of frequency"
        for rank in ranks.tolist()
    )
    positions = np.arange(measured.n_modes, dtype=np.int64)
    return Pairing(positions, by_frequency[ranks].astype(np.int64), unknown, unknown, reasons)


def pair_by_tracking(before: Pairing, previous: ModeSet, computed: ModeSet) -> Pairing:
    """Continue a pairing: each measured mode follows the computed shape it was paired with.

    previous, computed: the computed modes of `before` and of now, at the same rows.
    Raises LostMode where a shape does not continue.
    """
    if computed.n_modes < before.computed.size:
        raise LostMode(f"only {computed.n_modes} elastic modes for {before.computed.size} pairs")
    shapes_before = without_rounding(previous)[:, before.computed]
    shapes_now = without_rounding(computed)
    table = mac_or_zero(shapes_before, shapes_now)
    rows, columns = least_cost(-table)
    reasons = []
    for row, column in zip(rows.tolist(), columns.tolist(), strict=True):
        if table[row, column] < LOST_MAC and (
            _space_or_zero(
                shapes_before[:, row], shapes_now[:, close_modes(computed.frequencies_hz, column)]
            )
            < LOST_MAC
        ):
            raise LostMode(
                f"the elastic mode at {previous.frequencies_hz[before.computed[row]]:.4g} Hz, one "
                f"of the pairs, does not continue: the best MAC with its shape before is "
                f"{table[row, column]:.2f}"
            )
        moved = (
            ""
            if column == before.computed[row]
            else (f", now elastic mode {column + 1} (was {before.computed[row] + 1})")
        )
        reasons.append(f"continues its shape, MAC {table[row, column]:.3f}{moved}")
    unknown = np.full(rows.size, np.nan)
    return Pairing(before.measured, columns.astype(np.int64), unknown, unknown, tuple(reasons))


def mac_or_zero(first: Shapes, second: Shapes) -> Floats:
    """Return the MAC, 0 for a mode without motion at the sensors."""
    rows, columns = first.any(axis=0), second.any(axis=0)
    if rows.all() and columns.all():
        return mac(first, second)
    table = np.zeros((first.shape[1], second.shape[1]))
    if rows.any() and columns.any():
        table[np.ix_(rows, columns)] = mac(first[:, rows], second[:, columns])
    return table


def _spaces_or_zero(shapes: Shapes, basis: Shapes) -> Floats:
    """Return the share of each shape (n_dof, n_shapes) in a space, (n_shapes,); 0 for zeros."""
    moving, moves = basis[:, basis.any(axis=0)], shapes.any(axis=0)
    spaces = np.zeros(shapes.shape[1])
    if moving.shape[1] and moves.any():
        spaces[moves] = subspace_macs(shapes[:, moves], moving)
    return spaces


def _space_or_zero(shape: Shapes, basis: Shapes) -> float:
    return float(_spaces_or_zero(shape[:, None], basis)[0])


def cluster_mac(shapes: Shapes, basis: Shapes) -> float:
    """Share of the shapes of a cluster that lies in the space of others, in [0, 1].

    shapes: (n_dof, n), mass-normalised, basis: (n_dof, k). Of one shape each it is the MAC; turning
    the members of either does not change it. 0 for a zero shape.
    """
    moving = basis[:, basis.any(axis=0)]
    if not moving.shape[1] or not shapes.any():
        return 0.0
    left, sizes, _ = np.linalg.svd(moving / np.linalg.norm(moving, axis=0), full_matrices=False)
    inside = left[:, sizes > UNSEEN * sizes[0]].conj().T @ shapes
    return float(min(np.sum(np.abs(inside) ** 2) / np.sum(np.abs(shapes) ** 2), 1.0))


def without_rounding(modes: ModeSet) -> Shapes:
    """Return shapes (n_dof, n_modes), zero where the mode is at rest at the sensors.

    A mode of rotations alone, such as the torsion of beams on one axis, leaves noise there. Shapes
    whose scale is unknown tell only rounding from motion.
    """
    size = np.abs(modes.mode_shapes).max(axis=0, initial=0.0)
    share = AT_REST if modes.normalisation == "mass" else ROUNDING
    return np.where(size > share * size.max(initial=0.0), modes.mode_shapes, 0.0)


def close_modes(frequencies_hz: Floats, mode: int, width: float = CLUSTER) -> Integers:
    """Positions of the modes within a relative width of one mode's frequency, itself included."""
    apart = np.abs(frequencies_hz / frequencies_hz[mode] - 1.0)
    return np.flatnonzero(apart <= width)


def _enough(measured: ModeSet, computed: ModeSet) -> None:
    if computed.n_modes < measured.n_modes:
        raise LostMode(
            f"{measured.n_modes} measured modes cannot be paired one-to-one with "
            f"{computed.n_modes} computed elastic modes: compute more modes"
        )


def _reason(
    value: float, space: float, row: int, column: int, table: Floats, cluster: Integers
) -> str:
    if cluster.size > 1 and space > value + 0.05:
        members = ", ".join(str(mode + 1) for mode in cluster.tolist())
        return f"MAC {value:.3f}; {space:.3f} in the space of close elastic modes {members}"
    best = int(np.argmax(table[row]))
    if best != column:
        return (
            f"MAC {value:.3f}; elastic mode {best + 1} has {table[row, best]:.3f} but answers "
            "another measured mode better"
        )
    return f"highest MAC, {value:.3f}"


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

    elastic: its elastic modes; those before are tracked where both are known (matrices give
    translations only, a solver rotations too). Raises LostMode, ModesError.
    """
    pairing, previous = before
    if previous.n_dof != elastic.n_dof:
        rows_before, rows_now = common_dofs(previous, elastic)
        previous, elastic = previous.rows(rows_before), elastic.rows(rows_now)
    if not test.has_shapes:
        return pair_by_tracking(pairing, previous, elastic)
    numbers = [test.numbers[row] for row in pairing.measured.tolist()]
    by_hand = np.array([number in rules.by_hand for number in numbers], dtype=np.bool_)
    hand = _some(pairing, np.flatnonzero(by_hand))
    if hand.measured.size:
        tracked = pair_by_tracking(hand, previous, elastic)
        hand = _compared(test, seen, tracked.measured, tracked.computed, tracked.reasons)
    rows = pairing.measured[~by_hand]
    if not rows.size:
        return hand
    columns = np.delete(np.arange(seen.n_modes), hand.computed)
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
        shapes_c = without_rounding(seen.rows(rows_c))
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
