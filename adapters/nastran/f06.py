"""The print file (F06) of MSC Nastran, Simcenter Nastran, NASTRAN-95 and MYSTRAN.

Read line by line, for it may hold gigabytes. Tables break over pages, and each page repeats the
heading of its table, so a heading opens a table and the next heading or page closes it. `*` may
follow a number. All programs print seven digits or so: an OP2 file has the same ones.

Of several subcases the first that has the table is read. A run that broke off still has its
messages: what it left half printed is given as if it were not there, and `ended` is False.
"""

from __future__ import annotations

import io
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from modetune.adapters.nastran.eigenvectors import NastranModes, energy_table, shape_matrix
from modetune.adapters.nastran.f06_messages import (
    BANNER_LINES,
    END,
    FATAL,
    LONGEST,
    NEXT_MESSAGE,
    VERSION,
    FatalMessage,
    fatal_message,
)
from modetune.adapters.nastran.f06_tables import (
    EigenvalueTable,
    EigenvectorTables,
    EnergyTables,
    WeightTable,
)
from modetune.adapters.regular_file import open_regular
from modetune.core.errors import SolverCrashed

__all__ = ["F06", "FatalMessage", "read_f06"]


@dataclass(frozen=True, slots=True)
class F06:
    """What a print file says.

    version: of the program, as its banner has it, empty if none. ended: whether the run says it
    reached its end. fatal_messages: in the order of the file. modes: (0,) where none are printed.
    """

    version: str
    ended: bool
    fatal_messages: tuple[FatalMessage, ...]
    modes: NastranModes


def read_f06(path: Path) -> F06:
    """Read a print file, whether the run was good or not.

    Raises SolverCrashed where it cannot be opened, or where a run that reached its end printed
    tables that do not fit together.
    """
    scan = _Scan()
    try:
        # Titles may be in any encoding; what is read is ASCII.
        with (
            open_regular(path) as file,
            io.TextIOWrapper(file, encoding="latin-1", newline="\n") as lines,
        ):
            scan.read(lines)
    except OSError as error:
        raise SolverCrashed(f"{path} cannot be read: {error}") from error
    try:
        return scan.result()
    except (ValueError, OverflowError) as error:
        if scan.ended:
            raise SolverCrashed(f"{path} holds tables that do not fit: {error}") from error
        return scan.result(tables=False)


class _Scan:
    """One pass over the lines of a print file."""

    def __init__(self) -> None:
        self.ended = False
        self._version = ""
        self._messages: list[FatalMessage] = []
        self._open_message: list[str] = []
        self._eigenvalues = EigenvalueTable()
        self._eigenvectors = EigenvectorTables()
        self._energies = EnergyTables()
        self._weight = WeightTable()

    def read(self, lines: Iterable[str]) -> None:
        tables = (self._eigenvalues, self._eigenvectors, self._energies, self._weight)
        for number, line in enumerate(lines):
            if not line.endswith("\n"):
                line = "" if not END.search(line) else line  # cut within the line
            if number < BANNER_LINES and not self._version:
                found = VERSION.search(line)
                self._version = found.group() if found else ""
            self._message(line)
            if END.search(line):
                self.ended = True
            for table in tables:
                table.take(line)
        self._close_message()

    def _message(self, line: str) -> None:
        if FATAL.match(line):
            self._close_message()
            self._open_message = [line]
        elif self._open_message:
            blank = not line.strip("01 \n\r")
            over = line.startswith("1") or NEXT_MESSAGE.match(line) is not None
            if blank or over or len(self._open_message) >= LONGEST:
                self._close_message()
            else:
                self._open_message.append(line)

    def _close_message(self) -> None:
        if self._open_message:
            self._messages.append(fatal_message(self._open_message))
        self._open_message = []

    def result(self, tables: bool = True) -> F06:
        """Everything read, or the messages alone. Raises ValueError where tables do not fit."""
        eigenvalues, generalized_mass = self._eigenvalues.columns() if tables else np.zeros((2, 0))
        shapes = self._eigenvectors.shapes() if tables else []
        nodes, components, mode_shapes = shape_matrix(shapes, len(shapes))
        energies = self._energies.tables() if tables else []
        n_modes = eigenvalues.size or len({table.mode for table in energies})
        elements, strain_energies, totals = energy_table(energies, range(1, n_modes + 1))
        modes = NastranModes(
            eigenvalues=eigenvalues,
            generalized_mass=generalized_mass,
            mode_numbers=np.array([shape.mode for shape in shapes], dtype=np.int64),
            nodes=nodes,
            components=components,
            mode_shapes=mode_shapes,
            elements=elements,
            strain_energies=strain_energies,
            total_strain_energy=totals,
            mass=self._weight.mass,
        )
        return F06(self._version, self.ended, tuple(self._messages), modes)
