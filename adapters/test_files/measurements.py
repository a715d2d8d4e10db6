"""A test from its files, whatever their form, as one Measurement.

What a file is shows its content (`kinds.py`), whatever its name. Universal files are read together,
since one may hold the points and another the modes. Tables of modes or points, whole tests as HDF5,
MATLAB's files and what solvers left join them. Parts that say the same thing twice and differently
are refused with both places.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from modetune.adapters.test_files.geometry_csv import geometry_of, is_geometry
from modetune.adapters.test_files.hdf5 import read_test_hdf5
from modetune.adapters.test_files.kinds import FileKind, kind_of
from modetune.adapters.test_files.mat import read_mat
from modetune.adapters.test_files.modes_csv import modes_of
from modetune.adapters.test_files.repeated_csv import is_repeated, repeated_of
from modetune.adapters.test_files.solver_results import READERS, computed_modes, read_solver_results
from modetune.adapters.test_files.tables import FileTable, read_tables
from modetune.adapters.test_files.universal.axes import Axes
from modetune.adapters.test_files.universal.file import read_universal
from modetune.core.correlation.complexity import real_shapes
from modetune.core.errors import CampaignError
from modetune.core.measurement.frf import Complexes
from modetune.core.measurement.measurement import Measurement, TestGeometry
from modetune.core.modes import Floats, MeasuredModes, ModeSet

#: How far places of one point may differ between files, relative to the structure's size.
SAME = 1e-4
#: Suffixes that are written, and say what a damaged file was meant to be.
UNIVERSAL, CSV, HDF5 = (".unv", ".uff", ".uf"), (".csv",), (".h5", ".hdf5")
TABLES = ("table", "workbook")


@dataclass(frozen=True, slots=True)
class FileContents:
    """What a file is (`kinds.Form`), and the datasets of a universal one by name, in order."""

    path: Path
    form: str
    datasets: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class Inspection:
    """A test with what each file is.

    collinearity: (n_modes,), modal phase collinearity as measured; empty where real.
    n_functions: functions of all kinds in universal files, used or not.
    """

    measurement: Measurement
    files: tuple[FileContents, ...]
    collinearity: Floats
    n_functions: int


def read_measurement(
    paths: Sequence[Path], metres: float | None = None, axes: Axes = "auto"
) -> Measurement:
    """Read the files of a test.

    metres: length of the coordinates' unit in metres, over what files say. axes: whether those of
    universal files are rows or columns of dataset 2420. Raises CampaignError with file and line,
    also where the files hold neither modes, points nor response functions.
    """
    measurement = inspect_files(paths, metres, axes).measurement
    if measurement.is_empty:
        raise CampaignError(
            [
                f"{', '.join(map(str, paths))}: no modes, points or response functions in it",
                *measurement.notes,
            ]
        )
    return measurement


def inspect_files(
    paths: Sequence[Path], metres: float | None = None, axes: Axes = "auto"
) -> Inspection:
    """Read the files of a test and tell what each is. Raises CampaignError."""
    if not paths:
        raise CampaignError("no test file is named")
    if metres is not None and not (math.isfinite(metres) and metres > 0.0):
        raise CampaignError(f"the length unit of the test is {metres:g} m; it must be above zero")
    forms = {path: _kind(path) for path in paths}
    if len(forms) < len(paths):
        raise CampaignError("a test file is named twice")
    universal = [path for path, kind in forms.items() if kind.form == "universal"]
    parts: list[tuple[str, Measurement]] = []
    datasets: dict[Path, tuple[str, ...]] = {}
    collinearity, n_functions = np.zeros(0), 0
    if universal:
        test = read_universal(universal, axes)
        parts.append((", ".join(map(str, universal)), test.measurement))
        datasets = {file.path: file.datasets for file in test.files}
        collinearity, n_functions = test.collinearity, test.n_functions
    for path, kind in forms.items():
        if kind.form != "universal":
            parts.append((str(path), _read_one(path, kind)))
    merged = _merged(parts)
    if metres is not None and merged.geometry is not None:
        merged = _in_unit(merged, merged.geometry, metres)
    files = tuple(
        FileContents(path, kind.form, datasets.get(path, ())) for path, kind in forms.items()
    )
    return Inspection(merged, files, collinearity, n_functions)


def read_computed(path: Path) -> ModeSet:
    """All modes that a program left in a file, with rotations. Raises CampaignError."""
    kind = _kind(path)
    if kind.form in READERS:
        return computed_modes(path, kind.form)
    read = _tables(path, kind, computed=True) if kind.form in TABLES else read_measurement([path])
    if read.modes is None:
        raise CampaignError("it has points or response functions, and no modes")
    return read.modes.modes


def _kind(path: Path) -> FileKind:
    """What a file is: by its content, and by its suffix where bytes do not tell.

    Raises CampaignError with what it is where nothing reads it.
    """
    kind, suffix = kind_of(path), path.suffix.lower()
    if kind.form in ("unknown", "table") and suffix in UNIVERSAL:
        return FileKind("universal", "a universal file")  # its reader says what is wrong
    if kind.form == "unknown" and suffix in HDF5:
        return FileKind("hdf5", "a test that modetune wrote as HDF5")
    if kind.form in ("", "unknown"):
        raise CampaignError(f"{path} is {kind.said}, not a test that can be read; {kind.remedy}")
    return kind


def _read_one(path: Path, kind: FileKind) -> Measurement:
    if kind.form in READERS:
        return read_solver_results(path, kind.form)
    if kind.form == "hdf5":
        return read_test_hdf5(path)
    if kind.form == "mat":
        return read_mat(path, kind.said)
    return _tables(path, kind)


def _tables(path: Path, kind: FileKind, computed: bool = False) -> Measurement:
    """Modes and points of a text's one table, or of a workbook's sheets. Raises CampaignError."""
    tables = read_tables(path)
    if kind.form == "table":
        return _of_table(tables[0], computed)
    wanted = [
        table
        for table in tables
        if table.first in ("mode", "frequency_hz", "node", "metres") or is_repeated(table)
    ]
    if not wanted:
        sheets = ", ".join(table.name.removeprefix(f"{path}, sheet ") for table in tables)
        raise CampaignError(
            f"{path} is {kind.said} with sheets {sheets}, and none begins with a heading `mode`, "
            "`frequency` or `node`"
        )
    merged = _merged([(table.name, _of_table(table, computed)) for table in wanted])
    over = tuple(f"{table.name} is passed over" for table in tables if table not in wanted)
    return replace(merged, notes=merged.notes + over)


def _of_table(table: FileTable, computed: bool) -> Measurement:
    if is_geometry(table):
        return Measurement(geometry=geometry_of(table))
    return repeated_of(table) if is_repeated(table) else modes_of(table, computed)


def _merged(parts: Sequence[tuple[str, Measurement]]) -> Measurement:
    """All parts as one. Raises CampaignError where two contradict each other."""
    whole, places = Measurement(), {"modes": "", "geometry": "", "frfs": ""}
    for place, part in parts:
        modes, geometry, frfs = part.modes, part.geometry, part.frfs
        if whole.modes is not None and modes is not None:
            modes = _joined_modes(whole.modes, modes, (places["modes"], place))
        if whole.geometry is not None and geometry is not None:
            geometry = _joined_points(whole.geometry, geometry, (places["geometry"], place))
        if whole.deviations is not None and part.deviations is not None:
            raise CampaignError(
                f"both {places['modes']} and {place} give deviations; leave them out of one"
            )
        if whole.frfs is not None and frfs is not None:
            raise CampaignError(
                f"both {places['frfs']} and {place} hold response functions; leave out one"
            )
        for name, found in (("modes", modes), ("geometry", geometry), ("frfs", frfs)):
            if found is not None:
                places[name] = place
        whole = Measurement(
            modes or whole.modes,
            geometry or whole.geometry,
            frfs or whole.frfs,
            whole.notes + part.notes,
            whole.deviations or part.deviations,
            whole.repeats or part.repeats,
            _complex_shapes(whole, part),
        )
    return whole


def _complex_shapes(first: Measurement, second: Measurement) -> Complexes | None:
    """Those of the part that has the modes; of joined modes none."""
    if first.modes is not None and second.modes is not None:
        return None
    return second.complex_shapes if first.modes is None else first.complex_shapes


def _joined_modes(
    first: MeasuredModes, second: MeasuredModes, places: tuple[str, str]
) -> MeasuredModes:
    """The same modes at the sensors of both. Raises CampaignError where they are not the same."""
    one, two = first.modes, second.modes
    if first.numbers != second.numbers or not np.allclose(
        one.frequencies_hz, two.frequencies_hz, rtol=1e-3, atol=0.0
    ):
        raise CampaignError(
            f"{places[0]} and {places[1]} hold different modes; files that are read together must "
            "be of one test, with the same numbers and frequencies"
        )
    names = [
        set(zip(modes.nodes.tolist(), modes.components.tolist(), strict=True))
        for modes in (one, two)
    ]
    shared = sorted(names[0] & names[1])
    if shared:
        raise CampaignError(
            f"{places[0]} and {places[1]} both give shapes at node {shared[0][0]}; leave out one"
        )
    return MeasuredModes(
        first.numbers,
        replace(
            one,
            mode_shapes=np.vstack([real_shapes(one.mode_shapes), real_shapes(two.mode_shapes)]),
            nodes=np.concatenate([one.nodes, two.nodes]),
            components=np.concatenate([one.components, two.components]),
            damping_ratios=one.damping_ratios if one.damping_ratios.size else two.damping_ratios,
            normalisation=one.normalisation
            if one.normalisation == two.normalisation
            else "unknown",
        ),
    )


def _joined_points(
    first: TestGeometry, second: TestGeometry, places: tuple[str, str]
) -> TestGeometry:
    """The points of both. Raises CampaignError where they give one point two places."""
    told = f"{places[0]} and {places[1]}"
    known = [not math.isnan(points.metres) for points in (first, second)]
    if all(known) and not math.isclose(first.metres, second.metres, rel_tol=1e-5):
        raise CampaignError(f"{told} give points in different units of length")
    shared, row, other = np.intersect1d(first.nodes, second.nodes, return_indices=True)
    size = float(np.ptp(first.coordinates, axis=0).max())
    apart = np.abs(first.coordinates[row] - second.coordinates[other]).max(axis=1, initial=0.0)
    turned = np.abs(first.frames[row] - second.frames[other]).max(axis=(1, 2), initial=0.0)
    wrong = np.flatnonzero((apart > SAME * size) | (turned > SAME))
    if wrong.size:
        raise CampaignError(f"{told} give node {shared[wrong[0]]} different places or axes")
    new = ~np.isin(second.nodes, first.nodes)
    return TestGeometry(
        nodes=np.concatenate([first.nodes, second.nodes[new]]),
        coordinates=np.concatenate([first.coordinates, second.coordinates[new]]),
        frames=np.concatenate([first.frames, second.frames[new]]),
        lines=np.concatenate([first.lines, second.lines]),
        faces=np.concatenate([first.faces, second.faces]),
        metres=first.metres if known[0] else second.metres,
    )


def _in_unit(measurement: Measurement, points: TestGeometry, metres: float) -> Measurement:
    """The same with the unit of its coordinates named; told where a file names another."""
    notes = measurement.notes
    if not math.isnan(points.metres) and not math.isclose(points.metres, metres, rel_tol=1e-5):
        notes += (
            f"the files have lengths in {points.metres:g} m; {metres:g} m is taken, as asked",
        )
    return replace(measurement, geometry=replace(points, metres=metres), notes=notes)
