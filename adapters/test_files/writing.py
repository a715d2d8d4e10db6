"""A test in a file that campaigns read, of the form that the file's name tells."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from modetune.adapters.test_files.geometry_csv import write_geometry_csv
from modetune.adapters.test_files.hdf5 import write_test_hdf5
from modetune.adapters.test_files.measurements import CSV, HDF5, UNIVERSAL
from modetune.adapters.test_files.modes_csv import write_modes_csv
from modetune.adapters.test_files.universal.write import write_universal
from modetune.core.errors import CampaignError
from modetune.core.measurement.measurement import Measurement, TestGeometry
from modetune.core.modes import MeasuredModes


def check_out(path: Path) -> None:
    """Refuse what cannot be written, before the work is done. Raises CampaignError."""
    if path.suffix.lower() not in (*CSV, *HDF5, *UNIVERSAL):
        raise CampaignError(f"{path}: a test file is written as .csv, .h5 or .unv, by the suffix")


def write_modes(
    path: Path, modes: MeasuredModes, geometry: TestGeometry | None, comments: tuple[str, ...]
) -> None:
    """Write modes with comments on how they came about; in CSV without the points of the test.

    Raises as `write_test` does.
    """
    points = None if path.suffix.lower() in CSV else geometry
    write_test(path, Measurement(modes, points, None, comments), comments)


def write_test(path: Path, test: Measurement, comments: Sequence[str] = ()) -> list[Path]:
    """Write a test; as CSV with comments, and with points in a file beside the modes.

    Returns what was written. Raises StorageUnavailable, CampaignError for an unknown ending or
    where CSV has no form for what there is.
    """
    check_out(path)
    suffix = path.suffix.lower()
    if suffix not in CSV:
        (write_test_hdf5 if suffix in HDF5 else write_universal)(path, test)
        return [path]
    written = []
    if (modes := test.modes) is not None:
        write_modes_csv(path, modes.numbers, modes.modes, comments, test.deviations)
        written.append(path)
    if test.geometry is not None:
        points = path.with_name(f"{path.stem}-points.csv") if written else path
        write_geometry_csv(points, test.geometry, comments[:1])
        written.append(points)
    if not written:
        raise CampaignError(f"{path}: response functions are not written as CSV; name an .h5")
    return written
