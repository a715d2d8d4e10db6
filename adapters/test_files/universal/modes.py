"""The modes of a test, from shapes in its files that may be parts of modes.

A mode may come in parts: one dataset for each set-up of sensors that rove over the structure, in
one file or several, all scaled alike; or several times: once for each exciter position. Shapes
belong to one mode if number and frequency agree. Parts are joined while they are still complex, so
that one phase applies to all of them, and then made real.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from modetune.adapters.test_files.universal.datasets import DatasetShape, UniversalFile
from modetune.core.correlation.complexity import DOUBTFUL, modal_phase_collinearity, real_shapes
from modetune.core.errors import CampaignError
from modetune.core.measurement.response_functions import Complexes
from modetune.core.modes import Floats, MeasuredModes, ModeSet
from modetune.core.near_names import listed

#: Relative difference of frequencies up to which shapes of one number are one mode: references of a
#: test may each have their own pole. Between files, only digits may differ.
SAME_MODE, SAME_POLE = 1e-2, 1e-3
#: How far shapes of one mode may differ at a node, relative to their largest entry.
SAME_VALUE = 1e-3
#: Damping ratios that structures with modes hardly have.
HIGH = 0.2


def modes(
    files: Sequence[UniversalFile], notes: list[str]
) -> tuple[MeasuredModes | None, Complexes | None]:
    """Return the modes of all files together and, if they are complex, their measured shapes.

    The shapes are (n_dof, n_modes). Raises CampaignError for contradictions.
    """
    shapes = [item for file in files for item in file.contents if isinstance(item, DatasetShape)]
    if not shapes:
        return None, None
    groups = _groups(shapes)
    merged = [_merged(group, notes) for group in groups]
    nodes = sorted({node for values in merged for node in values})
    table = np.full((len(nodes), 6, len(groups)), np.nan, dtype=np.complex128)
    for column, values in enumerate(merged):
        for row, node in enumerate(nodes):
            if node in values:
                table[row, : values[node].size, column] = values[node]
    table, kept = _measured(table, np.array(nodes), notes)
    if not kept.any():
        raise CampaignError(f"{groups[0][0].place}: all shapes are zero everywhere")
    still = np.flatnonzero(~table[kept].any(axis=0))
    if still.size:
        shape = groups[int(still[0])][0]
        raise CampaignError(f"{shape.place}: mode {shape.number} is zero at every sensor")
    numbers = _numbers(groups, notes)
    rows, components = np.nonzero(kept)
    with_phase = any(np.iscomplexobj(shape.values) for group in groups for shape in group)
    found = table[kept] if with_phase else table[kept].real
    if np.iscomplexobj(found):
        _note_complex(modal_phase_collinearity(found), numbers, notes)
    leaders = [max(group, key=lambda shape: np.abs(shape.values).max()) for group in groups]
    unit = all(shape.modal_mass == 1.0 and not np.iscomplexobj(shape.values) for shape in shapes)
    measured = ModeSet(
        frequencies_hz=np.array([shape.frequency_hz for shape in leaders]),
        mode_shapes=real_shapes(found),
        nodes=np.array(nodes, dtype=np.int64)[rows],
        components=components.astype(np.int64) + 1,
        damping_ratios=_damping_ratios(leaders, numbers, notes),
        normalisation="mass" if unit else "unknown",
    )
    as_measured = np.asarray(found, dtype=np.complex128) if np.iscomplexobj(found) else None
    return MeasuredModes(numbers, measured), as_measured


def _groups(shapes: Sequence[DatasetShape]) -> list[list[DatasetShape]]:
    """Return shapes that belong to one mode, in the order of the files."""
    groups: list[list[DatasetShape]] = []
    for shape in shapes:
        home = next((group for group in groups if _same_mode(group[0], shape)), None)
        if home is None:
            groups.append([shape])
            continue
        home.append(shape)
    _check_between_files(groups)
    return groups


def _same_mode(first: DatasetShape, second: DatasetShape) -> bool:
    if first.number != second.number:
        return False
    apart = abs(first.frequency_hz - second.frequency_hz) / first.frequency_hz
    if first.place.path == second.place.path:
        return apart <= (SAME_MODE if first.number else 0.0)
    return apart <= SAME_POLE


def _check_between_files(groups: Sequence[Sequence[DatasetShape]]) -> None:
    """Refuse one number for modes of different frequencies in two files: both may be meant."""
    by_number: dict[int, DatasetShape] = {}
    for group in groups:
        shape = group[0]
        other = by_number.setdefault(shape.number, shape)
        if shape.number and other.place.path != shape.place.path:
            raise CampaignError(
                f"{shape.place} has mode {shape.number} at {shape.frequency_hz:g} Hz, "
                f"{other.place} at {other.frequency_hz:g} Hz; files that are read together must "
                "be of one test with the same modes"
            )


def _merged(group: Sequence[DatasetShape], notes: list[str]) -> dict[int, NDArray[np.complex128]]:
    """Return values of one mode by node, all excited from one reference."""
    merged: dict[int, NDArray[np.complex128]] = {}
    source: dict[int, DatasetShape] = {}
    for shape in _of_one_reference(group, notes):
        largest = float(np.abs(shape.values).max())
        for node, values in zip(shape.nodes.tolist(), shape.values, strict=True):
            given = merged.setdefault(node, np.zeros(6, dtype=np.complex128))
            new = np.append(values, np.zeros(6 - values.size))
            both = (given != 0.0) & (new != 0.0)  # zero: not measured in this set-up
            if np.abs(given - new)[both].max(initial=0.0) > SAME_VALUE * largest:
                raise CampaignError(
                    f"{shape.place} and {source[node].place} give mode {shape.number} different "
                    f"values at node {node}; the set-ups must be scaled alike, or one of them left "
                    "out"
                )
            merged[node] = np.where(given == 0.0, new, given)
            source.setdefault(node, shape)
    return merged


def _of_one_reference(group: Sequence[DatasetShape], notes: list[str]) -> list[DatasetShape]:
    """Return a mode's shape over each set of sensors, those of the reference that moves it most.

    References follow each other in the same order in every set-up. Each has its own scale and sign:
    shapes of two of them do not make one.
    """
    set_ups: list[list[DatasetShape]] = []
    for shape in group:
        home = next((shapes for shapes in set_ups if _same_sensors(shapes[0], shape)), None)
        if home is None:
            set_ups.append([shape])
        else:
            home.append(shape)
    counts = {len(shapes) for shapes in set_ups}
    if len(counts) > 1:
        raise CampaignError(
            f"{group[0].place}: mode {group[0].number} is given {min(counts)} times over some "
            f"points and {max(counts)} times over others; keep the shapes of one reference"
        )
    references = list(zip(*set_ups, strict=True))
    if len(references) == 1:
        return list(references[0])
    sizes = [
        sum(float((np.abs(shape.values) ** 2).sum()) for shape in shapes) for shapes in references
    ]
    chosen = list(references[int(np.argmax(sizes))])
    notes.append(
        f"mode {group[0].number} is given {len(references)} times over the same points (once a "
        f"reference); the strongest is taken, {chosen[0].place}"
    )
    return chosen


def _same_sensors(first: DatasetShape, second: DatasetShape) -> bool:
    """Return whether two shapes have the same nodes, and components measured in both."""
    if not np.array_equal(first.nodes, second.nodes):
        return False
    one, two = (shape.values != 0.0 for shape in (first, second))
    width = min(one.shape[1], two.shape[1])
    return bool((one[:, :width] & two[:, :width]).any())


def _measured(
    table: Complexes, nodes: NDArray[np.int64], notes: list[str]
) -> tuple[Complexes, NDArray[np.bool_]]:
    """Return the table with zeros where a part was not measured, and which entries were, (n, 6).

    A component that is zero in all modes was not measured: the format has no other way to say so.
    A node that some modes lack cannot be compared in them: it is left out of all.
    """
    missing = np.isnan(table).all(axis=1).any(axis=1)
    if missing.any():
        notes.append(f"nodes that some modes lack are left out: {listed(nodes[missing], 10)}")
    filled = np.nan_to_num(table)
    kept = (filled != 0.0).any(axis=2) & ~missing[:, None]
    unmoved = ~kept[:, :3] & ~missing[:, None]
    still = unmoved.all(axis=1) & ~kept.any(axis=1)
    if still.any():
        notes.append(f"nodes that move in no mode were not measured: {listed(nodes[still], 10)}")
    partly = int((unmoved & ~still[:, None]).sum())
    if partly:
        notes.append(
            f"{partly} translations that are zero in all modes were not measured and are left out"
        )
    return filled, kept


def _numbers(groups: Sequence[Sequence[DatasetShape]], notes: list[str]) -> tuple[int, ...]:
    """Return the modes' own numbers, or 1, 2, ... where these are missing or repeated."""
    numbers = tuple(group[0].number for group in groups)
    if len(set(numbers)) == len(numbers) and min(numbers) > 0:
        return numbers
    notes.append("the files do not number the modes, or use a number twice: they are renumbered")
    return tuple(range(1, len(groups) + 1))


