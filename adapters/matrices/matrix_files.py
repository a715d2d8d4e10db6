"""Files that hold one real symmetric matrix: Matrix Market, SciPy's npz, HDF5.

    FILE.mtx            Matrix Market, coordinate or array, general or symmetric
    FILE.npz            scipy.sparse.save_npz; nothing pickled is ever read
    FILE.h5:NAME        a dataset (n, n), or a group with the datasets data, indices, indptr of a
                        CSR matrix (n, n); of a symmetric matrix both triangles

A name with `:` in front of the dataset is how models and the functions here refer to a matrix.
"""

from __future__ import annotations

import zipfile
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from scipy import io, sparse

from modetune.core.algebra.factorisation import symmetric_matrix
from modetune.core.errors import ModelError

HDF5 = (".h5", ".hdf5")
#: What SciPy and h5py raise on files that are cut, damaged or something else.
_NO_MATRIX = (ValueError, KeyError, TypeError, AttributeError, EOFError, zipfile.BadZipFile)
_CSR = ("data", "indices", "indptr")


def split_reference(reference: str) -> tuple[str, str]:
    """File and dataset of a reference; the dataset is empty where the file is the matrix."""
    file, separator, name = reference.rpartition(":")
    if separator and Path(file).suffix.lower() in HDF5:
        return file, name
    return reference, ""


def read_matrix(folder: Path, reference: str) -> sparse.csr_array:
    """The matrix of a reference, relative to a folder, (n, n), both triangles.

    Raises ModelError where it cannot be read, or is not real, square, finite and symmetric.
    """
    file, name = split_reference(reference)
    path = folder / file
    suffix = path.suffix.lower()
    given: Any
    try:
        if suffix == ".mtx":
            given = io.mmread(path)
        elif suffix == ".npz":
            with path.open("rb") as stream:
                given = sparse.load_npz(stream)
        elif suffix in HDF5 and name:
            given = _read_hdf5(path, name)
        else:
            raise ModelError(
                f"{reference}: a matrix is FILE.mtx, FILE.npz or FILE.h5:NAME, NAME the dataset"
            )
    except OSError as error:
        raise ModelError(f"{path} cannot be read: {error.strerror or error}") from error
    except _NO_MATRIX as error:
        raise ModelError(f"{reference} in {folder} holds no matrix: {error}") from error
    if np.iscomplexobj(given):
        raise ModelError(f"the matrix {reference} is complex; real ones are needed")
    return symmetric_matrix(given, f"matrix {reference}")


def write_matrix(folder: Path, reference: str, matrix: sparse.csr_array) -> None:
    """Write a matrix where a reference says; other datasets of an HDF5 file stay."""
    file, name = split_reference(reference)
    path = folder / file
    path.parent.mkdir(parents=True, exist_ok=True)
    if path.suffix.lower() == ".mtx":
        io.mmwrite(path, sparse.coo_array(matrix), precision=17, symmetry="symmetric")
    elif path.suffix.lower() == ".npz":
        sparse.save_npz(path, matrix)
    else:
        with h5py.File(path, "a") as out:
            group = out.create_group(name)
            for part in _CSR:
                group.create_dataset(part, data=getattr(matrix, part))


def _read_hdf5(path: Path, name: str) -> sparse.csr_array:
    with h5py.File(path, "r") as file:
        if name not in file:
            raise ModelError(f"{path} has no dataset or group {name!r}")
        found = file[name]
        if isinstance(found, h5py.Dataset):
            return sparse.csr_array(np.asarray(found[()], dtype=np.float64))
        data, indices, indptr = (np.asarray(found[part][()]) for part in _CSR)
    size = indptr.size - 1
    matrix = sparse.csr_array((data, indices, indptr), shape=(size, size))
    matrix.check_format(full_check=True)
    return matrix
