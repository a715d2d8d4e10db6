"""MUMPS for one real symmetric matrix, or for many of the same sparsity, with factors in files.

MUMPS is multifrontal: it eliminates unknowns in dense fronts, one after the other up a tree, and
writes what a front adds to the factor once; only a solution reads it again. Memory contains the
fronts in progress and what they pass on. A solution reads the files forward and backward, once for
all its right-hand sides. (PARDISO looks back at earlier columns, and with factors in files would
read them again and again: `core/algebra/factor_room` uses it in memory only.)

The matrix is scaled to a unit diagonal, S = D A D with d_i = |a_ii|^-1/2, which keeps the signs of
its eigenvalues; S = L E L^T with 1x1 and 2x2 pivots has them in E (Sylvester). Factors in single
precision are those of a similar matrix, as PARDISO's are; right-hand sides are scaled by their
largest number.

The library comes with the system (REMEDY). Its one argument is a structure of some hundred members
that differs between versions, so it is read from the header that comes with the library. The
system's BLAS may be slow. CalculiX would use a faster replacement too, and with OpenBLAS it gave
wrong modes; so MUMPS gets MKL's BLAS, which is installed for PARDISO.

Sources: Amestoy, Duff, Koster and L'Excellent 2001; MUMPS users' guide 5.5, C interface (numbers of
icntl, cntl and infog below are counted from 1, as there).
"""

from __future__ import annotations

import ctypes.util
import re
import threading
import weakref
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from modetune.core.algebra.pardiso import check_triangle, share_blas, unit_of
from modetune.core.algebra.vector_room import in_file
from modetune.core.errors import ModelError, ModetuneError, SolverExhausted
from modetune.core.modes import Floats, Integers

#: What to do where the library is missing.
REMEDY = "install MUMPS (Debian and Ubuntu: apt-get install libmumps-seq-dev)"
#: Job number that ends a matrix.
END = -2
_BEGIN = -1
_HEADERS = Path("/usr/include")
_WORLD = -987654
_SYMMETRIC = 2  # real, indefinite
# One call at a time; reentrant, for garbage collection may free one matrix during a call.
_ONE_CALL = threading.RLock()
_ANALYSE, _FACTORISE, _SOLVE = 1, 2, 3
#: Room beyond what is foreseen, percent, for pivots that have to wait; more where it is too small.
_SPARE = (10, 50, 200)
_TOO_SMALL = (-8, -9)
_MEMORY, _SINGULAR, _FILES = (-7, -8, -9, -11, -13, -19), (-6, -10), (-90,)
#: Pivots below this, where diagonals are one, are as good as zero.
_ZERO = 1e-20
#: Entries that are scaled at a time.
_AT_ONCE = 4_000_000


@dataclass(frozen=True, slots=True, weakref_slot=True, eq=False)
class FactorFiles:
    """A folder for the files of one matrix alone, and what takes it away."""

    folder: Path
    remove: Callable[[], None]


@dataclass(frozen=True, slots=True, eq=False)
class MumpsLibrary:
    """MUMPS in one precision, as cffi has opened it."""

    ffi: Any
    program: Any
    structure: str

    def begun(self) -> Any:
        """Return MUMPS' structure for a new matrix, as its guide defines it."""
        told = self.ffi.new(f"{self.structure} *")
        told.sym, told.par, told.comm_fortran = _SYMMETRIC, 1, _WORLD
        self.run(told, _BEGIN)
        for number in (1, 2, 3, 4):  # nothing is printed
            told.icntl[number - 1] = 0
        return told

    def run(self, told: Any, job: int) -> int:
        """Returns MUMPS's error number, 0 where there is none."""
        with _ONE_CALL:
            told.job = job
            self.program(told)
        return min(int(told.infog[0]), 0)

    def pointer(self, array: NDArray[Any]) -> Any:
        """Where an array is, as long as it is kept."""
        return self.ffi.cast("void *", array.ctypes.data)


def is_available() -> bool:
    """Whether MUMPS is installed here, with its header and what reads that."""
    try:
        mumps_library(single=False)
    except SolverExhausted:
        return False
    return True


@cache
def mumps_library(single: bool) -> MumpsLibrary:
    """The library in single or in double precision. Raises SolverExhausted where there is none."""
    letter, number = ("s", "float") if single else ("d", "double")
    try:
        import cffi
    except ImportError as error:
        raise SolverExhausted("MUMPS is unavailable: the package cffi is not installed") from error
    ffi = cffi.FFI()
    try:
        header = (_HEADERS / f"{letter}mumps_c.h").read_text()
        version, declared = _declared(header, letter.upper(), number)
        _check_integers((_HEADERS / "mumps_int_def.h").read_text())
        ffi.cdef(declared)
        share_blas()
        found = ctypes.util.find_library(f"{letter}mumps_seq-{version.rpartition('.')[0]}")
        program = getattr(ffi.dlopen(found or f"lib{letter}mumps_seq.so"), f"{letter}mumps_c")
        library = MumpsLibrary(ffi, program, f"{letter.upper()}MUMPS_STRUC_C")
        told = library.begun()
        if ffi.string(told.version_number) != version.encode():
            raise ValueError(f"the library is not of its header's version, {version}")
        library.run(told, END)
    except (OSError, ValueError, AttributeError, cffi.CDefError, cffi.FFIError) as error:
        raise SolverExhausted(f"MUMPS is unavailable ({error}); {REMEDY}") from error
    return library


