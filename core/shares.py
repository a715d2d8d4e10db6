"""What each of several parameters changed in the stored matrices of one job.

One matrix job may move several parameters at once whose element groups share no node. Its
difference to the base is then block diagonal over the groups: the connected components of the
difference's pattern, each of which belongs to the group that has one of its nodes. Equations that
are no deck node's (incompatible modes of C3D8I, rotations of knots) are reached through those
that are.

Stored matrices are text of 14 digits, so an entry that did not change may differ in the last one,
by up to 10^-13 of itself, and another order of summation adds as little: what is below DUST of
sqrt(a_ii a_jj) is no change. A true change is above that unless the group is 10^12 times softer
than what it is joined to, where the text has lost it.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.csgraph import connected_components

from modetune.core.errors import ModelError
from modetune.core.matrices import MatrixResult
from modetune.core.modes import Integers

#: Share of sqrt(a_ii a_jj) below which two entries that were printed with 14 digits are the same.
DUST = 3e-13


def differences(
    base: MatrixResult, other: MatrixResult
) -> tuple[sparse.csr_array, sparse.csr_array]:
    """Upper triangles of what another state's stiffness and mass have beyond the base's, no dust.

    Raises ModelError where the two are not on the same equations.
    """
    if not (
        np.array_equal(base.nodes, other.nodes)
        and np.array_equal(base.components, other.components)
    ):
        raise ModelError(
            f"the stored matrices of two states of the model have other equations "
            f"({base.nodes.size} and {other.nodes.size}), as where shells of equal thickness "
            "become unequal; use finite_difference, or start where they are unequal"
        )
    return (
        _beyond(other.upper_stiffness, base.upper_stiffness),
        _beyond(other.upper_mass, base.upper_mass),
    )


def remainder(
    upper: sparse.csr_array, shares: Iterable[tuple[float, sparse.csr_array]]
) -> sparse.csr_array:
    """What is left of an upper triangle (n, n) without some shares times their factors, no dust."""
    taken = sparse.csr_array(upper.shape)
    for factor, share in shares:
        taken = taken + factor * share
    return _beyond(upper, sparse.csr_array(taken))


def _beyond(one: sparse.csr_array, other: sparse.csr_array) -> sparse.csr_array:
    """One upper triangle less another, without entries that are only rounding."""
    found = sparse.csr_array(one - other)
    size = np.sqrt(np.maximum(np.abs(one.diagonal()), np.abs(other.diagonal())))
    rows = np.repeat(np.arange(found.shape[0]), np.diff(found.indptr))
    found.data[np.abs(found.data) <= DUST * size[rows] * size[found.indices]] = 0.0
    found.eliminate_zeros()
    found.sort_indices()
    return found


def separate(
    difference: sparse.csr_array,
    nodes: Integers,
    footprints: Sequence[frozenset[int]],
    whole: sparse.csr_array | None = None,
) -> list[sparse.csr_array]:
    """The parts of a difference that belong to groups of elements, upper triangles (n, n) each.

    difference: upper triangle, (n, n), without dust; nodes: (n,), the node that each equation is
    named after; footprints: the nodes of each group; whole: upper triangle, (n, n), of the model,
    by which equations inside elements are joined to their nodes where the difference does not join
    them (of a rectangular shell's thickness it has only their diagonal). Raises ModelError where
    groups share a node, or a part of the difference touches none or several of them.
    """
    owner = _owners(nodes, footprints)
    _, component = connected_components(difference, directed=False)
    changed = np.diff(difference.indptr) > 0
    changed[difference.indices] = True
    lowest = np.full(nodes.size, len(footprints))
    highest = np.full(nodes.size, -1)
    named = changed & (owner >= 0)
    np.minimum.at(lowest, component[named], owner[named])
    np.maximum.at(highest, component[named], owner[named])
    if whole is not None:
        lost = np.flatnonzero(changed & (highest[component] < 0))
        beside = _beside(whole, lost, owner)
        np.minimum.at(lowest, component[lost], np.where(beside < 0, len(footprints), beside))
        np.maximum.at(highest, component[lost], beside)
    wrong = np.flatnonzero(changed & (lowest != highest)[component])
    if wrong.size:
        where = f"node {nodes[wrong[0]]}"
        raise ModelError(
            f"the stored matrices changed at {where}, which is not joined to the elements of any "
            "moved parameter; use finite_difference"
            if highest[component[wrong[0]]] < 0
            else f"the stored matrices changed at {where} by two parameters whose elements should "
            "share no node; use finite_difference"
        )
    owners = np.where(changed, highest[component], -1)
    return [_rows(difference, owners == place) for place in range(len(footprints))]


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


def _owners(nodes: Integers, footprints: Sequence[frozenset[int]]) -> Integers:
    """The group that has each equation's node, (n,); -1 where none has."""
    owner = np.full(nodes.size, -1)
    for place, footprint in enumerate(footprints):
        inside = np.isin(nodes, np.fromiter(footprint, np.int64, len(footprint)))
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
