"""Modes from the result file of a solver, read as a test: another model in place of a measurement.

The adapters of the solvers read these files. What no sensor could measure is left out with a note:
modes without a frequency, rotations (their unit differs from that of translations, and no MAC may
mix them) and freedoms that never move. Shapes are in the displacement system of each node, as in
the files.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np

from modetune.adapters.calculix.frd import read_frd, read_frd_points
from modetune.adapters.nastran.f06 import read_f06
from modetune.adapters.nastran.hdf5_modes import read_hdf5_modes
from modetune.adapters.nastran.op2 import read_op2
from modetune.adapters.nastran.punch import read_punch
from modetune.adapters.nastran.results import unit_modes
from modetune.adapters.test_files.file_kind import FileKind, Form, Format
from modetune.core.errors import CampaignError, SolverError
from modetune.core.measurement.measurement import Measurement, TestGeometry
from modetune.core.modes import Floats, Integers, MeasuredModes, ModeSet, mode_set

#: Modes of less than this share of the file's highest frequency are taken for rigid: rounding left
#: 3e-6 to 1e-5 of it in free models; a body on soft mounts had 2e-4 of its elastic modes.
RIGID = 1e-4
#: A place for each node, or none.
Points = tuple[Integers, Floats]


def _nowhere() -> Points:
    return np.zeros(0, dtype=np.int64), np.zeros((0, 3))


def _printed(path: Path) -> ModeSet:
    """Return modes of a print file; frequencies alone where it has no eigenvectors.

    Raises ValueError.
    """
    printed = read_f06(path)
    if printed.fatal_messages:
        raise ValueError(f"the run failed: {printed.fatal_messages[0].text.strip()}")
    found = printed.modes
    if found.eigenvalues.size and not found.mode_shapes.size:
        return mode_set(np.sqrt(np.maximum(found.eigenvalues, 0.0)) / (2.0 * np.pi))
    return unit_modes(found)


READERS: dict[Form, Callable[[Path], tuple[ModeSet, Points]]] = {
    "op2": lambda path: (unit_modes(read_op2(path)), _nowhere()),
    "f06": lambda path: (_printed(path), _nowhere()),
    "punch": lambda path: (read_punch(path), _nowhere()),
    "frd": lambda path: (read_frd(path), read_frd_points(path)),
    "nastran hdf5": read_hdf5_modes,
}


def read_modes(path: Path, kind: FileKind) -> ModeSet:
    """Read all modes of a result file, unchanged. Raises CampaignError."""
    return _read(path, kind)[0]


def read_solver_results(path: Path, kind: FileKind) -> Measurement:
    """Read the elastic modes of a result file as those of a test. Raises CampaignError."""
    modes, (nodes, coordinates) = _read(path, kind)
    frequencies = modes.frequencies_hz
    elastic = np.flatnonzero(frequencies > RIGID * frequencies.max(initial=0.0))
    if not elastic.size:
        raise CampaignError(f"{path} holds no mode with a frequency above zero")
    notes = []
    if elastic.size < modes.n_modes:
        rigid = np.setdiff1d(np.arange(modes.n_modes), elastic)
        notes.append(
            f"{path}: modes {', '.join(str(n + 1) for n in rigid)} are taken for rigid "
            f"({frequencies[rigid].max():.2g} Hz at most) and left out"
        )
    turning = modes.components > 3
    moving = modes.mode_shapes[:, elastic].any(axis=1)
    if (turning & moving).any():
        notes.append(f"{path}: {(turning & moving).sum()} rotations are left out")
    if still := int((~turning & ~moving).sum()):
        notes.append(f"{path}: {still} freedoms that never move are left out")
    kept = modes.select(elastic).rows(np.flatnonzero(moving & ~turning))
    measured = MeasuredModes(tuple((elastic + 1).tolist()), kept)
    places = np.isin(nodes, kept.nodes)
    if not places.any():
        return Measurement(measured, notes=tuple(notes))
    geometry = TestGeometry(
        nodes[places], coordinates[places], np.tile(np.eye(3), (int(places.sum()), 1, 1))
    )
    return Measurement(measured, geometry, notes=tuple(notes))


def _read(path: Path, kind: FileKind) -> tuple[ModeSet, Points]:
    try:
        return READERS[kind.form](path)
    except SolverError as error:
        raise CampaignError(str(error)) from error
    except (ValueError, OverflowError) as error:
        raise CampaignError(f"{path} holds no modes that can be read: {error}") from error


FORMAT = Format(read=read_solver_results, read_modes=read_modes)
