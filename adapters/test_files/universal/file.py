"""Universal files read through pyuff: a test's points, modes and functions, in one or in several.

pyuff reads whole files by name. It gets a tidied copy of the datasets that matter (`tidying.py`),
and what it returns is checked against the counts that the dataset itself gives. A dataset that
neither can read is passed over with a note.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyuff

from modetune.adapters.test_files.universal.axes import Axes, with_axes
from modetune.adapters.test_files.universal.blocks import DatasetBlock, read_blocks
from modetune.adapters.test_files.universal.contents import (
    Content,
    DatasetPlace,
    DatasetShape,
    Function,
    Units,
    UniversalFile,
)
from modetune.adapters.test_files.universal.convert import (
    drawing_of_elements,
    drawing_of_trace,
    function,
    node_table,
    systems_2420,
    systems_of_points,
    units,
)
from modetune.adapters.test_files.universal.functions import frfs
from modetune.adapters.test_files.universal.geometry import geometry
from modetune.adapters.test_files.universal.modes import modes
from modetune.adapters.test_files.universal.shapes import shape_55, shape_2414
from modetune.adapters.test_files.universal.tidying import bad_row, tidy
from modetune.core.errors import CampaignError, ModesError
from modetune.core.measurement.measurement import Measurement
from modetune.core.modes import Floats
from modetune.core.near_names import listed

#: How what pyuff returns for each dataset becomes what modetune knows.
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
#: Datasets whose content is not needed otherwise: a header with names and dates; windows, averages
#: and names beside each function (1858), none of which changes a ratio.
UNUSED = {151, 1858}
#: Rows of a header, counted from its number on, with the program that wrote the file or its data.
PROGRAMS = (6, 3)

#: What was passed over, by the reason.
Passed = dict[str, list[tuple[DatasetPlace, DatasetBlock]]]


def read_file(path: Path) -> UniversalFile:
    """A file's datasets. Raises CampaignError where it is cut short or nothing can be read."""
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
    """What wrote a file: of its header's rows (dataset 151) the last program's."""
    header = next((block for block in blocks if block.kind == 151), None)
    rows = (
        [] if header is None else [header.rows[row] for row in PROGRAMS if row < len(header.rows)]
    )
    return next((text for row in rows if (text := row.strip()) not in ("", "NONE")), "")


def _contents(
    wanted: Sequence[tuple[DatasetPlace, DatasetBlock, bytes]], passed: Passed
) -> list[Content]:
    """What datasets say; those that cannot be read are put into `passed` by the reason."""
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
    """What is doubtful of datasets that are read, a sentence each kind of doubt."""
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


@dataclass(frozen=True, slots=True)
class UniversalTest:
    """A test with its files and, of complex modes, how collinear their phases are, (n_modes,)."""

    measurement: Measurement
    files: tuple[UniversalFile, ...]
    collinearity: Floats
    n_functions: int


def read_universal(paths: Sequence[Path], axes: Axes = "auto") -> UniversalTest:
    """Read files as one test. axes: of datasets 2420. Raises CampaignError with file and line."""
    files = tuple(with_axes(read_file(path), axes) for path in paths)
    notes = [note for file in files for note in file.notes]
    try:
        points, responses, found = geometry(files, notes), frfs(files, notes), modes(files, notes)
    except ModesError as error:
        raise CampaignError(f"{', '.join(map(str, paths))}: {error}") from error
    measured = None if found is None else found.measured
    if points is not None and measured is not None:
        shapes = np.unique(measured.modes.nodes)
        unmeasured = np.setdiff1d(points.nodes, shapes)
        if unmeasured.size:
            notes.append(f"{unmeasured.size} of {points.nodes.size} points have no shape")
        lost = np.setdiff1d(shapes, points.nodes)
        if lost.size:
            notes.append(f"doubtful: {lost.size} nodes have a shape and no place")
    return UniversalTest(
        Measurement(
            measured,
            points,
            responses,
            tuple(notes),
            complex_shapes=None if found is None else found.complex_shapes,
        ),
        files,
        np.zeros(0) if found is None else found.collinearity,
        sum(isinstance(item, Function) for file in files for item in file.contents),
    )
