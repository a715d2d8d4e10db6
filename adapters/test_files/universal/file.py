"""Universal files of test systems, read and written through pyuff.

The files of one test are read together, since one may hold the points and another the modes. pyuff
reads whole files by name. It gets a normalised copy of the relevant datasets (`blocks.py`), and its
results are compared with the counts that each dataset states. A dataset that cannot be read is
passed over with a note.

A test is written as header (151), units (164), axes (2420), points (2411), lines (82), triangles
(2412), modes (55), response functions and coherences (58). Numbers have the digits of the format: 6
for shapes, frequencies and damping ratios, 12 for response functions, 17 for points. Response
functions are written in the units of dataset 164, and with SI labels where the unit of length is
unknown. HDF5 keeps every digit (`test_files/hdf5.py`).
"""

from __future__ import annotations

import math
import tempfile
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyuff

from modetune.adapters.test_files.file_kind import Axes, Format
from modetune.adapters.test_files.universal.blocks import DatasetBlock, bad_row, read_blocks, tidy
from modetune.adapters.test_files.universal.datasets import (
    Content,
    DatasetPlace,
    DatasetShape,
    Function,
    Units,
    UniversalFile,
    drawing_of_elements,
    drawing_of_trace,
    function,
    node_table,
    shape_55,
    shape_2414,
    systems_2420,
    systems_of_points,
    units,
)
from modetune.adapters.test_files.universal.functions import frfs, histories
from modetune.adapters.test_files.universal.modes import modes
from modetune.adapters.test_files.universal.points import geometry, with_axes
from modetune.core.errors import CampaignError, ModesError
from modetune.core.measurement.measurement import MeasuredFrfs, Measurement, TestGeometry
from modetune.core.measurement.response_functions import Response
from modetune.core.measurement.time_histories import TimeHistories
from modetune.core.modes import Floats, MeasuredModes
from modetune.core.near_names import listed
from modetune.core.storage.files import writing

#: Converters of what pyuff returns, by dataset.
CONVERT: dict[int, Callable[[DatasetPlace, DatasetBlock, Any], Content | None]] = {
    15: node_table,
    18: systems_of_points,
    55: shape_55,
    58: function,
    82: drawing_of_trace,
    164: units,
    2411: node_table,
    2412: drawing_of_elements,
    2414: shape_2414,
    2420: systems_2420,
}
#: Datasets without a converter: a header with names and dates; windows, averages and names of
#: each function (1858), none of which changes a ratio.
UNUSED = {151, 1858}
#: Rows of a header, counted from its number on, with the program that wrote the file or its data.
PROGRAMS = (6, 3)

#: Datasets that were passed over, by the reason.
Passed = dict[str, list[tuple[DatasetPlace, DatasetBlock]]]


def read_file(path: Path) -> UniversalFile:
    """Return a file's datasets.

    Raises CampaignError where it is cut short or nothing can be read.
    """
    blocks = read_blocks(path)
    notes: list[str] = []
    unknown: dict[str, list[int]] = {}
    passed: Passed = {}
    wanted: list[tuple[DatasetPlace, DatasetBlock, bytes]] = []
    for block in blocks:
        place = DatasetPlace(path, block.line, block.name)
        if block.kind not in CONVERT:
            if block.kind not in UNUSED:
                unknown.setdefault(block.name, []).append(block.line)
            continue
        try:
            wanted.append((place, block, tidy(block)))
        except ValueError as problem:
            passed.setdefault(str(problem), []).append((place, block))
    for name, lines in unknown.items():
        notes.append(f"{path}: dataset {name} ({_lines(lines)}) is not one that is read here")
    contents = _contents(wanted, passed)
    notes += [_passed_over(reason, found) for reason, found in passed.items()]
    notes += _doubts(contents)
    if not contents:
        raise CampaignError([f"{path} holds nothing of a test that can be read", *notes])
    return UniversalFile(
        path, tuple(block.name for block in blocks), tuple(contents), tuple(notes), _program(blocks)
    )


def _program(blocks: Sequence[DatasetBlock]) -> str:
    """Return the program that wrote a file: the last one in its header (dataset 151)."""
    header = next((block for block in blocks if block.kind == 151), None)
    rows = (
        [] if header is None else [header.rows[row] for row in PROGRAMS if row < len(header.rows)]
    )
    return next((text for row in rows if (text := row.strip()) not in ("", "NONE")), "")


