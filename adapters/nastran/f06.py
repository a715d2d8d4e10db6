"""The print file (F06) of MSC Nastran, Simcenter Nastran, NASTRAN-95 and MYSTRAN.

Read line by line, for it may hold gigabytes. Tables break over pages, and each page repeats the
heading of its table, so a heading opens a table and the next heading or page closes it. `*` may
follow a number. All programs print seven digits or so: an OP2 file has the same ones.

Of several subcases the first that has the table is read. A run that broke off still has its
messages: what it left half printed is given as if it were not there, and `ended` is False.

A fatal message is alone on its line, `*** USER FATAL MESSAGE 2025 (IFPDRV)` or
`^^^ USER FATAL ...` from a DMAP sequence, and continues until a blank line. MYSTRAN writes
`*ERROR  1308: ...`. Echoed decks may quote such a line, but have a line count before it.

Each table gets all lines and takes those that are its own. A table that cannot be right keeps the
reason and raises it as ValueError when its values are asked for: a run that broke off is read for
its messages all the same.
"""

from __future__ import annotations

import io
import mmap
import os
import re
from collections.abc import Iterable
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import BinaryIO

import numpy as np

from modetune.adapters.nastran.results import (
    ElementEnergies,
    GridShape,
    NastranModes,
    energy_table,
    shape_matrix,
)
from modetune.adapters.regular_file import open_regular
from modetune.core.errors import SolverCrashed
from modetune.core.modes import Floats

#: Lines of a weight generator's table at most.
WEIGHT_LINES = 80
#: Characters of a line, of which programs print 132.
LONGEST_LINE = 1000
#: A heading has spaced letters; any of them closes the table before it.
HEADING = re.compile(r"(?:\b[A-Z] ){4}")
MESSAGE = re.compile(r"[0 ]?\s{0,4}(?:\*{3}|\^{3}) ")
NUMBER = r"[-+]?\d+\.\d*(?:[EDed]?[-+]\d+)?\*?"
NUMBERS = re.compile(NUMBER)
#: A blank line, or a row of numbers with the letters of exponents and of kinds of points: neither a
#: heading nor a message.
ROW = re.compile(r"(?: [ \d.+\-DEGS]*)?\r?\n")


def number(text: str) -> float:
    """A number that Fortran printed: exponent letter D or, with three digits, none; a `*` behind.

    Raises ValueError where it is none.
    """
    plain = text.rstrip("*").replace("D", "E").replace("d", "E")
    return float(re.sub(r"(?<=[\d.])([-+]\d+)$", r"E\1", plain))


class EigenvalueTable:
    """REAL EIGENVALUES: mode, order, eigenvalue, radians, cycles, generalised mass, stiffness.

    A table before or after the AUGMENTATION OF RESIDUAL VECTORS gives way to one without: then it
    holds the fixed-interface modes of a component.
    """

    def __init__(self) -> None:
        self.open = False
        self._augmented = False
        self._of_component = False
        self._rows: list[list[float]] = []
        self._complete = False
        self._problem = ""

    def take(self, line: str) -> None:
        if line.startswith("1"):
            self.open = False
        elif HEADING.search(line):
            self.open = "R E A L   E I G E N V A L U E S" in line
            self._augmented = False
        elif self.open and "AUGMENTATION OF RESIDUAL VECTORS" in line:
            self._augmented = True
        elif MESSAGE.match(line):
            self.open = False  # what messages list may look like rows
        elif self.open and re.match(r"\s+\d+\s+\d+\s", line):
            self._row(line)

    def _row(self, line: str) -> None:
        if self._of_component and not self._augmented:
            self._rows, self._complete, self._problem = [], False, ""
        self._of_component = self._augmented
        words = line.split()
        try:
            row = [float(int(words[0])), *(number(word) for word in words[2:7])]
        except ValueError:
            row = []
        if len(words) != 7 or len(row) != 6 or not np.isfinite(row).all() or not _consistent(row):
            self._problem = self._problem or f"a row of the eigenvalues is {line.strip()!r}"
        elif row[0] == len(self._rows) + 1 and not self._complete:
            self._rows.append(row)
        elif row[0] == 1:
            self._complete = True  # the next subcase or design cycle
        elif not self._complete:
            self._problem = self._problem or f"eigenvalue {len(self._rows) + 1} is missing"

    def columns(self) -> Floats:
        """Eigenvalues and generalised masses, (2, n_modes)."""
        if self._problem:
            raise ValueError(self._problem)
        return np.array([[row[1], row[4]] for row in self._rows]).reshape(-1, 2).T


def _consistent(row: list[float]) -> bool:
    """Radians, cycles and generalised stiffness are those of the eigenvalue, to the printed digits.

    Half a unit of the seventh digit is 5e-7 in the worst case; older files print fewer digits.
    """
    _, eigenvalue, radians, cycles, mass, stiffness = row
    return bool(
        np.isclose(stiffness, eigenvalue * mass, rtol=1e-4, atol=1e-30)
        and np.isclose(radians, np.sqrt(abs(eigenvalue)), rtol=1e-5, atol=1e-30)
        and np.isclose(2.0 * np.pi * cycles, radians, rtol=1e-5, atol=1e-30)
    )


