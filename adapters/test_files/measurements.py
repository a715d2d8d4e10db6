"""A test from its files, whatever their form, and in files.

The content of a file shows its form, whatever its name (`file_kind.py`). Tables of modes, points,
repeated tests and time histories are read here; every other format has its own module. Parts that
contradict each other are refused, with both places.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from importlib import import_module
from pathlib import Path

import numpy as np

from modetune.adapters.test_files.environment_csv import split_environment, split_time
from modetune.adapters.test_files.file_kind import (
    NUMBERS,
    SUFFIXES,
    Axes,
    FileKind,
    Form,
    Format,
    kind_of,
)
from modetune.adapters.test_files.geometry_csv import geometry_of, is_geometry, write_geometry_csv
from modetune.adapters.test_files.histories import history_of, is_history
from modetune.adapters.test_files.modes_csv import modes_of, write_modes_csv
from modetune.adapters.test_files.repeated_csv import is_repeated, repeated_of
from modetune.adapters.test_files.tables import FileTable, read_tables
from modetune.core.correlation.complexity import modal_phase_collinearity, real_shapes
from modetune.core.errors import CampaignError
from modetune.core.measurement.measurement import Measurement, TestGeometry
from modetune.core.measurement.time_histories import TimeHistories
from modetune.core.modes import Floats, MeasuredModes, ModeSet

#: The module of this folder whose FORMAT reads a form. To remove a format, delete both the module
#: and its line.
FORMATS: dict[Form, str] = {
    "universal": "universal.file",
    "hdf5": "hdf5",
    "mat": "mat",
    "op2": "solver_results",
    "f06": "solver_results",
    "punch": "solver_results",
    "frd": "solver_results",
    "nastran hdf5": "solver_results",
}
TABLES: tuple[Form, ...] = ("table", "workbook")
#: Difference between the places of one point in two files, relative to the structure's size.
SAME = 1e-4


@dataclass(frozen=True, slots=True)
class FileContents:
    """The form of a file (`file_kind.Form`), and the datasets of a universal file, in order."""

    path: Path
    form: str
    datasets: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class Inspection:
    """A test and the form of each of its files.

    collinearity: (n_modes,), modal phase collinearity as measured; empty for real modes.
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

    metres: length of the coordinates' unit in metres, which overrides the files. axes: whether the
    axes of universal files are the rows or columns of dataset 2420. Raises CampaignError with file
    and line, also where the files hold neither modes, points nor response functions.
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
    """Read the files of a test and report what each of them is. Raises CampaignError."""
    if not paths:
        raise CampaignError("no test file is named")
    if metres is not None and not (math.isfinite(metres) and metres > 0.0):
        raise CampaignError(f"the length unit of the test is {metres:g} m; it must be above zero")
    kinds = {path: _readable_kind(path) for path in paths}
    if len(kinds) < len(paths):
        raise CampaignError("a test file is named twice")
    formats = {kind.form: _format(kind.form) for kind in kinds.values()}
    parts: list[tuple[str, Measurement]] = []
    datasets: dict[Path, tuple[str, ...]] = {}
    n_functions = 0
    for form, found in formats.items():
        if found.read_together:
            files = [path for path, kind in kinds.items() if kind.form == form]
            measurement, names, count = found.read_together(files, axes)
            parts.append((", ".join(map(str, files)), measurement))
            datasets |= names
            n_functions += count
    for path, kind in kinds.items():
        if read := formats[kind.form].read:
            parts.append((str(path), read(path, kind)))
    shapes = [part.complex_shapes for _, part in parts if part.complex_shapes is not None]
    merged = _merged(parts)
    if metres is not None and merged.geometry is not None:
        merged = _in_unit(merged, merged.geometry, metres)
    return Inspection(
        merged,
        tuple(
            FileContents(path, kind.form, datasets.get(path, ())) for path, kind in kinds.items()
        ),
        modal_phase_collinearity(shapes[0]) if shapes else np.zeros(0),
        n_functions,
    )


