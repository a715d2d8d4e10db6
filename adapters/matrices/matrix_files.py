"""Files that hold one real symmetric matrix: Matrix Market, SciPy's npz, HDF5.

    FILE.mtx            Matrix Market, coordinate or array, general or symmetric
    FILE.npz            scipy.sparse.save_npz; nothing pickled is ever read
    FILE.h5:NAME        a dataset (n, n), or a group with the datasets data, indices, indptr of a
                        CSR matrix (n, n); of a symmetric matrix both triangles
    FILE.op4:NAME       a matrix of an OUTPUT4 file, text or binary; one alone needs no name

A name with `:` in front of the dataset is how models and the functions here refer to a matrix.

What a file declares is compared with its size before memory is asked for it, and HDF5 is read by a
program of its own (`hdf5_reader.py`).
"""

from __future__ import annotations

import zipfile
import zlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from scipy import io, sparse

from modetune.adapters.hdf5_reader import CSR, DEFLATE, read_hdf5
from modetune.adapters.matrices.matrix_market import MOST_EQUATIONS, read_market
from modetune.adapters.matrices.op4 import op4_lines, read_op4
from modetune.adapters.regular_file import largest, open_regular
from modetune.core.algebra.factorisation import symmetric_matrix
from modetune.core.errors import ModelError
from modetune.core.modes import Floats

HDF5, OP4 = (".h5", ".hdf5"), ".op4"
#: What SciPy and NumPy raise on files that are cut, damaged or something else.
NO_ARRAYS = (
    ValueError, KeyError, TypeError, AttributeError, IndexError, EOFError, OverflowError,
    RuntimeError, MemoryError, zipfile.BadZipFile, zlib.error,
)  # fmt: skip


def split_reference(reference: str) -> tuple[str, str]:
    """File and dataset of a reference; the dataset is empty where the file is the matrix."""
    file, separator, name = reference.rpartition(":")
    if separator and Path(file).suffix.lower() in (*HDF5, OP4):
        return file, name
    return reference, ""


def read_matrices(folder: Path, references: Sequence[str]) -> list[sparse.csr_array | ModelError]:
    """The matrices of references, relative to a folder, each (n, n), both triangles.

    An error in place of one that cannot be read, or is not real, square, finite and symmetric. An
    HDF5 file is opened once for all of its datasets.
    """
    datasets: dict[str, list[str]] = {}
    for file, name in map(split_reference, references):
        if name and Path(file).suffix.lower() in HDF5:
            datasets.setdefault(file, []).append(name)
    stored: dict[tuple[str, str], dict[str, Floats] | ModelError] = {}
    for file, names in datasets.items():
        try:
            open_regular(folder / file).close()
        except OSError as error:
            problem = ModelError(f"{folder / file} cannot be read: {error.strerror}")
            stored.update({(file, name): problem for name in names})
            continue
        read = read_hdf5(folder / file, names)
        stored.update({(file, name): arrays for name, arrays in read.items()})
    found: list[sparse.csr_array | ModelError] = []
    for reference in references:
        try:
            found.append(_checked(folder, reference, stored.get(split_reference(reference))))
        except ModelError as error:
            found.append(error)
    return found


def _checked(
    folder: Path, reference: str, stored: dict[str, Floats] | ModelError | None
) -> sparse.csr_array:
    path = folder / split_reference(reference)[0]
    try:
        if isinstance(stored, ModelError):
            raise ValueError(str(stored))
        given = _read(path, reference) if stored is None else _of_arrays(stored)
        if np.iscomplexobj(given):
            raise ModelError(f"the matrix {reference} is complex; real ones are needed")
        return symmetric_matrix(given, f"matrix {reference}")
    except OSError as error:
        raise ModelError(f"{path} cannot be read: {error.strerror or error}") from error
    except NO_ARRAYS as error:
        said = str(error) or type(error).__name__
        raise ModelError(f"{reference} in {folder} holds no matrix: {said}") from error


def _read(path: Path, reference: str) -> Any:
    suffix = path.suffix.lower()
    if suffix not in (".mtx", ".npz", OP4):
        raise ModelError(
            f"{reference}: a matrix is FILE.mtx, FILE.npz, FILE.op4:NAME or FILE.h5:NAME, NAME "
            "the dataset"
        )
    if suffix == ".mtx":
        return read_market(path)
    if suffix == OP4:
        return read_op4(path, split_reference(reference)[1])
    with open_regular(path) as stream:
        check_archive(path)
        return _sound(sparse.load_npz(stream))


def check_archive(path: Path) -> None:
    """Raise ValueError where the arrays of an npz file are more than its bytes or than memory."""
    with zipfile.ZipFile(path) as archive:
        for item in archive.infolist():
            if item.file_size > DEFLATE * item.compress_size + 4096:
                raise ValueError(f"{item.filename} declares {item.file_size} bytes, too many")
        if sum(item.file_size for item in archive.infolist()) > largest(0.25):
            raise ValueError("its arrays are larger than can be read here")
        for item in archive.infolist():
            with archive.open(item) as stream:
                shape, kind = _array_header(stream)
            if kind.hasobject or int(np.prod(shape, dtype=object)) * kind.itemsize > item.file_size:
                raise ValueError(f"{item.filename} declares the shape {shape} and does not hold it")


def _array_header(stream: Any) -> tuple[tuple[int, ...], np.dtype[Any]]:
    """Shape and type of numbers that an array of an npz file declares."""
    form: Any = np.lib.format  # numpy gives its functions no types
    first = form.read_magic(stream) == (1, 0)
    shape, _, kind = (form.read_array_header_1_0 if first else form.read_array_header_2_0)(stream)
    return shape, kind


def _sound(matrix: Any) -> Any:
    """A sparse matrix of a file, its size and indices checked: SciPy itself trusts them."""
    if max(matrix.shape) > MOST_EQUATIONS:
        raise ValueError(f"it has the shape {matrix.shape}; {MOST_EQUATIONS} is the most")
    if matrix.format in ("csr", "csc", "bsr"):
        matrix.check_format(full_check=True)
    return matrix


def _of_arrays(arrays: dict[str, Floats]) -> Any:
    if "dense" in arrays:
        return sparse.csr_array(np.asarray(arrays["dense"], dtype=np.float64))
    data, indices, indptr = (arrays[part] for part in CSR)
    size = indptr.size - 1
    return _sound(sparse.csr_array((data, indices, indptr), shape=(size, size)))


def write_matrix(folder: Path, reference: str, matrix: sparse.csr_array) -> None:
    """Write a matrix where a reference says; others of an HDF5 or OUTPUT4 file stay."""
    file, name = split_reference(reference)
    path = folder / file
    path.parent.mkdir(parents=True, exist_ok=True)
    if path.suffix.lower() == ".mtx":
        io.mmwrite(path, sparse.coo_array(matrix), precision=17, symmetry="symmetric")
    elif path.suffix.lower() == ".npz":
        sparse.save_npz(path, matrix)
    elif path.suffix.lower() == OP4:
        with path.open("a", encoding="ascii") as text:  # one matrix behind the other
            text.writelines(op4_lines(name or path.stem[:8], matrix.toarray()))
    else:
        with h5py.File(path, "a") as out:
            group = out.create_group(name)
            for part in CSR:
                group.create_dataset(part, data=getattr(matrix, part))
