"""Allocates vectors and other large arrays in memory or in files, for example next to factors."""

from __future__ import annotations

import math
import os
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from modetune.core.errors import SolverExhausted
from modetune.core.modes import Floats

#: Allocates vectors: (n_rows, n_columns), in Fortran order, not initialised.
Room = Callable[[int, int], Floats]


def in_memory(n_rows: int, n_columns: int) -> Floats:
    """Allocate vectors in memory."""
    return np.empty((n_rows, n_columns), order="F")


def in_file(folder: Path, n_rows: int, n_columns: int) -> Floats:
    """Allocate vectors in an unnamed file of a folder, which is deleted with the array.

    Raises SolverExhausted where the disk is full.
    """
    what = f"{n_columns} vectors of {n_rows} equations"
    return _mapped(folder, np.dtype(np.float64), (n_rows, n_columns), what)


def put_in_file(folder: Path, array: NDArray[Any]) -> NDArray[Any]:
    """An array (n,) or (n, k) with its numbers in such a file. Raises as `in_file` does."""
    if not array.size:
        return array
    room = _mapped(folder, array.dtype, array.shape, f"{array.size} entries of matrices")
    room[...] = array
    return room


def _mapped(folder: Path, kind: np.dtype[Any], shape: tuple[int, ...], what: str) -> NDArray[Any]:
    size = kind.itemsize * math.prod(shape)
    with tempfile.TemporaryFile(dir=folder) as file:
        try:
            os.posix_fallocate(file.fileno(), 0, size)
        except OSError as error:
            raise SolverExhausted(
                f"{folder}: {what} have no room there, {size / 1e9:.3g} GB: {error.strerror}"
            ) from error
        room = np.memmap(file, kind, "r+", shape=shape, order="F")
    return room.view(np.ndarray)
