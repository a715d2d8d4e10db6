"""One factorisation of a sparse symmetric matrix, for as many right-hand sides as wanted.

A is brought to a unit diagonal first, S = D A D with d_i = |a_ii|^-1/2, so that translations in
mm and rotations in rad weigh the same, and

    A^-1 b = D S^-1 D b,    condition = ||S||_1 ||S^-1||_1,

with ||S^-1||_1 estimated from a few solves (Hager 1984; Higham 1988). A condition beyond 10^14
leaves no digit of the answer: the matrix is called singular, as a free structure's stiffness is.
The rounding of a rigid-body eigenvalue cannot be told from such a small one.

Intel's PARDISO factorises as L D L^T with 1x1 and 2x2 pivots, so indefinite matrices such as
K - shift M are as welcome as positive ones. A complex symmetric A + iB is solved as the real

    [ A  -B ] [x]   [ f ]
    [-B  -A ] [y] = [-g ],      (A + iB)(x + iy) = f + ig.

Where PARDISO is not installed SciPy's SuperLU does the same more slowly. PARDISO uses all cores
in each call and its calls come one at a time, whatever the number of threads; results can be
shared by threads.
"""

from __future__ import annotations

import copy
import os
import threading
import weakref
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass, field
from functools import cache
from typing import Any, Literal, Protocol, TypeAlias

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse import linalg

from modetune.core.errors import ModelError

Numbers: TypeAlias = NDArray[np.float64] | NDArray[np.complex128]
Matrix: TypeAlias = sparse.sparray | sparse.spmatrix | NDArray[np.float64] | NDArray[np.complex128]

SINGULAR_CONDITION = 1e14
_COLUMNS_AT_ONCE = 64  # bounds the copies made of a right-hand side
_PARDISO = threading.RLock()  # reentrant: garbage collection may free one factor during a call
_superlu_only: ContextVar[bool] = ContextVar("superlu_only", default=False)


class _Solver(Protocol):
    def solve(self, rhs: Any) -> Any: ...


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
    _factors: _Solver = field(repr=False)
    _kind: np.dtype[Any] = field(repr=False)

    def solve(self, rhs: Any) -> Any:
        """The solution x of A x = rhs.

        rhs: (n,) or (n, n_rhs), dense or sparse, real or complex; x is dense, of the same shape,
        complex where the matrix or rhs is. Raises ModelError where the shape is wrong or a value
        is not finite.
        """
        is_sparse = sparse.issparse(rhs)
        given: Any = rhs if is_sparse else np.asarray(rhs)
        if given.ndim not in (1, 2) or given.shape[0] != self.n:
            raise ModelError(f"a right-hand side of shape {given.shape} for {self.n} equations")
        if not np.isfinite(given.data if is_sparse else given).all():
            raise ModelError("a right-hand side holds values that are not finite")
        columns = given.reshape((self.n, -1))
        columns = columns.tocsc() if is_sparse else columns
        kind = np.result_type(columns.dtype, self._kind, np.float64)
        solution = np.empty(columns.shape, dtype=kind)
        scale = self._scale[:, None]
        for start in range(0, columns.shape[1], _COLUMNS_AT_ONCE):
            part = slice(start, start + _COLUMNS_AT_ONCE)
            block = columns[:, part].toarray() if is_sparse else columns[:, part]
            solution[:, part] = scale * self._factors.solve(scale * block)
        return solution.reshape(given.shape)