def read_computed(path: Path) -> ModeSet:
    """Read all modes that a program wrote, with rotations. Raises CampaignError."""
    kind = _readable_kind(path)
    if kind.form in TABLES:
        modes = _read_tables(path, kind, computed=True).modes
    elif read_modes := _format(kind.form).read_modes:
        return read_modes(path, kind)
    else:
        modes = read_measurement([path]).modes
    if modes is None:
        raise CampaignError("it has points or response functions, and no modes")
    return modes.modes


def read_histories(paths: Sequence[Path]) -> tuple[list[TimeHistories], list[str]]:
    """Read the time histories of files, with notes; none where files hold something else.

    Raises CampaignError with file and line.
    """
    found: list[TimeHistories] = []
    notes: list[str] = []
    for path in paths:
        form = kind_of(path).form
        if (form in FORMATS or form in TABLES) and (read := _format(form).read_histories):
            found += read(path, notes)
    return found, notes


def check_out(path: Path) -> None:
    """Refuse a file that cannot be written, before the work is done. Raises CampaignError."""
    form = SUFFIXES.get(path.suffix.lower())
    if form not in FORMATS and form not in TABLES:
        raise CampaignError(f"{path}: a test file is written as .csv, .h5 or .unv, by the suffix")


def write_modes(
    path: Path, modes: MeasuredModes, geometry: TestGeometry | None, comments: tuple[str, ...]
) -> None:
    """Write modes with comments on their origin, and in other forms than CSV with the points.

    Raises as `write_test` does.
    """
    points = None if SUFFIXES.get(path.suffix.lower()) in TABLES else geometry
    write_test(path, Measurement(modes, points, None, comments), comments)


def write_test(path: Path, test: Measurement, comments: Sequence[str] = ()) -> list[Path]:
    """Write a test in the form of the suffix; CSV has comments, and a second file for points.

    Returns what was written. Raises StorageUnavailable, and CampaignError for an unknown suffix or
    where CSV has no form for what the test holds.
    """
    check_out(path)
    if write := _format(SUFFIXES[path.suffix.lower()]).write:
        write(path, test)
        return [path]
    written = []
    if (modes := test.modes) is not None:
        write_modes_csv(
            path,
            modes.numbers,
            modes.modes,
            comments,
            test.deviations,
            test.environment,
            test.measured_at,
        )
        written.append(path)
    if test.geometry is not None:
        points = path.with_name(f"{path.stem}-points.csv") if written else path
        write_geometry_csv(points, test.geometry, comments[:1])
        written.append(points)
    if not written:
        raise CampaignError(f"{path}: response functions are not written as CSV; name an .h5")
    return written


def _format(form: Form) -> Format:
    """Return the format of a form that can be read; its module is imported at first use."""
    if form in TABLES:
        return Format(_read_tables, read_histories=_table_histories)
    found: Format = import_module(f"{__package__}.{FORMATS[form]}").FORMAT
    return found


def _readable_kind(path: Path) -> FileKind:
    """Return the kind of a file by its content, or by its suffix where bytes do not show it.

    Raises CampaignError with a description of the file where nothing reads it.
    """
    kind, meant = kind_of(path), SUFFIXES.get(path.suffix.lower())
    open_form = kind.form == "unknown" or (kind.form == "table" and meant == "universal")
    if open_form and meant in ("universal", "hdf5"):
        kind = FileKind(meant, kind.description)  # its reader reports what is wrong
    if kind.form not in FORMATS and kind.form not in TABLES:
        remedy = kind.remedy or NUMBERS
        raise CampaignError(f"{path} is {kind.description}, not a test that can be read; {remedy}")
    return kind


