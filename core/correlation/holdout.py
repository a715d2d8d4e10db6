"""Modes of a test that take no part in updating: found in the model, judged before and after.

What an update was made from it must match; what was held out shows whether the model got better
or was only bent to fit. A held-out mode is looked for among the computed modes that no used mode
is paired with, so it never takes a partner from a used one. By its shape where shapes were
measured; else by its place in the order of all measured frequencies at first, and by the shape
that was found then later on.

It got worse where its frequency error grew by more than the frequency was measured with, where its
MAC fell by more than 0.02 (the scatter of a good test's MAC), or where it is not found any more.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

import numpy as np
from numpy.typing import NDArray

from modetune.core.correlation.pairing import (
    LOST_MAC,
    Pairing,
    pair_by_order,
    pair_by_shape,
    without_rounding,
)
from modetune.core.modes import Floats, Integers, MeasuredModes, ModeSet, mode_name, mode_set

#: A MAC that falls by more than this got worse.
MAC_FALL = 0.02
#: The position of a computed mode that was not found.
LOST = -1


@dataclass(frozen=True, slots=True)
class HeldOut:
    """Held-out modes before and after updating; all arrays are (n_modes,).

    numbers: of the test's modes; configurations: whose test each is of, empty where there is one.
    initial_hz, updated_hz: of the model, NaN where a mode is not
    found; error_initial, error_updated: relative frequency errors; mac_initial, mac_updated: the
    larger of MAC and MAC in the space of close modes, NaN where no shape was measured.
    worse: whether the mode got worse.
    """

    numbers: Integers
    test_hz: Floats
    initial_hz: Floats
    updated_hz: Floats
    error_initial: Floats
    error_updated: Floats
    mac_initial: Floats
    mac_updated: Floats
    worse: NDArray[np.bool_]
    configurations: tuple[str, ...] = ()

    @property
    def names(self) -> tuple[str, ...]:
        """What people call the modes."""
        of = self.configurations or ("",) * self.numbers.size
        return tuple(mode_name(*item) for item in zip(self.numbers.tolist(), of, strict=True))

    @property
    def any_worse(self) -> bool:
        return bool(self.worse.any())

    def only(self, which: NDArray[np.bool_]) -> HeldOut:
        """Some of the modes; which: (n_modes,)."""
        own = {name: getattr(self, name)[which] for name in _ARRAYS}
        pairs = zip(self.configurations, which.tolist(), strict=False)
        return HeldOut(**own, configurations=tuple(name for name, chosen in pairs if chosen))

    def reason(self, mode: int) -> str:
        """What became of a mode, in words that follow its name."""
        if np.isnan(self.updated_hz[mode]):
            return "is not found in the updated model"
        before = (
            "was not found"
            if np.isnan(self.initial_hz[mode])
            else (f"was {100 * self.error_initial[mode]:+.2f} % off in frequency")
        )
        text = f"{before} and is {100 * self.error_updated[mode]:+.2f} % off now"
        if np.isfinite(self.mac_updated[mode]):
            mac = f"{self.mac_initial[mode]:.3f} before and {self.mac_updated[mode]:.3f} now"
            text = f"{text}, MAC {mac}"
        return text


#: Fields of HeldOut that are arrays.
_ARRAYS = tuple(item.name for item in fields(HeldOut) if item.name != "configurations")


def together(first: MeasuredModes, second: MeasuredModes) -> MeasuredModes:
    """The modes of both, first's first; their sensors are the same."""
    one, two = first.modes, second.modes
    known = one.damping_ratios.size and two.damping_ratios.size
    modes = mode_set(
        np.concatenate([one.frequencies_hz, two.frequencies_hz]),
        np.concatenate([one.mode_shapes, two.mode_shapes], axis=1),
        one.nodes,
        one.components,
        np.concatenate([one.damping_ratios, two.damping_ratios]) if known else (),
        one.normalisation,
    )
    return MeasuredModes(first.numbers + second.numbers, modes)


def join_held_out(parts: Sequence[HeldOut]) -> HeldOut | None:
    """The modes of all parts in their order; nothing where there are none."""
    if not parts:
        return None
    whole = {name: np.concatenate([getattr(part, name) for part in parts]) for name in _ARRAYS}
    return HeldOut(**whole, configurations=sum((part.configurations for part in parts), ()))


def pair_held_out(
    held: MeasuredModes, used: MeasuredModes, computed: ModeSet, pairing: Pairing
) -> Pairing:
    """Held-out modes among the computed ones that `pairing` leaves free, positions of all of them.

    computed: as the test's sensors see them where shapes were measured. A mode that is not there
    has the position LOST, whatever becomes of the others.
    """
    free = np.setdiff1d(np.arange(computed.n_modes), pairing.computed)
    if held.has_shapes:
        return _by_shape(held.modes, computed, free)
    found = _lost(held.modes.n_modes, "no computed mode has its place in the order of frequency")
    known = np.concatenate([held.modes.frequencies_hz, used.modes.frequencies_hz])
    ranks = np.argsort(np.argsort(known, kind="stable"), kind="stable")[: held.modes.n_modes]
    there = np.flatnonzero(ranks < computed.n_modes)
    if not there.size:
        return found
    ordered = pair_by_order(held.modes.select(there), computed, np.delete(known, there))
    own = np.isin(ordered.computed, free)
    reasons = np.array(ordered.reasons)[own].tolist()
    return _placed(found, there[own], ordered.computed[own], reasons)


