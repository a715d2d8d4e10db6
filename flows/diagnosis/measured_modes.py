"""Plausibility of a test without the model: copied modes, faulty sensors, damping in percent.

The limits are wide enough that a sound test gives no finding.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import combinations

import numpy as np

from modetune.core.correlation.correlation import auto_mac
from modetune.core.modes import COMPONENTS, Floats, MeasuredModes, ModeSet
from modetune.core.near_names import listed
from modetune.flows.diagnosis.findings import (
    TEST,
    Finding,
    modes_left_out,
    sensors_dropped,
    setting,
)

#: Off the diagonal of the auto-MAC: above it the sensors hardly distinguish two modes.
ALIKE = 0.8
#: Numbers this near to each other (relative) were copied: no two measurements agree so well.
COPIED = 1e-6
#: 1 - MAC, about the square of the shapes' difference, of shapes that were copied with few digits.
COPIED_MAC = 1e-8
#: A sensor that stays below this share of the largest motion in every mode measures nothing.
STILL = 1e-6
#: A sensor this many times above all others in a mode dominates it.
DOMINATES = 10.0
#: Fewer sensors than this cannot identify an outlier.
FEW_SENSORS = 6
#: Fraction of critical; more is not light damping, and most likely percent.
HIGHEST_DAMPING = 0.2


def data_findings(test: MeasuredModes) -> Iterator[Finding]:
    """Report everything implausible in the measured modes."""
    yield from _frequencies(test)
    yield from _damping(test)
    if not test.has_shapes:
        return
    moving = np.abs(test.modes.mode_shapes).max(axis=0) > 0.0
    yield from (
        TEST.wrong(
            "the shape is zero at every sensor",
            f"test mode {number}",
            "leave the mode out with `test.use`, or export it again",
            modes_left_out(number),
        )
        for number, moves in zip(test.numbers, moving.tolist(), strict=True)
        if not moves
    )
    yield from _alike(test, moving)
    yield from _sensors(test)


def sensor_name(modes: ModeSet, row: int) -> str:
    """`node.component`, as test files name a sensor."""
    return f"{modes.nodes[row]}.{COMPONENTS[modes.components[row] - 1]}"


def _frequencies(test: MeasuredModes) -> Iterator[Finding]:
    frequencies = test.modes.frequencies_hz
    if not (frequencies > 0.0).all():
        rigid = [test.numbers[place] for place in np.flatnonzero(frequencies <= 0.0).tolist()]
        yield TEST.wrong(
            "the frequency is not above zero",
            f"test mode {listed(rigid)}",
            "leave rigid-body modes out with `test.use`",
            modes_left_out(*rigid),
        )
        return
    steps = np.diff(frequencies)
    if (steps < 0.0).any():
        late = [test.numbers[place + 1] for place in np.flatnonzero(steps < 0.0).tolist()]
        yield TEST.doubtful(
            "the frequencies are not in ascending order",
            f"test mode {listed(late)}",
            "check whether columns were mixed up",
            modes_left_out(*late),
        )
    for first, second in combinations(range(len(test.numbers)), 2):
        if abs(frequencies[second] / frequencies[first] - 1.0) < COPIED:
            yield TEST.doubtful(
                f"two modes have the same frequency, {frequencies[first]:.6g} Hz",
                f"test modes {test.numbers[first]} and {test.numbers[second]}",
                "leave one out with `test.use` if it was identified twice",
                modes_left_out(test.numbers[second]),
            )


def _damping(test: MeasuredModes) -> Iterator[Finding]:
    damping = test.modes.damping_ratios
    strange = [
        place
        for place, value in enumerate(damping.tolist())
        if value < 0.0 or value > HIGHEST_DAMPING
    ]
    if not strange:
        return
    values = listed(f"{damping[place]:.3g}" for place in strange)
    percent = float(np.median(damping)) > HIGHEST_DAMPING
    remedy = "damping ratios are fractions of critical: divide by 100 if these are percent"
    yield TEST.doubtful(
        f"damping ratio {values} is below zero or above 20 %",
        f"test mode {listed(test.numbers[place] for place in strange)}",
        remedy if percent else "identify the mode again, or leave it out",
        *([] if percent else [modes_left_out(*(test.numbers[place] for place in strange))]),
    )


def _alike(
    test: MeasuredModes, moving: np.ndarray[tuple[int], np.dtype[np.bool_]]
) -> Iterator[Finding]:
    shapes = test.modes.mode_shapes
    n_dof, n_modes = shapes.shape
    if n_dof < n_modes:
        yield TEST.doubtful(
            f"{n_dof} sensors cannot distinguish {n_modes} modes",
            "",
            "use fewer modes (`test.use`), or more sensors",
            setting("test.use"),
        )
    places = np.flatnonzero(moving)
    if n_dof < 2 or places.size < 2:
        return
    table = auto_mac(shapes[:, places])
    for first, second in combinations(range(places.size), 2):
        value = float(table[first, second])
        names = [test.numbers[places[place]] for place in (first, second)]
        where = f"test modes {names[0]} and {names[1]}"
        if n_dof > 2 and 1.0 - value < COPIED_MAC:
            yield TEST.wrong(
                "two modes have the same shape",
                where,
                "one is a copy: export the test again, or leave it out with `test.use`",
                modes_left_out(names[1]),
            )
        elif value > ALIKE:
            yield TEST.doubtful(
                f"the sensors can hardly distinguish two modes (auto-MAC {value:.3f})",
                where,
                "pairs of these modes may be swapped; add sensors, or use one of them",
                modes_left_out(names[1]),
            )


def _sensors(test: MeasuredModes) -> Iterator[Finding]:
    sizes = np.abs(test.modes.mode_shapes)
    units = sizes / np.where(sizes.max(axis=0) > 0.0, sizes.max(axis=0), 1.0)
    still = np.flatnonzero(units.max(axis=1) < STILL)
    if still.size:
        names = [sensor_name(test.modes, row) for row in still.tolist()]
        yield TEST.doubtful(
            f"no mode moves {still.size} sensor{'' if still.size == 1 else 's'}",
            listed(names),
            "a dead channel, or a direction in which the structure does not move; leave the "
            "row out if it was not measured",
            sensors_dropped(*names),
        )
    yield from _copied_rows(test, still.tolist())
    yield from _outliers(test, units)


def _copied_rows(test: MeasuredModes, still: list[int]) -> Iterator[Finding]:
    """Report identical rows, which cannot occur by chance with three modes or more."""
    shapes = test.modes.mode_shapes
    if shapes.shape[1] < 3:
        return
    firsts: dict[bytes, int] = {}
    copies: list[tuple[str, str]] = []
    for row, values in enumerate(shapes):
        if row in still:
            continue
        pattern = np.round(values / values[np.abs(values).argmax()], 6) + 0.0
        first = firsts.setdefault(pattern.tobytes(), row)
        if first != row and np.allclose(np.abs(values), np.abs(shapes[first]), rtol=COPIED, atol=0):
            copies.append((sensor_name(test.modes, first), sensor_name(test.modes, row)))
    if not copies:
        return
    yield TEST.doubtful(
        "sensors have identical values in all modes",
        listed(f"{first} = {other}" for first, other in copies),
        "if one channel was exported twice, leave one row out",
        sensors_dropped(*(other for _, other in copies)),
    )


def _outliers(test: MeasuredModes, units: Floats) -> Iterator[Finding]:
    """Report sensors that move far more than all others, and the modes in which they do."""
    if units.shape[0] < FEW_SENSORS:
        return
    order = np.argsort(units, axis=0)
    columns = np.arange(units.shape[1])
    ratio = units[order[-1], columns] / np.maximum(units[order[-2], columns], 1e-300)
    dominated = (ratio > DOMINATES) & (units.max(axis=0) > 0.0)
    for row in np.unique(order[-1][dominated]).tolist():
        modes = [place for place in np.flatnonzero(dominated).tolist() if order[-1][place] == row]
        yield TEST.doubtful(
            f"one sensor moves {min(ratio[modes].max(), 1e6):.3g} times as much as any other",
            f"sensor {sensor_name(test.modes, row)} in test mode "
            f"{listed(test.numbers[place] for place in modes)}",
            "look at its calibration and mounting, or leave its row out",
            sensors_dropped(sensor_name(test.modes, row)),
        )
