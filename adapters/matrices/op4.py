"""Matrices in OUTPUT4 files, as Nastran and its relatives write and read them.

Text as Nastran's FORMATTED, BIGMAT=NO: a header with columns, rows, form (6 symmetric), type (2
real double) and name, then each column from its first entry to its last, and a column behind the
last one. Reading, binary files too, is pyNastran's.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from modetune.adapters.regular_file import largest, open_regular
from modetune.core.modes import Floats
from modetune.core.near_names import suggestion

#: Numbers a line, and their form: 17 digits, which is all that a double has.
ON_A_LINE, FORM = 3, "1P,3E23.16"


def read_op4(path: Path, name: str) -> Any:
    """The matrix of a name, dense or sparse; the only one where the name is empty.

    Raises OSError, ValueError where it is not there, and what pyNastran raises of files that are
    damaged or something else.
    """
    from pyNastran.op4.op4 import OP4  # takes a moment, and most models have none

    with open_regular(path) as stream:
        size = stream.seek(0, 2)
    if size > largest(0.25):
        raise ValueError("it is larger than can be read here")
    try:
        found = OP4(debug=None).read_op4(str(path))
    except (AssertionError, NotImplementedError, SyntaxError) as error:
        raise ValueError(f"pyNastran does not read it as OUTPUT4: {error}") from error
    names = {key.upper(): item for key, item in found.items()}
    if not name and len(names) == 1:
        return next(iter(names.values())).data
    if name.upper() not in names:
        there = ", ".join(names) or "none"
        raise ValueError(
            f"it has the matrices {there}{suggestion(name.upper(), names)}; name one as "
            f"{path.name}:NAME"
        )
    return names[name.upper()].data


def op4_lines(name: str, matrix: Floats) -> Iterator[str]:
    """The text of a symmetric dense matrix (n, n); name: of eight letters at most."""
    n = matrix.shape[0]
    yield f"{n:8d}{n:8d}{6:8d}{2:8d}{name:8s}{FORM}\n"
    for column in range(n):
        there = np.flatnonzero(matrix[:, column])
        if there.size:
            first, last = int(there[0]), int(there[-1]) + 1
            yield f"{column + 1:8d}{first + 1:8d}{2 * (last - first):8d}\n"
            yield from _numbers(matrix[first:last, column].tolist())
    yield f"{n + 1:8d}{1:8d}{2:8d}\n"
    yield from _numbers([1.0])


def _numbers(numbers: list[float]) -> Iterator[str]:
    for start in range(0, len(numbers), ON_A_LINE):
        yield "".join(f"{value:23.16E}" for value in numbers[start : start + ON_A_LINE]) + "\n"
