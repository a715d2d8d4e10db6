"""Files of real symmetric matrices: Matrix Market, SciPy's npz, HDF5, Nastran's OUTPUT4 and DMIG.

    FILE.mtx            Matrix Market, coordinate or array, general or symmetric
    FILE.npz            scipy.sparse.save_npz; pickled objects are never read
    FILE.h5:NAME        a dataset (n, n), or a group with the datasets data, indices, indptr of a
                        CSR matrix (n, n) with both triangles
    FILE.op4:NAME       a matrix of an OUTPUT4 file, text or binary; NAME may be left out if the
                        file has only one
    FILE.pch:NAME       a DMIG of a punch file or deck (`dmig.py`)

Models and the functions here refer to a matrix by such a name.

The size that a file declares is compared with its length before memory is allocated. A separate
program reads HDF5 (`hdf5_reader.py`). SciPy's reader of Matrix Market files (1.17) writes past its
memory where an array has more values than declared, and reads past it where the last line has no
end, so these files are read here:

    %%MatrixMarket matrix coordinate real symmetric
    % comments
    3 3 5                rows, columns, entries
    1 1 2.0              row, column, value; one triangle of a symmetric matrix

`array` files have rows and columns as their size, then only values, column by column (R. F.
Boisvert, R. Pozo, K. A. Remington, The Matrix Market exchange formats, NISTIR 5935, 1996).

OUTPUT4 is written as Nastran's FORMATTED, BIGMAT=NO: a header with columns, rows, form (6
symmetric), type (2 real double) and name, then each column from its first entry to its last, and
one more column at the end. pyNastran reads these files, binary ones too.
"""

from __future__ import annotations

import contextlib
import io
import struct
import tokenize
import warnings
import zipfile
import zlib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import scipy.io
from scipy import sparse

from modetune.adapters.hdf5_reader import DEFLATE, read_hdf5
from modetune.adapters.matrices.dmig import BULK, Terms, arranged, one_of, read_dmig, united
from modetune.adapters.regular_file import largest, open_regular, read_regular
from modetune.core.algebra.factorisation import symmetric_matrix
from modetune.core.algebra.matrices import CSR
from modetune.core.errors import ModelError
from modetune.core.modes import Floats, Integers
from modetune.core.near_names import suggestion
from modetune.core.storage.files import make_folder

HDF5, OP4 = (".h5", ".hdf5"), ".op4"
#: What SciPy and NumPy raise on files that are cut, damaged or something else.
NO_ARRAYS = (
    ValueError, KeyError, TypeError, AttributeError, SyntaxError, IndexError, EOFError,
    OverflowError, RuntimeError, MemoryError, zipfile.BadZipFile, zlib.error, struct.error,
    tokenize.TokenError,
)  # fmt: skip


def split_reference(reference: str) -> tuple[str, str]:
    """Return file and dataset of a reference; the dataset is empty where the file is the matrix."""
    file, separator, name = reference.rpartition(":")
    if separator and Path(file).suffix.lower() in (*HDF5, OP4, *BULK):
        return file, name
    return reference, ""


def is_dmig(reference: str) -> bool:
    """Whether a reference names a DMIG, whose rows have names."""
    return Path(split_reference(reference)[0]).suffix.lower() in BULK


def read_terms(folder: Path, references: Iterable[str]) -> dict[str, Terms | ModelError]:
    """Return the DMIG among references, or why one cannot be read. A file is read once."""
    files: dict[str, list[tuple[str, str]]] = {}
    for reference in filter(is_dmig, references):
        file, name = split_reference(reference)
        files.setdefault(file, []).append((reference, name))
    found: dict[str, Terms | ModelError] = {}
    for file, named in files.items():
        path, there = folder / file, dict[str, Terms | None]()
        try:
            there = read_dmig(path)
        except ModelError as error:
            found.update({reference: error for reference, _ in named})
            continue
        for reference, name in named:
            try:
                found[reference] = one_of(there, path, name)
            except ModelError as error:
                found[reference] = error
    return found


