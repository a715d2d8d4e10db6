"""What ccx leaves: the .dat file of a modal job, and its messages.

The .dat file has one table of eigenvalues and then, under a heading with the mode's number, the
printed quantities of each mode. Quantities are taken by mode number; frequencies would collide
for repeated modes. A good run prints the whole table: an exit code of 0 proves nothing.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from modetune.adapters.calculix.cyclic_symmetry import CyclicSymmetry, standing_modes
from modetune.adapters.calculix.job import ALL, NODES
from modetune.adapters.cross_checks import SPARE_EIGENVALUE, check_mark
from modetune.adapters.regular_file import read_regular
from modetune.adapters.solver import ModalAnalysis
from modetune.core.errors import ModesError, NoResult
from modetune.core.modes import Floats, Integers, mode_set
from modetune.core.updating.job_results import ModalResult

#: Columns are printed to seven digits, so each is off by 5e-7 of its value at most; an eigenvalue
#: and the square of its frequency by three times that.
COLUMN_ROUNDING = 1.6e-6
MODE_HEADING = "E I G E N V A L U E    N U M B E R"
#: Headings of the table, of which there is one for each nodal diameter of a cyclic structure, and
#: of the parts of a complex mode.
TABLE_HEADING = "E I G E N V A L U E   O U T P U T"
REAL, IMAGINARY = "R E A L   P A R T", "I M A G I N A R Y   P A R T"


@dataclass(frozen=True, slots=True)
class SolverMessage:
    """An *ERROR of ccx: its text, and what it says of its place in the deck.

    card_image: the line it quotes; keyword: the card it was reading, as in `*SOLID SECTION`;
    element: the element it names. Empty or 0 where there is none.
    """

    text: str
    card_image: str
    keyword: str
    element: int


def read_version(banner: str) -> str:
    """The version in what `ccx -v` prints, empty where there is none."""
    found = re.search(r"Version\s+([0-9][\w.]*)", banner)
    return found.group(1) if found else ""


def read_messages(log: str) -> list[SolverMessage]:
    """All *ERROR messages of a log, each with its continuation lines."""
    found = []
    for match in re.finditer(r"^ *\*ERROR.*(?:\n(?! *\*[EW]) +\S.*)*", log, re.MULTILINE):
        text = "\n".join(line.strip() for line in match.group().splitlines())
        image = re.search(r"Card image:?\s*\n(.*)", text)
        keyword = re.match(r"\*ERROR reading (\*[A-Z ]*[A-Z])", text)
        element = re.search(r"element +(\d+)", text)
        found.append(
            SolverMessage(
                text,
                image.group(1).strip() if image else "",
                keyword.group(1) if keyword else "",
                int(element.group(1)) if element else 0,
            )
        )
    return found


def read_modal(
    dat: Path,
    analysis: ModalAnalysis,
    point_mass: float,
    node_set: str = NODES,
    cyclic: CyclicSymmetry | None = None,
) -> ModalResult:
    """The modes of a .dat file. Raises NoResult where it is not whole, or another job's.

    node_set: the name that the job gives the nodes whose shapes are wanted. cyclic: the symmetry of
    which the deck is one sector, None where it is the whole.
    """
    try:
        text = read_regular(dat).decode("utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise NoResult(f"{dat} cannot be read: {error}") from error
    if cyclic is not None:
        return _cyclic_result(dat, text, analysis, point_mass, node_set, cyclic)
    return _one_table(dat, text, analysis, point_mass, node_set)


def _cyclic_result(
    dat: Path,
    text: str,
    analysis: ModalAnalysis,
    point_mass: float,
    node_set: str,
    cyclic: CyclicSymmetry,
) -> ModalResult:
    """The lowest modes of all nodal diameters. Raises NoResult."""
    _, *tables = text.split(TABLE_HEADING)
    asked = replace(analysis, n_modes=cyclic.rows(analysis.n_modes))
    if len(tables) != cyclic.last - cyclic.first + 1:
        raise NoResult(
            f"{dat} holds {len(tables)} of the nodal diameters {cyclic.first} to {cyclic.last}: "
            "the run broke off"
        )
    found = []
    for diameter, table in enumerate(tables, start=cyclic.first):
        head, *modes = table.split(MODE_HEADING)
        parts = []
        for mine, other in ((REAL, IMAGINARY), (IMAGINARY, REAL)):
            own = [_part(mode, mine, other) for mode in modes]
            whole = MODE_HEADING.join([head, *own]).rstrip() + "\n"
            parts.append(_one_table(dat, whole, asked, point_mass, node_set))
        found.append((diameter, parts[0], parts[1]))
    try:
        return standing_modes(found, cyclic, analysis.n_modes)
    except ValueError as error:
        raise NoResult(f"{dat} holds no whole result: {error}") from error


def _part(mode: str, mine: str, other: str) -> str:
    """One part of a complex mode under its number; empty where the run broke off before."""
    number, _, _ = mode.strip().partition("\n")
    return f" {number}\n{mode.partition(mine)[2].partition(other)[0]}"


def _one_table(
    dat: Path, text: str, analysis: ModalAnalysis, point_mass: float, node_set: str
) -> ModalResult:
    """The modes of one table of eigenvalues. Raises NoResult."""
    head, *modes = text.split(MODE_HEADING)
    try:
        eigenvalues = _eigenvalues(head)
    except ValueError as error:
        raise NoResult(f"{dat} is not a result: {error}") from error
    if not text.endswith("\n"):
        raise NoResult(f"{dat} ends within a line: the run broke off")
    if eigenvalues.size < analysis.n_modes or len(modes) < analysis.n_modes:
        raise NoResult(
            f"{dat} holds {eigenvalues.size} eigenvalues and {len(modes)} modes of "
            f"{analysis.n_modes}: the run broke off, or the model has fewer unknowns"
        )
    try:
        return _modal_result(eigenvalues, modes, analysis, point_mass, node_set)
    except (ValueError, IndexError, ModesError) as error:
        raise NoResult(f"{dat} holds no whole result: {error}") from error


def _modal_result(
    eigenvalues: Floats, modes: list[str], analysis: ModalAnalysis, point_mass: float, node_set: str
) -> ModalResult:
    shapes, numbers, nodes = [], list[int](), np.zeros(0, dtype=np.int64)
    for mode in modes:
        numbers.append(int(mode.split(None, 1)[0]))
        nodes, shape = _displacements(mode, node_set)
        if not np.array_equal(np.sort(nodes), np.sort(np.array(analysis.nodes, dtype=np.int64))):
            raise ValueError(f"mode {numbers[-1]} has shapes at other nodes than were asked for")
        shapes.append(shape)
    if numbers != list(range(1, eigenvalues.size + 1)):
        raise ValueError(f"modes numbered {numbers[:3]}... do not follow the table")
    energies = {
        name: np.array([_total(mode, "internal energy", name) for mode in modes])
        for name in {ALL, *(name for _, sets in analysis.groups for name in sets)}
    }
    # Mass-normalised modes have phi^T K phi = lambda, so a strain energy far above all eigenvalues
    # is impossible, compressive preload or not. ARPACK gives such modes (about 1e26 times too
    # large) where K is singular to its last digits.
    # Modes of spare unknowns may be such, and are left out later.
    own = eigenvalues < 0.5 * SPARE_EIGENVALUE
    worst = int(np.argmax(np.where(own, energies[ALL], 0.0)))
    if own[worst] and not energies[ALL][worst] <= 1e6 * np.abs(eigenvalues[own]).max():
        raise ValueError(
            f"mode {worst + 1} (eigenvalue {eigenvalues[worst]:g}) has the impossible strain "
            f"energy {energies[ALL][worst]:g}: ccx found no true modes of this model"
        )
    groups = [
        sum((energies[name] for name in sets), np.zeros(eigenvalues.size))
        for _, sets in analysis.groups
    ]
    return ModalResult(
        eigenvalues=eigenvalues,
        modes=mode_set(
            np.sqrt(np.maximum(eigenvalues, 0.0)) / (2.0 * np.pi),
            np.stack(shapes, axis=1),
            np.repeat(nodes, 3),
            np.tile(np.arange(1, 4), nodes.size),
            normalisation="mass",
        ),
        groups=tuple(name for name, _ in analysis.groups),
        strain_energies=np.array(groups).reshape(len(groups), eigenvalues.size),
        total_strain_energy=energies[ALL],
        mass=_total(modes[0], "mass", ALL) + point_mass,
    )


def _eigenvalues(head: str) -> Floats:
    """The table's eigenvalues. Raises ValueError where a row's columns contradict each other."""
    table = head.split("P A R T I C I P A T I O N")[0]
    number = r"([-+]?[\d.]+E[-+]\d+)"
    rows = re.findall(rf"^ +(?:\d+ +)?\d+ +{number} +{number} +{number} +{number}", table, re.M)
    values = np.array(rows, dtype=np.float64).reshape(-1, 4)
    eigenvalues, real, cycles, imaginary = values.T
    squared = np.where(eigenvalues < 0.0, -(imaginary**2), real**2)
    idle = np.where(eigenvalues < 0.0, real, imaginary)
    apart = np.abs(squared - eigenvalues) > COLUMN_ROUNDING * np.abs(eigenvalues)
    apart |= np.abs(2.0 * np.pi * cycles - real) > COLUMN_ROUNDING * real
    wrong = np.flatnonzero(apart | (idle != 0.0))
    if wrong.size:
        raise ValueError(
            f"eigenvalue {wrong[0] + 1} is {eigenvalues[wrong[0]]:g}, which its frequency columns "
            f"({real[wrong[0]]:g}, {cycles[wrong[0]]:g}, {imaginary[wrong[0]]:g}) contradict"
        )
    return np.asarray(eigenvalues)


def _displacements(mode: str, node_set: str) -> tuple[Integers, Floats]:
    """Node numbers (n,), and the shape (3 n,) as x, y, z node by node."""
    # With user elements ccx prints all unknowns of a node, the translations first.
    found = re.search(r" displacements \((?:vx,vy,vz|v\(i\),i=1\.\.ndof)\)(.*)\n\s*", mode)
    if found is None:
        raise ValueError("a mode has no displacements")
    check_mark(node_set, found.group(1))
    numbers = mode[found.end() :].split("total ")[0]
    width = len(numbers.partition("\n")[0].split()) or 4  # none where no nodes were asked for
    table = np.array([_number(word) for word in numbers.split()]).reshape(-1, width)
    return table[:, 0].astype(np.int64), table[:, 1:4].reshape(-1)


def _total(mode: str, quantity: str, name: str) -> float:
    heading = rf"total {quantity} for set {re.escape(name)} and time.*\n\s*\n\s*(\S+)"
    found = re.search(heading, mode)
    if found is None:
        raise ValueError(f"no total {quantity} of set {name}")
    return _number(found.group(1))


def _number(text: str) -> float:
    """A number that Fortran printed; an exponent of three digits costs it the letter E."""
    try:
        return float(text)
    except ValueError:
        return float(re.sub(r"(?<=\d)([+-]\d{3})$", r"E\1", text))