class EigenvectorTables:
    """REAL EIGENVECTOR NO. n, page by page, and MYSTRAN's EIGENVECTOR tables."""

    def __init__(self) -> None:
        self.open = False
        self._mystran = False
        self._eigenvalue = np.nan
        self._mode = 0
        self._subcase = 0
        self._first_subcase: int | None = None
        self._pages: dict[int, _Points] = {}

    def take(self, line: str) -> None:
        if self.open and (line.startswith(" ") and line[:24].strip()[:1].isdigit()):
            self._row(line)
        elif line.startswith("1"):
            self.open = False
        elif found := re.search(r"R E A L   E I G E N V E C T O R   N O \.\s+(\d+)", line):
            self._start(int(found.group(1)), mystran=False)
        elif found := re.match(r"\s*OUTPUT FOR EIGENVECTOR\s+(\d+)", line):
            self._mode, self.open = int(found.group(1)), False
        elif HEADING.search(line):
            self.open = False
            if line.strip() == "E I G E N V E C T O R" and self._mode:
                self._start(self._mode, mystran=True)
        elif found := re.match(rf".?\s*EIGENVALUE =\s*({NUMBER})\s*$", line):
            self._eigenvalue = number(found.group(1))
        elif found := re.search(r"\bSUBCASE (\d+)\s*$", line[:200]) if line[:1] == "0" else None:
            self._subcase = int(found.group(1))

    def _start(self, mode: int, mystran: bool) -> None:
        self._mode, self._mystran = mode, mystran
        if self._first_subcase is None:
            self._first_subcase = self._subcase
        self.open = self._subcase == self._first_subcase
        if self.open:
            self._pages.setdefault(mode, _Points(self._eigenvalue))

    def _row(self, line: str) -> None:
        self._pages[self._mode].take(line, self._mystran)

    def shapes(self) -> list[GridShape]:
        return [
            points.shape(mode) for mode, points in sorted(self._pages.items()) if points.numbers
        ]


class _Points:
    """The points of one mode while they are read."""

    def __init__(self, eigenvalue: float) -> None:
        self.eigenvalue = eigenvalue
        self.numbers: list[int] = []
        self._scalar: list[bool] = []
        self._values: list[list[float]] = []
        self._problem = ""

    def take(self, line: str, mystran: bool) -> None:
        point, kind, *_ = [*line.split(None, 2), ""]
        text = line[24:] if mystran else line.partition(f" {kind} ")[2]
        values = NUMBERS.findall(text) if not NUMBERS.sub("", text).strip() else []
        try:
            node, numbers = int(point), [number(value) for value in values]
        except ValueError:
            node, numbers = 0, []
        if kind == "S" and 1 <= len(numbers) <= 6:
            # Consecutive scalar points are six in a row, under the first one's number.
            for offset, value in enumerate(numbers):
                self._add(node + offset, True, [value, 0.0, 0.0, 0.0, 0.0, 0.0])
        elif node > 0 and len(numbers) == 6 and (mystran or kind == "G"):
            self._add(node, False, numbers)
        elif kind not in ("E", "H", "L"):
            self._problem = self._problem or f"a row of an eigenvector is {line.strip()!r}"

    def _add(self, node: int, scalar: bool, values: list[float]) -> None:
        self.numbers.append(node)
        self._scalar.append(scalar)
        self._values.append(values)

    def shape(self, mode: int) -> GridShape:
        if self._problem:
            raise ValueError(self._problem)
        return GridShape(
            mode,
            self.eigenvalue,
            np.array(self.numbers, dtype=np.int64),
            np.array(self._scalar, dtype=np.bool_),
            np.array(self._values),
        )


class EnergyTables:
    """ELEMENT STRAIN ENERGIES: one table an element type and mode."""

    def __init__(self) -> None:
        self.open = False
        self._type, self._total, self._mode = "", np.nan, 0
        self._subcase = 0
        self._first_subcase: int | None = None
        self._rows: dict[tuple[str, int], tuple[float, list[tuple[int, float]]]] = {}
        self._problem = ""

    def take(self, line: str) -> None:
        if line.startswith("1"):
            self.open, self._mode = False, 0
        elif line.startswith("0") and (found := re.search(r"\bSUBCASE (\d+)\s*$", line)):
            self._subcase = int(found.group(1))
        elif HEADING.search(line):
            self.open = "E L E M E N T   S T R A I N   E N E R G I E S" in line
            if self.open and self._first_subcase is None:
                self._first_subcase = self._subcase
        elif self.open and self._subcase == self._first_subcase:
            self._line(line)

    def _line(self, line: str) -> None:
        if found := re.search(r"ELEMENT-TYPE = (\S+).*IN PROBLEM\s*=\s*(\S+)", line):
            self._type, self._total = found.group(1), self._number(found.group(2))
        elif found := re.search(r"\bMODE\s+(\d+)\s.*IN SET", line):
            self._mode = int(found.group(1))
            self._rows.setdefault((self._type, self._mode), (self._total, []))
        elif (found := re.match(rf"\s+(\d+)\s+({NUMBER})\s+{NUMBER}", line)) and self._mode:
            _, rows = self._rows[self._type, self._mode]
            rows.append((int(found.group(1)), self._number(found.group(2))))
        elif re.match(r"\s{30,}\d+\s", line) and self._mode:
            self._problem = self._problem or f"a row of strain energies is {line.strip()!r}"

    def _number(self, text: str) -> float:
        try:
            return number(text)
        except ValueError:
            self._problem = self._problem or f"a strain energy is printed as {text!r}"
            return np.nan

    def tables(self) -> list[ElementEnergies]:
        if self._problem:
            raise ValueError(self._problem)
        return [
            ElementEnergies(
                mode,
                element_type,
                total,
                np.array([element for element, _ in rows], dtype=np.int64),
                np.array([energy for _, energy in rows]),
            )
            for (element_type, mode), (total, rows) in self._rows.items()
        ]


