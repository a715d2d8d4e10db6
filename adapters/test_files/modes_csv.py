"""Measured modes as CSV, modetune's own documented form.

    # comments and blank lines are skipped
    mode,           1,      2,      3
    frequency_hz,   5.51,   15.74,  34.75
    damping_ratio,  0.0042, 0.0031, 0.003       (optional, fraction of critical)
    frequency_deviation, 0.001, 0.001, 0.004    (optional, standard deviation over the frequency)
    shape_deviation,     0.02,  0.02,  0.1      (optional, of a shape's entries, over its rms)
    101.x,          0.12,  -0.40,   0.03        (sensor: node.component x y z rx ry rz)
    101.z,          ...

One column a mode, numbered as the test numbers them. Sensor rows are optional: without them only
frequencies are compared. A shape may have any scaling of its own.
"""

from __future__ import annotations

import csv
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from modetune.adapters.regular_file import read_regular
from modetune.core.errors import CampaignError, ModesError
from modetune.core.measurement.measurement import MeasuredDeviations, Measurement
from modetune.core.modes import COMPONENTS, MeasuredModes, ModeSet, mode_set
from modetune.core.storage.files import writing

#: Rows that say how exactly frequencies and shapes were measured.
DEVIATIONS = ("frequency_deviation", "shape_deviation")


@dataclass(frozen=True, slots=True)
class CsvRow:
    """One row of the file: the line it stands on, its name, and its other fields."""

    line: int
    name: str
    fields: tuple[str, ...]


def read_modes_csv(path: Path) -> MeasuredModes:
    """The modes of a test. Raises CampaignError with every problem, each with file and line."""
    found = read_test_csv(path).modes
    assert found is not None
    return found


def read_test_csv(path: Path, computed: bool = False) -> Measurement:
    """The modes of a test and how exactly they were measured. Raises CampaignError likewise.

    computed: the modes are a model's, which may be rigid (0 Hz), or move none of these nodes.
    """
    rows = _rows(path)
    if not rows or rows[0].name != "mode":
        raise CampaignError(
            f"{path}, line {rows[0].line if rows else 1}: the first row must be `mode, 1, 2, ...`"
        )
    header, *others = rows
    problems: list[str] = []
    numbers = _mode_numbers(path, header, problems)
    frequencies: list[float] | None = None
    damping: list[float] = []
    deviations: dict[str, list[float]] = {}
    sensors: dict[tuple[int, int], list[float]] = {}
    seen: set[str | tuple[int, int]] = set()
    for row in others:
        where = f"{path}, line {row.line}"
        values = _numbers(where, row, len(header.fields), problems)
        dof = _dof(row.name)
        if (dof or row.name) in seen:
            problems.append(f"{where}: a second row `{row.name}`")
        seen.add(dof or row.name)
        if dof:
            sensors[dof] = values
        elif row.name == "damping_ratio":
            damping = values
        elif row.name in DEVIATIONS:
            deviations[row.name] = values
            if any(value <= 0.0 for value in values):
                problems.append(f"{where}: `{row.name}` must be above zero, found {min(values):g}")
        elif row.name == "frequency_hz":
            frequencies = values
            if any(value < 0.0 or (value == 0.0 and not computed) for value in values):
                problems.append(f"{where}: frequencies must be above zero")
        else:
            problems.append(
                f"{where}: row `{row.name}` is neither frequency_hz, damping_ratio, "
                f"{', '.join(DEVIATIONS)} nor a sensor such as 101.x"
            )
    if frequencies is None:
        problems.append(f"{path}, line {header.line}: no row `frequency_hz` follows")
    if problems:
        raise CampaignError(problems)
    shapes = np.array(list(sensors.values())).reshape(len(sensors), len(numbers))
    still = np.flatnonzero(~shapes.any(axis=0))
    if sensors and still.size and not computed:
        raise CampaignError(
            f"{path}, line {header.line}: mode {numbers[still[0]]} is zero at every sensor"
        )
    places = np.array(list(sensors), dtype=np.int64).reshape(-1, 2)
    modes = mode_set(frequencies or [], shapes, places[:, 0], places[:, 1], damping)
    known = [np.array(deviations.get(name, [math.nan] * len(numbers))) for name in DEVIATIONS]
    return Measurement(
        MeasuredModes(numbers, modes), deviations=MeasuredDeviations(*known) if deviations else None
    )


