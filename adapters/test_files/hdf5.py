"""A test as HDF5: modetune's own documented format, which keeps everything.

    attributes          format = "modetune test data", version = 1
    notes               what readers decided or left out, strings
    modes/              numbers, frequencies_hz (n_modes,), mode_shapes (n_dof, n_modes), nodes,
                        components (n_dof,), damping_ratios (n_modes,) or empty;
                        attribute normalisation
    geometry/           nodes (n,), coordinates (n, 3), frames (n, 3, 3), lines (n, 2),
                        faces (n, 3); attribute metres (NaN: unknown)
    frfs/               frequencies_hz (n_lines,), values (n_lines, n_functions), nodes, components,
                        signs, reference_nodes, reference_components, reference_signs
                        (n_functions,), coherences (n_lines, n_functions) or empty; attribute kind
    deviations/         frequencies, shapes (n_modes,), relative, NaN: unknown; correlation
                        (n_modes, n_modes) of the frequencies
    repeats/            of repeated tests: places, numbers, frequencies_hz, damping_ratios, used
                        (n_tests, n_modes); attribute worth
    environment/        keys, values (n_quantities,): what else was measured, such as temperature_C
    attributes          measured_at, seconds since 1970

Each group may be missing. `core/storage/codec` writes it. The first 512 bytes hold a SHA-256 of all
that follows, which is verified before HDF5 opens the file (`core/storage/sealed_file`). Other
programs write such files with `write_test_hdf5`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from modetune.adapters.regular_file import largest, read_errors, read_regular
from modetune.adapters.test_files.file_kind import OWN_TITLE, Format
from modetune.core.errors import CampaignError, ModesError, StoreDamaged
from modetune.core.measurement.measurement import (
    MeasuredDeviations,
    MeasuredFrfs,
    Measurement,
    RepeatedTests,
    TestGeometry,
)
from modetune.core.modes import Floats, Integers, MeasuredModes, ModeSet, Normalisation
from modetune.core.storage.codec import read_value, write_value
from modetune.core.storage.files import writing
from modetune.core.storage.sealed_file import content, holds, sealed, title_of

__test__ = False  # it reads and writes tests, and is none

VERSION = 1


@dataclass(frozen=True, slots=True)
class _Modes:
    """Measured modes with their numbers, in one group."""

    numbers: Integers
    frequencies_hz: Floats
    mode_shapes: NDArray[np.float64] | NDArray[np.complex128]
    nodes: Integers
    components: Integers
    damping_ratios: Floats
    normalisation: Normalisation


@dataclass(frozen=True, slots=True)
class _File:
    """The content of the file."""

    format: str
    version: int
    notes: tuple[str, ...]
    modes: _Modes | None
    geometry: TestGeometry | None
    frfs: MeasuredFrfs | None
    deviations: MeasuredDeviations | None = None
    repeats: RepeatedTests | None = None
    environment: Mapping[str, float] | None = None
    measured_at: float | None = None


def write_test_hdf5(path: Path, measurement: Measurement) -> None:
    """Write a test whole or not at all. Raises StorageUnavailable."""
    modes = None
    if (measured := measurement.modes) is not None:
        columns = [getattr(measured.modes, item.name) for item in fields(ModeSet)]
        modes = _Modes(np.array(measured.numbers, dtype=np.int64), *columns)
    form = _File(
        OWN_TITLE,
        VERSION,
        measurement.notes,
        modes,
        measurement.geometry,
        measurement.frfs,
        measurement.deviations,
        measurement.repeats,
        measurement.environment or None,
        None if math.isnan(measurement.measured_at) else measurement.measured_at,
    )
    data = sealed(OWN_TITLE, lambda file: write_value(file, form))
    with writing(path) as part:
        part.write_bytes(data)


def read_test_hdf5(path: Path) -> Measurement:
    """Read a test. Raises CampaignError where the file is damaged or of another form."""
    with read_errors(f"test file {path}", CampaignError):
        data = read_regular(path, largest(0.5))
    if title_of(data) != OWN_TITLE:
        raise CampaignError(
            f"test file {path} is not a test that modetune wrote as HDF5; write one with "
            "`modetune files inspect FILES --write OUT.h5`"
        )
    if not holds(data, OWN_TITLE):
        raise CampaignError(
            f"the checksum of test file {path} does not hold: it was damaged or cut short; copy or "
            "write it again"
        )
    try:
        with content(data) as file:
            if file.attrs.get("version") != VERSION:
                raise CampaignError(
                    f"test file {path} has version {file.attrs.get('version')} of the form; this "
                    f"modetune reads {VERSION}"
                )
            form = read_value(file, _File)
        modes = None
        if form.modes is not None:
            columns = {item.name: getattr(form.modes, item.name) for item in fields(ModeSet)}
            modes = MeasuredModes(tuple(form.modes.numbers.tolist()), ModeSet(**columns))
    except (StoreDamaged, ModesError) as problem:
        raise CampaignError(f"test file {path} is not a readable test ({problem})") from problem
    return Measurement(
        modes,
        form.geometry,
        form.frfs,
        form.notes,
        form.deviations,
        form.repeats,
        environment=form.environment or {},
        measured_at=math.nan if form.measured_at is None else form.measured_at,
    )


FORMAT = Format(read=lambda path, kind: read_test_hdf5(path), write=write_test_hdf5)