def _contents(
    wanted: Sequence[tuple[DatasetPlace, DatasetBlock, bytes]], passed: Passed
) -> list[Content]:
    """Return the content of datasets; unreadable ones go into `passed` by the reason."""
    contents: list[Content] = []
    with tempfile.TemporaryDirectory(prefix="modetune-") as folder:
        copy = Path(folder) / "tidy.uff"
        copy.write_bytes(b"".join(text for _, _, text in wanted))
        file = pyuff.UFF(str(copy))
        kinds = [block.kind for _, block, _ in wanted]
        if kinds and file.get_set_types().tolist() != kinds:  # a mark by chance amid binary values
            raise CampaignError(
                f"{wanted[0][0].path}: its binary values look like marks of datasets; export the "
                "file again with text values (dataset 58 instead of 58b)"
            )
        for index, (place, block, _) in enumerate(wanted):
            try:
                content = CONVERT[block.kind](place, block, _read_set(file, index))
            except ValueError as problem:
                passed.setdefault(str(problem), []).append((place, block))
                continue
            except OverflowError:
                passed.setdefault("has a number that is too large", []).append((place, block))
                continue
            if content is not None:
                contents.append(content)
    return contents


def _passed_over(reason: str, found: Sequence[tuple[DatasetPlace, DatasetBlock]]) -> str:
    place, block = found[0]
    # a dataset that says something else than is wanted here is not damaged
    doubt = "" if reason.startswith(("holds", "is the conjugate")) else "doubtful: "
    row = bad_row(block) if doubt else None
    where = "" if row is None else f" (line {block.line + row} is not made of numbers)"
    more = f" (and {len(found) - 1} more)" if len(found) > 1 else ""
    return f"{doubt}{place} {reason}{where}; passed over{more}"


def _doubts(contents: Sequence[Content]) -> list[str]:
    """Return a sentence for each kind of doubt about datasets that are read."""
    found: dict[str, list[DatasetPlace]] = {}
    for item in contents:
        if isinstance(item, Units | DatasetShape) and item.doubt:
            found.setdefault(item.doubt, []).append(item.place)
    return [
        f"doubtful: {places[0]}: {doubt}"
        + (f" (and {len(places) - 1} more)" if len(places) > 1 else "")
        for doubt, places in found.items()
    ]


def _read_set(file: Any, index: int) -> Any:
    try:
        return file.read_sets(index)
    except Exception as error:  # pyuff raises nothing more precise, whatever is wrong
        raise ValueError("is not in the form of its number") from error


def _lines(lines: Sequence[int]) -> str:
    return (
        f"line {lines[0]}" if len(lines) == 1 else f"{len(lines)} times, lines {listed(lines, 5)}"
    )


def read_universal(
    paths: Sequence[Path], axes: Axes = "auto"
) -> tuple[Measurement, tuple[UniversalFile, ...]]:
    """Read files as one test. axes: of datasets 2420. Raises CampaignError with file and line."""
    files = tuple(with_axes(read_file(path), axes) for path in paths)
    notes = [note for file in files for note in file.notes]
    try:
        points, responses = geometry(files, notes), frfs(files, notes)
        measured, complex_shapes = modes(files, notes)
    except ModesError as error:
        raise CampaignError(f"{', '.join(map(str, paths))}: {error}") from error
    if points is not None and measured is not None:
        shapes = np.unique(measured.modes.nodes)
        unmeasured = np.setdiff1d(points.nodes, shapes)
        if unmeasured.size:
            notes.append(f"{unmeasured.size} of {points.nodes.size} points have no shape")
        lost = np.setdiff1d(shapes, points.nodes)
        if lost.size:
            notes.append(f"doubtful: {lost.size} nodes have a shape and no place")
    test = Measurement(measured, points, responses, tuple(notes), complex_shapes=complex_shapes)
    return test, files


def _read_together(
    paths: Sequence[Path], axes: Axes
) -> tuple[Measurement, dict[Path, tuple[str, ...]], int]:
    test, files = read_universal(paths, axes)
    functions = [item for file in files for item in file.contents if isinstance(item, Function)]
    return test, {file.path: file.datasets for file in files}, len(functions)


def _read_histories(path: Path, notes: list[str]) -> list[TimeHistories]:
    return histories(read_file(path).contents, path, notes)


