"""The weighting of a test as the campaign's `residuals` say it, by the test's own names.

A name that the test has not, or whose value would count for nothing, is refused with its line and
the nearest name that there is.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import get_args

import numpy as np

from modetune.adapters.yaml_file import YamlFile
from modetune.core.measurement.measurement import Measurement
from modetune.core.modes import Floats, MeasuredModes, ModeSet, dof_name
from modetune.core.near_names import suggestion
from modetune.core.updating.weighting import Weighting
from modetune.flows.campaign.schema import CampaignFile
from modetune.flows.responses.residuals import ResidualSection, SensorKey
from modetune.flows.responses.section import OTHERS

#: Steps that know no weights, but which responses there are (thesis (34), (45)).
UNWEIGHTED = ("pseudo_inverse", "minimum_norm")


def weighting_of(
    section: ResidualSection, measurement: Measurement, test: MeasuredModes
) -> Weighting:
    """The weighting of modes of a test at their sensors; what the campaign does not say, the test
    may tell."""
    told = _told(measurement)
    by_mode = [
        np.array([section.of_mode(key, n, told.get(key, {}).get(n)) for n in test.numbers])
        for key in ("frequency_deviation", "shape_deviation", "frequency_weight", "shape_weight")
    ]
    by_sensor = [
        _by_sensor(values, test.modes)
        for values in (section.sensor_deviation, section.sensor_weight)
    ]
    correlation = _correlation(section, measurement, test)
    return replace(Weighting(*by_mode, *by_sensor), frequency_correlation=correlation)


def _correlation(section: ResidualSection, measurement: Measurement, test: MeasuredModes) -> Floats:
    """Correlation of frequencies (n, n) as far as the test tells their deviations; else none."""
    modes, known = measurement.modes, measurement.deviations
    if modes is None or known is None or known.correlation is None:
        return np.zeros((0, 0))
    rows = [modes.numbers.index(number) for number in test.numbers]
    told = np.array([section.of_mode("frequency_deviation", n, math.nan) for n in test.numbers])
    by_test = np.isnan(told)
    found = np.where(np.outer(by_test, by_test), known.correlation[np.ix_(rows, rows)], 0.0)
    np.fill_diagonal(found, 1.0)
    return found


def _told(measurement: Measurement) -> dict[str, dict[int, float]]:
    """Deviations that the test tells, by the campaign's key and the mode's number."""
    modes, known = measurement.modes, measurement.deviations
    if modes is None or known is None:
        return {}
    columns = {"frequency_deviation": known.frequencies, "shape_deviation": known.shapes}
    return {
        key: {
            number: value
            for number, value in zip(modes.numbers, values.tolist(), strict=True)
            if np.isfinite(value)
        }
        for key, values in columns.items()
    }


def kept_sensors(section: ResidualSection, test: MeasuredModes) -> MeasuredModes:
    """The test without the sensors that have no weight."""
    kept = np.flatnonzero(_by_sensor(section.sensor_weight, test.modes) > 0.0)
    if kept.size == test.modes.n_dof:
        return test
    return MeasuredModes(test.numbers, test.modes.rows(kept))


def weight_problems(
    source: YamlFile,
    file: CampaignFile,
    measurement: Measurement,
    used: Sequence[int],
    held_out: Sequence[int],
) -> list[str]:
    """Why the `residuals` do not fit the test. used, held_out: numbers of its modes."""
    section, test = file.residuals, measurement.modes
    assert test is not None
    found = []
    for keys, values in section.by_mode:
        judged = (*used, *held_out) if keys == ("frequency_deviation",) else used
        for name in values:
            said = "" if name == OTHERS else _mode_problem(name, test.numbers, judged)
            if said:
                where = source.where(("residuals", *keys, name))
                found.append(f"{where}: residuals.{'.'.join(keys)}: {said}")
    for key in get_args(SensorKey):
        found += [
            f"{source.where(('residuals', key, name))}: residuals.{key}: {said}"
            for name in getattr(section, key)
            if (said := _sensor_problem(name, test))
        ]
    return found or _idle(source, file, measurement, test.use(tuple(used)))


def _mode_problem(name: str, numbers: Sequence[int], judged: Sequence[int]) -> str:
    has = ", ".join(map(str, numbers))
    if not name.isdecimal():
        return f"{name!r} is neither the number of a mode ({has}) nor `{OTHERS}`"
    if int(name) not in numbers:
        near = min(numbers, key=lambda number: abs(number - int(name)))
        return f"the test has no mode {name}; the nearest is {near} (it has {has})"
    if int(name) not in judged:
        return (
            f"mode {name} is not used, so this would count for nothing; use it, or leave this out"
        )
    return ""


def _sensor_problem(name: str, test: MeasuredModes) -> str:
    names = _sensor_names(test.modes)
    if not names:
        return "the test holds frequencies only, no sensors"
    if name in names or name in {item.partition(".")[0] for item in names}:
        return ""
    return f"the test has no sensor {name}{suggestion(name, names)}"


def _idle(
    source: YamlFile, file: CampaignFile, measurement: Measurement, test: MeasuredModes
) -> list[str]:
    """Weights that leave nothing, or that would count for nothing."""
    section, step = file.residuals, file.update.step
    where = source.where(("residuals",))
    weighting = weighting_of(section, measurement, test)
    weights = np.concatenate([weighting.frequency_weights, weighting.shape_weights])
    if not weights.any() and not any(kind.counts for kind in section.kinds.values()):
        return [f"{where}: residuals: all weights are 0; one must be above zero"]
    found = []
    if test.has_shapes and not weighting.sensor_weights.any():
        place = source.where(("residuals", "sensor_weight"))
        found.append(f"{place}: residuals.sensor_weight leaves out every sensor of the test")
    counted = [name for name, weight in section.sensor_weight.items() if weight > 0.0]
    if counted and not section.with_shapes:
        found.append(
            f"{source.where(('residuals', 'sensor_weight', counted[0]))}: residuals.sensor_weight: "
            f"{counted[0]} has a weight, but no shapes are compared; give `shape_weight`"
        )
    if step in UNWEIGHTED:
        found += [
            f"{source.where(('residuals', kind))}: residuals.{kind}: `step: {step}` knows no "
            "deviations, without which this cannot stand beside frequencies; use trust_region, "
            "weighted_least_squares or regularised"
            for kind in section.kinds
        ]
    if step in UNWEIGHTED and np.unique(weights[weights > 0.0]).size > 1:
        found.append(
            f"{where}: residuals: `step: {step}` knows no weights but 0, and those given differ; "
            "use weighted_least_squares or regularised, or one weight for all"
        )
    return found


def _by_sensor(given: Mapping[str, float], modes: ModeSet) -> Floats:
    """Values of the sensors (n_dof,): its own, that of its point, or 1."""
    return np.array(
        [given.get(name, given.get(name.partition(".")[0], 1.0)) for name in _sensor_names(modes)]
    )


def _sensor_names(modes: ModeSet) -> list[str]:
    return [
        dof_name(dof) for dof in zip(modes.nodes.tolist(), modes.components.tolist(), strict=True)
    ]
