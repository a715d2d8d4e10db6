"""Mode shapes of datasets 55 and 2414."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from modetune.adapters.test_files.universal.blocks import (
    HEADERS,
    DatasetBlock,
    data_kind,
    node_rows,
)
from modetune.adapters.test_files.universal.contents import DatasetPlace, DatasetShape
from modetune.core.measurement.frf import Complexes
from modetune.core.modes import Floats, Integers

NORMAL_MODE, COMPLEX_MODES = 2, (3, 7)
_WIDTH = 13  # of a value: E13.5


def shape_55(place: DatasetPlace, block: DatasetBlock, read: Any) -> DatasetShape | None:
    """Dataset 55; nothing where it has no values. Raises ValueError where it is not a mode."""
    analysis, count, is_complex = data_kind(block.rows[6])
    _check_mode(analysis, count)
    if analysis == NORMAL_MODE:
        pole = _normal(read["freq"], read["modal_damp_vis"], read["modal_damp_his"])
        mass = float(read["modal_m"])
    else:
        pole, mass = _complex(complex(read["eig"])), math.nan
    if is_complex and count == 6:
        nodes, values = complex_with_rotations(block)
    else:
        nodes = np.asarray(read["node_nums"], dtype=np.int64)
        columns = [np.asarray(read[f"r{component}"]) for component in range(1, count + 1)]
        if any(column.size != nodes.size for column in columns):
            raise ValueError("does not have as many values at each node as it announces")
        values = np.column_stack(columns)
    return _shape(place, int(read["mode_n"]), pole, nodes, values, mass)


def shape_2414(place: DatasetPlace, block: DatasetBlock, read: Any) -> DatasetShape | None:
    """Dataset 2414 with data at nodes. Raises ValueError where it is not a mode."""
    analysis, count, is_complex = data_kind(block.rows[9])
    _check_mode(analysis, count)
    reals = [float(read[f"record12_field{field}"]) for field in range(1, 7)]
    if analysis == NORMAL_MODE:
        pole, mass = _normal(reals[1], reals[4], reals[5]), reals[3]
    else:
        eigenvalue = complex(read["record13_field1"], read["record13_field2"])
        pole, mass = _complex(eigenvalue), math.nan
    nodes = np.asarray(read["node_nums"], dtype=np.int64)
    values = np.asarray(read["data_at_node"], dtype=np.float64)
    if values.ndim != 2 or values.shape[1] != count * (1 + is_complex):
        raise ValueError("does not have as many values at each node as it announces")
    if is_complex:
        values = values[:, ::2] + 1j * values[:, 1::2]
    return _shape(place, int(read["record10_field6"]), pole, nodes, values, mass)


def complex_with_rotations(block: DatasetBlock) -> tuple[Integers, Complexes]:
    """Nodes (n,) and values (n, 6) of a dataset 55, which pyuff refuses to read for this kind."""
    nodes, values = [], []
    for node, rows in node_rows([row.rstrip() for row in block.rows], HEADERS[55], 55):
        fields = [
            row[start : start + _WIDTH] for row in rows for start in range(0, len(row), _WIDTH)
        ]
        if len(fields) != 12:
            raise ValueError(f"has {len(fields)} of 12 numbers at node {node.strip()}")
        numbers = [float(field.replace("D", "E").replace("d", "e")) for field in fields]
        nodes.append(int(node))
        values.append(numbers)
    table = np.array(values).reshape(-1, 12)
    return np.array(nodes, dtype=np.int64), table[:, ::2] + 1j * table[:, 1::2]


def _check_mode(analysis: int, count: int) -> None:
    if analysis not in (NORMAL_MODE, *COMPLEX_MODES):
        raise ValueError(f"holds no mode (its analysis type is {analysis})")
    if count not in (3, 6):
        raise ValueError(f"has {count} values a node, where a shape has 3 or 6")


def _normal(frequency_hz: Any, viscous: Any, hysteretic: Any) -> tuple[float, float]:
    """Frequency and damping ratio; half the loss factor where no viscous damping is given."""
    damping = float(viscous) or 0.5 * float(hysteretic)
    return float(frequency_hz), damping or math.nan


def _complex(eigenvalue: complex) -> tuple[float, float]:
    """Frequency and damping ratio of a pole in rad/s."""
    magnitude = abs(eigenvalue)
    if not magnitude > 0.0:
        raise ValueError("has the eigenvalue 0")
    if eigenvalue.imag < 0.0:
        raise ValueError("is the conjugate of a mode (its eigenvalue's imaginary part is negative)")
    return magnitude / (2.0 * math.pi), -eigenvalue.real / magnitude


def _shape(
    place: DatasetPlace,
    number: int,
    pole: tuple[float, float],
    nodes: Integers,
    values: NDArray[np.float64] | Complexes | Floats,
    mass: float,
) -> DatasetShape | None:
    if nodes.size == 0:
        return None
    if values.shape[0] != nodes.size or np.unique(nodes).size != nodes.size:
        raise ValueError("gives a node twice or without values")
    if not (np.isfinite(values).all() and math.isfinite(pole[0])):
        raise ValueError("has a value that is not a finite number")
    if not pole[0] > 0.0:
        raise ValueError(f"is of a mode at {pole[0]:g} Hz, which must be above zero")
    order = np.argsort(nodes)
    return DatasetShape(place, number, *pole, nodes[order], values[order], mass or math.nan)
