"""Measured modes as CSV, modetune's own documented form.

    # comments and blank lines are skipped
    mode,           1,      2,      3
    frequency_hz,   5.51,   15.74,  34.75
    damping_ratio,  0.0042, 0.0031, 0.003       (optional, fraction of critical)
    101.x,          0.12,  -0.40,   0.03        (sensor: node.component x y z rx ry rz)
    101.z,          ...

One column a mode, numbered as the test numbers them. Sensor rows are optional: without them only
frequencies are compared. A shape may have any scaling of its own.
"""

from __future__ import annotations

import csv
import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from modetune.core.errors import CampaignError
from modetune.core.modes import COMPONENTS, MeasuredModes, ModeSet, mode_set
from modetune.core.store import writing


def read_modes_csv(path: Path) -> MeasuredModes:
    """Read a test. Raises CampaignError with every problem, each with file and line."""
    try:
        text = path.read_text(encoding="utf-8-sig")
    except OSError as error:
        raise CampaignError(f"test file {path} cannot be read: {error.strerror}") from error
    except UnicodeDecodeError as error:
        raise CampaignError(f"test file {path} is not a text file: {error}") from error
    rows = [
        (number, [field.strip() for field in fields])
        for number, fields in enumerate(csv.reader(text.splitlines()), start=1)
        if any(field.strip() for field in fields) and not fields[0].lstrip().startswith("#")
    ]
    if not rows or rows[0][1][0] != "mode":
        raise CampaignError(
            f"{path}, line {rows[0][0] if rows else 1}: the first row must be `mode, 1, 2, ...`"
        )
    problems: list[str] = []
    numbers = _mode_numbers(path, rows[0], problems)
    table: dict[str, list[float]] = {}
    for line, (name, *fields) in rows[1:]:
        if name in table:
            problems.append(f"{path}, line {line}: a second row `{name}`")
        table[name] = _numbers(path, line, name, fields, len(numbers), problems)
    return _measured(path, numbers, table, problems)


def _mode_numbers(path: Path, row: tuple[int, list[str]], problems: list[str]) -> tuple[int, ...]:
    line, (_, *fields) = row
    numbers = [int(field) for field in fields if field.isdigit()]
    if len(numbers) != len(fields) or not numbers or len(set(numbers)) != len(numbers):
        problems.append(
            f"{path}, line {line}: mode numbers must be different whole numbers, found "
            f"{', '.join(fields) or 'none'}"
        )
    return tuple(numbers)


def _numbers(
    path: Path, line: int, name: str, fields: list[str], count: int, problems: list[str]
) -> list[float]:
    if len(fields) != count:
        problems.append(
            f"{path}, line {line}: `{name}` has {len(fields)} values for {count} modes"
        )
    values = []
    for field in fields:
        try:
            value = float(field)
        except ValueError:
            value = math.nan
        if not math.isfinite(value):
            problems.append(f"{path}, line {line}: `{name}` has {field!r} where a number must be")
        values.append(value)
    return values


def _measured(
    path: Path, numbers: tuple[int, ...], table: dict[str, list[float]], problems: list[str]
) -> MeasuredModes:
    frequencies = table.pop("frequency_hz", None)
    damping = table.pop("damping_ratio", [])
    if frequencies is None:
        problems.append(f"{path}: there is no row `frequency_hz`")
    elif any(value <= 0.0 for value in frequencies):
        problems.append(f"{path}: frequencies must be above zero")
    dofs = []
    for name in table:
        node, _, component = name.partition(".")
        if not node.isdigit() or component not in COMPONENTS:
            problems.append(
                f"{path}: row `{name}` is neither frequency_hz, damping_ratio nor a sensor such "
                "as 101.x"
            )
            continue
        dofs.append((int(node), COMPONENTS.index(component) + 1))
    if problems:
        raise CampaignError(problems)
    places = np.array(dofs, dtype=np.int64).reshape(-1, 2)
    shapes = np.array(list(table.values())).reshape(len(dofs), len(numbers))
    still = np.flatnonzero(~shapes.any(axis=0)) if len(dofs) else np.zeros(0, dtype=np.int64)
    if still.size:
        raise CampaignError(f"{path}: mode {numbers[still[0]]} is zero at every sensor")
    modes = mode_set(frequencies or [], shapes, places[:, 0], places[:, 1], damping)
    return MeasuredModes(numbers, modes)


def write_modes_csv(
    path: Path, numbers: Sequence[int], modes: ModeSet, comment: Sequence[str] = ()
) -> None:
    """Write modes in the form that `read_modes_csv` reads. Raises StorageUnavailable."""
    lines = [f"# {line}" for line in comment]
    lines.append(",".join(["mode", *map(str, numbers)]))
    lines.append(_row("frequency_hz", modes.frequencies_hz.tolist()))
    if modes.damping_ratios.size:
        lines.append(_row("damping_ratio", modes.damping_ratios.tolist()))
    for row in range(modes.n_dof):
        component = COMPONENTS[modes.components[row] - 1]
        lines.append(_row(f"{modes.nodes[row]}.{component}", modes.mode_shapes[row].tolist()))
    with writing(path) as part:
        part.write_text("\n".join(lines) + "\n", encoding="utf-8")


def _row(name: str, values: Sequence[float]) -> str:
    return ",".join([name, *(f"{value:.10g}" for value in values)])