class WeightTable:
    """The mass by the grid point weight generator, the first if there are several; NaN if none."""

    def __init__(self) -> None:
        self.mass = np.nan
        self._left = 0  # lines that may still be the table's

    @property
    def open(self) -> bool:
        """Whether the next line may be the table's."""
        return self._left > 0 and not np.isfinite(self.mass)

    def take(self, line: str) -> None:
        if "O U T P U T   F R O M" in line and "W E I G H T   G E N E R A T O R" in line:
            self._left = WEIGHT_LINES
        if not self.open:
            return
        self._left -= 1
        words = line.replace("*", " ").split()
        numbers = [number(word) for word in words if NUMBERS.fullmatch(word)]
        # Mass and centre along the first axis; NX prints the mass by name.
        if (words[:1] == ["X"] and len(numbers) == 4) or (
            "Total mass" in line and len(numbers) == 1
        ):
            self.mass = numbers[0]


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


def read_f06(path: Path, tables: bool = True) -> F06:
    """Read a print file, whether the run was good or not.

    tables: whether they are read; if not, nor is what is before the first message, or before the
    last lines if there is none. Raises SolverCrashed where it cannot be opened, or where a run that
    reached its end printed tables that do not fit together.
    """
    scan = _Scan(tables)
    try:
        # Titles may be in any encoding; what is read is ASCII.
        with (
            open_regular(path) as file,
            io.TextIOWrapper(file, encoding="latin-1", newline="\n") as lines,
        ):
            if not tables:
                file.seek(_first_message(file))
            scan.read(lines)
    except OSError as error:
        raise SolverCrashed(f"{path} cannot be read: {error}") from error
    try:
        return scan.result()
    except (ValueError, OverflowError) as error:
        if scan.ended:
            raise SolverCrashed(f"{path} holds tables that do not fit: {error}") from error
        return scan.result(tables=False)


def _first_message(file: BinaryIO) -> int:
    """Where the line of the first message begins, or the end of a file that has none."""
    size = os.fstat(file.fileno()).st_size
    if not size:
        return 0
    with mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as text:
        places = [text.find(word) for word in MESSAGE_WORDS]
        first = min((place for place in places if place >= 0), default=size - END_BYTES)
        return text.rfind(b"\n", 0, max(first, 0)) + 1


class _Scan:
    """One pass over the lines of a print file."""

    def __init__(self, tables: bool) -> None:
        self.ended = False
        self._tables = tables
        self._version = ""
        self._messages: list[FatalMessage] = []
        self._open_message: list[str] = []
        self._eigenvalues = EigenvalueTable()
        self._eigenvectors = EigenvectorTables()
        self._energies = EnergyTables()
        self._weight = WeightTable()

    def read(self, lines: Iterable[str]) -> None:
        every = (self._eigenvalues, self._eigenvectors, self._energies, self._weight)
        tables = every if self._tables else ()
        for number, line in enumerate(lines):
            if not line.endswith("\n"):
                line = "" if not END.search(line) else line  # cut within the line
            if len(line) > LONGEST_LINE:
                line = "\n"  # no line of a print file
            if ROW.fullmatch(line):  # most lines, and most of them in no table that is read
                if self._open_message:
                    self._message(line)
                for table in tables:
                    if table.open:
                        table.take(line)
                continue
            if number < BANNER_LINES and not self._version:
                found = VERSION.search(line)
                self._version = found.group() if found else ""
            self._message(line)
            if "END" in line and END.search(line):
                self.ended = True
            for table in tables:
                table.take(line)
        self._close_message()

    def _message(self, line: str) -> None:
        if ("FATAL" in line or "*ERROR" in line) and FATAL.match(line):
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
#: One of these is in each, and the end of a file that has whether its run ended.
MESSAGE_WORDS, END_BYTES = (b"FATAL", b"*ERROR"), 1 << 16
#: A message is a few lines; anything longer is a table that follows it.
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
CARD_NUMBER = re.compile(
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
    number = (card and re.search(rf"\b{card}\s+(\d+)\b", sentence)) or CARD_NUMBER.search(sentence)
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
