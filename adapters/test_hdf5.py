"""A test as HDF5, modetune's own documented form, which loses nothing.

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

Each group may be missing. The first 512 bytes hold a SHA-256 of all that follows: HDF5 hangs or
crashes on some files with a wrong byte, so it is looked at before HDF5 sees the file. Programs
other than modetune write such files by `write_test_hdf5`.
"""

from __future__ import annotations

import hashlib
import io
from dataclasses import fields
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from modetune.core.errors import CampaignError, ModesError
from modetune.core.geometry import TestGeometry
from modetune.core.measurement import MeasuredFrfs, Measurement
from modetune.core.modes import MeasuredModes, ModeSet
from modetune.core.store import writing

__test__ = False  # tests are what it holds, not what it is

FORMAT, VERSION = "modetune test data", 1
BLOCK = 512
SEAL = b"modetune test data\nsha256 "
_MODES = ("frequencies_hz", "mode_shapes", "nodes", "components", "damping_ratios")


def write_test_hdf5(path: Path, measurement: Measurement) -> None:
    """Write a test whole or not at all. Raises StorageUnavailable."""
    image = io.BytesIO()
    with h5py.File(image, "w", userblock_size=BLOCK) as file:
        file.attrs.update(format=FORMAT, version=VERSION)
        # A note may name a path that is not UTF-8.
        notes = [note.encode("utf-8", "backslashreplace") for note in measurement.notes]
        file.create_dataset("notes", data=notes, dtype=h5py.string_dtype())
        if measurement.modes is not None:
            modes = measurement.modes.modes
            group = file.create_group("modes")
            group.attrs["normalisation"] = modes.normalisation
            group["numbers"] = np.array(measurement.modes.numbers, dtype=np.int64)
            for name in _MODES:
                group[name] = getattr(modes, name)
        if measurement.geometry is not None:
            group = file.create_group("geometry")
            group.attrs["metres"] = measurement.geometry.metres
            for name in _arrays(TestGeometry):
                group[name] = getattr(measurement.geometry, name)
        if measurement.frfs is not None:
            group = file.create_group("frfs")
            group.attrs["kind"] = measurement.frfs.kind
            for name in _arrays(MeasuredFrfs):
                group[name] = getattr(measurement.frfs, name)
    content = image.getbuffer()[BLOCK:]
    with writing(path) as part, part.open("wb") as written:
        written.write(_seal(content))
        written.write(content)


def read_test_hdf5(path: Path) -> Measurement:
    """Read a test. Raises CampaignError where the file is damaged or of another form."""
    try:
        data = path.read_bytes()
    except OSError as error:
        raise CampaignError(f"test file {path} cannot be read: {error.strerror}") from error
    if not data.startswith(SEAL):
        raise CampaignError(
            f"test file {path} is no test that modetune wrote as HDF5; write one with "
            "`modetune inspect FILES --write OUT.h5`"
        )
    if data[:BLOCK] != _seal(memoryview(data)[BLOCK:]):
        raise CampaignError(
            f"the checksum of test file {path} does not hold: it was damaged or cut short; copy or "
            "write it again"
        )
    try:
        with h5py.File(io.BytesIO(data), "r") as file:
            if file.attrs["format"] != FORMAT or int(file.attrs["version"]) > VERSION:
                raise CampaignError(
                    f"test file {path} has version {file.attrs['version']} of the form; this "
                    f"modetune reads up to {VERSION}"
                )
            return _measurement(file)
    except (OSError, KeyError, RuntimeError, ValueError, TypeError, MemoryError) as error:
        raise CampaignError(f"test file {path} is not a readable test ({error})") from error
    except ModesError as error:
        raise CampaignError(f"test file {path}: {error}") from error


def is_test_hdf5(data: bytes) -> bool:
    """Whether these first bytes of a file are those of an HDF5 file, ours or another's."""
    return data.startswith((SEAL, b"\x89HDF\r\n"))


def _measurement(file: Any) -> Measurement:
    modes = geometry = frfs = None
    if "modes" in file:
        group = file["modes"]
        found = _read(group, _MODES)
        modes = MeasuredModes(
            tuple(_read(group, ("numbers",))["numbers"].tolist()),
            ModeSet(**found, normalisation=group.attrs["normalisation"]),
        )
    if "geometry" in file:
        group = file["geometry"]
        found = _read(group, _arrays(TestGeometry))
        geometry = TestGeometry(**found, metres=float(group.attrs["metres"]))
    if "frfs" in file:
        group = file["frfs"]
        found = _read(group, _arrays(MeasuredFrfs))
        frfs = MeasuredFrfs(**found, kind=group.attrs["kind"])
    return Measurement(modes, geometry, frfs, tuple(file["notes"].asstr()[()].tolist()))


def _read(group: Any, names: tuple[str, ...]) -> dict[str, Any]:
    """These datasets. Raises ValueError for one that is no array of numbers."""
    found = {name: np.asarray(group[name][()]) for name in names}
    for name, array in found.items():
        if array.dtype.kind not in "iufc" or not array.ndim:
            raise ValueError(f"`{name}` is no array of numbers")
    return found


def _arrays(form: Any) -> tuple[str, ...]:
    """The fields of a form that are arrays: datasets of the same names."""
    return tuple(field.name for field in fields(form) if field.name not in ("metres", "kind"))


def _seal(content: memoryview) -> bytes:
    """The first block of a file that goes on with this content."""
    return (SEAL + hashlib.sha256(content).hexdigest().encode()).ljust(BLOCK, b"\n")