QUANTITIES: dict[Response, int] = {"receptance": 8, "mobility": 11, "accelerance": 12}
LABELS: dict[Response, str] = {"receptance": "m", "mobility": "m/s", "accelerance": "m/s^2"}
FREQUENCY, FORCE = 18, 13
#: Numbers that a trace line may hold (Record 1 of dataset 82), in pairs and the zero after each.
PAIRS_A_TRACE = 250 // 3
#: The largest number of the ten columns that it has.
LARGEST = 10**10 - 1

Fields = dict[Any, Any]  # pyuff's own form of a dataset


def write_universal(path: Path, measurement: Measurement) -> None:
    """Write a test whole or not at all.

    Raises ModesError where there is nothing to write or the format cannot hold it,
    StorageUnavailable.
    """
    if measurement.is_empty:
        raise ModesError(f"{path}: there is nothing to write")
    if measurement.deviations is not None:
        raise ModesError(
            f"{path}: a universal file has no place for deviations; write .csv or .h5, or leave "
            "them out of the test"
        )
    with writing(path) as part, part.open("wb") as file, tempfile.TemporaryDirectory() as folder:
        # a file for each dataset: pyuff reads its whole file again after each one it appends
        one = Path(folder) / "one.uff"
        for dataset in _datasets(measurement):
            pyuff.UFF(str(one)).write_sets(dataset, mode="overwrite")
            file.write(one.read_bytes())


def _datasets(measurement: Measurement) -> Iterator[Fields]:
    yield {
        "type": 151, "model_name": "NONE", "description": "test data", "db_app": "modetune",
        "program": "modetune", "date_db_created": "", "time_db_created": "", "date_db_saved": "",
        "time_db_saved": "", "date_file_written": "", "time_file_written": "",
    }  # fmt: skip
    if measurement.geometry is not None:
        yield from _geometry(measurement.geometry)
    if measurement.modes is not None:
        yield from _modes(measurement.modes)
    if measurement.frfs is not None:
        metres = math.nan if measurement.geometry is None else measurement.geometry.metres
        yield from _functions(measurement.frfs, metres)


