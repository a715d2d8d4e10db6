"""The modes in a punch file (PCH), as DISPLACEMENT(PUNCH) leaves them, of Nastran or OptiStruct.

Lines of 80 columns: `$` begins a heading, the last eight are a number of the line; a point has its
number in columns 1-10, its kind in 18 and three components in fields of 18, three more on the next
line. One mode follows the other:

    $EIGENVECTOR
    $REAL OUTPUT
    $EIGENVALUE =  1.0000000E+00  MODE =     1
             1       G      0.000000E+00      1.000000E+00      0.000000E+00
    -CONT-                  0.000000E+00      0.000000E+00      0.000000E+00

Generalised masses are not in it: shapes are as the deck asks (NORM of EIGRL).
"""

from __future__ import annotations

import io
import re
from pathlib import Path

import numpy as np

from modetune.adapters.nastran.fields import read_number
from modetune.adapters.nastran.results import GridShape, shape_matrix
from modetune.adapters.regular_file import open_regular, read_errors
from modetune.core.modes import ModeSet, mode_set

EIGENVALUE = re.compile(r"\$EIGENVALUE\s*=\s*(\S+)\s+MODE\s*=\s*(\d+)")
#: Columns of the three values of a line, and of what says which line it is.
VALUES = tuple(slice(18 + 18 * place, 36 + 18 * place) for place in range(3))
DATA = slice(0, 72)


def read_punch(path: Path) -> ModeSet:
    """The real modes of a file, the first subcase's. Raises ValueError, with the line."""
    shapes: dict[int, list[tuple[int, str, list[float]]]] = {}
    eigenvalues: dict[int, float] = {}
    mode, reading = 0, False
    with read_errors("it", ValueError):
        with open_regular(path) as file, io.TextIOWrapper(file, encoding="latin-1") as source:
            lines = [line.rstrip("\r\n") for line in source]
    for number, line in enumerate(lines, start=1):
        try:
            if line.startswith("$"):
                if line.startswith("$TITLE"):
                    mode, reading = 0, False
                reading |= line.startswith("$EIGENVECTOR")
                if reading and "OUTPUT" in line and "$REAL OUTPUT" not in line:
                    raise ValueError("its modes are complex; real normal modes are needed")
                found = EIGENVALUE.match(line)
                if found and int(found[2]) in eigenvalues:
                    break  # the next subcase
                if found:
                    mode = int(found[2])
                    eigenvalues[mode], shapes[mode] = read_number(found[1]), []
            elif mode and reading:
                values = [read_number(line[DATA][place]) for place in VALUES if line[place].strip()]
                if line.startswith("-CONT-"):
                    shapes[mode][-1][2].extend(values)
                else:
                    shapes[mode].append((int(line[:10]), line[10:18].strip(), values))
        except (ValueError, IndexError) as error:
            raise ValueError(f"line {number}: {error}") from error
    if not shapes:
        raise ValueError("it holds no $EIGENVECTOR with its $EIGENVALUE and MODE")
    grids = [_grid(mode, eigenvalues[mode], points) for mode, points in shapes.items()]
    nodes, components, mode_shapes = shape_matrix(grids, len(grids))
    frequencies = np.sqrt(np.maximum(list(eigenvalues.values()), 0.0)) / (2.0 * np.pi)
    return mode_set(frequencies, mode_shapes, nodes, components)


def _grid(mode: int, eigenvalue: float, points: list[tuple[int, str, list[float]]]) -> GridShape:
    scalar = np.array([kind == "S" for _, kind, _ in points])
    values = np.zeros((len(points), 6))
    for row, (node, _, found) in enumerate(points):
        if len(found) != (1 if scalar[row] else 6):
            raise ValueError(f"node {node} of mode {mode} has {len(found)} components")
        values[row, : len(found)] = found
    nodes = np.array([node for node, _, _ in points], dtype=np.int64)
    return GridShape(mode, eigenvalue, nodes, scalar, values)
