"""Room for the vectors of a search: in memory, or in files beside factors that are there."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np

from modetune.core.errors import SolverExhausted
from modetune.core.modes import Floats

#: Makes room for so many vectors: (n_rows, n_columns), in Fortran order, with any numbers.
Room = Callable[[int, int], Floats]


def in_memory(n_rows: int, n_columns: int) -> Floats:
    """Room for so many vectors in memory."""
    return np.empty((n_rows, n_columns), order="F")


def in_file(folder: Path, n_rows: int, n_columns: int) -> Floats:
    """Room for so many vectors in a file of a folder, which has no name and goes with the array.

    Raises SolverExhausted where the disk is full.
    """
    size = 8 * n_rows * n_columns
    with tempfile.TemporaryFile(dir=folder) as file:
        try:
            os.posix_fallocate(file.fileno(), 0, size)
        except OSError as error:
            raise SolverExhausted(
                f"{folder}: {n_columns} vectors of {n_rows} equations have no room there, "
                f"{size / 1e9:.3g} GB: {error.strerror}"
            ) from error
        room = np.memmap(file, np.float64, "r+", shape=(n_rows, n_columns), order="F")
    return room.view(np.ndarray)
