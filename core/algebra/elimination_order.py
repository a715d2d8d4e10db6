"""The order in which the unknowns of a sparse symmetric matrix are eliminated.

Nested dissection of its graph by METIS: a set of points that cuts the graph in two goes last, each
half is cut again, and so on; the factor then has entries within halves and cuts alone (George 1973;
Karypis and Kumar 1998). What is cut is not the graph of the unknowns but one of a third or a fifth
as many points. Unknowns of a node, and of nodes on both sides of a thin wall, are numbered one
after the other and are coupled to the same other nodes, though not to the same unknowns of these
(in a wall in a plane of the axes, motion across is not coupled to motion along). So an unknown
belongs to the point of the one before it if the rows of both reach the same blocks of three
unknowns. Where there are no such zeros the rows themselves are compared, for by blocks neighbours
in a grid with one unknown a node would be alike. A point weighs as many unknowns as it has.
"""

from __future__ import annotations

import signal
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from modetune.core.modes import Integers

#: Unknowns of a block: displacements of a point, half of what it has with rotations.
_BLOCK = 3
#: Least share that both rows reach of what two unknowns of a point reach beyond the first of them:
#: neighbours on a line of bricks have two thirds in common, unknowns of a node all but a few zeros.
_ALIKE = 0.8
#: Unknowns up to which PARDISO's own order takes less than a tenth of a second, whatever the model.
SMALL = 10_000


def elimination_order(upper: sparse.csr_array) -> Integers | None:
    """The unknowns (n,), counted from 0, in the order of their elimination.

    upper: (n, n), the upper triangle, sorted, with each diagonal entry. None where the program that
    factorises may as well find its own: METIS is not installed, or the matrix is small or diagonal.
    """
    metis = _metis()
    n = upper.shape[0]
    if n <= SMALL or metis is None:
        return None
    first = _first_of_points(upper)
    weights = np.diff(first, append=n)
    point = np.repeat(np.arange(first.size, dtype=upper.indices.dtype), weights)
    reached = _reached(point[upper.indices], np.append(upper.indptr[first], upper.nnz), first.size)
    beyond = sparse.triu(reached, k=1, format="csr")
    graph = sparse.csr_array(beyond + beyond.T)
    if graph.nnz == 0:
        return None
    kind = metis.zero_copy_dtype()
    edges = metis.CSRAdjacency(graph.indptr.astype(kind), graph.indices.astype(kind))
    try:
        order, _ = metis.nested_dissection(edges, vweights=weights.astype(kind))
    except RuntimeError:  # METIS takes SIGTERM for a fault of its own, and leaves it blocked
        if signal.SIGTERM in signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGTERM}):
            raise KeyboardInterrupt from None
        raise
    place = np.empty(first.size, dtype=np.int64)
    place[np.asarray(order)] = np.arange(first.size)
    return np.argsort(place[point], kind="stable")


def _first_of_points(upper: sparse.csr_array) -> Integers:
    """The first unknown of each point, (n_points,), ascending."""
    n = upper.shape[0]
    alike = _rows_alike(_reached(upper.indices // _BLOCK, upper.indptr, n))
    if (
        np.count_nonzero(alike & (upper.diagonal(1) == 0.0)) < n // 10
    ):  # no zeros between unknowns of a point
        alike = _rows_alike(_reached(upper.indices, upper.indptr, n))
    return np.flatnonzero(np.append(True, ~alike))


def _rows_alike(reached: sparse.csr_array) -> NDArray[np.bool_]:
    """Whether a row reaches, beyond its own place, nearly what the next one does, (n_rows - 1,)."""
    common = np.diff(sparse.csr_array(reached[:-1].multiply(reached[1:])).indptr)
    reach = np.diff(reached.indptr)
    return np.asarray(common >= _ALIKE * np.maximum(reach[:-1] - 1, reach[1:]))


def _reached(columns: NDArray[Any], starts: NDArray[Any], width: int) -> sparse.csr_array:
    """Return a pattern (n_rows, width) from columns that may occur more than once in a row."""
    marks = np.ones(columns.size, dtype=np.bool_)
    pattern = sparse.csr_array((marks, columns, starts.copy()), shape=(starts.size - 1, width))
    pattern.sum_duplicates()
    return pattern


@cache
def _metis() -> Any | None:
    try:
        import pymetis
    except ImportError:
        return None
    return pymetis
