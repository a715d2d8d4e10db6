"""Modes as a test file that campaigns read, by the file's name."""

from __future__ import annotations

from pathlib import Path

from modetune.adapters.test_files.hdf5 import write_test_hdf5
from modetune.adapters.test_files.modes_csv import write_modes_csv
from modetune.adapters.test_files.universal.write import write_universal
from modetune.core.errors import CampaignError
from modetune.core.measurement.measurement import Measurement, TestGeometry
from modetune.core.modes import MeasuredModes

FORMS = (".csv", ".h5", ".unv", ".uff")


def check_out(path: Path) -> None:
    """Refuse what cannot be written, before the work is done. Raises CampaignError."""
    if path.suffix.lower() not in FORMS:
        raise CampaignError(f"{path}: a test file is written as {', '.join(FORMS)}, by its name")


def write_test(
    path: Path, modes: MeasuredModes, geometry: TestGeometry | None, comments: tuple[str, ...]
) -> None:
    """Write real modes, in CSV and HDF5 with comments on how they came about.

    geometry: of the test, which universal files and HDF5 take along. Raises StorageUnavailable,
    CampaignError for an unknown ending.
    """
    check_out(path)
    if path.suffix.lower() == ".csv":
        write_modes_csv(path, modes.numbers, modes.modes, comments)
    elif path.suffix.lower() == ".h5":
        write_test_hdf5(path, Measurement(modes, geometry, None, comments))
    else:
        write_universal(path, Measurement(modes, geometry))
