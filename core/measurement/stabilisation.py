"""Which poles of a fitted polynomial are modes: the stabilisation diagram, judged without eyes.

A polynomial of higher order than the structure has modes gives poles of modes and poles of noise.
The first recur at every order, the others wander. A pole is
stable where the order before has a pole that agrees with it in

    frequency |f - f'| / f' <= 1 %,  damping |zeta - zeta'| / zeta' <= 5 %,  shape 1 - MAC <= 2 %,

the criteria of the thesis (4.2), which takes three stable poles for a sign of a mode. Poles that
are not damped vibrations in the band (negative or very high damping, real, conjugates) are left
out first: with its last coefficient held at one the least squares solution throws most
computational poles to the unstable side (Cauberghe 2004, 4.3).

For the choice without a user, poles of successive orders are linked one to one into tracks, nearest
in all three measures first. So two modes 1 % apart, which agree in frequency, stay two tracks:
their shapes or dampings are nearer to their own. A track may pause, since orders in between can
miss a mode. Of two tracks of like shape (MAC > 0.9) nearer to each other than the half-width
zeta f of the resonance, the longer one counts: no measurement separates such a pair.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from modetune.core.assignment import least_cost
from modetune.core.correlation.correlation import mac
from modetune.core.errors import CampaignError
from modetune.core.measurement.response_functions import Complexes
from modetune.core.modes import Floats, Integers

#: Orders that a track may miss before it ends.
PAUSE = 4


class Stability(IntEnum):
    """In what a pole agrees with the order before; each step holds those below it."""

    NEW = 0
    FREQUENCY = 1
    DAMPING = 2
    STABLE = 3


@dataclass(frozen=True, slots=True)
class Criteria:
    """When a pole is stable, and when a row of stable poles is a mode.

    frequency, damping: relative differences; shape: 1 - MAC. largest_damping: of a pole that is
    taken for a vibration. least_stable: stable poles of a track that is a mode without a user's
    word, 0 for a sixth of the orders; least_picked: with it. least_share: of the response near a
    mode's frequency that only the mode makes up (modal_fit.mode_shares); edge_share: the same
    within 3 % of the band from its ends, where polynomials like to put a pole for what lies
    outside. Raises CampaignError where a limit makes no sense.
    """

    frequency: float = 0.01
    damping: float = 0.05
    shape: float = 0.02
    largest_damping: float = 0.2
    least_stable: int = 0
    least_picked: int = 3
    least_share: float = 0.05
    edge_share: float = 0.3

    def __post_init__(self) -> None:
        limits = (self.frequency, self.damping, self.shape, self.largest_damping)
        if not all(0.0 < limit < 1.0 for limit in limits):
            raise CampaignError(
                "limits of a stable pole (frequency, damping, shape, largest damping) must lie "
                f"between 0 and 1, found {', '.join(f'{limit:g}' for limit in limits)}"
            )

    def enough(self, order: int) -> int:
        """Stable poles of a mode, up to this order."""
        return self.least_stable or max(self.least_picked, order // 6)

    def wanted_shares(self, frequencies_hz: Floats, band_hz: tuple[float, float]) -> Floats:
        """The share that a mode at each frequency must have, like frequencies_hz."""
        low, high = band_hz
        from_end = np.minimum(frequencies_hz - low, high - frequencies_hz)
        return np.where(from_end < 0.03 * (high - low), self.edge_share, self.least_share)


@dataclass(frozen=True, slots=True)
class OrderPoles:
    """The poles of one order that may be vibrations.

    poles: (n_poles,), rad/s, upper half plane, ascending in |p|. shapes: (n_functions, n_poles),
    complex. stability: (n_poles,), of Stability.
    """

    order: int
    poles: Complexes
    shapes: Complexes
    stability: Integers

    @property
    def frequencies_hz(self) -> Floats:
        """|p| / 2 pi, (n_poles,)."""
        return np.asarray(np.abs(self.poles) / (2.0 * np.pi))

    @property
    def damping_ratios(self) -> Floats:
        """Fraction of critical, (n_poles,)."""
        return np.asarray(-self.poles.real / np.abs(self.poles))


@dataclass(frozen=True, slots=True)
class Track:
    """One pole followed over the orders.

    places: (n, 2), place in the diagram and pole there; n_stable: how many are stable.
    pole: of the track, the last stable one, where bias is least; shape likewise.
    """

    places: Integers
    n_stable: int
    pole: complex
    shape: Complexes

    @property
    def frequency_hz(self) -> float:
        """|p| / 2 pi."""
        return abs(self.pole) / (2.0 * np.pi)

    @property
    def damping_ratio(self) -> float:
        """Fraction of critical."""
        return -self.pole.real / abs(self.pole)


def physical_poles(
    poles: Complexes, band_hz: tuple[float, float], largest_damping: float
) -> Complexes:
    """Those of an order's poles that may be damped vibrations in the band, ascending in |p|.

    poles: (n,), rad/s, conjugates and all; band_hz: lower and upper.
    """
    given = poles[np.isfinite(poles)]
    frequencies, damping = np.abs(given) / (2.0 * np.pi), -given.real / np.abs(given)
    inside = (frequencies >= band_hz[0]) & (frequencies <= band_hz[1]) & (given.imag > 0.0)
    kept = given[inside & (damping > 0.0) & (damping < largest_damping)]
    return np.asarray(kept[np.argsort(np.abs(kept))])


def judge_orders(orders: Sequence[OrderPoles], criteria: Criteria) -> tuple[OrderPoles, ...]:
    """The orders with each pole judged against the order before it. Raises as core.mac."""
    judged: list[OrderPoles] = []
    before: OrderPoles | None = None
    for item in orders:
        stability = np.zeros(item.poles.size, dtype=np.int64)
        if before is not None and item.poles.size and before.poles.size:
            near, damped, alike = _agreement(item, before, criteria)
            steps = near.astype(np.int64) + (near & damped) + (near & damped & alike)
            stability = steps.max(axis=1)
        judged.append(replace(item, stability=stability))
        before = item
    return tuple(judged)


def follow_poles(orders: Sequence[OrderPoles], criteria: Criteria) -> tuple[Track, ...]:
    """Poles of successive orders linked one to one, ascending in frequency.

    orders: judged. Tracks without a stable pole are left out, and the shorter one of two at one
    resonance (see above). Raises as core.mac.
    """
    open_tracks: list[list[tuple[int, int]]] = []
    ended: list[list[tuple[int, int]]] = []
    for place, item in enumerate(orders):
        ended += [track for track in open_tracks if track[-1][0] < place - 1 - PAUSE]
        open_tracks = [track for track in open_tracks if track[-1][0] >= place - 1 - PAUSE]
        linked = _link(open_tracks, orders, item, criteria)
        for pole in range(item.poles.size):
            if pole in linked:
                open_tracks[linked[pole]].append((place, pole))
            else:
                open_tracks.append([(place, pole)])
    tracks = [_track(places, orders) for places in (*ended, *open_tracks)]
    found = _without_doubles([track for track in tracks if track is not None])
    return tuple(sorted(found, key=lambda track: track.frequency_hz))


def pick_tracks(
    tracks: Sequence[Track], frequencies_hz: Sequence[float], criteria: Criteria
) -> tuple[int, ...]:
    """Places of the stable tracks nearest to the frequencies that a user asks for, ascending.

    Raises CampaignError with every frequency that has none within the frequency criterion, or
    that has the same one as another.
    """
    known = [k for k, track in enumerate(tracks) if track.n_stable >= criteria.least_picked]
    if not known:
        raise CampaignError(
            "no pole is stable over the orders: widen the band, raise the largest order, or look "
            "at the data"
        )
    at = np.array([tracks[place].frequency_hz for place in known])
    problems: list[str] = []
    chosen: list[int] = []
    for wanted in frequencies_hz:
        nearest = int(np.argmin(np.abs(at - wanted)))
        if abs(at[nearest] - wanted) > criteria.frequency * wanted:
            problems.append(
                f"no stable pole is within {100.0 * criteria.frequency:g} % of {wanted:g} Hz; the "
                f"nearest is at {at[nearest]:.4g} Hz"
            )
        elif nearest in chosen:
            problems.append(
                f"the stable pole nearest to {wanted:g} Hz, at {at[nearest]:.4f} Hz, is asked for "
                "twice"
            )
        chosen.append(nearest)
    if problems:
        raise CampaignError(problems)
    return tuple(sorted(known[place] for place in chosen))


def _agreement(
    item: OrderPoles, before: OrderPoles, criteria: Criteria
) -> tuple[NDArray[np.bool_], NDArray[np.bool_], NDArray[np.bool_]]:
    """Frequency, damping and shape of each pole against each of the order before."""
    f, zeta = before.frequencies_hz, before.damping_ratios
    near = np.abs(item.frequencies_hz[:, None] - f) <= criteria.frequency * f
    damped = np.abs(item.damping_ratios[:, None] - zeta) <= criteria.damping * zeta
    alike = mac(item.shapes, before.shapes) >= 1.0 - criteria.shape
    return near, damped, alike


def _link(
    tracks: Sequence[Sequence[tuple[int, int]]],
    orders: Sequence[OrderPoles],
    item: OrderPoles,
    criteria: Criteria,
) -> dict[int, int]:
    """Return which open track each pole of an order continues."""
    if not tracks or not item.poles.size:
        return {}
    last = [(orders[track[-1][0]], track[-1][1]) for track in tracks]
    f = np.array([order.frequencies_hz[pole] for order, pole in last])
    zeta = np.array([order.damping_ratios[pole] for order, pole in last])
    shapes = np.column_stack([order.shapes[:, pole] for order, pole in last])
    parts = (
        np.abs(item.frequencies_hz[:, None] - f) / (criteria.frequency * f),
        # Damping and shape may change more than the criteria from order to order and still be
        # the same mode's: a track is a row of neighbours, of which the stable ones are counted.
        np.abs(item.damping_ratios[:, None] - zeta) / (10.0 * criteria.damping * zeta),
        (1.0 - mac(item.shapes, shapes)) / (10.0 * criteria.shape),
    )
    cost = np.where(np.logical_and.reduce([part <= 1.0 for part in parts]), sum(parts), 1e6)
    rows, columns = least_cost(cost)
    return {
        int(pole): int(track)
        for pole, track in zip(rows, columns, strict=True)
        if cost[pole, track] < 1e6
    }


def _track(places: Sequence[tuple[int, int]], orders: Sequence[OrderPoles]) -> Track | None:
    stable = [
        (place, pole) for place, pole in places if orders[place].stability[pole] == Stability.STABLE
    ]
    if not stable:
        return None
    place, pole = stable[-1]
    return Track(
        places=np.array(places, dtype=np.int64),
        n_stable=len(stable),
        pole=complex(orders[place].poles[pole]),
        shape=np.asarray(orders[place].shapes[:, pole]),
    )


def _without_doubles(tracks: Sequence[Track]) -> list[Track]:
    kept: list[Track] = []
    for track in sorted(tracks, key=lambda item: -item.n_stable):
        width = track.damping_ratio * track.frequency_hz
        twin = any(
            abs(track.frequency_hz - other.frequency_hz)
            < max(width, other.damping_ratio * other.frequency_hz)
            and mac(track.shape[:, None], other.shape[:, None])[0, 0] > 0.9
            for other in kept
        )
        if not twin:
            kept.append(track)
    return kept
