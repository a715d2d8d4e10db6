"""Identified modes as a test file that campaigns read."""

from __future__ import annotations

from pathlib import Path

from modetune.adapters.test_files.hdf5 import write_test_hdf5
from modetune.adapters.test_files.modes_csv import write_modes_csv
from modetune.adapters.test_files.universal.write import write_universal
from modetune.core.errors import CampaignError
from modetune.core.measurement.measurement import Measurement, TestGeometry
from modetune.flows.studies.identify.identify import Identification

FORMS = (".csv", ".h5", ".unv", ".uff")


def check_out(path: Path) -> None:
    """Refuse what cannot be written, before the work is done. Raises CampaignError."""
    if path.suffix.lower() not in FORMS:
        raise CampaignError(f"{path}: a test file is written as {', '.join(FORMS)}, by its name")


def write_modes(
    path: Path, found: Identification, geometry: TestGeometry | None, source: str
) -> None:
    """Write the real modes, in CSV with a comment on how they came about.

    geometry: of the test, which universal files and HDF5 take along. Raises StorageUnavailable,
    CampaignError for an unknown ending.
    """
    check_out(path)
    said = comments(found, source)
    if path.suffix.lower() == ".csv":
        write_modes_csv(path, found.modes.numbers, found.modes.modes, said)
    elif path.suffix.lower() == ".h5":
        write_test_hdf5(path, Measurement(found.modes, geometry, None, said))
    else:
        write_universal(path, Measurement(found.modes, geometry))


def comments(found: Identification, source: str) -> tuple[str, ...]:
    """Source, settings and quality, a line each."""
    lines, settings = found.frfs.frequencies_hz, found.settings
    limits = settings.criteria
    names = " ".join(source.split())
    chosen = f"nearest to {', '.join(map(str, settings.pick))} Hz" if settings.pick else "automatic"
    collinear = ", ".join(f"{value:.3f}" for value in found.phase_collinearity)
    worst = int(found.worst_functions[0])
    scale = {"mass": "unit modal mass in kg", "max": "largest entry 1"}
    return (
        f"identified by modetune from {names}",
        f"{found.frac.size} functions ({found.frfs.kind}), {lines[0]:g} to {lines[-1]:g} Hz, "
        f"{lines.size} lines, least-squares complex frequency, order {settings.order}",
        f"stable poles: frequency {limits.frequency:g}, damping {limits.damping:g}, shape "
        f"{limits.shape:g}; choice: {chosen}",
        f"shapes: {scale.get(found.modes.modes.normalisation, 'any scale')}; modal phase "
        f"collinearity {collinear}",
        f"FRAC: mean {found.frac.mean():.4f}, least {found.frac[worst]:.4f} at "
        f"{found.function_name(worst)}",
        *found.notes,
    )
