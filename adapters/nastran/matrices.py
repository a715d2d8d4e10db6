"""The matrices that MYSTRAN keeps for a restart (CHKPNT), with what their rows are.

Its modes are those of KLL and MLL, on the degrees of freedom that constraints, rigid elements and
AUTOSPC leave. OUTPUT4 would give them too, but each column from its first entry to its last: 7.5 GB
of 12 MB for a plate of 4,300 shells with one rigid element. The restart files hold the entries that
are not zero, as unformatted records of Fortran: the time of the run, the number of entries, and
row, column and value of each. Which row is which component of which grid point the table of degrees
of freedom (TDOF) says, which PARAM,PRTDOF prints after each round of AUTOSPC; the last one holds.

MYSTRAN would then factorise them and look for modes, half of its time and of its memory. It has no
request to stop there, but partitions matrices for OUTPUT4 right after it has written its own files,
and stops where the partitioning vector names a grid point that the deck does not have.

The degrees of freedom of the M set depend on others (MPC, RBE2, RBE3): u_M = GMN u_N, and those of
the N set are rows of KLL or held.
"""

from __future__ import annotations

import mmap
import re
from collections.abc import Collection
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from modetune.adapters.nastran.dialect import JOB
from modetune.adapters.regular_file import open_regular
from modetune.core.algebra.matrices import DependentDofs, MatrixResult
from modetune.core.errors import NoResult
from modetune.core.modes import Integers

#: Name of the vector that stops a run, the statements that keep the files and call for it, and the
#: parameter that prints the table.
STOP = "MODETUNE"
KEEP_AND_STOP = ("CHKPNT", "OUTPUT4 KLL,,,,//-1/21", f"PARTN KLL,{STOP},{STOP}")
PRINT_TABLE = "PARAM,PRTDOF,1"
#: Its last message then.
STOPPED = re.compile(rf"\bPARTVEC\b.*\b{STOP}\b")
#: Files of KLL, MLL and GMN; there is no last one without dependent degrees of freedom.
STIFFNESS, MASS, DEPENDENT = f"{JOB}.L2G", f"{JOB}.L2I", f"{JOB}.L2A"
#: One entry between the marks of its record.
ENTRY = np.dtype(
    [("begin", "<i4"), ("row", "<i4"), ("column", "<i4"), ("value", "<f8"), ("end", "<i4")]
)
#: Entries read at once.
ENTRIES_AT_ONCE = 1 << 20
#: The heading of the table, and a row: a grid point (blank for its other components), a component,
#: the same by internal numbers, and the place in 14 sets.
HEADING = b"DEGREE OF FREEDOM TABLE SORTED ON GRID POINT (TDOF)"
ROW = re.compile(rb"^ *\d*-\d +\d*-\d .*$", re.MULTILINE)
TOTAL = b"\nTOTAL NUMBER OF DOF"
#: Numbers of a row: both grid points and components, and the places.
IN_ROW = 18
#: Columns of the table: node, component, and the sets that count.
NODE, COMPONENT, IN_M, IN_N, IN_O, IN_R, IN_L = 0, 1, 3, 4, 12, 14, 15


def read_restart(folder: Path, print_file: str, grids: Collection[int]) -> MatrixResult:
    """The matrices of a run. Raises NoResult where they are not whole, or of another deck.

    grids: grid points that the deck has at least.
    """
    try:
        with open_regular(folder / print_file) as file:
            table = _last_table(file)
        strange = sorted(set(grids) - set(table[:, NODE].tolist()))
        if strange:
            raise ValueError(
                f"they are those of another deck, which has no grid point {strange[0]} "
                f"({len(strange)} of the deck's are missing); remove the folder and run it again"
            )
        kept = _members(table, IN_L)
        size = kept.shape[0]
        if table[:, [IN_O, IN_R]].any():
            raise ValueError("matrices of a reduced model (OMIT, ASET or SUPORT)")
        return MatrixResult(
            _matrix(folder / STIFFNESS, size, size, upper=True),
            _matrix(folder / MASS, size, size, upper=True),
            kept[:, NODE],
            kept[:, COMPONENT],
            _dependent(folder / DEPENDENT, table),
        )
    except (OSError, ValueError, IndexError) as error:
        raise NoResult(f"the matrices of the MYSTRAN run in {folder}: {error}") from error


def _last_table(file: BinaryIO) -> Integers:
    """The last table of degrees of freedom, (n_dof, 16). Raises ValueError where there is none."""
    with mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as printed:
        first = printed.rfind(HEADING)
        last = printed.find(TOTAL, max(first, 0))
        rows = ROW.findall(printed[first:last]) if 0 <= first < last else []
    # Components other than a grid point's first have no number of it.
    text = b" ".join(
        row.replace(b"-", b" 0 " if row.lstrip().startswith(b"-") else b" ") for row in rows
    )
    whole = not re.search(rb"[^\d\s]", text)
    numbers: Integers = np.fromstring(text if whole else "", dtype=np.int64, sep=" ")
    if not rows or numbers.size != IN_ROW * len(rows):
        raise ValueError("the table of its degrees of freedom is missing or not whole")
    table = numbers.reshape(-1, IN_ROW)
    if (table[:, 1] != table[:, 3]).any():  # a row lacks a number that another has too many
        raise ValueError("the table of its degrees of freedom has rows of other lengths")
    begun = np.maximum.accumulate(np.where(table[:, 0] > 0, np.arange(len(rows)), 0))
    return np.column_stack([table[begun, 0], table[:, 1], table[:, 4:]])


def _members(table: Integers, column: int) -> Integers:
    """The rows of a set, in its order. Raises ValueError where one is missing."""
    found = table[table[:, column] > 0]
    found = found[np.argsort(found[:, column])]
    if not np.array_equal(found[:, column], np.arange(1, found.shape[0] + 1)):
        raise ValueError("its table of degrees of freedom lacks some of a set")
    return found


def _matrix(path: Path, n_rows: int, n_columns: int, upper: bool = False) -> sparse.csr_array:
    """A matrix of one file, or its upper triangle. Raises OSError, ValueError."""
    kept = list[tuple[NDArray[Any], ...]]()
    with open_regular(path) as file:
        head: NDArray[np.int32] = np.fromfile(file, "<i4", 6)
        whole = head.size == 6 and not (head[[0, 2, 3, 5]] != 4).any()
        left = int(head[4]) if whole else 0
        while left and whole:
            entries = np.fromfile(file, ENTRY, min(left, ENTRIES_AT_ONCE))
            left -= entries.size
            whole = bool(entries.size and ((entries["begin"] == 16) & (entries["end"] == 16)).all())
            own = entries[entries["row"] <= entries["column"]] if upper else entries
            kept.append((own["value"].copy(), own["row"] - 1, own["column"] - 1))
    if not whole:
        raise ValueError(f"{path.name} is not whole")
    if not kept:
        return sparse.csr_array((n_rows, n_columns))
    values, rows, columns = map(np.concatenate, zip(*kept, strict=True))
    return sparse.csr_array((values, (rows, columns)), shape=(n_rows, n_columns))


def _dependent(path: Path, table: Integers) -> DependentDofs | None:
    """What the M set is on the rows of KLL."""
    own, others = _members(table, IN_M), _members(table, IN_N)
    if not own.size:
        return None
    ties = sparse.csc_array(_matrix(path, own.shape[0], others.shape[0]))
    on_rows = sparse.csr_array(ties[:, _members(table, IN_L)[:, IN_N] - 1])
    return DependentDofs(own[:, NODE], own[:, COMPONENT], on_rows)
