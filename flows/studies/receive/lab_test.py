"""One test of the lab: read, identified if it is a recording, and judged by an earlier test."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from modetune.adapters.test_files.hdf5 import write_test_hdf5
from modetune.adapters.test_files.measurements import read_histories, read_measurement
from modetune.core.errors import CampaignError, ModesError
from modetune.core.measurement.measurement import MeasuredDeviations, Measurement
from modetune.core.measurement.sensor_corrections import correct_sensors
from modetune.core.modes import Floats, MeasuredModes
from modetune.core.monitoring.tracked_modes import TrackedModes, doubts_about, track_modes
from modetune.flows.campaign.schema import TestSection
from modetune.flows.campaign.units import LENGTH_METRES
from modetune.flows.studies.identify.identification import IdentificationSettings
from modetune.flows.studies.identify.measured_functions import SpectraSettings, read_functions
from modetune.flows.studies.identify.operational_modes import OperationalModes, identify_test

#: The band in which modes are identified, relative to the lowest and highest earlier frequency.
BELOW, ABOVE = 0.6, 1.25


@dataclass(frozen=True, slots=True)
class LabTest:
    """A test of the lab under the campaign's numbers, and why it may be wrong."""

    measurement: Measurement
    tracked: TrackedModes
    doubts: tuple[str, ...]


def read_lab_test(
    path: Path,
    section: TestSection,
    before: MeasuredModes,
    own: Measurement,
    identification: IdentificationSettings,
) -> LabTest:
    """Read a test file, and follow the modes of an earlier test in it.

    section: the campaign's test, whose units, axes and corrections of sensors hold for the file
    too; own: the campaign's own test, whose points are taken where the file has none. before: the
    earlier modes, corrected. Raises CampaignError with the reason for a file that is of no use.
    """
    metres = None if section.length is None else LENGTH_METRES[section.length]
    whole = _with_modes(path, section, metres, before, identification)
    sensors = section.sensors
    try:
        corrected = correct_sensors(whole, sensors.reverse, sensors.exchange, sensors.drop)
    except ModesError as error:
        raise CampaignError(str(error)) from error
    assert whole.modes is not None
    assert corrected.modes is not None
    tracked = track_modes(before, corrected.modes)
    doubts = doubts_about(before, corrected.modes, tracked)
    places = list(tracked.places)
    kept = replace(
        whole,
        modes=MeasuredModes(tracked.modes.numbers, whole.modes.modes.select(places)),
        deviations=_deviations(whole.deviations, places),
        complex_shapes=None if whole.complex_shapes is None else whole.complex_shapes[:, places],
        geometry=whole.geometry or own.geometry,
        repeats=None,
    )
    return LabTest(kept, tracked, doubts)


def write_lab_test(path: Path, test: LabTest) -> None:
    """Write an accepted test for the update. Raises StorageUnavailable."""
    write_test_hdf5(path, test.measurement)


def _with_modes(
    path: Path,
    section: TestSection,
    metres: float | None,
    before: MeasuredModes,
    identification: IdentificationSettings,
) -> Measurement:
    """Return the test with its modes, identified where it has none."""
    histories, _ = read_histories([path])
    if not histories:
        whole = read_measurement([path], metres, section.axes)
        if whole.modes is not None:
            return whole
        if whole.frfs is None:
            raise CampaignError(f"{path} has neither modes nor anything to identify them from")
    functions, outputs = read_functions([path], SpectraSettings())
    if identification.band_hz is None:
        highest = _highest(before.modes.frequencies_hz, functions, outputs)
        band = (BELOW * float(before.modes.frequencies_hz.min()), highest)
        identification = replace(identification, band_hz=band)
    found, _ = identify_test(functions, outputs, identification, [path])
    notes = (*functions.notes, *found.notes)
    deviations = found.deviations if isinstance(found, OperationalModes) else None
    return replace(functions, modes=found.modes, notes=notes, deviations=deviations)


def _highest(earlier_hz: Floats, functions: Measurement, outputs: object) -> float:
    """Return the upper end of the band, at most what was measured."""
    highest = ABOVE * float(earlier_hz.max())
    if functions.frfs is not None:
        return min(highest, float(functions.frfs.frequencies_hz[-1]))
    step = getattr(outputs, "step_s", 0.0)
    return min(highest, 0.5 / step) if step else highest


def _deviations(
    deviations: MeasuredDeviations | None, places: Sequence[int]
) -> MeasuredDeviations | None:
    if deviations is None:
        return None
    both, index = deviations.correlation, np.array(places, dtype=np.int64)
    return MeasuredDeviations(
        deviations.frequencies[index],
        deviations.shapes[index],
        None if both is None else both[np.ix_(index, index)],
    )