def _rows(path: Path) -> list[CsvRow]:
    try:
        data = read_regular(path)
        text = data.decode("utf-8-sig")
    except OSError as error:
        raise CampaignError(f"test file {path} cannot be read: {error.strerror}") from error
    except UnicodeDecodeError as error:
        number = data.count(b"\n", 0, error.start) + 1
        raise CampaignError(f"test file {path}, line {number}: not a text file: {error}") from error
    rows = []
    for number, line in enumerate(text.splitlines(), start=1):
        if not line.strip(" \t,;") or line.lstrip().startswith("#"):
            continue
        try:  # line by line, so that no quote can swallow the lines below it
            name, *fields = [field.strip() for field in next(csv.reader([line]))]
        except csv.Error as error:
            raise CampaignError(f"{path}, line {number}: {error}") from error
        rows.append(CsvRow(number, name, tuple(fields)))
    return rows


def _mode_numbers(path: Path, row: CsvRow, problems: list[str]) -> tuple[int, ...]:
    numbers = tuple(int(field) for field in row.fields if _whole(field))
    if len(numbers) != len(row.fields) or not numbers or len(set(numbers)) != len(numbers):
        problems.append(
            f"{path}, line {row.line}: mode numbers must be different whole numbers, found "
            f"{', '.join(row.fields) or 'none'}"
        )
    return numbers


def _numbers(where: str, row: CsvRow, count: int, problems: list[str]) -> list[float]:
    if len(row.fields) != count:
        problems.append(f"{where}: `{row.name}` has {len(row.fields)} values for {count} modes")
    values = []
    for field in row.fields:
        try:
            value = float(field)
        except ValueError:
            value = math.nan
        if not math.isfinite(value):
            problems.append(f"{where}: `{row.name}` has {field!r} where a number must be")
        values.append(value)
    return values


def _dof(name: str) -> tuple[int, int] | None:
    """Node and component 1..6 of a sensor's name; nothing where it is not a sensor's."""
    node, _, component = name.partition(".")
    if not _whole(node) or component not in COMPONENTS:
        return None
    return int(node), COMPONENTS.index(component) + 1


def _whole(text: str) -> bool:
    return text.isascii() and text.isdecimal() and len(text) < 19  # what 64 bits hold


def write_modes_csv(
    path: Path,
    numbers: Sequence[int],
    modes: ModeSet,
    comment: Sequence[str] = (),
    deviations: MeasuredDeviations | None = None,
) -> None:
    """Write real modes in the form that `read_modes_csv` reads.

    Raises ModesError for complex shapes, StorageUnavailable.
    """
    if np.iscomplexobj(modes.mode_shapes):
        raise ModesError(f"{path}: complex mode shapes cannot be written as CSV")
    lines = [f"# {line}" for line in comment]
    lines.append(",".join(["mode", *map(str, numbers)]))
    lines.append(_row("frequency_hz", modes.frequencies_hz.tolist()))
    if modes.damping_ratios.size:
        lines.append(_row("damping_ratio", modes.damping_ratios.tolist()))
    if deviations is not None:
        columns = (deviations.frequencies, deviations.shapes)
        lines += [
            _row(name, values.tolist())
            for name, values in zip(DEVIATIONS, columns, strict=True)
            if np.isfinite(values).all()
        ]
    for row in range(modes.n_dof):
        component = COMPONENTS[modes.components[row] - 1]
        lines.append(_row(f"{modes.nodes[row]}.{component}", modes.mode_shapes[row].tolist()))
    with writing(path) as part:
        part.write_text("\n".join(lines) + "\n", encoding="utf-8")


def _row(name: str, values: Sequence[float]) -> str:
    return ",".join([name, *(f"{value:.10g}" for value in values)])