def track_held_out(
    before: Pairing, previous: ModeSet, computed: ModeSet, pairing: Pairing
) -> Pairing:
    """Held-out modes that continue the shapes they had, where no shape was measured.

    previous, computed: the computed modes of `before` and of now, at the same rows.
    """
    found = _lost(before.computed.size, "its shape does not continue")
    known = np.flatnonzero(before.computed != LOST)
    free = np.setdiff1d(np.arange(computed.n_modes), pairing.computed)
    if not known.size:
        return found
    tracked = _by_shape(previous.select(before.computed[known]), computed, free)
    there = tracked.computed != LOST
    reasons = [f"continues its shape, MAC {mac:.3f}" for mac in tracked.mac[there].tolist()]
    return _placed(found, known[there], tracked.computed[there], reasons)


def judge_held_out(
    held: MeasuredModes,
    frequency_deviations: Floats,
    initial: tuple[ModeSet, Pairing],
    updated: tuple[ModeSet, Pairing],
) -> HeldOut:
    """Compare held-out modes before and after.

    initial, updated: the computed modes and where the held-out ones are among them.
    frequency_deviations: (n_modes,), relative standard deviations of the measured frequencies.
    """
    test_hz = held.modes.frequencies_hz[initial[1].measured]
    known = frequency_deviations[initial[1].measured]
    hz = [_frequencies(*state) for state in (initial, updated)]
    errors = [values / test_hz - 1.0 for values in hz]
    macs = [pairing.judged_mac for _, pairing in (initial, updated)]
    return HeldOut(
        numbers=np.array([held.numbers[place] for place in initial[1].measured.tolist()]),
        test_hz=test_hz,
        initial_hz=hz[0],
        updated_hz=hz[1],
        error_initial=errors[0],
        error_updated=errors[1],
        mac_initial=macs[0],
        mac_updated=macs[1],
        worse=(
            (np.abs(errors[1]) > np.abs(errors[0]) + known)
            | (macs[1] < macs[0] - MAC_FALL)
            | np.isnan(hz[1]) & np.isfinite(hz[0])
        ),
    )


def unfound(test: MeasuredModes) -> tuple[ModeSet, Pairing]:
    """A state of the model in which none of these modes is found, for `judge_held_out`."""
    n_modes = test.modes.n_modes
    return mode_set([]), _lost(n_modes, "not found")


def _frequencies(computed: ModeSet, pairing: Pairing) -> Floats:
    found = pairing.computed != LOST
    values = np.full(found.size, np.nan)
    values[found] = computed.frequencies_hz[pairing.computed[found]]
    return values


def _by_shape(wanted: ModeSet, computed: ModeSet, free: Integers) -> Pairing:
    """As many of the wanted shapes as there are among the free computed modes; the others LOST."""
    lost = _lost(wanted.n_modes, "no computed mode that is free resembles it")
    if not free.size:
        return lost
    among = computed.select(free)
    # Zero shapes far from all others fill in if there are too few modes: they resemble nothing.
    spare = max(0, wanted.n_modes - free.size)
    if spare:
        shapes = without_rounding(among)
        far = 1e3 * max(among.frequencies_hz.max(), wanted.frequencies_hz.max())
        among = mode_set(
            np.concatenate([among.frequencies_hz, np.full(spare, far)]),
            np.concatenate([shapes, np.zeros((shapes.shape[0], spare))], axis=1),
            among.nodes,
            among.components,
        )
    found = pair_by_shape(wanted, among, lost_mac=0.0)
    there = found.judged_mac >= LOST_MAC
    placed = _placed(
        lost,
        np.flatnonzero(there),
        free[found.computed[there]],
        np.array(found.reasons)[there].tolist(),
    )
    return replace(
        placed,
        mac=np.where(there, found.mac, np.nan),
        subspace_mac=np.where(there, found.subspace_mac, np.nan),
    )


def _placed(lost: Pairing, which: Integers, positions: Integers, reasons: Sequence[str]) -> Pairing:
    """With the positions of some modes that were found."""
    computed, text = lost.computed.copy(), list(lost.reasons)
    computed[which] = positions
    for mode, reason in zip(which.tolist(), reasons, strict=True):
        text[mode] = reason
    return replace(lost, computed=computed, reasons=tuple(text))


def _lost(n_modes: int, reason: str) -> Pairing:
    unknown = np.full(n_modes, np.nan)
    return Pairing(
        np.arange(n_modes), np.full(n_modes, LOST), unknown, unknown, (reason,) * n_modes
    )