def factorise(matrix: Matrix, singular_condition: float = SINGULAR_CONDITION) -> Factorisation:
    """Factorise a symmetric matrix, definite or not.

    matrix: (n, n), sparse or dense, real or complex symmetric (not Hermitian), both triangles;
    singular_condition: the condition from which on it counts as singular (inf: as long as there
    is any answer, for work close to an eigenvalue). Raises ModelError where the matrix is not
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
    return Factorisation(a.shape[0], condition, solver, scale, factors, a.dtype)


def symmetric_matrix(matrix: Matrix, name: str) -> sparse.csr_array:
    """The matrix as float64 or complex128 CSR with sorted indices, after a check at the door.

    matrix: (n, n). Raises ModelError, with the name, where it is empty, not square, not finite,
    or unsymmetric by more than 10^-6 of its largest entry (text files keep seven digits).
    """
    given: Any = matrix
    if not sparse.issparse(given) and np.ndim(given) != 2:
        raise ModelError(f"the {name} must be a matrix, but has {np.ndim(given)} axes")
    a = sparse.csr_array(given)
    kind = np.complex128 if np.issubdtype(a.dtype, np.complexfloating) else np.float64
    a = a.astype(kind)
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


@contextmanager
def superlu_only() -> Iterator[None]:
    """Within this context, and in this thread only, SuperLU factorises even where PARDISO is."""
    token = _superlu_only.set(True)
    try:
        yield
    finally:
        _superlu_only.reset(token)


def _unit_diagonal(a: sparse.csr_array) -> NDArray[np.float64]:
    """Factors that scale each diagonal entry, or the largest of its row if it is zero, to one."""
    diagonal = np.abs(a.diagonal())
    largest = abs(a).max(axis=1).toarray().ravel()
    empty = np.flatnonzero(largest == 0.0)
    if empty.size:
        shown = ", ".join(map(str, empty[:10].tolist())) + (", ..." if empty.size > 10 else "")
        raise ModelError(
            f"a matrix of {a.shape[0]} equations is singular: {empty.size} rows hold only zeros "
            f"(counted from 0: {shown}); unknowns without stiffness must be left out"
        )
    # A diagonal lost in its row's rounding would be scaled up to a false unit pivot.
    return np.asarray(1.0 / np.sqrt(np.where(diagonal > 1e-12 * largest, diagonal, largest)))


def _factors_of(scaled: sparse.csr_array) -> tuple[_Solver, Literal["pardiso", "superlu"]]:
    real = not np.iscomplexobj(scaled.data)
    if not _superlu_only.get() and _shared_pardiso() is not None:
        return (_PardisoFactors if real else _ComplexPardisoFactors)(scaled), "pardiso"
    try:
        factors = linalg.splu(
            sparse.csc_array(scaled),
            permc_spec="MMD_AT_PLUS_A",
            diag_pivot_thresh=0.1,
            options={"SymmetricMode": True},
        )
    except RuntimeError as error:  # all that SuperLU says of an exactly singular matrix
        raise ModelError(f"a matrix of {scaled.shape[0]} equations is singular") from error
    return _SuperLuFactors(factors, real), "superlu"


def _inverse_norm(factors: _Solver, a: sparse.csr_array) -> float:
    """A lower bound, seldom off by more than 3, of the 1-norm of the inverse (Higham 1988)."""
    n = a.shape[0]
    x = np.full((n, 1), 1.0 / n, dtype=a.dtype)
    estimate, visited = 0.0, -1
    for _ in range(5):
        y = factors.solve(x)
        estimate = max(estimate, float(np.abs(y).sum()))
        signs = np.where(y == 0, 1.0, y / np.where(y == 0, 1.0, np.abs(y)))
        slope = np.abs(factors.solve(np.conj(signs)))
        largest = int(np.argmax(slope))
        if largest == visited or not np.isfinite(estimate):
            break
        visited = largest
        x = np.zeros_like(x)
        x[largest] = 1.0
    alternating = (np.arange(n) % 2 * -2.0 + 1.0) * (1.0 + np.arange(n) / max(n - 1, 1))
    other = factors.solve(alternating.astype(a.dtype)[:, None])
    estimate = max(estimate, 2.0 * float(np.abs(other).sum()) / (3.0 * n))
    return estimate if np.isfinite(estimate) else np.inf


class _SuperLuFactors:
    """SuperLU's factors; a complex right-hand side of real factors is solved in two parts."""

    def __init__(self, factors: Any, real: bool) -> None:
        self._factors, self._real = factors, real

    def solve(self, rhs: Any) -> Any:
        if self._real and np.iscomplexobj(rhs):
            return self.solve(rhs.real) + 1j * self.solve(rhs.imag)
        kind = np.float64 if self._real else np.complex128
        return self._factors.solve(np.asarray(rhs, dtype=kind))


class _PardisoFactors:
    """PARDISO's factors of a real symmetric matrix; its memory is freed with the object."""

    def __init__(self, scaled: sparse.csr_array) -> None:
        # PARDISO wants the upper triangle with every diagonal entry, zeros included.
        upper = sparse.coo_array(sparse.triu(scaled, k=1))
        places = np.arange(scaled.shape[0])
        values = np.concatenate([upper.data, scaled.diagonal()])
        rows = np.concatenate([upper.row, places])
        columns = np.concatenate([upper.col, places])
        self._upper = sparse.csr_array((values, (rows, columns)), shape=scaled.shape)
        self._upper.sort_indices()
        self._pardiso = _new_pardiso()
        with _PARDISO:
            self._pardiso.factorize(self._upper)
        weakref.finalize(self, _free, self._pardiso).atexit = False

    def solve(self, rhs: Any) -> Any:
        if np.iscomplexobj(rhs):
            return self.solve(rhs.real) + 1j * self.solve(rhs.imag)
        with _PARDISO:
            return self._pardiso.solve(self._upper, np.asfortranarray(rhs, dtype=np.float64))


class _ComplexPardisoFactors:
    """PARDISO's factors of a complex symmetric matrix, through the real one of twice its size."""

    def __init__(self, scaled: sparse.csr_array) -> None:
        a, b = scaled.real, scaled.imag
        self._n = scaled.shape[0]
        self._real = _PardisoFactors(sparse.csr_array(sparse.block_array([[a, -b], [-b, -a]])))

    def solve(self, rhs: Any) -> Any:
        both = self._real.solve(np.concatenate([rhs.real, -rhs.imag]))
        return both[: self._n] + 1j * both[self._n :]


@cache
def _shared_pardiso() -> Any | None:
    """The package's own solver, which has looked for and loaded the library; None without it."""
    # Read when MKL is loaded: the same numbers to the last digit in each run on a machine.
    os.environ.setdefault("MKL_CBWR", "AUTO")
    try:
        from pypardiso.scipy_aliases import pypardiso_solver
    except ImportError:
        return None
    return pypardiso_solver


def _new_pardiso() -> Any:
    """A solver of its own memory on the loaded library, set for symmetric indefinite matrices."""
    pardiso = copy.copy(_shared_pardiso())
    assert pardiso is not None
    pardiso.pt = np.zeros(64, dtype=np.int64)
    pardiso.iparm = np.zeros(64, dtype=np.int32)
    pardiso.perm = np.zeros(0, dtype=np.int32)
    pardiso.set_matrix_type(-2)
    # 1: own settings; 2: METIS ordering; 10: zero pivots are lifted to 1e-16; 11, 13: scaling and
    # matching; 21: 2x2 pivots. Left at 0 is 8: solutions are refined only after a lifted pivot,
    # for refining takes twice as long again as solving.
    for number, value in ((1, 1), (2, 2), (10, 16), (11, 1), (13, 1), (21, 1)):
        pardiso.set_iparm(number, value)
    return pardiso


def _free(pardiso: Any) -> None:
    with _PARDISO:
        pardiso.free_memory(everything=True)
