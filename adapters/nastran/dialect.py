"""The programs that read Nastran decks, and what differs between them from outside.

MSC Nastran and Simcenter (NX) Nastran share their command line except for the keyword of the
threads; MYSTRAN takes the deck alone. None of the three prints its version without a run (and the
first two not without a licence), so the program file identifies it.
"""

from __future__ import annotations

import hashlib
import os
import shutil
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Literal

from modetune.adapters.regular_file import read_errors
from modetune.adapters.solver import Capabilities
from modetune.core.errors import SolverMissing

DialectName = Literal["msc", "nx", "mystran"]
#: The deck of a job; what the program leaves has the same stem.
JOB = "job"
DECK = f"{JOB}.bdf"
#: Environment variable with the version of the Nastran program, if its file does not identify it.
VERSION_VARIABLE = "MODETUNE_NASTRAN_VERSION"
#: Memory of a Nastran run in the program's own words (4gb); the site's own setting where not set.
MEMORY_VARIABLE = "MODETUNE_NASTRAN_MEMORY"
MISSING = (
    "the {title} program `{program}` is not on this machine; install it and put it on PATH, or "
    "name its start script with {variable}"
)


@dataclass(frozen=True, slots=True)
class Dialect:
    """One program: how it is named, started and asked, and what it can give.

    print_file, result_file: the names it gives its F06 and OP2 files. error_file, logs: where else
    it may say what went wrong. threads: keyword of the number of threads, empty where there is
    none. displays: describers of the request for mode shapes.
    """

    name: DialectName
    title: str
    variable: str
    program: str
    print_file: str
    result_file: str
    logs: tuple[str, ...]
    threads: str
    displays: str
    capabilities: Capabilities

    def arguments(self, program: str, threads: int) -> tuple[str, ...]:
        """The argument list that runs the deck in the folder it is started in."""
        if self.name == "mystran":
            return (program, DECK)
        memory = os.environ.get(MEMORY_VARIABLE, "")
        return (
            program,
            DECK,
            "scr=yes",  # the database goes with the run
            "old=no",  # nothing is renamed to .1: the folder is new
            "batch=no",  # stays in the foreground, so that its end is the program's end
            "news=no",
            "notify=no",
            "sdirectory=.",
            "out=.",
            *((f"memory={memory}",) if memory else ()),
            *((f"{self.threads}={threads}",) if threads > 1 else ()),
        )

    def program_name(self) -> str:
        """The program: what the environment names, or the usual one."""
        return os.environ.get(self.variable) or self.program

    def version(self, program: str) -> str:
        """Return what identifies the program's version. Raises SolverMissing."""
        found = shutil.which(program)
        if found is None:
            raise SolverMissing(
                MISSING.format(title=self.title, program=program, variable=self.variable)
            )
        named = os.environ.get(VERSION_VARIABLE, "") if self.name != "mystran" else ""
        return named or program_version(Path(found))


@lru_cache(maxsize=8)
def _digest(program: Path, size: int, modified_ns: int) -> str:
    with program.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def program_version(program: Path) -> str:
    """Name of a program's file and the first 12 digits of its SHA-256. Raises SolverMissing."""
    with read_errors(f"the program {program}", SolverMissing):
        status = program.stat()
        digest = _digest(program, status.st_size, status.st_mtime_ns)
    return f"{program.name} {digest[:12]}"


_NASTRAN = Capabilities(
    strain_energies=True,
    matrices=False,
    frequency_sensitivities=True,
    shape_sensitivities=True,
    # No licence of it is at hand here, so each site shows for its own that they are right.
    to_confirm=frozenset(
        ("frequency_sensitivities", "shape_sensitivities", "matrices", "matrix_modes")
    ),
)

MSC = Dialect(
    name="msc",
    title="Nastran",
    variable="MODETUNE_NASTRAN",
    program="nastran",
    print_file=f"{JOB}.f06",
    result_file=f"{JOB}.op2",
    logs=(f"{JOB}.log", f"{JOB}.f04"),
    threads="smp",
    displays="PLOT",
    capabilities=_NASTRAN,
)
NX = replace(
    MSC,
    name="nx",
    title="Simcenter Nastran",
    threads="parallel",
    # Whether its DRESP1 takes a mode's displacement is not known; differences are always right.
    capabilities=replace(_NASTRAN, shape_sensitivities=False),
)
MYSTRAN = Dialect(
    name="mystran",
    title="MYSTRAN",
    variable="MODETUNE_MYSTRAN",
    program="mystran",
    print_file=f"{JOB}.F06",
    result_file=f"{JOB}.OP2",
    logs=(f"{JOB}.ERR",),
    threads="",
    displays="PLOT,PRINT",  # its F06 is read where its OP2 falls short
    capabilities=Capabilities(
        strain_energies=False, matrices=True, matrix_modes=True, masses="lumped"
    ),
)
DIALECTS: dict[DialectName, Dialect] = {"msc": MSC, "nx": NX, "mystran": MYSTRAN}
