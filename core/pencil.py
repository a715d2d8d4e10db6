"""K - s M of one model after the other, all of one sparsity, from their upper triangles.

What depends on the sparsity alone is kept: the union of both patterns, the places of the entries
of K and M in it, the order of the unknowns for the factorisation, and which rows have mass.
Products with a triangle U are U x + U^T x - d x, column by column: faster than with the mirrored
matrix in blocks, and half its memory.

Many unknowns may have no mass (rotations, condensed nodes). The eigenvectors of

    A = (K - s M)^-1 M

follow from their rows with mass, phi = A phi / theta, so vectors are kept on these rows only and
M x is spread over all rows for a solution.
"""

from __future__ import annotations

from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from modetune.core.errors import ModelError
from modetune.core.factorisation import SymmetricFactors, symmetric_factors
from modetune.core.modes import Floats, Integers

Places: TypeAlias = NDArray[np.int32] | NDArray[np.int64] | slice

_LOST = 1e-2  # of a known solution, relative: beyond this the matrix has no inverse to speak of


class Pencil:
    """One model's K and M, and the factors of K - s M at one shift s.

    stiffness, mass: upper triangles, (n, n). rows: (n_with_mass,), or all as a slice. shift: where
    it is factorised, (rad/s)^2. below: eigenvalues below the shift (Sylvester's law of inertia:
    as many as K - s M has negative ones); -1 where a pivot was as good as zero.
    """

    def __init__(self, stiffness: sparse.csr_array, mass: sparse.csr_array) -> None:
        """Order the unknowns; nothing is factorised yet.

        stiffness, mass: (n, n), upper triangles, sorted, kept and not copied. Raises ModelError
        where they are no model, SolverExhausted where memory does not suffice.
        """
        _check(stiffness, mass)
        self.n = int(stiffness.shape[0])
        self.shift: float | None = None
        self.below = -1
        pattern = _union(stiffness, mass)
        self._n_entries = int(pattern.nnz)
        self._stiffness_places = _places(pattern, stiffness)
        self._mass_places = _places(pattern, mass)
        self._take(stiffness, mass)
        self._factors: SymmetricFactors = symmetric_factors(pattern)

    def update(self, stiffness: sparse.csr_array, mass: sparse.csr_array) -> bool:
        """Take the next model; false, and nothing done, where its sparsity is another."""
        if not (_alike(stiffness, self.stiffness) and _alike(mass, self.mass)):
            return False
        _check(stiffness, mass)
        self._take(stiffness, mass)
        return True

    def factorise(self, shift: float) -> None:
        """Factorise K - shift M. Raises ModelError where it is exactly singular."""
        values = np.zeros(self._n_entries)
        values[self._stiffness_places] = self.stiffness.data
        values[self._mass_places] -= shift * self.mass.data
        self.shift = None
        self._factors.refactor(values)
        self.shift = shift
        self.below = -1 if self._factors.lifted_pivots else self._factors.negative_pivots

    def inverse(self, block: Floats, out: Floats | None = None) -> Floats:
        """(K - s M)^-1 block, (n,) or (n, n_columns), at the last shift; out: where to put it."""
        return self._factors.solve(block, out)

    def apply(self, inertia: Floats) -> Floats:
        """(K - s M)^-1 f on all rows, (n, n_columns), of forces f on the rows with mass."""
        return self.inverse(self.spread(inertia))

    def apply_inside(self, inertia: Floats, out: Floats) -> None:
        """As apply, on the rows with mass only, (n_with_mass, n_columns), put into out."""
        if isinstance(self.rows, slice):
            self.inverse(inertia, out)
        else:
            out[...] = self.apply(inertia)[self.rows]

    def spread(self, block: Floats) -> Floats:
        """A block on the rows with mass, on all rows, with zeros elsewhere."""
        if isinstance(self.rows, slice):
            return block
        whole = np.zeros((self.n, *block.shape[1:]), order="F")
        whole[self.rows] = block
        return whole

    def stiff(self, block: Floats) -> Floats:
        """K block, (n, n_columns)."""
        return triangle_product(self.stiffness, block)

    def inertia(self, block: Floats, out: Floats | None = None) -> Floats:
        """M block, on the rows with mass; out: where to put it, in Fortran order."""
        return triangle_product(self._inner_mass, block, self._inner_diagonal, out)

    def largest_eigenvalue(self) -> float:
        """A number of the size of the largest eigenvalue: the stiffest unknown by itself."""
        inertia = self.mass.diagonal()
        moving = inertia > 0.0
        largest = float(np.max(np.abs(self.stiffness.diagonal()[moving]) / inertia[moving]))
        return largest if largest > 0.0 else 1.0

    def is_invertible(self) -> bool:
        """Whether the factors give a known solution back, in the scale of each unknown."""
        known = np.random.default_rng(1).standard_normal(self.n)
        shift = 0.0 if self.shift is None else self.shift
        diagonal = np.abs(self.stiffness.diagonal()) + abs(shift) * self.mass.diagonal()
        if not diagonal.all():
            return False
        known /= np.sqrt(diagonal)
        forces = triangle_product(self.stiffness, known)
        forces -= shift * triangle_product(self.mass, known)
        lost = (self.inverse(forces) - known) * np.sqrt(diagonal)
        return bool(np.linalg.norm(lost) <= _LOST * np.sqrt(self.n))

    def _take(self, stiffness: sparse.csr_array, mass: sparse.csr_array) -> None:
        self.stiffness, self.mass = stiffness, mass
        self.shift, self.below = None, -1
        self.rows, self._inner_mass = _with_mass(mass)
        self._inner_diagonal = self._inner_mass.diagonal()
        self.n_with_mass = int(self._inner_mass.shape[0])


