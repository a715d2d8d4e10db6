"""Sensors that seem turned round or exchanged, by the modes that test and model have in common."""

from __future__ import annotations

import numpy as np

from modetune.core.correlation.sensor_errors import SensorError, sensor_errors
from modetune.core.modes import MeasuredModes, ModeSet, common_dofs
from modetune.flows.studies.check.findings import Finding
from modetune.flows.studies.check.measured_modes import sensor_name
from modetune.flows.studies.check.pairing import ModePreview

#: A pair of a lower MAC may be no pair, and tells nothing of sensors.
BELIEVED_MAC = 0.5


def suspected_sensors(
    test: MeasuredModes, elastic: ModeSet, modes: tuple[ModePreview, ...]
) -> list[Finding]:
    """A finding for each sensor, or two, whose change lifts the MAC clearly.

    elastic: computed modes as the test's sensors see them; modes: as paired.
    """
    believed = [mode for mode in modes if mode.judged_mac >= BELIEVED_MAC]  # NaN without shapes
    if not believed:
        return []
    rows, seen = common_dofs(test.modes, elastic)
    columns = [test.numbers.index(mode.mode) for mode in believed]
    shapes = elastic.mode_shapes[seen]
    spaces = []
    for mode in believed:
        space = shapes[:, np.array(mode.answering) - 1]
        spaces.append(space[:, space.any(axis=0)])
    errors = sensor_errors(test.modes.mode_shapes[rows][:, columns], spaces)
    return [
        _finding(test.modes, rows[list(error.rows)].tolist(), error, believed) for error in errors
    ]


def _finding(
    modes: ModeSet, rows: list[int], error: SensorError, believed: list[ModePreview]
) -> Finding:
    most = int(np.argmax(error.after - error.before))
    gain = (
        f"the MAC of mode {believed[most].mode} would be {error.after[most]:.2f} instead of "
        f"{error.before[most]:.2f}"
    )
    names = [sensor_name(modes, row) for row in rows]
    if len(names) == 1:
        return Finding(
            "doubtful",
            "sensors",
            f"turned round, {gain}",
            f"sensor {names[0]}",
            "upside down, or a wrong sign in the test's file?",
        )
    return Finding(
        "doubtful",
        "sensors",
        f"swapped? Exchanged, {gain}",
        f"sensors {' and '.join(names)}",
        "look at cables and channel names",
    )
