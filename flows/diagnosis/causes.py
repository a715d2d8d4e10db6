"""Why a test and a model may disagree: units, copied data, reversed and exchanged sensors."""

from __future__ import annotations

from collections.abc import Sequence

from modetune.core.errors import ModesError
from modetune.core.modes import ModeSet
from modetune.flows.campaign.case import Case
from modetune.flows.diagnosis.findings import Finding
from modetune.flows.diagnosis.measured_modes import data_findings
from modetune.flows.diagnosis.pairing import factor_findings, preview
from modetune.flows.diagnosis.sensors import suspected_sensors

#: Number of causes that a message names.
NAMED = 3


def causes(case: Case, elastic: ModeSet) -> tuple[Finding, ...]:
    """Return what may be wrong with a test that the modes of a model do not match.

    elastic: the model's elastic modes at the nodes of the sensors.
    """
    test = case.measured
    found = [item for item in data_findings(test) if item.level != "good"]
    try:
        seen = case.sensors.observe(elastic) if test.has_shapes else elastic
        wrong_unit = tuple(factor_findings(test, seen))
        if wrong_unit:  # no pair within the bounds is right then
            return wrong_unit
        modes = preview(test, seen, case.rules)
    except ModesError:  # fewer modes than the test has, or no common sensor
        return tuple(found)
    if test.has_shapes:
        found += suspected_sensors(test, case.sensors, elastic, modes)
    return tuple(found)


def cause_sentences(found: Sequence[Finding]) -> tuple[str, ...]:
    """Return a sentence for each of the first few causes, with its remedy."""
    return tuple(f"A possible cause: {item.text}." for item in found[:NAMED])