def _note_complex(collinearity: Floats, numbers: tuple[int, ...], notes: list[str]) -> None:
    each = ", ".join(
        f"mode {number} {value:.3f}" for number, value in zip(numbers, collinearity, strict=True)
    )
    notes.append(
        "complex shapes were made real (`residuals.complex_shapes` compares them as they are with "
        f"those of a damped model); their modal phase collinearity: {each}"
    )
    low = [number for number, value in zip(numbers, collinearity, strict=True) if value < DOUBTFUL]
    if low:
        notes.append(
            f"doubtful: modes {listed(low, 10)} are far from real (modal phase collinearity below "
            f"{DOUBTFUL})"
        )


def _damping_ratios(
    leaders: Sequence[DatasetShape], numbers: tuple[int, ...], notes: list[str]
) -> Floats:
    ratios = np.array([shape.damping for shape in leaders])
    if np.isnan(ratios).all():
        return np.zeros(0)
    if np.isnan(ratios).any():
        missing = [
            number for number, ratio in zip(numbers, ratios, strict=True) if math.isnan(ratio)
        ]
        notes.append(f"modes without damping in the file get 0: {listed(missing, 10)}")
    negative = [number for number, ratio in zip(numbers, ratios, strict=True) if ratio < 0.0]
    if negative:
        notes.append(f"doubtful: modes with negative damping: {listed(negative, 10)}")
    high = [number for number, ratio in zip(numbers, ratios, strict=True) if ratio > HIGH]
    if high:
        notes.append(
            f"doubtful: modes with a damping ratio above {HIGH:g}: {listed(high, 10)}; is it in "
            "per cent in the file?"
        )
    return np.nan_to_num(ratios)
