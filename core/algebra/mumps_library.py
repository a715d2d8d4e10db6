"""MUMPS's library, in single and in double precision.

It comes with the system (REMEDY). Its one argument is a structure of some hundred members that is
not the same in all versions, so it is read from the header that comes with the library. The BLAS of
the system may be slow, and a faster one in its place would be CalculiX's too, which with OpenBLAS
was seen to give modes that are none; so MUMPS gets MKL's, which is here for PARDISO. Source: MUMPS
users' guide 5.5, C interface.
"""

from __future__ import annotations

import ctypes.util
import re
import threading
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from modetune.core.algebra.pardiso import share_blas
from modetune.core.errors import SolverExhausted

#: What to do where the library is not there.
REMEDY = "install MUMPS (Debian and Ubuntu: apt-get install libmumps-seq-dev)"
#: What ends a matrix, in the numbers of the program's jobs.
END = -2
_BEGIN = -1
_HEADERS = Path("/usr/include")
_WORLD = -987654
_SYMMETRIC = 2  # real, indefinite
# One call at a time; reentrant, for garbage collection may free one matrix during a call.
_ONE_CALL = threading.RLock()


@dataclass(frozen=True, slots=True, eq=False)
class MumpsLibrary:
    """MUMPS in one precision, as cffi has opened it."""

    ffi: Any
    program: Any
    structure: str

    def begun(self) -> Any:
        """What MUMPS is told of a new matrix, and tells: its structure, as the guide has it."""
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
