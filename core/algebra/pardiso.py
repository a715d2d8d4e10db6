"""Intel MKL's PARDISO for one real symmetric matrix, or for many of the same sparsity.

PARDISO works in phases: 11 orders the unknowns and finds the pattern of the factors, 22 fills
them with numbers, 33 solves. The first depends on the pattern alone; models of an updating
campaign differ in their values, so it is gone through once and 22 for each model. The order is
one that is given (core/algebra/elimination_order), or PARDISO's own parallel nested dissection.

The matrix is A = L D L^T with 1x1 and 2x2 pivots (type -2), whose signs are the signs of A's
eigenvalues (Sylvester).

Factors in single precision take half the room and are those of a similar matrix, 6e-8 of each
number of A away: whoever takes their answers for A's must make them better with A itself. A is
scaled by a power of two, right-hand sides by their largest number, so that neither leaves the range
of single precision.

The library is the one that pypardiso finds and loads; its own solve is not used, for it copies
and compares the whole matrix with each call. PARDISO uses all cores in a call, and calls come
one at a time whatever the number of threads. Source: Intel oneMKL reference, PARDISO parameters
(numbers of iparm below are counted from 1, as there).
"""

from __future__ import annotations

import ctypes
import math
import os
import sys
import threading
import weakref
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from modetune.core.algebra.vector_room import in_memory
from modetune.core.errors import ModelError, ModetuneError, SolverExhausted
from modetune.core.modes import Floats, Integers

# One call at a time; reentrant, for garbage collection may free one matrix during a call.
_ONE_CALL = threading.RLock()
_ANALYSE, _FACTORISE, _SOLVE, _FREE = 11, 22, 33, -1
_TOO_LONG = -8
_SYMMETRIC = -2  # real, indefinite

_INPUT, _MEMORY = "input", "memory"
_ERRORS = {
    -1: (_INPUT, "its arrays are not consistent"),
    -2: (_MEMORY, "there is not enough memory"),
    -3: (_INPUT, "its unknowns could not be ordered"),
    -4: (_INPUT, "a pivot is zero"),
    -5: (_INPUT, "PARDISO reports an internal error"),
    -6: (_INPUT, "its unknowns could not be ordered"),
    -7: (_INPUT, "a diagonal entry is zero"),
    _TOO_LONG: (_MEMORY, "its factors have too many entries for this library"),
    -12: (_INPUT, "the library lacks its interface for 64-bit integers"),
}