def read_matrices(
    folder: Path,
    references: Sequence[str],
    dmig: Mapping[str, Terms | ModelError] | None = None,
    names: Integers | None = None,
) -> list[sparse.csr_array | ModelError]:
    """Return the matrices of references, relative to a folder, each (n, n), both triangles.

    An error in place of one that cannot be read, or is not real, square, finite and symmetric. An
    HDF5 file is opened once for all of its datasets. dmig: the DMIG among them, where they are read
    already; names: of their unknowns (n, 2), by default all of theirs, ascending.
    """
    terms = read_terms(folder, references) if dmig is None else dmig
    rows = names
    if rows is None and (read := [item for item in terms.values() if isinstance(item, Terms)]):
        rows = united(read)
    datasets: dict[str, list[str]] = {}
    for file, name in map(split_reference, references):
        if name and Path(file).suffix.lower() in HDF5:
            datasets.setdefault(file, []).append(name)
    stored: dict[tuple[str, str], dict[str, Floats] | ModelError] = {}
    for file, own_names in datasets.items():
        try:
            open_regular(folder / file).close()
        except OSError as error:
            problem = ModelError(f"{folder / file} cannot be read: {error.strerror}")
            stored.update({(file, name): problem for name in own_names})
            continue
        arrays_of = read_hdf5(folder / file, own_names)
        stored.update({(file, name): arrays for name, arrays in arrays_of.items()})
    found: list[sparse.csr_array | ModelError] = []
    for reference in references:
        try:
            own = terms.get(reference)
            if isinstance(own, ModelError):
                raise own
            if own is not None and rows is not None:
                found.append(symmetric_matrix(arranged(own, rows), f"matrix {reference}"))
                continue
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
        text = str(error) or type(error).__name__
        raise ModelError(f"{reference} in {folder} holds no matrix: {text}") from error


def _read(path: Path, reference: str) -> Any:
    suffix = path.suffix.lower()
    if suffix not in (".mtx", ".npz", OP4):
        raise ModelError(
            f"{reference}: a matrix is FILE.mtx, FILE.npz, FILE.op4:NAME, FILE.pch:NAME (DMIG) or "
            "FILE.h5:NAME, NAME the dataset"
        )
    if suffix == ".mtx":
        return read_market(path)
    if suffix == OP4:
        return read_op4(path, split_reference(reference)[1])
    with open_regular(path) as stream, warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of headers as Python 2 wrote them
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
            form: Any = np.lib.format  # numpy gives its functions no types
            with archive.open(item) as stream:
                first = form.read_magic(stream) == (1, 0)
                read = form.read_array_header_1_0 if first else form.read_array_header_2_0
                shape, _, kind = read(stream)
            if kind.hasobject or int(np.prod(shape, dtype=object)) * kind.itemsize > item.file_size:
                raise ValueError(f"{item.filename} declares the shape {shape} and does not hold it")


def _sound(matrix: Any) -> Any:
    """Return a sparse matrix of a file, its size and indices checked: SciPy itself trusts them."""
    if max(matrix.shape) > MOST_EQUATIONS:
        raise ValueError(f"it has the shape {matrix.shape}; {MOST_EQUATIONS} is the most")
    if matrix.format in ("csr", "csc", "bsr"):
        matrix.check_format(full_check=True)
    return matrix


def _of_arrays(arrays: dict[str, Floats]) -> Any:
    if "dense" in arrays:
        return sparse.csr_array(np.asarray(arrays["dense"], dtype=np.float64))
    data, indices, indptr = (arrays[part] for part in CSR)
    if any(map(np.iscomplexobj, (data, indices, indptr))):
        raise ValueError("it is complex")
    if not all(((part >= 0) & (part < MOST_ENTRIES)).all() for part in (indices, indptr)):
        raise ValueError("its indices are no numbers of rows and columns")
    size = indptr.size - 1
    return _sound(sparse.csr_array((data, indices, indptr), shape=(size, size)))


def write_matrix(folder: Path, reference: str, matrix: sparse.csr_array) -> None:
    """Write a matrix where a reference says; others of an HDF5 or OUTPUT4 file stay."""
    file, name = split_reference(reference)
    path = folder / file
    make_folder(path.parent)
    if path.suffix.lower() == ".mtx":
        scipy.io.mmwrite(path, sparse.coo_array(matrix), precision=17, symmetry="symmetric")
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


#: More than can be solved here; their row pointers take 160 MB.
MOST_EQUATIONS = 20_000_000
#: No matrix has more entries than integers of 64 bits that a double holds.
MOST_ENTRIES = 2**53
#: Numbers on a line by the field; complex fields are refused as such.
FIELDS = {"real": 3, "double": 3, "integer": 3, "pattern": 2}


