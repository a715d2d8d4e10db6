"""Plausibility of sensors: their nodes and directions, and reversed or exchanged sensors."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from modetune.core.correlation.correlation import Shapes
from modetune.core.correlation.sensor_errors import SensorError, sensor_errors, turned_axes
from modetune.core.errors import ModesError
from modetune.core.measurement.sensor_map import SensorMap
from modetune.core.modes import Floats, Integers, MeasuredModes, ModeSet, common_dofs
from modetune.core.near_names import listed
from modetune.flows.campaign.campaign import Campaign
from modetune.flows.campaign.mapping import CHOICE, REASONS, SensorRow
from modetune.flows.diagnosis.findings import (
    SENSORS,
    Finding,
    Level,
    Setting,
    sensors_dropped,
    setting,
)
from modetune.flows.diagnosis.measured_modes import sensor_name
from modetune.flows.diagnosis.pairing import ModePreview

#: Readers of test files begin a note of something doubtful with it.
DOUBT = "doubtful:"
#: Determine the pose of the test.
LANDMARKS = setting("test.sensors.match")
#: Cosine of an angle between directions that are as good as one.
ONE_DIRECTION = 0.99


def sensor_findings(campaign: Campaign, said: str = "") -> Iterator[Finding]:
    """Report doubtful, omitted and duplicate sensors, and the notes of reader and mapping.

    said: the remark on the pose chosen by measured shapes; it replaces a doubt about the poses.
    """
    if not campaign.test.has_shapes:
        return
    mapping = campaign.case.mapping
    uncertain = [
        SENSORS.doubtful(what, "", remedy, LANDMARKS)
        for what, remedy in mapping.uncertain
        if not (said and remedy == CHOICE)
    ]
    if said:
        remedy = CHOICE if mapping.others else ""
        level: Level = "doubtful" if remedy else "good"
        uncertain.append(Finding(level, "sensors", said, "", remedy, (LANDMARKS,) * bool(remedy)))
    yield from (_of_note(note) for note in (*campaign.case.measurement.notes, *mapping.notes))
    yield from uncertain
    yield from _by_reason(mapping.doubtful)
    yield from _by_reason(tuple(row for row in mapping.left_out if not row.at_rest), "left out: ")
    if mapping.alignment is not None:
        nodes, unit = np.unique(mapping.sensors.model_nodes).size, mapping.unit
        furthest = float(mapping.sensors.distances.max())
        where = f"{nodes} nodes" + " and bars" * bool(mapping.sensors.on_bars.any())
        said = f"{mapping.sensors.n_sensors} sensors on {where}, at most"
        away = f"{furthest:.4g} {unit}".rstrip()
        yield SENSORS.good(f"{said} {away} away")
    yield from _alike(campaign)


def _of_note(note: str) -> Finding:
    """Return a note of reader or mapping as a finding, doubtful if the note begins so."""
    if note.startswith(DOUBT):
        return SENSORS.doubtful(note.removeprefix(DOUBT).strip(), "", "check the test's files")
    return SENSORS.good(note)


def _by_reason(rows: tuple[SensorRow, ...], before: str = "") -> Iterator[Finding]:
    """Group sensors with the same reason into one finding."""
    names: dict[str, list[str]] = {}
    for row in rows:
        names.setdefault(row.reason, []).append(row.sensor)
    shown = [*names.items()][:REASONS]
    if len(names) > REASONS:
        others = [sensor for sensors in [*names.values()][REASONS:] for sensor in sensors]
        shown.append(("for reasons like these", others))
    yield from (
        SENSORS.doubtful(
            f"{before}{reason}",
            f"sensor {listed(sensors)}",
            "check the test's geometry and `test.sensors`, or name the node by hand",
            LANDMARKS,
            *([] if before else [sensors_dropped(*sensors)]),
        )
        for reason, sensors in shown
    )


def _alike(campaign: Campaign) -> Iterator[Finding]:
    """Report sensors that measure the same direction at the same node."""
    seen = campaign.case.sensors
    order = np.lexsort((seen.turns, seen.model_nodes))
    order = order[~seen.on_bars[order]]  # on arms they move differently
    pairs_found: list[Integers] = []
    # Of one node come next to each other; with six ways to look, the later ones repeat the
    # findings.
    for behind in range(1, min(6, order.size)):
        one, other = order[:-behind], order[behind:]
        cosines = np.abs(np.sum(seen.directions[one] * seen.directions[other], axis=1))
        same = (seen.model_nodes[one] == seen.model_nodes[other]) & (
            seen.turns[one] == seen.turns[other]
        )
        alike = same & (cosines > ONE_DIRECTION)
        pairs_found.append(np.sort(np.column_stack([one[alike], other[alike]]), axis=1))
    if not any(found.size for found in pairs_found):
        return
    found = np.unique(np.concatenate(pairs_found), axis=0)
    modes = campaign.test.modes
    pairs = [f"{sensor_name(modes, a)} and {sensor_name(modes, b)}" for a, b in found.tolist()]
    yield SENSORS.doubtful(
        "they measure the same direction at the same node",
        f"sensors {listed(pairs)}",
        "refine the mesh there, or check the positions of the sensors",
        sensors_dropped(*dict.fromkeys(sensor_name(modes, b) for _, b in found.tolist())),
    )


#: Pairs with a lower MAC may be wrong and are no evidence about sensors.
BELIEVED_MAC = 0.2


def suspected_sensors(
    test: MeasuredModes, sensors: SensorMap, computed: ModeSet, modes: tuple[ModePreview, ...]
) -> list[Finding]:
    """A finding for each outlying sensor, or two, or one for all axes.

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
                "x, y and z of the test differ from those of the model: check cables, the test's "
                "geometry and `test.sensors`",
                setting("test.sensors.rotation"),
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
        f"{error.before[most]:.2f}; its misfit is {error.score:.0f} times the scatter of "
        "the others"
    )
    names = [sensor_name(modes, row) for row in rows]
    if len(names) == 1:
        return SENSORS.doubtful(
            f"reversed? With the other sign {gain}",
            f"sensor {names[0]}",
            "if it was mounted upside down or has the wrong sign, set "
            f"`test.sensors.reverse: [{names[0]}]`",
            Setting(("test", "sensors", "reverse"), (names[0],), "add"),
        )
    return SENSORS.doubtful(
        f"exchanged? With each other's channel {gain}",
        f"sensors {' and '.join(names)}",
        "if cables or channel names were mixed up, set "
        f"`test.sensors.exchange: [[{', '.join(names)}]]`",
        Setting(("test", "sensors", "exchange"), (names,), "add"),
    )