def _declared(header: str, letter: str, number: str) -> tuple[str, str]:
    """The version of a header; its structure and program, as C that says what its names mean."""
    version = re.search(r'define\s+MUMPS_VERSION\s+"([\d.]+)"', header)
    structure = re.search(r"typedef struct \{.*?\} \w+_STRUC_C;", header, re.DOTALL)
    if version is None or structure is None:
        raise ValueError("its header holds no structure that is known")
    lengths = re.findall(r"^#\s*define\s+\w+_LEN\s+\d+", header, re.MULTILINE)
    kinds = {"MUMPS_INT": "int", "MUMPS_INT8": "int64_t"}
    kinds |= {f"{letter}MUMPS_REAL": number, f"{letter}MUMPS_COMPLEX": number}
    named = [f"typedef {kind} {name};" for name, kind in kinds.items()]
    program = f"void {letter.lower()}mumps_c({letter}MUMPS_STRUC_C *);"
    return version.group(1), "\n".join([*lengths, *named, structure.group(), program])


def _check_integers(header: str) -> None:
    if re.search(r"^\s*#\s*define\s+MUMPS_INTSIZE64", header, re.MULTILINE):
        raise ValueError("it counts unknowns with 64 bits")


class Mumps:
    """A real symmetric matrix and its factors in files, which go with the object.

    n: number of equations; exact: whether the factors are in double precision.
    """

    def __init__(
        self,
        upper: sparse.csr_array,
        files: FactorFiles,
        *,
        single: bool = False,
        order: Integers | None = None,
    ) -> None:
        """Order the unknowns of a matrix; `refactor` gives it its values.

        upper: (n, n), the upper triangle, sorted, with each diagonal entry; files: where the
        factors are kept; single: factors in single precision; order: (n,), the unknowns from 0 in
        the order of their elimination, where MUMPS is not to find one. Raises ModelError where
        upper is not such a triangle, SolverExhausted where MUMPS is unavailable or memory does not
        suffice.
        """
        check_triangle(upper)
        self.n = int(upper.shape[0])
        self.exact = not single
        self.files = files
        self._kind = np.dtype(np.float32 if single else np.float64)
        self._scale: Floats = np.ones(self.n)
        self._library = library = mumps_library(single)
        self._told = told = library.begun()
        self._release = weakref.finalize(self, _end, library, told, files)
        self._release.atexit = False
        counts = np.diff(upper.indptr)
        self._rows = np.repeat(np.arange(1, self.n + 1, dtype=np.int32), counts)
        self._columns = upper.indices.astype(np.int32) + np.int32(1)
        self._place(order)
        self._call(_ANALYSE)

    def refactor(self, values: Floats) -> None:
        """Factorise the matrix with these values in the same places.

        values: (n_entries,). Raises ModelError where the matrix is singular, SolverExhausted.
        """
        if values.shape != self._rows.shape:
            raise ModelError(f"{values.size} values for {self._rows.size} entries of a matrix")
        diagonal = np.abs(values[self._rows == self._columns])
        self._scale = 1.0 / np.sqrt(np.where(diagonal > 0.0, diagonal, diagonal.max(initial=1.0)))
        scaled = np.empty(values.shape, dtype=self._kind)
        for first in range(0, values.size, _AT_ONCE):
            part = slice(first, first + _AT_ONCE)
            scales = self._scale[self._rows[part] - 1] * self._scale[self._columns[part] - 1]
            np.multiply(values[part], scales, out=scaled[part], casting="same_kind")
        del values, diagonal  # as large as what MUMPS is about to take for its fronts
        self._told.a = self._library.pointer(scaled)
        for spare in _SPARE:
            self._told.icntl[14 - 1] = spare
            error = self._library.run(self._told, _FACTORISE)
            if error not in _TOO_SMALL:
                break
        self._told.a = self._library.ffi.NULL
        self._check(error)

    def solve(self, block: Floats, out: Floats | None = None) -> Floats:
        """The solution of A x = block by the last factors.

        block: (n,) or (n, n_rhs), finite. out: where to put x, of the same shape and in Fortran
        order. Returns x, in Fortran order. Raises SolverExhausted.
        """
        given = np.asarray(block, dtype=np.float64)
        x = np.empty(given.shape, order="F") if out is None else out
        assert x.shape == given.shape
        assert x.flags.f_contiguous
        if not given.size:
            return x
        columns = given.reshape((self.n, -1))
        solved = np.empty(columns.shape, dtype=self._kind, order="F")
        units = np.empty(columns.shape[1])
        for place, column in enumerate(columns.T):
            forces = column * self._scale
            units[place] = unit_of(forces)
            np.multiply(forces, units[place], out=solved[:, place], casting="same_kind")
        self._told.rhs = self._library.pointer(solved)
        self._told.nrhs, self._told.lrhs = solved.shape[1], self.n
        self._call(_SOLVE)
        for own, moved, unit in zip(
            x.reshape((self.n, -1), order="F").T, solved.T, units, strict=True
        ):
            np.multiply(moved, self._scale / unit, out=own)
        return x

    def room_for(self, n_rows: int, n_columns: int) -> Floats:
        """Return an array in a file next to the factors, (n_rows, n_columns), in Fortran order."""
        return in_file(self.files.folder, n_rows, n_columns)

    def close(self) -> None:
        """Give memory and files back now, not with the object: there is no solution after it."""
        self._release()

    @property
    def held(self) -> str:
        """How the factors are held."""
        return f"{'' if self.exact else ' in single precision'} on disk"

    @property
    def negative_pivots(self) -> int:
        """How many eigenvalues of the matrix are negative (Sylvester's law of inertia)."""
        return int(self._told.infog[12 - 1])

    @property
    def lifted_pivots(self) -> int:
        """How many pivots were as good as zero."""
        return int(self._told.infog[28 - 1])

    @property
    def factor_entries(self) -> int:
        """How many entries the factor L has, or will have."""
        return _whole(self._told.infog[20 - 1])

    @property
    def memory(self) -> int:
        """The memory with which the factors can be made and used, in bytes, where the pattern that
        was given, with its values in double precision, is given up."""
        own = self._rows.nbytes + self._rows.size * (self._kind.itemsize - 8)
        return 10**6 * int(self._told.infog[26 - 1]) + own

    @property
    def disk(self) -> int:
        """What the files of the factors take, in bytes."""
        return _whole(self._told.infog[3 - 1]) * self._kind.itemsize

    def _place(self, order: Integers | None) -> None:
        told, library = self._told, self._library
        told.n, told.nnz = self.n, self._rows.size
        told.irn, told.jcn = library.pointer(self._rows), library.pointer(self._columns)
        # 7: order given, or found by MUMPS's own PORD; 8: scaled already; 22: factors in files; 24:
        # pivots as good as zero are counted.
        chosen = {7: 4, 8: 0, 14: _SPARE[0], 22: 1, 24: 1}
        if order is not None:
            self._position = np.empty(self.n, dtype=np.int32)
            self._position[order] = np.arange(1, self.n + 1)
            told.perm_in = library.pointer(self._position)
            chosen[7] = 1
        for number, value in chosen.items():
            told.icntl[number - 1] = value
        told.cntl[3 - 1] = -_ZERO
        folder = bytes(self.files.folder)
        if len(folder) >= len(told.ooc_tmpdir):
            raise SolverExhausted(
                f"{self.files.folder}: MUMPS keeps factors below paths of up to "
                f"{len(told.ooc_tmpdir) - 1} bytes alone: name a shorter one for the store"
            )
        told.ooc_tmpdir, told.ooc_prefix = folder, b"factors"

    def _call(self, job: int) -> None:
        self._check(self._library.run(self._told, job))

    def _check(self, error: int) -> None:
        if error:
            raise _as_error(error, int(self._told.infog[1]), self.n, self.files.folder)


def _end(library: MumpsLibrary, told: Any, files: FactorFiles) -> None:
    library.run(told, END)
    files.remove()


def _whole(told: int) -> int:
    """Return a count, which MUMPS gives as a negative number of millions if it is large."""
    return int(told) if told >= 0 else -1_000_000 * int(told)


def _as_error(error: int, size: int, n: int, folder: Path) -> ModetuneError:
    matrix = f"a matrix of {n} equations cannot be factorised"
    if error in _MEMORY:
        return SolverExhausted(
            f"{matrix}: there is not enough memory even with factors on disk; take a machine with "
            "more of it, a smaller model, or fewer modes"
        )
    if error in _FILES:
        return SolverExhausted(
            f"{matrix}: the files of the factors cannot be written or read in {folder}; free some "
            "disk space, or give it more memory"
        )
    if error in _SINGULAR:
        return ModelError(f"{matrix}: a pivot is zero")
    return ModelError(f"{matrix}: MUMPS reports error {error} ({size})")