def read_market(path: Path) -> sparse.csr_array:
    """Return the matrix of a file, (n_rows, n_columns), both triangles.

    Raises OSError, ValueError where it is complex, no Matrix Market file, or declares other than it
    holds.
    """
    text = read_regular(path, largest(0.25))
    head, form, field, symmetry = _banner(text)
    start = head
    while (line := text[start : text.find(b"\n", start) + 1]) and (
        line.startswith(b"%") or not line.strip()
    ):
        start += len(line)
    sizes = [int(word) for word in line.split()]
    body = text[start + len(line) :]
    if len(sizes) != (2 if form == "array" else 3) or min(sizes) < 0:
        raise ValueError(f"its size line is {line[:40]!r}")
    if max(sizes[:2]) > MOST_EQUATIONS:
        raise ValueError(f"it declares {sizes[0]} x {sizes[1]}; {MOST_EQUATIONS} is the most")
    rows, columns = sizes[:2]
    if form == "array":
        count = rows * columns if symmetry == "general" else rows * (rows + 1) // 2
        values = _table(body, count, 1)[:, 0]
        column, row = (
            np.divmod(np.arange(count), rows) if symmetry == "general" else np.triu_indices(rows)
        )
    else:
        table = _table(body, sizes[2], FIELDS[field])
        places = table[:, :2]
        if not ((places >= 1) & (places <= (rows, columns)) & (places == np.floor(places))).all():
            raise ValueError("an entry's row or column is none of the matrix")
        row, column = places.astype(np.int64).T - 1
        values = table[:, 2] if table.shape[1] == 3 else np.ones(len(table))
    if symmetry == "symmetric":
        off = row != column
        row, column = np.concatenate([row, column[off]]), np.concatenate([column, row[off]])
        values = np.concatenate([values, values[off]])
    return sparse.csr_array(sparse.coo_array((values, (row, column)), shape=(rows, columns)))


def _banner(text: bytes) -> tuple[int, str, str, str]:
    """Return where the first line ends, and what it says: form, field and symmetry."""
    end = text.find(b"\n", 0, 1024) + 1
    words = text[:end].decode("ascii", "replace").lower().split()
    if len(words) != 5 or words[:2] != ["%%matrixmarket", "matrix"]:
        raise ValueError("it does not start with a line `%%MatrixMarket matrix ...`")
    form, field, symmetry = words[2:]
    if field == "complex":
        raise ValueError("it is complex; real ones are needed")
    if (
        form not in ("coordinate", "array")
        or field not in FIELDS
        or symmetry not in ("general", "symmetric")
        or (form == "array" and field == "pattern")
    ):
        raise ValueError(f"{form} {field} {symmetry} is not read here")
    return end, form, field, symmetry


def _table(body: bytes, count: int, width: int) -> Floats:
    """Return `count` lines of `width` numbers."""
    if count * 2 * width > len(body) + 1:  # a digit and what parts it from the next
        raise ValueError(f"it declares {count} entries and has {len(body)} bytes of them")
    if not body.strip():
        if count:
            raise ValueError(f"it declares {count} entries and has none")
        return np.zeros((0, width))
    table = np.loadtxt(io.BytesIO(body), comments=None, ndmin=2)
    if table.shape != (count, width):
        raise ValueError(
            f"it declares {count} lines of {width} numbers and has {len(table)} of {table.shape[1]}"
        )
    return np.asarray(table)


#: Numbers a line, and their form: 17 digits, which is all that a double has.
ON_A_LINE, FORM = 3, "1P,3E23.16"


def read_op4(path: Path, name: str) -> Any:
    """Return the matrix of a name, dense or sparse; the only one where the name is empty.

    Raises OSError, ValueError where it is not there, and what pyNastran raises of files that are
    damaged or something else.
    """
    from pyNastran.op4.op4 import OP4  # takes a moment, and most models have none

    with open_regular(path) as stream:
        size = stream.seek(0, 2)
    if size > largest(0.25):
        raise ValueError("it is larger than can be read here")
    try:
        with contextlib.redirect_stdout(io.StringIO()):  # it prints what it cannot read
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
    """Yield the text of a symmetric dense matrix (n, n); name: of eight letters at most."""
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
