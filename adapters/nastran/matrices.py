"""The matrices that MYSTRAN keeps for a restart (CHKPNT), with what their rows are.

Its modes are those of KLL and MLL, on the degrees of freedom that constraints, rigid elements and
AUTOSPC leave. OUTPUT4 would give them too, but each column from its first entry to its last: 7.5 GB
of 12 MB for a plate of 4,300 shells with one rigid element. The restart files hold the entries that
are not zero, as unformatted records of Fortran: the time of the run, the number of entries, and
row, column and value of each. Which row is which component of which grid point the table of degrees
of freedom (TDOF) says, which PARAM,PRTDOF prints after each round of AUTOSPC; the last one holds.

The degrees of freedom of the M set depend on others (MPC, RBE2, RBE3): u_M = GMN u_N, and those of
the N set are rows of KLL or held.
"""

from __future__ import annotations

import io
import re
from collections.abc import Collection, Iterable
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from modetune.adapters.cross_checks import SPARE_EIGENVALUE
from modetune.adapters.nastran.dialect import JOB
from modetune.adapters.regular_file import open_regular
from modetune.core.algebra.matrices import DependentDofs, MatrixResult, upper_triangle
from modetune.core.errors import NoResult
from modetune.core.modes import Integers

#: Executive statement that keeps the files, and the parameter that prints the table.
KEEP, PRINT_TABLE = "CHKPNT", "PARAM,PRTDOF,1"
#: Files of KLL, MLL and GMN; there is no last one without dependent degrees of freedom.
STIFFNESS, MASS, DEPENDENT = f"{JOB}.L2G", f"{JOB}.L2I", f"{JOB}.L2A"
#: One entry between the marks of its record.
ENTRY = np.dtype(
    [("begin", "<i4"), ("row", "<i4"), ("column", "<i4"), ("value", "<f8"), ("end", "<i4")]
)
#: The heading of the table, and a row: a grid point (blank for its other components), a component,
#: the same by internal numbers, and the place in 14 sets.
HEADING = "DEGREE OF FREEDOM TABLE SORTED ON GRID POINT (TDOF)"
ROW = re.compile(r" *\d*-\d +\d*-\d ")
#: Numbers of a row: both grid points and components, and the places.
IN_ROW = 18
#: Columns of the table: node, component, and the sets that count.
NODE, COMPONENT, IN_M, IN_N, IN_O, IN_R, IN_L = 0, 1, 3, 4, 12, 14, 15


def read_restart(folder: Path, print_file: str, grids: Collection[int]) -> MatrixResult:
    """The matrices of a run. Raises NoResult where they are not whole, or of another deck.

    grids: grid points that the deck has at least.
    """
    try:
        with (
            open_regular(folder / print_file) as file,
            io.TextIOWrapper(file, encoding="latin-1", newline="\n") as lines,
        ):
            table = _last_table(lines)
        strange = sorted(set(grids) - set(table[:, NODE].tolist()))
        if strange:
            raise ValueError(
                f"they are those of another deck, which has no grid point {strange[0]} "
                f"({len(strange)} of the deck's are missing); remove the folder and run it again"
            )
        kept = _members(table, IN_L)
        size = kept.shape[0]
        stiffness, mass = (_matrix(folder / name, size, size) for name in (STIFFNESS, MASS))
        if table[:, [IN_O, IN_R]].any():
            raise ValueError("matrices of a reduced model (OMIT, ASET or SUPORT)")
        dependent = _dependent(folder / DEPENDENT, table)
        # Unknowns that let it find all modes of a small model are not the model's.
        spare = stiffness.diagonal() >= 0.5 * SPARE_EIGENVALUE * mass.diagonal()
        own = np.flatnonzero(~spare | (mass.diagonal() == 0.0))
        if dependent is not None:
            dependent = replace(dependent, matrix=sparse.csr_array(dependent.matrix[:, own]))
        return MatrixResult(
            upper_triangle(sparse.csr_array(stiffness[own][:, own])),
            upper_triangle(sparse.csr_array(mass[own][:, own])),
            kept[own, NODE],
            kept[own, COMPONENT],
            dependent,
        )
    except (OSError, ValueError, IndexError) as error:
        raise NoResult(f"the matrices of the MYSTRAN run in {folder}: {error}") from error


def _last_table(lines: Iterable[str]) -> Integers:
    """The last table of degrees of freedom, (n_dof, 16). Raises ValueError where there is none."""
    rows, inside = list[str](), False
    for line in lines:
        if inside and ROW.match(line):
            rows.append(line)
        elif HEADING in line:
            rows, inside = [], True  # the table before it no longer holds
        elif inside and line.startswith("TOTAL NUMBER OF DOF"):
            inside = False
    # Components other than a grid point's first have no number of it.
    text = " ".join(
        row.replace("-", " 0 " if row.lstrip().startswith("-") else " ") for row in rows
    )
    whole = not re.search(r"[^\d\s]", text)
    numbers: Integers = np.fromstring(text if whole else "", dtype=np.int64, sep=" ")
    if not rows or inside or numbers.size != IN_ROW * len(rows):
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


def _matrix(path: Path, n_rows: int, n_columns: int) -> sparse.csr_array:
    """A matrix of one file. Raises OSError, ValueError."""
    with open_regular(path) as file:
        head: NDArray[np.int32] = np.fromfile(file, "<i4", 6)
        count = int(head[4]) if head.size == 6 else -1
        entries = np.fromfile(file, ENTRY, max(count, 0))
    marks = (entries["begin"] == 16) & (entries["end"] == 16)
    if count != entries.size or not marks.all() or (head[[0, 2, 3, 5]] != 4).any():
        raise ValueError(f"{path.name} is not whole")
    places = entries["row"] - 1, entries["column"] - 1
    return sparse.csr_array((entries["value"], places), shape=(n_rows, n_columns))


def _dependent(path: Path, table: Integers) -> DependentDofs | None:
    """What the M set is on the rows of KLL."""
    own, others = _members(table, IN_M), _members(table, IN_N)
    if not own.size:
        return None
    ties = sparse.csc_array(_matrix(path, own.shape[0], others.shape[0]))
    on_rows = sparse.csr_array(ties[:, _members(table, IN_L)[:, IN_N] - 1])
    return DependentDofs(own[:, NODE], own[:, COMPONENT], on_rows)