def triangle_product(
    upper: sparse.csr_array,
    block: Floats,
    diagonal: Floats | None = None,
    out: Floats | None = None,
) -> Floats:
    """The symmetric matrix with this upper triangle times a block, in Fortran order.

    upper: (n, n); block: (n,) or (n, n_columns); diagonal: (n,) of upper, where it is at hand;
    out: where to put it, of the shape of block.
    """
    lower = upper.T
    diagonal = upper.diagonal() if diagonal is None else diagonal
    out = np.empty(block.shape, order="F") if out is None else out
    columns, into = (a[:, None] if a.ndim == 1 else a for a in (block, out))
    for place in range(columns.shape[1]):
        x = np.ascontiguousarray(columns[:, place])
        y = upper @ x
        y += lower @ x
        y -= diagonal * x
        into[:, place] = y
    return out


def _with_mass(mass: sparse.csr_array) -> tuple[Integers | slice, sparse.csr_array]:
    # A row of M with a zero on its diagonal is a zero row, or M were no mass.
    inertia = mass.diagonal()
    moving = inertia != 0.0
    if (inertia < 0.0).any():
        raise ModelError(
            f"the mass matrix is negative at row {int(np.argmin(inertia))} (from 0): it is no mass"
        )
    if moving.all():
        return slice(None), mass
    if not moving.any():
        raise ModelError("the mass matrix is zero: there is nothing that moves")
    rows = np.flatnonzero(moving)
    inner = sparse.csr_array(mass[rows][:, rows])
    inner.sort_indices()
    if np.count_nonzero(inner.data) != np.count_nonzero(mass.data):
        raise ModelError("the mass matrix has negative eigenvalues: it is no mass")
    return rows, inner


def _union(stiffness: sparse.csr_array, mass: sparse.csr_array) -> sparse.csr_array:
    ones = [_numbered(a, np.ones(a.nnz)) for a in (stiffness, mass)]
    diagonal = sparse.csr_array(sparse.eye_array(stiffness.shape[0]))
    union = sparse.csr_array(ones[0] + ones[1] + diagonal)
    union.sort_indices()
    return union


def _places(pattern: sparse.csr_array, part: sparse.csr_array) -> Places:
    """Where the entries of a part stand among those of the pattern, (n_entries,)."""
    if _alike(pattern, part):
        return slice(None)
    numbers = _numbered(pattern, np.arange(1.0, pattern.nnz + 1.0))
    inside = sparse.csr_array(numbers.multiply(_numbered(part, np.ones(part.nnz))))
    inside.sort_indices()
    kind: Any = np.int32 if pattern.nnz < 2**31 else np.int64
    return np.asarray(inside.data - 1.0, dtype=kind)


def _numbered(pattern: sparse.csr_array, values: Floats) -> sparse.csr_array:
    return sparse.csr_array((values, pattern.indices, pattern.indptr), shape=pattern.shape)


def _alike(first: sparse.csr_array, second: sparse.csr_array) -> bool:
    return (
        first.shape == second.shape
        and first.nnz == second.nnz
        and np.array_equal(first.indptr, second.indptr)
        and np.array_equal(first.indices, second.indices)
    )


def _check(stiffness: sparse.csr_array, mass: sparse.csr_array) -> None:
    if stiffness.shape != mass.shape or stiffness.shape[0] != stiffness.shape[1]:
        raise ModelError(f"stiffness is {stiffness.shape}, mass is {mass.shape}: not one model")
    for name, matrix in (("stiffness", stiffness), ("mass", mass)):
        if not matrix.has_canonical_format or not _is_upper(matrix):
            raise ModelError(f"the {name} matrix is no upper triangle with sorted rows")
        if not np.isfinite(matrix.data).all():
            raise ModelError(f"the {name} matrix holds values that are not finite")


def _is_upper(matrix: sparse.csr_array) -> bool:
    filled = np.flatnonzero(np.diff(matrix.indptr))
    return bool((matrix.indices[matrix.indptr[filled]] >= filled).all())
