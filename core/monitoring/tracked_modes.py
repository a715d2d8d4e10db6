"""The modes of a new test under the numbers of an earlier one, and why the test may be wrong.

An identification counts its modes from 1, and another night it finds one more or one less. Modes go
together one to one, at the least sum over pairs of

    1 - MAC + |ln(f_new / f_before)| / REACH,

with the MAC at common sensors. A member of a set of close modes has the share of its shape in the
space of the whole set instead, because shapes turn within it from test to test. Without shapes the
frequencies decide.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from modetune.core.assignment import least_cost
from modetune.core.brief import brief
from modetune.core.correlation.correlation import mac, subspace_macs
from modetune.core.correlation.sensor_errors import sensor_errors
from modetune.core.modes import Floats, MeasuredModes, ModeSet, close_sets, common_dofs, dof_name

#: Change of a frequency up to which it is that of the same mode, as a logarithm.
REACH = 0.2
#: MAC from which a shape is that of the same mode: below, half of it is something else.
LEAST_MAC = 0.5
#: Relative distance of modes whose shapes may turn into each other from test to test.
CLOSE = 0.02
#: Share of the earlier modes, and of their sensors, that a sound test has.
ENOUGH = 0.5
#: MAC of shapes that are surely the same, for which frequencies are then compared.
SURE_MAC = 0.9
#: All frequencies off by one factor: modes that show it, its size, and its scatter, as logarithms.
SCALED_MODES, SCALED, SCATTER = 3, 0.1, 0.02
#: Part of the largest motion below which a sensor measured nothing.
STILL = 1e-9


@dataclass(frozen=True, slots=True, repr=False)
class TrackedModes:
    """The modes of a new test that an earlier one has.

    modes: under the earlier numbers; places: (n_modes,), of these in the new test; macs:
    (n_modes,), NaN without shapes. missing: earlier numbers without a partner; new_hz: (n_new,),
    frequencies of the modes that the earlier test does not have.
    """

    modes: MeasuredModes
    places: tuple[int, ...]
    macs: Floats
    missing: tuple[int, ...]
    new_hz: Floats

    __repr__ = brief


def track_modes(before: MeasuredModes, found: MeasuredModes) -> TrackedModes:
    """Return the modes of a test under the numbers of an earlier test."""
    alike = _likeness(before.modes, found.modes)
    shift = np.abs(_log_ratios(before.modes, found.modes))
    cost = np.nan_to_num(1.0 - alike) + shift / REACH
    forbidden = (shift > REACH) | (alike < LEAST_MAC)
    rows, columns = least_cost(np.where(forbidden, 10.0 + cost, cost))
    kept = ~forbidden[rows, columns]
    rows, columns = rows[kept], columns[kept]
    numbers = tuple(before.numbers[row] for row in rows.tolist())
    new = np.setdiff1d(np.arange(found.modes.n_modes), columns)
    return TrackedModes(
        modes=MeasuredModes(numbers, found.modes.select(columns)),
        places=tuple(columns.tolist()),
        macs=alike[rows, columns],
        missing=tuple(number for number in before.numbers if number not in numbers),
        new_hz=found.modes.frequencies_hz[new],
    )


def doubts_about(
    before: MeasuredModes, found: MeasuredModes, tracked: TrackedModes
) -> tuple[str, ...]:
    """Return why a test may be wrong, a sentence each; empty for a sound one."""
    return tuple(_doubts(before, found, tracked))


def _doubts(before: MeasuredModes, found: MeasuredModes, tracked: TrackedModes) -> Iterator[str]:
    if before.has_shapes and not found.has_shapes:
        yield "it has frequencies only, and earlier tests have shapes"
    both = before.has_shapes and found.has_shapes
    if both:
        yield from _sensor_doubts(before.modes, found.modes)
        factor = _common_factor(before.modes, found.modes)
        if factor is not None:
            yield (
                f"all frequencies are {factor:.3g} times those of earlier tests, with the same "
                "shapes: is the sampling rate right?"
            )
    n, wanted = len(tracked.modes.numbers), len(before.numbers)
    if n < ENOUGH * wanted:
        names = ", ".join(map(str, tracked.missing))
        yield f"only {n} of {wanted} modes were found again (not {names})"
    if both and n:
        yield from _turned_sensors(before, tracked)


def _likeness(before: ModeSet, found: ModeSet) -> Floats:
    """Return MAC or share in the space of close modes, (n_before, n_found); NaN without shapes."""
    unknown = np.full((before.n_modes, found.n_modes), np.nan)
    rows, there = common_dofs(before, found)
    if not rows.size:
        return unknown
    first, second = before.mode_shapes[rows], found.mode_shapes[there]
    if not (first.any(axis=0).all() and second.any(axis=0).all()):
        return unknown
    table = mac(first, second)
    for members in close_sets(before.frequencies_hz, CLOSE):
        if members.size > 1 and rows.size > members.size:
            table[members] = np.maximum(table[members], subspace_macs(second, first[:, members]))
    return table


def _log_ratios(before: ModeSet, found: ModeSet) -> Floats:
    """Return ln(f_found / f_before), (n_before, n_found)."""
    return np.asarray(
        np.log(found.frequencies_hz[None, :] / before.frequencies_hz[:, None]), dtype=np.float64
    )


def _sensor_doubts(before: ModeSet, found: ModeSet) -> Iterator[str]:
    rows, there = common_dofs(before, found)
    if rows.size < ENOUGH * before.n_dof:
        yield f"it has {rows.size} of the {before.n_dof} sensors of earlier tests"
    sizes = np.abs(found.mode_shapes[there]).max(axis=1, initial=0.0)
    moved = np.abs(before.mode_shapes[rows]).max(axis=1, initial=0.0) > 0.0
    still = rows[(sizes <= STILL * sizes.max(initial=0.0)) & moved]
    if still.size:
        yield f"{_names(before, still.tolist())} measured nothing"


def _common_factor(before: ModeSet, found: ModeSet) -> float | None:
    """Return the factor between all frequencies of modes with the same shapes; None for near 1."""
    alike = np.nan_to_num(_likeness(before, found))
    sure = (alike >= SURE_MAC) & (alike == alike.max(axis=1)[:, None])
    sure &= alike == alike.max(axis=0)
    ratios = _log_ratios(before, found)[sure]
    if ratios.size < SCALED_MODES:
        return None
    middle = float(np.median(ratios))
    scatter = float(np.abs(ratios - middle).max())
    return float(np.exp(middle)) if abs(middle) > SCALED and scatter < SCATTER else None


def _turned_sensors(before: MeasuredModes, tracked: TrackedModes) -> Iterator[str]:
    """Yield sensors that seem reversed or exchanged since the earlier test."""
    earlier = before.use(tracked.modes.numbers).modes
    rows, there = common_dofs(earlier, tracked.modes.modes)
    if not rows.size:
        return
    shapes, others = tracked.modes.modes.mode_shapes[there], earlier.mode_shapes[rows]
    if not (shapes.any(axis=0).all() and others.any(axis=0).all()):
        return
    for error in sensor_errors(shapes, [others[:, [k]] for k in range(others.shape[1])], others):
        names = _names(earlier, rows[list(error.rows)].tolist())
        what = "seems reversed" if len(error.rows) == 1 else "seem exchanged with each other"
        macs = f"mean MAC {error.before.mean():.3f}, undone {error.after.mean():.3f}"
        yield f"{names} {what} ({macs})"


def _names(modes: ModeSet, rows: list[int]) -> str:
    names = [dof_name((int(modes.nodes[row]), int(modes.components[row]))) for row in rows]
    sensors = "sensor" if len(names) == 1 else "sensors"
    return f"{sensors} {', '.join(names[:5])}{' and more' if len(names) > 5 else ''}"
