"""Sensors that seem turned round or exchanged, by the modes that test and model have in common."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from modetune.core.correlation.correlation import Shapes
from modetune.core.correlation.sensor_errors import SensorError, sensor_errors
from modetune.core.correlation.turned_axes import turned_axes
from modetune.core.errors import ModesError
from modetune.core.measurement.sensors import SensorMap
from modetune.core.modes import Floats, MeasuredModes, ModeSet, common_dofs
from modetune.flows.studies.check.findings import SENSORS, Finding
from modetune.flows.studies.check.measured_modes import sensor_name
from modetune.flows.studies.check.pairing import ModePreview

#: A pair of a lower MAC may be no pair, and tells nothing of sensors.
BELIEVED_MAC = 0.2


def suspected_sensors(
    test: MeasuredModes, sensors: SensorMap, computed: ModeSet, modes: tuple[ModePreview, ...]
) -> list[Finding]:
    """A finding for each sensor, or two, that stands out of the others, or one for all axes.

    computed: elastic modes at the model's nodes; modes: as paired.
    """
    if not any(np.isfinite(mode.judged_mac) for mode in modes):  # NaN without shapes
        return []
    elastic = sensors.observe(computed)
    rows, seen = common_dofs(test.modes, elastic)

    def turned(matrix: Floats) -> Shapes | None:
        aside = replace(sensors, directions=sensors.directions @ matrix.T)
        try:
            return aside.observe(computed).mode_shapes[seen]
        except ModesError:  # a component that the model does not have
            return None

    axes = turned_axes(test.modes.mode_shapes[rows], turned)
    if axes is not None:
        return [
            SENSORS.doubtful(
                f"all axes {' or '.join(axes.told)}: mean MAC {axes.mac:.2f} instead of "
                f"{axes.before:.2f}",
                "",
                "x, y and z of the test are not those of the model: see cables, the test's "
                "geometry and `test.sensors`",
            )
        ]
    believed = [mode for mode in modes if mode.judged_mac >= BELIEVED_MAC]
    if not believed:
        return []
    columns = [test.numbers.index(mode.mode) for mode in believed]
    shapes = elastic.mode_shapes[seen]
    spaces = []
    for mode in believed:
        space = shapes[:, np.array(mode.answering) - 1]
        spaces.append(space[:, space.any(axis=0)])
    errors = sensor_errors(test.modes.mode_shapes[rows][:, columns], spaces, shapes)
    return [
        _finding(test.modes, rows[list(error.rows)].tolist(), error, believed) for error in errors
    ]


def _finding(
    modes: ModeSet, rows: list[int], error: SensorError, believed: list[ModePreview]
) -> Finding:
    most = int(np.argmax(error.after - error.before))
    gain = (
        f"the MAC of mode {believed[most].mode} would be {error.after[most]:.2f} instead of "
        f"{error.before[most]:.2f}; it stands out by {error.score:.0f} times the scatter of the "
        "others"
    )
    names = [sensor_name(modes, row) for row in rows]
    if len(names) == 1:
        return SENSORS.doubtful(
            f"turned round, {gain}",
            f"sensor {names[0]}",
            "upside down, or a wrong sign in the test's file?",
        )
    return SENSORS.doubtful(
        f"swapped? Exchanged, {gain}",
        f"sensors {' and '.join(names)}",
        "look at cables and channel names",
    )