@dataclass(frozen=True, slots=True)
class FactorMemory:
    """What PARDISO holds, in bytes.

    ordering_peak: largest during the ordering; permanent: kept between calls, without factors;
    factors: the factors themselves with work space; peak: largest of all.
    """

    ordering_peak: int
    permanent: int
    factors: int

    @property
    def peak(self) -> int:
        return max(self.ordering_peak, self.permanent + self.factors)

    @property
    def single_peak(self) -> int:
        """The same of factors in single precision, by those in double precision."""
        return max(self.ordering_peak, self.permanent + self.factors // 2)


class Pardiso:
    """A real symmetric matrix and its factors; their memory is freed with the object.

    n: number of equations.
    """

    def __init__(
        self,
        upper: sparse.csr_array,
        *,
        matching: bool = False,
        long_integers: bool = False,
        single: bool = False,
        order: Integers | None = None,
    ) -> None:
        """Order the unknowns of a matrix; `refactor` gives it its values.

        upper: (n, n), the upper triangle, sorted, with each diagonal entry; matching: scale and
        pair unknowns by their values first, for matrices with zeros on the diagonal; long_integers:
        for factors of more than 2^31 entries (turned to anyhow where PARDISO asks for it); single:
        factors in single precision; order: (n,), the unknowns from 0 in the order of their
        elimination, where PARDISO is not to find one; it does not go with matching. Raises
        ModelError where upper is not such a triangle, SolverExhausted where memory does not
        suffice.
        """
        check_triangle(upper)
        self.n = int(upper.shape[0])
        self._order = order
        self._settings = _settings(matching, single, order is not None)
        self.exact = not single
        self._unit = 1.0
        self._values: NDArray[Any] = upper.data
        self._open(upper.indptr + 1, upper.indices + 1, long_integers)

    def refactor(self, values: Floats) -> None:
        """Factorise the matrix with these values in the same places.

        values: (n_entries,), kept, copied only for single precision. Raises ModelError if the
        matrix is singular, SolverExhausted.
        """
        if values.shape != self._values.shape or values.dtype != np.float64:
            raise ModelError(f"{values.size} values for {self._values.size} entries of a matrix")
        self._values = np.ascontiguousarray(values)
        if not self.exact:
            self._unit = unit_of(values)
            self._values = _rounded(values, self._unit)
        self._call(_FACTORISE)

    def solve(self, block: Floats, out: Floats | None = None) -> Floats:
        """The solution of A x = block by the last factors.

        block: (n,) or (n, n_rhs), finite; fastest in Fortran order. out: where to put x, of the
        same shape and in Fortran order, not block itself. Returns x, in Fortran order.
        """
        given = np.asfortranarray(block, dtype=np.float64)
        x = np.empty(given.shape, order="F") if out is None else out
        assert x.shape == given.shape
        assert x.flags.f_contiguous
        if given.size and self.exact:
            self._call(_SOLVE, given, x)
        elif given.size:
            units = np.apply_along_axis(unit_of, 0, given)
            answer = np.empty(given.shape, dtype=np.float32, order="F")
            self._call(_SOLVE, _rounded(given, units), answer)
            np.multiply(answer, self._unit / units, out=x)
        return x

    def room_for(self, n_rows: int, n_columns: int) -> Floats:
        """Room for vectors in memory, (n_rows, n_columns), as `in_memory`."""
        return in_memory(n_rows, n_columns)

    def close(self) -> None:
        """Give memory back now, not with the object: there is no solution after it."""
        self._release()

    @property
    def held(self) -> str:
        """How the factors are held, where that is not in double precision."""
        return "" if self.exact else " in single precision"

    @property
    def negative_pivots(self) -> int:
        """How many eigenvalues of the matrix are negative (Sylvester's law of inertia)."""
        return int(self._handle.iparm[22])

    @property
    def lifted_pivots(self) -> int:
        """How many pivots were as good as zero and were replaced by a small number."""
        return int(self._handle.iparm[13])

    @property
    def factor_entries(self) -> int:
        """How many entries the factor L has: PARDISO's count, which is one modulo 2^32, as near as
        may be to the room that the ordering has foreseen."""
        told = int(self._handle.iparm[17])
        return told + 2**32 * max(round((self._foreseen - told) / 2**32), 0)

    @property
    def memory(self) -> FactorMemory:
        """The memory of the last phases; PARDISO counts in kilobytes."""
        peak, permanent, factors = (1024 * int(number) for number in self._handle.iparm[14:17])
        return FactorMemory(peak, permanent, factors)

    def _open(self, starts: Any, columns: Any, long_integers: bool) -> None:
        kind: Any = np.int64 if long_integers else np.int32
        order = np.zeros(1) if self._order is None else self._order + 1
        self._handle = _Handle(
            self.n,
            np.ascontiguousarray(starts, dtype=kind),
            np.ascontiguousarray(columns, dtype=kind),
            self._settings.astype(kind),
            order.astype(kind),
        )
        self._release = weakref.finalize(self, self._handle.close)
        self._release.atexit = False
        self._call(_ANALYSE)
        self._foreseen = self.memory.factors // (8 if self.exact else 4)

    def _call(
        self, phase: int, rhs: NDArray[Any] | None = None, out: NDArray[Any] | None = None
    ) -> None:
        error = self._handle.call(phase, self._values, rhs, out)
        if error == _TOO_LONG and not self._handle.long_integers:
            before = self._handle
            before.close()
            self._open(before.starts, before.columns, long_integers=True)
            if phase != _ANALYSE:
                self._call(phase, rhs, out)
        elif error:
            raise _error_of(error, self._handle)


@dataclass(slots=True, eq=False)
class _Handle:
    """PARDISO's own data of one matrix, its integers all of one kind; order: counted from 1."""

    n: int
    starts: NDArray[Any]
    columns: NDArray[Any]
    iparm: NDArray[Any]
    order: NDArray[Any]
    addresses: NDArray[np.int64] = field(default_factory=lambda: np.zeros(64, dtype=np.int64))
    closed: bool = False

    @property
    def long_integers(self) -> bool:
        return bool(self.iparm.dtype == np.int64)

    def call(
        self, phase: int, values: NDArray[Any], rhs: NDArray[Any] | None, out: NDArray[Any] | None
    ) -> int:
        """Run a phase; returns PARDISO's error number."""
        integer: Any = ctypes.c_int64 if self.long_integers else ctypes.c_int32
        program = _program(self.long_integers)
        count = 1 if rhs is None or rhs.ndim == 1 else rhs.shape[1]
        error = integer(0)

        def number(value: int) -> Any:
            return ctypes.byref(integer(value))

        with _ONE_CALL:
            program(
                _pointer(self.addresses),
                number(1),
                number(1),
                number(_SYMMETRIC),
                number(phase),
                number(self.n),
                _pointer(values),
                _pointer(self.starts),
                _pointer(self.columns),
                _pointer(self.order),
                number(count),
                _pointer(self.iparm),
                number(0),
                _pointer(rhs),
                _pointer(out),
                ctypes.byref(error),
            )
        return int(error.value)

    def close(self) -> None:
        """Give PARDISO's memory back."""
        if not self.closed:
            self.closed = True
            self.call(_FREE, np.zeros(0), None, None)


def is_available() -> bool:
    """Whether MKL is installed here."""
    return _library() is not None


def share_blas() -> None:
    """MKL's BLAS, where it is installed, for libraries that are opened from now on, ahead of what
    they are linked with."""
    library = _library()
    if library is not None:
        ctypes.CDLL(library._name, mode=ctypes.RTLD_GLOBAL)


@cache
def _library() -> Any | None:
    # Read when MKL is loaded: the same numbers to the last digit in each run on a machine.
    os.environ.setdefault("MKL_CBWR", "AUTO")
    # Where pip puts it; pypardiso would look through all folders.
    here = sorted(Path(sys.prefix, "lib").glob("libmkl_rt.so*"))
    if here:
        os.environ.setdefault("PYPARDISO_MKL_RT", str(here[0]))
    try:
        from pypardiso.scipy_aliases import pypardiso_solver
    except ImportError:
        return None
    return pypardiso_solver.libmkl


@cache
def _program(long_integers: bool) -> Any:
    library = _library()
    if library is None:
        raise ModelError("PARDISO is not installed here: pypardiso must be, with MKL")
    program = library.pardiso_64 if long_integers else library.pardiso
    program.argtypes, program.restype = [ctypes.c_void_p] * 16, None
    return program


def _settings(matching: bool, single: bool, ordered: bool) -> NDArray[np.int64]:
    iparm = np.zeros(64, dtype=np.int64)
    # 1: own settings; 2: parallel METIS; 10: pivots below 1e-20 of the norm are lifted, zeros
    # that is, for masses and rotations make small ones; 24: factors in two levels of parallel
    # work, which halves the time of single solves. Left at 0 is 8: solutions are refined only
    # after a lifted pivot, for refining takes twice as long again as solving. 37: unknowns whose
    # rows are 95 % alike, as those of a node are, are ordered as one, which halves the ordering.
    chosen = {1: 1, 2: 3, 10: 20, 18: -1, 21: 1, 24: 1, 28: int(single), 37: -95}
    if matching:  # 10: the scaled matrix is of norm one; 24 does not go with 11 and 13
        chosen |= {2: 2, 10: 16, 11: 1, 13: 1, 24: 0, 37: 0}
    if ordered:  # by unknowns, not by blocks of them
        chosen |= {5: 1, 37: 0}
    for number, value in chosen.items():
        iparm[number - 1] = value
    return iparm


def unit_of(values: Floats) -> float:
    """A power of two that brings the largest of these to about one."""
    largest = max(float(values.max()), -float(values.min()))
    return 2.0 ** -math.frexp(largest)[1] if largest > 0.0 else 1.0


def _rounded(values: Floats, units: Floats | float) -> NDArray[np.float32]:
    single = np.empty(values.shape, dtype=np.float32, order="F")
    return np.multiply(values, units, out=single, casting="same_kind")


def check_triangle(upper: sparse.csr_array) -> None:
    n = upper.shape[0]
    if upper.shape != (n, n) or n == 0 or upper.dtype != np.float64:
        raise ModelError(f"a real square matrix was expected, but {upper.dtype} {upper.shape} came")
    starts = upper.indptr
    full_rows = bool((starts[1:] > starts[:-1]).all())
    if not (
        full_rows
        and np.array_equal(upper.indices[starts[:-1]], np.arange(n))
        and upper.has_canonical_format
    ):
        raise ModelError(
            f"a matrix of {n} equations is not an upper triangle with sorted rows, each of which "
            "begins with its diagonal entry"
        )


def _error_of(error: int, handle: _Handle) -> ModetuneError:
    of = f"a matrix of {handle.n} equations cannot be factorised"
    kind, words = _ERRORS.get(error, (_INPUT, "PARDISO gives a reason unknown here"))
    text = f"{of}: {words} (PARDISO error {error})"
    if kind == _MEMORY:
        return SolverExhausted(f"{text}; free memory, take a smaller model, or factors on disk")
    if error in (-4, -7):
        return ModelError(f"{text}: it is singular")
    return ModelError(text)


def _pointer(array: NDArray[Any] | None) -> Any:
    return None if array is None else ctypes.c_void_p(array.ctypes.data)
