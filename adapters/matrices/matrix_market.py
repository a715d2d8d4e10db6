"""Matrix Market files of real matrices, read with bounds.

    %%MatrixMarket matrix coordinate real symmetric
    % comments
    3 3 5                rows, columns, entries
    1 1 2.0              row, column, value; of symmetric matrices one triangle

`array` files have rows and columns in place of the size and then the values alone, column by
column. SciPy's reader (1.17) writes past its memory where an array has more values than were
declared, and reads past it where the last line has no end.

Source: R. F. Boisvert, R. Pozo, K. A. Remington, The Matrix Market exchange formats, NISTIR 5935,
1996.
"""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
from scipy import sparse

from modetune.adapters.regular_file import largest, read_regular
from modetune.core.modes import Floats

#: Beyond what is solved here; row pointers of so many take 160 MB.
MOST_EQUATIONS = 20_000_000
#: Numbers in a line by the field; of complex ones it is told that they are complex.
FIELDS = {"real": 3, "double": 3, "integer": 3, "pattern": 2}


def read_market(path: Path) -> sparse.csr_array:
    """The matrix of a file, (n_rows, n_columns), both triangles.

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
    """Where the first line ends, and what it says: form, field and symmetry."""
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
    """So many lines of so many numbers."""
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
