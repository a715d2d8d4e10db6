"""What each of several parameters changed in the stored matrices of one job.

One matrix job may move several parameters at once whose element groups share no node. Its
difference to the base is then block diagonal over the groups: the connected components of the
difference's pattern, each of which belongs to the group that has one of its nodes. Equations that
are not a deck node's (incompatible modes of C3D8I, rotations of knots) are reached through those
that are.

Stored matrices are text of 14 digits of sums over elements, so entries that stand for the same
number may differ by rounding. An entry a_ij printed so is off by half a unit of its last digit,
0.5 10^-13 |a_ij| at most; a sum of m terms is off by m eps / 2 times the sum of their sizes, and
threads may take the terms in another order. Element matrices are positive semi-definite, hence

    |k_ij| <= sqrt(k_ii k_jj) for each element, and sum |k_ij| <= sqrt(a_ii a_jj) (Cauchy, Schwarz):

both are at most ROUNDING sqrt(a_ii a_jj), however small the sum itself is. What follows from
several matrices has the rounding of all of them, sum_s ROUNDING sqrt(a_ii^s a_jj^s), and by Cauchy
and Schwarz again that is at most ROUNDING sqrt(d_i d_j) with d the sum of their diagonals. Below
this nothing is a change: also not in a remainder, where entries that were too small to be seen as a
parameter's are left over (on a mesh with dust of 10^-13 in its coordinates, where exact zeros of
the ideal one are 10^-13 of the diagonal). A true change is above it unless a group is some 10^12
times softer than what it is joined to, where the text has lost it.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.csgraph import connected_components

from modetune.core.algebra.matrices import ROWS_AT_ONCE, MatrixResult
from modetune.core.errors import ModelError
from modetune.core.modes import Floats, Integers

#: Terms that are summed to one entry: 24 tetrahedra of 4 integration points, 8 bricks of 27.
TERMS = 256
#: Largest rounding of a stored entry in sqrt(a_ii a_jj): its 14 digits, and that of its sum.
ROUNDING = 0.5e-13 + 0.5 * TERMS * float(np.finfo(np.float64).eps)


def differences(
    base: MatrixResult, other: MatrixResult
) -> tuple[sparse.csr_array, sparse.csr_array]:
    """Upper triangles of what another state's stiffness and mass have beyond the base's.

    Differences that may be rounding are left out.

    Raises ModelError where the two are not on the same equations.
    """
    if not (
        np.array_equal(base.nodes, other.nodes)
        and np.array_equal(base.components, other.components)
    ):
        raise ModelError(
            f"the stored matrices of two states of the model have other equations "
            f"({base.nodes.size} and {other.nodes.size}), as where shells of equal thickness "
            "become unequal; start where they are unequal"
        )
    stiffness, mass = (
        _without_rounding(new - old, np.abs(new.diagonal()) + np.abs(old.diagonal()))
        for old, new in (
            (base.upper_stiffness, other.upper_stiffness),
            (base.upper_mass, other.upper_mass),
        )
    )
    return stiffness, mass


def remainder(
    upper: sparse.csr_array, taken: Iterable[tuple[float, sparse.csr_array]]
) -> sparse.csr_array:
    """What is left of an upper triangle (n, n) without parts of it, no rounding.

    taken: factors and matrices; factor times matrix is what a parameter has of the triangle, found
    as its change where the parameter is twice as large.
    """
    # A copy: entries are taken out in place below, of the triangle itself where nothing is taken.
    left, diagonal = upper.copy(), upper.diagonal()
    sizes = np.abs(diagonal)
    for factor, matrix in taken:
        part = factor * matrix
        left, own = left - part, part.diagonal()
        # The two matrices of that change, diagonal and diagonal + own.
        sizes += np.where(own != 0.0, 2.0 * np.abs(diagonal) + np.abs(own), 0.0)
    return _without_rounding(left, sizes)


def _without_rounding(found: sparse.csr_array, sizes: Floats) -> sparse.csr_array:
    """A difference without entries that are only rounding.

    sizes: (n,), of the matrices that it was made of the sum of their diagonals.
    """
    found = sparse.csr_array(found)
    root = np.sqrt(sizes)
    for first in range(0, root.size, ROWS_AT_ONCE):
        starts = found.indptr[first : first + ROWS_AT_ONCE + 1]
        piece = slice(starts[0], starts[-1])
        allowed = np.repeat(ROUNDING * root[first : first + ROWS_AT_ONCE], np.diff(starts))
        allowed *= root[found.indices[piece]]
        data = found.data[piece]
        data[np.abs(data) <= allowed] = 0.0
    found.eliminate_zeros()
    found.sort_indices()
    return found


def separate(
    difference: sparse.csr_array,
    nodes: Integers,
    node_groups: Sequence[frozenset[int]],
    whole: sparse.csr_array | None = None,
) -> list[sparse.csr_array]:
    """The parts of a difference that belong to groups of elements, upper triangles (n, n) each.

    difference: upper triangle, (n, n), without rounding; nodes: (n,), the node that each equation
    is named after; node_groups: the nodes of each group; whole: upper triangle (n, n) of the model,
    by which equations inside elements are joined to their nodes where the difference does not join
    them (of a rectangular shell's thickness it has only their diagonal). Raises ModelError where
    groups share a node, or a part of the difference touches none or several of them.
    """
    owner = _owners(nodes, node_groups)
    _, component = connected_components(difference, directed=False)
    changed = np.diff(difference.indptr) > 0
    changed[difference.indices] = True
    lowest = np.full(nodes.size, len(node_groups))
    highest = np.full(nodes.size, -1)
    named = changed & (owner >= 0)
    np.minimum.at(lowest, component[named], owner[named])
    np.maximum.at(highest, component[named], owner[named])
    if whole is not None:
        lost = np.flatnonzero(changed & (highest[component] < 0))
        beside = _beside(whole, lost, owner)
        np.minimum.at(lowest, component[lost], np.where(beside < 0, len(node_groups), beside))
        np.maximum.at(highest, component[lost], beside)
    wrong = np.flatnonzero(changed & (lowest != highest)[component])
    if wrong.size:
        where = f"node {nodes[wrong[0]]}"
        raise ModelError(
            f"the stored matrices changed at {where}, which is not joined to the elements of any "
            "moved parameter"
            if highest[component[wrong[0]]] < 0
            else f"the stored matrices changed at {where} by two parameters whose elements should "
            "share no node"
        )
    owners = np.where(changed, highest[component], -1)
    return [_rows(difference, owners == place) for place in range(len(node_groups))]


def with_tied(nodes: Iterable[int], ties: Iterable[tuple[set[int], set[int]]]) -> set[int]:
    """These nodes and all that ties lead to from them; ties: nodes, and those they depend on."""
    leads: dict[int, set[int]] = {}
    for dependent, others in ties:
        for node in dependent:
            leads.setdefault(node, set()).update(others)
    reached, new = set(nodes), set(nodes)
    while new:
        new = set[int]().union(*(leads.get(node, ()) for node in new)) - reached
        reached |= new
    return reached


def _beside(whole: sparse.csr_array, rows: Integers, owner: Integers) -> Integers:
    """The group of the nodes that each of these rows is coupled with, (n_rows,); -1 where none.

    An equation inside an element is coupled with that element's nodes alone, and two groups share
    no node.
    """
    found = np.full(rows.size, -1)
    for part in (whole[rows], sparse.csr_array(sparse.csc_array(whole)[:, rows].T)):
        here = np.repeat(np.arange(rows.size), np.diff(part.indptr))
        np.maximum.at(found, here, owner[part.indices])
    return found


def _owners(nodes: Integers, node_groups: Sequence[frozenset[int]]) -> Integers:
    """The group that has each equation's node, (n,); -1 where none has."""
    owner = np.full(nodes.size, -1)
    for place, group in enumerate(node_groups):
        inside = np.isin(nodes, np.fromiter(group, np.int64, len(group)))
        shared = np.flatnonzero(inside & (owner >= 0))
        if shared.size:
            raise ModelError(
                f"parameters {owner[shared[0]]} and {place} of one matrix job share node "
                f"{nodes[shared[0]]}: their changes cannot be told apart"
            )
        owner[inside] = place
    return owner


def _rows(upper: sparse.csr_array, kept: NDArray[np.bool_]) -> sparse.csr_array:
    """The matrix with these rows only, the others empty."""
    counts = np.diff(upper.indptr)
    entries = np.repeat(kept, counts)
    pointers = np.concatenate([[0], np.cumsum(np.where(kept, counts, 0))])
    data, indices = upper.data[entries], upper.indices[entries]
    pointers = pointers.astype(upper.indptr.dtype)
    return sparse.csr_array((data, indices, pointers), shape=upper.shape)
