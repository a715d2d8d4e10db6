"""Mode shapes of datasets 55 and 2414."""

from __future__ import annotations

import math
import re
from typing import Any

import numpy as np
from numpy.typing import NDArray

from modetune.adapters.test_files.universal.blocks import DatasetBlock
from modetune.adapters.test_files.universal.contents import DatasetPlace, DatasetShape
from modetune.adapters.test_files.universal.tidying import HEADERS, DataKind, data_kind, node_rows
from modetune.core.measurement.frf import Complexes
from modetune.core.modes import Floats, Integers

NORMAL_MODE, COMPLEX_MODES = 2, (3, 7)
#: Quantities that move: not told, general, displacement, velocity, acceleration. Forms that do not.
MOTIONS, TENSORS = (0, 1, 8, 11, 12), (4, 5)
#: A frequency in an id line, and how near a pole is to one that was printed with few digits.
_HERTZ = re.compile(r"(\d+(?:[.,]\d*)?(?:e[+-]?\d+)?)\s*hz\b", re.IGNORECASE)
SAME_HZ = 5e-3
_WIDTH = 13  # of a value: E13.5


def shape_55(place: DatasetPlace, block: DatasetBlock, read: Any) -> DatasetShape | None:
    """Dataset 55; nothing where it has no values. Raises ValueError where it is not a mode."""
    said, doubt = data_kind(block.rows[6]), ""
    _check_mode(said)
    if said.analysis == NORMAL_MODE:
        pole = _normal(read["freq"], read["modal_damp_vis"], read["modal_damp_his"])
        mass = float(read["modal_m"])
    else:
        pole, doubt = _by_its_text(complex(read["eig"]), " ".join(block.rows[1:6]))
        mass = math.nan
    if said.is_complex and said.count == 6:
        nodes, values = complex_with_rotations(block)
    else:
        nodes = np.asarray(read["node_nums"], dtype=np.int64)
        columns = [np.asarray(read[f"r{component}"]) for component in range(1, said.count + 1)]
        if any(column.size != nodes.size for column in columns):
            raise ValueError("does not have as many values at each node as it announces")
        values = np.column_stack(columns)
    return _shape(place, int(read["mode_n"]), pole, nodes, values, mass, doubt)


def shape_2414(place: DatasetPlace, block: DatasetBlock, read: Any) -> DatasetShape | None:
    """Dataset 2414 with data at nodes. Raises ValueError where it is not a mode."""
    said = data_kind(block.rows[9])
    _check_mode(said)
    reals = [float(read[f"record12_field{field}"]) for field in range(1, 7)]
    if said.analysis == NORMAL_MODE:
        pole, mass = _normal(reals[1], reals[4], reals[5]), reals[3]
    else:
        eigenvalue = complex(read["record13_field1"], read["record13_field2"])
        pole, mass = _complex(eigenvalue), math.nan
    nodes = np.asarray(read["node_nums"], dtype=np.int64)
    values = np.asarray(read["data_at_node"], dtype=np.float64)
    if values.ndim != 2 or values.shape[1] != said.count * (1 + said.is_complex):
        raise ValueError("does not have as many values at each node as it announces")
    if said.is_complex:
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


def _check_mode(said: DataKind) -> None:
    if said.analysis not in (NORMAL_MODE, *COMPLEX_MODES):
        raise ValueError(f"holds no mode (its analysis type is {said.analysis})")
    if said.quantity not in MOTIONS or said.form in TENSORS:
        raise ValueError(f"holds no motion (its data type is {said.quantity})")
    if said.count not in (3, 6):
        raise ValueError(f"has {said.count} values a node, where a shape has 3 or 6")


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


def _by_its_text(eigenvalue: complex, text: str) -> tuple[tuple[float, float], str]:
    """Frequency and damping ratio of a pole, and a doubt where its dataset names it in Hz.

    The format has poles in rad/s; programs that write Hz often say the frequency in an id line.
    """
    frequency_hz, damping = _complex(eigenvalue)
    for found in _HERTZ.finditer(text):
        named = float(found[1].replace(",", "."))
        if named > 0.0 and math.isclose(named, abs(eigenvalue), rel_tol=SAME_HZ):
            return (abs(eigenvalue), damping), "its text has the pole in Hz, which is taken"
    return (frequency_hz, damping), ""


def _shape(
    place: DatasetPlace,
    number: int,
    pole: tuple[float, float],
    nodes: Integers,
    values: NDArray[np.float64] | Complexes | Floats,
    mass: float,
    doubt: str = "",
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
    return DatasetShape(place, number, *pole, nodes[order], values[order], mass or math.nan, doubt)