def _geometry(points: TestGeometry) -> Iterator[Fields]:
    _check_numbers(points.nodes)
    if not math.isnan(points.metres):
        yield {
            "type": 164, "units_code": 1 if points.metres == 1.0 else 9,
            "length": 1.0 / points.metres, "force": 1.0, "temp": 1.0, "temp_offset": 273.15,
        }  # fmt: skip
    frames, which = np.unique(points.frames.reshape(-1, 9), axis=0, return_inverse=True)
    turned = np.flatnonzero((frames != np.eye(3).ravel()).any(axis=1))
    numbers = np.zeros(len(frames), dtype=np.int64)
    numbers[turned] = np.arange(2, turned.size + 2)  # 1 is the global system for many programs
    if turned.size:
        yield {
            "type": 2420,
            "Part_UID": 1,
            "Part_Name": "NONE",
            "CS_sys_labels": numbers[turned].tolist(),
            "CS_types": [0] * turned.size,
            "CS_colors": [8] * turned.size,
            "CS_names": [f"CS{number}" for number in numbers[turned].tolist()],
            "CS_matrices": [np.vstack([frames[row].reshape(3, 3), np.zeros(3)]) for row in turned],
        }
    n = points.nodes.size
    yield {
        "type": 2411,
        "node_nums": points.nodes,
        "def_cs": np.zeros(n, dtype=np.int64),
        "disp_cs": numbers[which.ravel()],
        "color": np.full(n, 8),
        "x": points.coordinates[:, 0],
        "y": points.coordinates[:, 1],
        "z": points.coordinates[:, 2],
    }
    for first in range(0, len(points.lines), PAIRS_A_TRACE):
        pairs = points.lines[first : first + PAIRS_A_TRACE]
        trace = np.column_stack([pairs, np.zeros(len(pairs), dtype=np.int64)]).ravel()[:-1]
        yield {"type": 82, "trace_num": first // PAIRS_A_TRACE + 1, "nodes": trace}
    if len(points.faces):
        yield {"type": 2412, 91: [
            {
                "element_nums": number, "fe_descriptor": 91, "phys_table": 1, "mat_table": 1,
                "color": 8, "num_nodes": 3, "nodes_nums": nodes,
            }
            for number, nodes in enumerate(points.faces.tolist(), start=1)
        ]}  # fmt: skip


def _modes(measured: MeasuredModes) -> Iterator[Fields]:
    modes = measured.modes
    if np.iscomplexobj(modes.mode_shapes):
        raise ModesError("the shapes of a test are written as real ones")
    if not modes.n_dof:
        raise ModesError("modes without shapes cannot be written as a universal file; write CSV")
    _check_numbers(modes.nodes)
    nodes, rows = np.unique(modes.nodes, return_inverse=True)
    damping = modes.damping_ratios if modes.damping_ratios.size else np.zeros(modes.n_modes)
    width = 6 if modes.components.max() > 3 else 3
    for mode, number in enumerate(measured.numbers):
        values = np.zeros((nodes.size, width))
        values[rows, modes.components - 1] = modes.mode_shapes[:, mode]
        dataset: Fields = {
            "type": 55,
            "analysis_type": 2,
            "data_ch": 2 if width == 3 else 3,
            "spec_data_type": QUANTITIES["receptance"],
            "load_case": 0,
            "mode_n": number,
            "freq": float(modes.frequencies_hz[mode]),
            "node_nums": nodes,
            "modal_m": 1.0 if modes.normalisation == "mass" else 0.0,
            "modal_damp_vis": float(damping[mode]),
        }
        dataset.update({f"r{column + 1}": values[:, column] for column in range(width)})
        yield dataset


def _functions(frfs: MeasuredFrfs, metres: float) -> Iterator[Fields]:
    """Yield functions and coherences.

    metres: the file's unit of length, NaN where it gives none.
    """
    _check_numbers(np.concatenate([frfs.nodes, frfs.reference_nodes]))
    even = _even(frfs.frequencies_hz)
    directions = (frfs.components * frfs.signs).astype(np.int64)
    references = (frfs.reference_components * frfs.reference_signs).astype(np.int64)
    # SI divided by the units of dataset 164: lengths of translations, and of moments
    unit = 1.0 if math.isnan(metres) else metres
    turning = (frfs.components > 3).astype(np.int64)
    moments = (frfs.reference_components > 3).astype(np.int64)
    values = frfs.values * unit ** (moments + turning - 1.0)
    labels = (LABELS[frfs.kind], "N") if math.isnan(metres) else ("NONE", "NONE")
    kinds = [(4, values, QUANTITIES[frfs.kind], FORCE)]
    if frfs.coherences.size:
        kinds.append((6, frfs.coherences, 0, 0))
    for kind, values, numerator, denominator in kinds:
        for column in range(values.shape[1]):
            yield {
                "type": 58,
                "func_type": kind,
                "rsp_node": int(frfs.nodes[column]),
                "rsp_dir": int(directions[column]),
                "ref_dir": int(references[column]),
                "ref_node": int(frfs.reference_nodes[column]),
                "x": frfs.frequencies_hz,
                "data": values[:, column],
                "abscissa_spacing": int(even),
                "abscissa_spec_data_type": FREQUENCY,
                "abscissa_axis_units_lab": "Hz",
                "ordinate_spec_data_type": numerator,
                "orddenom_spec_data_type": denominator,
                "ordinate_axis_units_lab": labels[0] if numerator else "NONE",
                "orddenom_axis_units_lab": labels[1] if numerator else "NONE",
            }


def _even(frequencies_hz: Floats) -> bool:
    """Return whether first frequency and step, printed with 6 digits, give the others."""
    if frequencies_hz.size < 2:
        raise ModesError("response functions at one frequency cannot be written")
    printed = [
        float(f"{value:.5e}")
        for value in (frequencies_hz[0], frequencies_hz[1] - frequencies_hz[0])
    ]
    grid = printed[0] + printed[1] * np.arange(frequencies_hz.size)
    if np.abs(grid - frequencies_hz).max() <= 0.01 * printed[1]:
        return True
    rounded = np.array([float(f"{value:.5e}") for value in frequencies_hz])
    if (np.diff(rounded) <= 0.0).any():
        raise ModesError(
            "the frequencies of the response functions are closer than the 6 digits of a universal "
            "file; write HDF5 instead"
        )
    return False


def _check_numbers(nodes: np.ndarray[Any, np.dtype[np.int64]]) -> None:
    if nodes.size and (nodes.max() > LARGEST or nodes.min() < 1):
        raise ModesError(f"nodes in a universal file are numbered 1 to {LARGEST}")


FORMAT = Format(read_together=_read_together, read_histories=_read_histories, write=write_universal)
