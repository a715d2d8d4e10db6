"""The matrices that ccx stores (`*FREQUENCY, SOLVER=MATRIXSTORAGE`), read from their text.

Three files: `.dof` names each equation, `node.component` a line; `.sti` and `.mas` hold stiffness
and mass as `row column value` lines, 1-based, the upper triangle column by column with rows
ascending, so each column ends with its diagonal. Entries that are zero are written too. A large
model has gigabytes of them: they are read in pieces, parsed by polars, and kept without zeros.
"""

from __future__ import annotations

import io
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import polars as pl
from numpy.typing import NDArray
from scipy import sparse

from modetune.adapters.regular_file import open_regular, read_regular
from modetune.core.algebra.matrices import MatrixResult
from modetune.core.errors import NoResult

#: Bytes parsed at once; polars is no faster with more.
PIECE = 16 << 20
#: Fewest characters of a line: `1 1 ` and a number in twenty columns, and the line's end.
LINE = 25
SCHEMA = {"row": pl.Int32, "column": pl.Int32, "signed": pl.Float64, "plain": pl.Float64}
HEAD = b"0 0  0.0\n"
Indices = NDArray[np.int32]


def read_matrices(folder: Path, job: str) -> MatrixResult:
    """The matrices of a MATRIXSTORAGE job. Raises NoResult where they are not whole.

    Off-diagonal entries that are exactly zero are left out, diagonal ones never: the pattern is
    that of the entries that are not zero at these parameter values.
    """
    try:
        names = _read_names(folder / f"{job}.dof")
        size = names.height
        with ThreadPoolExecutor(2) as pool:  # polars lets go of the interpreter while it parses
            paths = [folder / f"{job}.{ending}" for ending in ("sti", "mas")]
            stiffness, mass = pool.map(read_triangle, paths, [size, size])
    except (
        OSError, pl.exceptions.PolarsError, pl.exceptions.PanicException, ValueError, IndexError,
        OverflowError,
    ) as error:  # fmt: skip  # polars panics on some garbled text
        raise NoResult(f"{folder}: the stored matrices cannot be read: {error}") from error
    return MatrixResult(stiffness, mass, names["node"].to_numpy(), names["component"].to_numpy())


def _read_names(path: Path) -> pl.DataFrame:
    """Node and component of each equation, from `node.component` lines."""
    data = read_regular(path)
    schema = {"node": pl.Int64, "component": pl.Int64}
    names = pl.read_csv(io.BytesIO(data), separator=".", has_header=False, schema=schema)
    if not data.endswith(b"\n") or names.null_count().sum_horizontal().item():
        raise ValueError(f"{path.name} ends within a line")
    return names


def read_triangle(path: Path, size: int, piece: int = PIECE) -> sparse.csr_array:
    """The upper triangle of a symmetric matrix, (size, size), sorted CSR, all diagonal entries.

    piece: bytes read at once. Raises ValueError where the file is not whole.
    """
    # Pages of these that stay unused cost no memory.
    most = path.stat().st_size // LINE + 1
    rows, values = np.empty(most, dtype=np.int32), np.empty(most)
    ends, filled, last = [np.zeros(1, dtype=np.int64)], 0, (0, 0)
    for text in _pieces(path, piece):
        row, column, value = _parsed(text, path.name)
        diagonal = row == column
        _check_order(row, column, diagonal, last, path.name)
        last = int(row[-1]), int(column[-1])
        kept = np.flatnonzero((value != 0.0) | diagonal)
        more = filled + kept.size
        np.subtract(row[kept], 1, out=rows[filled:more])
        values[filled:more] = value[kept]
        # A column ends with its diagonal.
        ends.append(np.flatnonzero(diagonal[kept]) + (filled + 1))
        filled = more
    if last != (size, size):
        raise ValueError(f"{path.name} ends with entry {last} of {size} equations")
    rows.resize(filled, refcheck=False)
    values.resize(filled, refcheck=False)
    starts = np.concatenate(ends)
    if filled < 2**31:
        starts = starts.astype(np.int32)  # as the rows are: indices of two kinds would be copied
    columns = sparse.csc_array((values, rows, starts), shape=(size, size))
    return sparse.csr_array(columns.tocsr())


def _pieces(path: Path, size: int) -> Iterator[bytes]:
    """The text in pieces of whole lines, each after a line that shows polars the columns."""
    buffer = bytearray(size)
    buffer[: len(HEAD)] = HEAD
    view, start = memoryview(buffer), len(HEAD)
    with open_regular(path) as file:
        while data := file.read(size - start):
            end = start + len(data)
            view[start:end] = data
            cut = buffer.rfind(b"\n", 0, end) + 1
            if cut > len(HEAD):
                yield bytes(view[:cut])
            rest = bytes(view[cut:end])
            start = len(HEAD) + len(rest)
            view[len(HEAD) : start] = rest
    if start > len(HEAD):
        raise ValueError(f"{path.name} ends within a line")


def _parsed(text: bytes, name: str) -> tuple[Indices, Indices, NDArray[np.float64]]:
    """Row, column and value of each entry.

    A value has twenty columns, so a blank precedes one without sign: it is the fourth word of its
    line, one with a sign the third. Letting polars parse both is twice as fast as removing the
    blanks.
    """
    table = pl.read_csv(text, separator=" ", has_header=False, schema=SCHEMA)
    signed, plain = table["signed"], table["plain"]
    value = signed.fill_null(plain)
    nulls = sum(series.null_count() for series in (table["row"], table["column"], value))
    if nulls or signed.null_count() + plain.null_count() != table.height:
        raise ValueError(f"{name} has a line without row, column or value")
    row, column = table["row"].to_numpy(), table["column"].to_numpy()
    return row[1:], column[1:], value.to_numpy()[1:]


def _check_order(
    row: Indices, column: Indices, diagonal: NDArray[np.bool_], last: tuple[int, int], name: str
) -> None:
    """Raise ValueError where entries do not follow the ones before, or a diagonal one is missing.

    last: row and column of the entry before these, zeros at the start. A column starts after the
    diagonal of the one before, and within a column rows ascend, so none is below the diagonal.
    """
    first = last[1] + (last[0] == last[1])
    fits = column[0] == first and (column[0] > last[1] or row[0] > last[0]) and row.min() >= 1
    ordered = np.array_equal(column[1:], column[:-1] + diagonal[:-1])
    if not (fits and ordered and ((row[1:] > row[:-1]) | diagonal[:-1]).all()):
        raise ValueError(f"{name} lacks entries between column {last[1]} and {column[-1]}")
