"""One matrix of a model of matrices, or the error that says why it cannot be read."""

from __future__ import annotations

from pathlib import Path

from scipy import sparse

from modetune.adapters.matrices.matrix_files import read_matrices
from modetune.core.errors import ModelError


def read_matrix(folder: Path, reference: str) -> sparse.csr_array:
    """The matrix of a reference. Raises ModelError."""
    (found,) = read_matrices(folder, [reference])
    if isinstance(found, ModelError):
        raise found
    return found
