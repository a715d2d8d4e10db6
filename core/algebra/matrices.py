"""Stiffness and mass of one model state, kept as upper triangles.

Matrices of finite element models are symmetric, and those of large models are most of what the
memory holds: the lower triangle is never stored. With U the upper triangle of A, D its diagonal,

    A x = U x + U^T x - D x,        X^T A X = S + S^T,   S = X^T (U - D / 2) X.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import sparse

from modetune.core.modes import Floats, Integers

#: The arrays of a CSR matrix, by their names in SciPy and in files.
CSR = ("data", "indices", "indptr")
#: Rows of a projection that are multiplied at once, so that their product stays in the cache.
ROWS_AT_ONCE = 16384
#: Largest relative error of a stored entry: CalculiX writes 14 digits; other matrices are exacter.
ENTRY_ROUNDING = 5e-14


@dataclass(frozen=True, slots=True)
class DependentDofs:
    """Degrees of freedom that constraints and rigid elements make sums of a model's equations.

    nodes, components: (n_dependent,). matrix: (n_dependent, n), CSR, their sums over equations.
    """

    nodes: Integers
    components: Integers
    matrix: sparse.csr_array


@dataclass(frozen=True, slots=True)
class MatrixResult:
    """Stiffness and mass of one model state on the solver's own equations.

    upper_stiffness, upper_mass: (n, n), upper triangles with the diagonal, CSR with sorted
    indices, in the deck's units.
    nodes, components: (n,), the name of each equation; a name may occur more than once if the
    solver adds unknowns (incompatible modes, expanded shells).
    dependent: what the solver has eliminated, None if unknown.
    """

    upper_stiffness: sparse.csr_array
    upper_mass: sparse.csr_array
    nodes: Integers
    components: Integers
    dependent: DependentDofs | None = None

    @classmethod
    def of_full(
        cls,
        stiffness: sparse.csr_array,
        mass: sparse.csr_array,
        nodes: Integers,
        components: Integers,
    ) -> MatrixResult:
        """The state whose matrices (n, n) are given with both triangles."""
        return cls(upper_triangle(stiffness), upper_triangle(mass), nodes, components)

    @property
    def stiffness(self) -> sparse.csr_array:
        """Both triangles, (n, n), assembled at each access: keep the result to use it twice."""
        return symmetric(self.upper_stiffness)

    @property
    def mass(self) -> sparse.csr_array:
        """Both triangles, (n, n), assembled at each access: keep the result to use it twice."""
        return symmetric(self.upper_mass)


def upper_triangle(full: sparse.csr_array) -> sparse.csr_array:
    """The upper triangle of a matrix (n, n), diagonal included, with sorted indices."""
    upper = sparse.csr_array(sparse.triu(full, format="csr"))
    upper.sum_duplicates()
    return upper


def symmetric(upper: sparse.csr_array) -> sparse.csr_array:
    """The full symmetric matrix of an upper triangle."""
    strict = sparse.triu(upper, k=1, format="csr")
    return sparse.csr_array(upper + strict.T)


def upper_product(upper: sparse.csr_array, block: Floats) -> Floats:
    """A x of the symmetric matrix with this upper triangle; block: (n, k)."""
    own, kept = touched_product(upper, block)
    found = np.zeros((upper.shape[0], block.shape[1]))
    found[kept] = own
    return found


def touched_product(upper: sparse.csr_array, block: Floats) -> tuple[Floats, Integers]:
    """The same on the rows that are not zero, (n_touched, k), and which these are."""
    inside, kept = touched(upper)
    rows = np.ascontiguousarray(block[kept])
    own = inside @ rows
    own += inside.T @ rows
    own -= inside.diagonal()[:, None] * rows
    return own, kept


def eigenvalue_rounding(here: MatrixResult, eigenvalues: Floats, shapes: Floats) -> Floats:
    """Return how far rounding of the entries may move each eigenvalue, (n_modes,).

    eigenvalues: (n_modes,). shapes: phi, (n, n_modes), of modal mass 1. With errors |dK| <= e |K|
    and |dM| <= e |M| of the entries, d lambda = phi^T (dK - lambda dM) phi is at most
    e |phi|^T (|K| + |lambda| |M|) |phi|. In a stiff structure on soft springs that is far more
    than e lambda: energies of its elements cancel in rigid motion, and their rounding does not.
    """
    sizes = np.abs(shapes)
    stiffness, mass = (
        np.einsum("ij,ij->j", sizes, upper_product(sparse.csr_array(abs(upper)), sizes))
        for upper in (here.upper_stiffness, here.upper_mass)
    )
    return np.asarray(ENTRY_ROUNDING * (stiffness + np.abs(eigenvalues) * mass))


def projected(upper: sparse.csr_array, block: Floats) -> Floats:
    """X^T A X, (k, k), of the symmetric matrix with this upper triangle; block: X, (n, k).

    Nothing is copied of a block in C order. With half the diagonal U is half of A, so the product
    is S + S^T; it is gathered from a few rows of U at a time, which stay in the cache.
    """
    rows = np.ascontiguousarray(block)
    half = np.zeros((rows.shape[1],) * 2)
    filled = np.flatnonzero(np.diff(upper.indptr))
    for start in range(0, filled.size, ROWS_AT_ONCE):
        own = filled[start : start + ROWS_AT_ONCE]
        first, last = upper.indptr[own[0]], upper.indptr[own[-1] + 1]
        pointers = np.append(upper.indptr[own], last) - first
        data, indices = upper.data[first:last].copy(), upper.indices[first:last]
        leading = pointers[:-1]
        data[leading[indices[leading] == own]] *= 0.5
        some = sparse.csr_array((data, indices, pointers), shape=(own.size, upper.shape[1]))
        half += rows[own].T @ (some @ rows)
    return np.asarray(half + half.T)


def touched(upper: sparse.csr_array) -> tuple[sparse.csr_array, Integers]:
    """A matrix without its empty rows and columns, and which equations it keeps."""
    n = upper.shape[0]
    seen = np.diff(upper.indptr) > 0
    seen[upper.indices] = True
    kept = np.flatnonzero(seen)
    if kept.size == n:
        return upper, kept
    place = np.cumsum(seen, dtype=upper.indices.dtype) - 1
    pointers = np.append(upper.indptr[:-1][kept], upper.indptr[-1])
    small = (upper.data, place[upper.indices], pointers)
    return sparse.csr_array(small, shape=(kept.size, kept.size)), kept


def union(matrices: Sequence[sparse.csr_array]) -> sparse.csr_array:
    """A matrix of ones with an entry wherever one of these (n, n) has one, sorted."""
    whole = _marked(matrices[0], np.ones(matrices[0].nnz, dtype=np.int32))
    for item in matrices[1:]:
        whole = sparse.csr_array(whole + _marked(item, np.ones(item.nnz, dtype=np.int32)))
    whole.sort_indices()
    return whole


def places_in(pattern: sparse.csr_array, part: sparse.csr_array) -> Integers:
    """Return the positions of a part's entries among those of a pattern, both sorted.

    Entries that the pattern does not have are left out.
    """
    count = np.int32 if pattern.nnz < np.iinfo(np.int32).max else np.int64
    numbered = _marked(pattern, np.arange(1, pattern.nnz + 1, dtype=count))
    found = sparse.csr_array(numbered.multiply(_marked(part, np.ones(part.nnz, dtype=count))))
    found.sort_indices()
    return np.asarray(found.data - 1)


def same_pattern(one: sparse.csr_array, other: sparse.csr_array) -> bool:
    """Whether two matrices have their entries in the same places."""
    return (
        one.shape == other.shape
        and one.nnz == other.nnz
        and np.array_equal(one.indptr, other.indptr)
        and np.array_equal(one.indices, other.indices)
    )


def _marked(pattern: sparse.csr_array, marks: Integers) -> sparse.csr_array:
    """A matrix with these integers for its entries."""
    return sparse.csr_array((marks, pattern.indices, pattern.indptr), shape=pattern.shape)
