"""Why a test and a model may disagree, from the modes of the model.

The causes come in the order in which one hides another: with a wrong unit no pair is right, with
wrong sensors no shape, with wrong supports no mode.
"""

from __future__ import annotations

from collections.abc import Sequence

from modetune.core.errors import ModesError
from modetune.core.modes import Floats
from modetune.core.updating.job_results import ModalResult
from modetune.flows.campaign.case import Case
from modetune.flows.diagnosis.boundary import boundary_findings
from modetune.flows.diagnosis.findings import Finding
from modetune.flows.diagnosis.measured_modes import data_findings
from modetune.flows.diagnosis.missing_modes import (
    absent_findings,
    lost_findings,
    order_findings,
    unmeasured,
)
from modetune.flows.diagnosis.pairing import ModePreview, factor_findings, preview
from modetune.flows.diagnosis.point_mass import point_mass_findings
from modetune.flows.diagnosis.sensors import suspected_sensors

#: Number of causes that a message names.
NAMED = 3


def causes(case: Case, result: ModalResult, columns: Floats | None = None) -> tuple[Finding, ...]:
    """Return what may be wrong with a test that the modes of a model do not match.

    result: modes at the nodes of the sensors and others. columns: as in `point_mass_findings`.
    """
    data = [item for item in data_findings(case.measured) if item.level != "good"]
    found: list[Finding] = []
    try:
        modes = _preview(case, result)
        found += [i for i in model_causes(case, result, modes, columns) if i.level != "good"]
        if not found:
            found += absent_findings(result.elastic, modes, case.rules)
    except ModesError:  # fewer modes than the test has, or no common sensor
        pass
    return tuple(sorted([*found, *data], key=lambda item: item.level != "wrong"))


def model_causes(
    case: Case,
    result: ModalResult,
    modes: tuple[ModePreview, ...],
    columns: Floats | None = None,
) -> tuple[Finding, ...]:
    """Return what is wrong with pairs of test and model, good findings included.

    modes: all measured modes with their pairs; columns: as in `causes`. Raises ModesError.
    """
    test = case.measured
    seen = case.sensors.observe(result.elastic) if test.has_shapes else result.elastic
    unit = tuple(factor_findings(test, seen, case.rules))
    if any(item.level == "wrong" for item in unit):  # no pair within the bounds is right then
        return unit
    if not test.has_shapes:
        order = tuple(order_findings(test, seen, case.rules))
        mass = () if unit or order else tuple(point_mass_findings(case, result, modes, columns))
        return (*unit, *order, *mass)
    sensors = tuple(suspected_sensors(test, case.sensors, result.elastic, modes))
    missing = tuple(unmeasured(test, seen, modes, _leaves_modes_out(case)))
    if unit or sensors:
        return (*unit, *sensors, *(item for item in missing if item.level == "good"))
    supports = tuple(boundary_findings(case, result))
    if supports:
        return supports
    return (
        *point_mass_findings(case, result, modes, columns),
        *lost_findings(test, seen, modes, case.rules),
        *missing,
    )


def _preview(case: Case, result: ModalResult) -> tuple[ModePreview, ...]:
    test = case.measured
    seen = case.sensors.observe(result.elastic) if test.has_shapes else result.elastic
    return preview(test, seen, case.rules)


def _leaves_modes_out(case: Case) -> bool:
    """Return whether the test has modes that the campaign neither uses nor holds out."""
    there = case.measurement.modes
    return there is not None and not set(there.numbers) <= set(case.measured.numbers)


def cause_sentences(found: Sequence[Finding]) -> tuple[str, ...]:
    """Return a sentence for each of the first few causes, with its remedy."""
    return tuple(f"A possible cause: {item.text}." for item in found[:NAMED])