def _read_tables(path: Path, kind: FileKind, computed: bool = False) -> Measurement:
    """Read modes and points of a text's one table, or of a workbook's sheets.

    Raises CampaignError.
    """
    tables = read_tables(path)
    if kind.form == "table":
        return _of_table(tables[0], computed)
    wanted = [
        table
        for table in tables
        if table.first in ("mode", "frequency_hz", "node", "metres")
        or is_repeated(table)
        or split_environment(table)[0]
        or split_time(table)[1] is not table
    ]
    if not wanted:
        sheets = ", ".join(table.name.removeprefix(f"{path}, sheet ") for table in tables)
        raise CampaignError(
            f"{path} is {kind.description} with sheets {sheets}, and none begins with a heading "
            "`mode`, `frequency` or `node`"
        )
    merged = _merged([(table.name, _of_table(table, computed)) for table in wanted])
    over = tuple(f"{table.name} is passed over" for table in tables if table not in wanted)
    return replace(merged, notes=merged.notes + over)


def _table_histories(path: Path, notes: list[str]) -> list[TimeHistories]:
    return [history_of(table) for table in read_tables(path) if is_history(table)]


def _of_table(table: FileTable, computed: bool) -> Measurement:
    environment, others = split_environment(table)
    at, rest = split_time(others)
    if table.rows and not rest.rows:
        return Measurement(environment=environment, measured_at=at)
    if is_geometry(rest):
        found = Measurement(geometry=geometry_of(rest))
    else:
        found = repeated_of(rest) if is_repeated(rest) else modes_of(rest, computed)
    return replace(found, environment=environment, measured_at=at)


def _merged(parts: Sequence[tuple[str, Measurement]]) -> Measurement:
    """Join all parts. Raises CampaignError where two contradict each other."""
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
        if both := sorted(whole.environment.keys() & part.environment.keys()):
            raise CampaignError(f"two files give {both[0]} of the environment; leave out one")
        times = {at for at in (whole.measured_at, part.measured_at) if at == at}
        if len(times) > 1:
            raise CampaignError("two files give different times of the test; leave out one")
        # Joined modes have no complex shapes.
        shapes = part.complex_shapes if whole.modes is None else whole.complex_shapes
        joined = whole.modes is not None and part.modes is not None
        whole = Measurement(
            modes or whole.modes,
            geometry or whole.geometry,
            frfs or whole.frfs,
            whole.notes + part.notes,
            whole.deviations or part.deviations,
            whole.repeats or part.repeats,
            None if joined else shapes,
            {**whole.environment, **part.environment},
            times.pop() if times else math.nan,
        )
    return whole


def _joined_modes(
    first: MeasuredModes, second: MeasuredModes, places: tuple[str, str]
) -> MeasuredModes:
    """Join the sensors of the same modes. Raises CampaignError where the modes differ."""
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
    """Join points. Raises CampaignError where one point has two places."""
    both = f"{places[0]} and {places[1]}"
    known = [not math.isnan(points.metres) for points in (first, second)]
    if all(known) and not math.isclose(first.metres, second.metres, rel_tol=1e-5):
        raise CampaignError(f"{both} give points in different units of length")
    shared, row, other = np.intersect1d(first.nodes, second.nodes, return_indices=True)
    size = float(np.ptp(first.coordinates, axis=0).max())
    apart = np.abs(first.coordinates[row] - second.coordinates[other]).max(axis=1, initial=0.0)
    turned = np.abs(first.frames[row] - second.frames[other]).max(axis=(1, 2), initial=0.0)
    wrong = np.flatnonzero((apart > SAME * size) | (turned > SAME))
    if wrong.size:
        raise CampaignError(f"{both} give node {shared[wrong[0]]} different places or axes")
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
    """Set the unit of the coordinates, with a note where a file has another."""
    notes = measurement.notes
    if not math.isnan(points.metres) and not math.isclose(points.metres, metres, rel_tol=1e-5):
        notes += (
            f"the files have lengths in {points.metres:g} m; {metres:g} m is taken, as asked",
        )
    return replace(measurement, geometry=replace(points, metres=metres), notes=notes)
