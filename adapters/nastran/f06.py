"""The print file (F06) of MSC Nastran, Simcenter Nastran, NASTRAN-95 and MYSTRAN.

Read line by line, for it may hold gigabytes. Tables break over pages, and each page repeats the
heading of its table, so a heading opens a table and the next heading or page closes it. `*` may
follow a number. All programs print seven digits or so: an OP2 file has the same ones.

Of several subcases the first that has the table is read. A run that broke off still has its
messages: what it left half printed is given as if it were not there, and `ended` is False.

A fatal message stands alone on its line, `*** USER FATAL MESSAGE 2025 (IFPDRV)` or
`^^^ USER FATAL ...` from a DMAP sequence, and goes on until a blank line. MYSTRAN writes
`*ERROR  1308: ...`. Echoed decks may quote such a line, but have a line count before it.
"""

from __future__ import annotations

import io
import re
from collections.abc import Iterable
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np

from modetune.adapters.nastran.eigenvectors import NastranModes, energy_table, shape_matrix
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


FATAL = re.compile(
    r"^[01+ ]?\s{0,12}(?:(?:\*{3}|\^{3})\s*(?:\w+ )?(?:USER|SYSTEM|NASTRAN|DMAP)?\s*FATAL\b"
    r"|\*ERROR\s+\d+\s*:|\^{3}\s.*\bFATAL\b)"
)
NEXT_MESSAGE = re.compile(r"^[01+ ]?\s{0,12}(?:\*{3} |\^{3} |\*ERROR|\*WARNING|\*INFORMATION)")
#: A message is a few lines; what goes on longer is a table that follows it.
LONGEST = 20

CARD = re.compile(
    r"\b(?:BULK DATA ENTRY|BULK DATA CARD|BULK DATA|ENTRY|ENTRIES|CARD|ELEMENT TYPE)\s*[=:]?\s+"
    r"(?:NAME\s+)?['\"]?([A-Z][A-Z0-9]{2,7})\b"
)
NAMES = (
    r"C(?:QUAD|TRIA|HEXA|PENTA|TETRA|PYRAM|BAR|BEAM|ROD|ELAS|BUSH|ONM|ONROD|TUBE|SHEAR|GAP|DAMP)\w*"
    r"|P(?:SHELL|SOLID|BAR|BEAM|ROD|COMP|ELAS|BUSH|TUBE|SHEAR|MASS)\w*|MAT\d{1,2}|GRID|RB(?:E\d|AR)"
    r"|SPC1?|MPC|EIGRL?|CORD\d[RCS]|DESVAR|DVPREL\d|DVMREL\d|DRESP\d|[AO]SET1?|SUPORT"
)
KNOWN_CARD = re.compile(rf"\b({NAMES})\b")
NUMBER = re.compile(
    r"\b(?:ID|EID|PID|MID|GID|SID|POINT|GRID|ELEMENT|PROPERTY|MATERIAL"
    rf"|{NAMES})(?:\s*ID)?\s*[=:#\s]\s*(\d+)\b"
)
#: Words that follow "entry" or "card" in sentences and are not names of cards.
NO_CARD = frozenset(
    "FOR WITH WAS WERE NOT AND THE HAS HAVE FIELD FIELDS IMAGE IS ARE THAT WHICH NAME IN ON OF "
    "MUST NUMBER COUNT DECK ENTRY CARD SECTION POSSIBLY REQUIRED MISSING".split()
)

VERSION = re.compile(
    r"MYSTRAN\s+Version\s+[\w.]+|Simcenter Nastran\s+[\w.]+|NX Nastran\s+[\w.]+"
    r"|MSC Nastran\s+V?\d[\w.]+|Version\s+[\d][\w.\-]+|VERSION\s+-?\s*[\d][\w.]+|[A-Z]+ VERSION\b"
)
END = re.compile(r"\* \* \* END OF JOB \* \* \*|>> MYSTRAN END\b")
BANNER_LINES = 400


@dataclass(frozen=True, slots=True)
class FatalMessage:
    """A fatal message: its text, and what it says of its place in the deck.

    card_image: the card it quotes; card: the name of the card it speaks of; number: the first
    number of a card, element, point or property it names. Empty or 0 where there is none.
    """

    text: str
    card_image: str
    card: str
    number: int


def fatal_message(lines: list[str]) -> FatalMessage:
    """What the lines of one message say."""
    texts = [line[1:].strip() if line[:1] in "01+" else line.strip() for line in lines]
    # The message's own number and subroutine are not a card.
    body = [re.sub(r"MESSAGE\s+\d+\s*(?:\(\w+\))?|^\*ERROR\s+\d+\s*:", "", texts[0]), *texts[1:]]
    sentence = " ".join(body)
    names = [name for name in CARD.findall(sentence) if name not in NO_CARD]
    names = names or KNOWN_CARD.findall(sentence)
    card = names[0] if names else ""
    number = (card and re.search(rf"\b{card}\s+(\d+)\b", sentence)) or NUMBER.search(sentence)
    return FatalMessage(
        text="\n".join(texts),
        card_image=_card_image(texts[1:], card),
        card=card,
        number=int(number.group(1)) if number else 0,
    )


def _card_image(lines: list[str], card: str) -> str:
    for line in lines:
        if card and re.match(rf"{card}\*?(?:,|\s+\d)", line):
            return line
    for before, line in pairwise(lines):
        if re.search(r"(?:card|entry) image|as follows", before, re.IGNORECASE):
            return line
    return ""
