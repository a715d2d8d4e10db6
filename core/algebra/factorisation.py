"""One factorisation of a sparse symmetric matrix, for as many right-hand sides as wanted.

A is brought to a unit diagonal first, S = D A D with d_i = |a_ii|^-1/2, so that translations in
mm and rotations in rad weigh the same, and

    A^-1 b = D S^-1 D b,    condition = ||S||_1 ||S^-1||_1,

with ||S^-1||_1 estimated from a few solves (Hager 1984; Higham 1988). A condition beyond 10^14
leaves no digit of the answer: the matrix is called singular, as a free structure's stiffness is.
The rounding of a rigid-body eigenvalue cannot be distinguished from such a small one.

Intel's PARDISO factorises as L D L^T with 1x1 and 2x2 pivots, so indefinite matrices such as K -
shift M are as welcome as positive ones. Where PARDISO is not installed SciPy's SuperLU does the
same more slowly. Results can be shared by threads. Models that differ in their values only are
factorised one after the other by one `SymmetricFactors`, which orders the unknowns once.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Literal, Protocol, TypeAlias

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse import linalg

from modetune.core.algebra import matrices
from modetune.core.algebra.factor_room import roomy_factors
from modetune.core.algebra.pardiso import is_available
from modetune.core.algebra.vector_room import in_memory
from modetune.core.errors import ModelError
from modetune.core.near_names import listed

Matrix: TypeAlias = sparse.sparray | sparse.spmatrix | NDArray[np.float64]

SINGULAR_CONDITION = 1e14
_COLUMNS_AT_ONCE = 64  # bounds the copies made of a right-hand side


class SymmetricFactors(Protocol):
    """The factors of one real symmetric matrix after the other, all of one sparsity.

    negative_pivots: how many eigenvalues of the matrix are negative. lifted_pivots: how many were
    as good as zero. factor_entries: of the factor L. exact: whether they are in double precision.
    held: how they are held, where that is not in double precision in memory.
    """

    @property
    def exact(self) -> bool: ...

    @property
    def held(self) -> str: ...
    @property
    def negative_pivots(self) -> int: ...
    @property
    def lifted_pivots(self) -> int: ...
    @property
    def factor_entries(self) -> int: ...

    def refactor(self, values: NDArray[np.float64]) -> None:
        """Factorise the matrix with these values in the places of its upper triangle."""

    def solve(
        self, block: NDArray[np.float64], out: NDArray[np.float64] | None = None
    ) -> NDArray[np.float64]:
        """The solution of A x = block, (n,) or (n, n_rhs), in Fortran order; out: its place."""

    def room_for(self, n_rows: int, n_columns: int) -> NDArray[np.float64]:
        """Room for vectors (n_rows, n_columns) where the factors are, in Fortran order."""


@dataclass(frozen=True, slots=True)
class Factorisation:
    """The factors of one matrix.

    n: number of equations. condition: estimate for the matrix scaled to a unit diagonal.
    solver: the program that holds the factors.
    """

    n: int
    condition: float
    solver: Literal["pardiso", "superlu"]
    _scale: NDArray[np.float64] = field(repr=False)
    _factors: SymmetricFactors = field(repr=False)

    def solve(self, rhs: Any) -> Any:
        """The solution x of A x = rhs.

        rhs: (n,) or (n, n_rhs), dense or sparse, real or complex; x is dense, of the same shape.
        Raises ModelError where the shape is wrong or a value is not finite.
        """
        is_sparse = sparse.issparse(rhs)
        given: Any = rhs if is_sparse else np.asarray(rhs)
        if given.ndim not in (1, 2) or given.shape[0] != self.n:
            raise ModelError(f"a right-hand side of shape {given.shape} for {self.n} equations")
        if not np.isfinite(given.data if is_sparse else given).all():
            raise ModelError("a right-hand side holds values that are not finite")
        if np.iscomplexobj(given):
            return self.solve(given.real) + 1j * self.solve(given.imag)
        columns = given.reshape((self.n, -1))
        columns = columns.tocsc() if is_sparse else columns
        solution = np.empty(columns.shape)
        scale = self._scale[:, None]
        for start in range(0, columns.shape[1], _COLUMNS_AT_ONCE):
            part = slice(start, start + _COLUMNS_AT_ONCE)
            block = columns[:, part].toarray() if is_sparse else columns[:, part]
            solution[:, part] = scale * self._factors.solve(scale * block)
        return solution.reshape(given.shape)


def factorise(matrix: Matrix, singular_condition: float = SINGULAR_CONDITION) -> Factorisation:
    """Factorise a symmetric matrix, definite or not.

    matrix: (n, n), sparse or dense, both triangles; singular_condition: the condition
    from which on it counts as singular (inf: as long as there is any answer, for work close to an
    eigenvalue). Raises ModelError where the matrix is not
    square, symmetric and finite, an equation is empty, or the matrix is singular.
    """
    a = symmetric_matrix(matrix, "matrix")
    scale = _unit_diagonal(a)
    scaled = sparse.csr_array(sparse.diags_array(scale) @ a @ sparse.diags_array(scale))
    factors, solver = _factors_of(scaled)
    norm = float(np.max(abs(scaled).sum(axis=0)))
    condition = norm * _inverse_norm(factors, scaled)
    if not condition < singular_condition:
        raise ModelError(
            f"a matrix of {a.shape[0]} equations is singular: condition number {condition:.1e}; "
            "a part that moves freely, or a mechanism, must be held first"
        )
    return Factorisation(a.shape[0], condition, solver, scale, factors)


def symmetric_matrix(matrix: Matrix, name: str) -> sparse.csr_array:
    """The matrix as float64 CSR with sorted indices, after a check at the door.

    matrix: (n, n). Raises ModelError, with the name, where it is empty, complex, not square, not
    finite, or unsymmetric by more than 10^-6 of its largest entry (text files keep seven digits).
    """
    given: Any = matrix
    if not sparse.issparse(given) and np.ndim(given) != 2:
        raise ModelError(f"the {name} must be a matrix, but has {np.ndim(given)} axes")
    a = sparse.csr_array(given)
    if np.issubdtype(a.dtype, np.complexfloating):
        raise ModelError(f"the {name} must be real, but is complex")
    a = a.astype(np.float64)
    if a.shape[0] != a.shape[1] or a.shape[0] == 0:
        raise ModelError(f"the {name} must be square, but has shape {a.shape}")
    if not np.isfinite(a.data).all():
        raise ModelError(f"the {name} holds values that are not finite")
    largest = float(abs(a).max()) if a.nnz else 0.0
    difference = abs(a - a.T)
    if difference.nnz and float(difference.max()) > 1e-6 * largest:
        raise ModelError(
            f"the {name} is not symmetric: entries differ by {float(difference.max()):.2e}, "
            f"the largest is {largest:.2e}; one triangle alone must be mirrored first"
        )
    a.sum_duplicates()
    return a


def symmetric_factors(
    upper: sparse.csr_array, columns: int = 0, similar: int | None = None
) -> SymmetricFactors:
    """Order a real symmetric matrix for factorisation by the program that is here.

    upper: (n, n), the upper triangle, sorted, with each diagonal entry. `refactor` gives values.
    columns: vectors (n,) that will be in memory with the factors; similar: with those of a similar
    matrix, if these suffice. Raises ModelError where it is no such triangle,
    SolverExhausted where memory does not suffice.
    """
    if is_available():
        return roomy_factors(upper, columns=columns, similar=similar)
    return _SymmetricSuperLu(upper)


def filled_triangle(matrix: sparse.csr_array) -> sparse.csr_array:
    """The upper triangle of a matrix, sorted, with each diagonal entry, zeros included."""
    upper = matrices.upper_triangle(matrix)
    stored = upper.tocoo()
    lacking = np.setdiff1d(np.arange(matrix.shape[0]), stored.row[stored.row == stored.col])
    if lacking.size == 0:
        return upper
    rows, columns = (np.concatenate([a, lacking]) for a in (stored.row, stored.col))
    values = np.concatenate([stored.data, np.zeros(lacking.size)])
    filled = sparse.csr_array((values, (rows, columns)), shape=matrix.shape)
    filled.sort_indices()
    return filled


def _unit_diagonal(a: sparse.csr_array) -> NDArray[np.float64]:
    """Factors that scale each diagonal entry, or the largest of its row if it is zero, to one."""
    diagonal = np.abs(a.diagonal())
    largest = abs(a).max(axis=1).toarray().ravel()
    empty = np.flatnonzero(largest == 0.0)
    if empty.size:
        shown = listed(empty.tolist(), 10)
        raise ModelError(
            f"a matrix of {a.shape[0]} equations is singular: {empty.size} rows hold only zeros "
            f"(counted from 0: {shown}); unknowns without stiffness must be left out"
        )
    # A diagonal lost in its row's rounding would be scaled up to a false unit pivot.
    return np.asarray(1.0 / np.sqrt(np.where(diagonal > 1e-12 * largest, diagonal, largest)))


def _factors_of(scaled: sparse.csr_array) -> tuple[SymmetricFactors, Literal["pardiso", "superlu"]]:
    upper = filled_triangle(scaled)
    if is_available():
        pardiso = roomy_factors(upper, matching=True)
        pardiso.refactor(upper.data)
        return pardiso, "pardiso"
    superlu = _SymmetricSuperLu(upper, pivoting=0.1)
    superlu.refactor(upper.data)
    return superlu, "superlu"


def _inverse_norm(factors: SymmetricFactors, a: sparse.csr_array) -> float:
    """A lower bound, seldom off by more than 3, of the 1-norm of the inverse (Higham 1988)."""
    n = a.shape[0]
    x = np.full((n, 1), 1.0 / n)
    estimate, visited = 0.0, -1
    for _ in range(5):
        y = factors.solve(x)
        estimate = max(estimate, float(np.abs(y).sum()))
        slope = np.abs(factors.solve(np.where(y < 0.0, -1.0, 1.0)))
        largest = int(np.argmax(slope))
        if largest == visited or not np.isfinite(estimate):
            break
        visited = largest
        x = np.zeros_like(x)
        x[largest] = 1.0
    alternating = (np.arange(n) % 2 * -2.0 + 1.0) * (1.0 + np.arange(n) / max(n - 1, 1))
    other = factors.solve(alternating[:, None])
    estimate = max(estimate, 2.0 * float(np.abs(other).sum()) / (3.0 * n))
    return estimate if np.isfinite(estimate) else np.inf


class _SymmetricSuperLu:
    """SuperLU with pivots on the diagonal, whose signs then count eigenvalues; pivoting: share of
    the largest in its column below which an entry of the diagonal is no pivot."""

    held = ""
    exact = True

    def __init__(self, upper: sparse.csr_array, pivoting: float = 0.0) -> None:
        self._pivoting = pivoting
        # Both triangles, and for each of their entries its place in the upper one.
        numbered = sparse.csr_array(
            (np.arange(1.0, upper.nnz + 1.0), upper.indices, upper.indptr), shape=upper.shape
        )
        both = sparse.csc_array(numbered + sparse.triu(numbered, k=1).T)
        self._places = both.data.astype(np.int64) - 1
        self._pattern = (both.indices, both.indptr)
        self._shape = both.shape
        self._factors: Any = None
        self.negative_pivots = 0
        self.lifted_pivots = 0
        self.factor_entries = 0

    def refactor(self, values: NDArray[np.float64]) -> None:
        matrix = sparse.csc_array((values[self._places], *self._pattern), shape=self._shape)
        try:
            self._factors = linalg.splu(
                matrix,
                permc_spec="MMD_AT_PLUS_A",
                diag_pivot_thresh=self._pivoting,
                options={"SymmetricMode": True},
            )
        except RuntimeError as error:  # all that SuperLU says of an exactly singular matrix
            raise ModelError(f"a matrix of {self._shape[0]} equations is singular") from error
        self.negative_pivots = int(np.sum(self._factors.U.diagonal() < 0.0))
        # A zero on the diagonal makes SuperLU leave it, and the signs then count nothing.
        self.lifted_pivots = int(np.sum(self._factors.perm_r != self._factors.perm_c))
        self.factor_entries = int(self._factors.L.nnz)

    def solve(
        self, block: NDArray[np.float64], out: NDArray[np.float64] | None = None
    ) -> NDArray[np.float64]:
        x = self._factors.solve(np.asarray(block, dtype=np.float64))
        if out is None:
            return np.asfortranarray(x)
        out[...] = x
        return out

    def room_for(self, n_rows: int, n_columns: int) -> NDArray[np.float64]:
        return in_memory(n_rows, n_columns)
