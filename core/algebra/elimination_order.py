"""The order in which the unknowns of a sparse symmetric matrix are eliminated.

Nested dissection of its graph by METIS: a set of points that cuts the graph in two goes last, each
half is cut again, and so on (George 1973; Karypis and Kumar 1998). The factor then has entries
within halves and cuts alone. What is cut is not the graph of the unknowns but a third or a sixth
of it, that of the points they belong to: unknowns of a point are numbered one after the other and
are coupled to the same other points, though not to the same unknowns of these (a plate in a plane
of the axes has zeros between its own plane and the direction across). So an unknown belongs to the
point of the one before it if the rows of both reach nearly the same blocks of three unknowns.
Points weigh as many unknowns as they have.
"""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from modetune.core.modes import Integers

#: Unknowns of a block: displacements of a point, half of what it has with rotations.
_BLOCK = 3
#: Share of what the rows of two unknowns of one point reach that both do, at least: neighbours on a
#: line of bricks have two thirds in common, unknowns of a point all but a few zeros.
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
    order, _ = metis.nested_dissection(edges, vweights=weights.astype(kind))
    place = np.empty(first.size, dtype=np.int64)
    place[np.asarray(order)] = np.arange(first.size)
    return np.argsort(place[point], kind="stable")


def _first_of_points(upper: sparse.csr_array) -> Integers:
    """The first unknown of each point, (n_points,), ascending."""
    n = upper.shape[0]
    second = np.minimum(upper.indptr[:-2] + 1, upper.nnz - 1)
    coupled = upper.indices[second] == np.arange(1, n)
    alike = np.where(
        coupled,
        _rows_alike(_reached(upper.indices, upper.indptr, n), coupled),
        _rows_alike(_reached(upper.indices // _BLOCK, upper.indptr, n)),
    )
    return np.flatnonzero(np.append(True, ~alike))


def _rows_alike(
    reached: sparse.csr_array, own: NDArray[np.bool_] | bool = False
) -> NDArray[np.bool_]:
    """Whether a row reaches nearly what the next one does, (n_rows - 1,); own: and itself too."""
    common = np.diff(sparse.csr_array(reached[:-1].multiply(reached[1:])).indptr)
    reach = np.diff(reached.indptr)
    return np.asarray(common >= _ALIKE * np.maximum(reach[:-1] - own, reach[1:]))


def _reached(columns: NDArray[Any], starts: NDArray[Any], width: int) -> sparse.csr_array:
    """A pattern (n_rows, width) of columns that may stand more than once in a row."""
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
