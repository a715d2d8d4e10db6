"""A survey of Nastran decks: reading, writing back, runs by MYSTRAN and CalculiX.

    python -m benchmarks.corpus [FOLDERS]      decks below folders, those of the shared data if none
    python -m benchmarks.corpus --cards        one small deck a card (card_decks.py)

prints a Markdown row per deck: whether it is read, whether it is written back byte for byte, the
number of modes from each solver or the first reason for having none, and the largest difference of
the reference's first four elastic frequencies from the nearest computed one. (Some programs include
torsion of bars and others do not, so the order of modes differs.) The reference is the OP2 or F06
file next to the deck if it has modes, otherwise MYSTRAN. `--json FILE` writes the rows, `--counts`
prints only the sums. Decks outside linear structural dynamics are recognised by their cards
(outside.py) and counted separately.
"""

from __future__ import annotations

import argparse
import json
import logging
import re
import sys
import tempfile
import threading
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from benchmarks.card_decks import write_decks
from benchmarks.outside import outside

from modetune.adapters.nastran.deck import read_deck, write_edited
from modetune.adapters.nastran.f06 import read_f06
from modetune.adapters.nastran.model import understand
from modetune.adapters.nastran.op2 import read_op2
from modetune.adapters.nastran.solver import mystran_solver
from modetune.adapters.process import run_process
from modetune.adapters.solver import ModalAnalysis, Solver
from modetune.adapters.translation.solver import translated_solver
from modetune.core.errors import ModetuneError
from modetune.core.modes import Floats
from modetune.core.parameters import Parameter
from modetune.core.updating.job_results import ModalResult

#: Number of requested modes; a small model has fewer.
MODES = (10, 6, 4, 2, 1)
#: Number of compared elastic modes.
COMPARED = 4
#: Modes below this part of the largest frequency are rigid, if the solver does not mark them.
RIGID = 1e-4
#: Number of nodes with requested shapes, to check that shapes are read.
NODES = 3
TIMEOUT_S = 120.0
#: Part of the message about a model that has no modes.
MASSLESS = "nothing in the model has mass"
SUFFIXES = (".bdf", ".dat", ".nas")
BINDERS: dict[str, Callable[[Path, tuple[Parameter, ...]], Solver]] = {
    "mystran": mystran_solver,
    "calculix": translated_solver,
}


@dataclass(frozen=True, slots=True)
class Row:
    """The outcome of a deck. A solver's column has the number of modes, or the reason for none."""

    deck: str
    read: str
    rewritten: str
    mystran: str
    calculix: str
    difference: str
    outside: str = ""

    @property
    def runs(self) -> bool:
        """Return whether a solver gives modes."""
        return self.mystran.isdecimal() or self.calculix.isdecimal()

    @property
    def massless(self) -> bool:
        """Return whether the model has no modes because it has no mass."""
        return MASSLESS in self.mystran


def decks_below(folder: Path) -> list[Path]:
    """Return the main decks below a folder: included files have no BEGIN BULK."""
    found = sorted(p for p in folder.rglob("*") if p.suffix.lower() in SUFFIXES)
    return [path for path in found if b"BEGIN" in path.read_bytes().upper()]


def look_at(path: Path, name: str) -> Row:
    """Read, write back and run a deck."""
    logging.disable(logging.WARNING)
    other = outside(path)
    try:
        deck = read_deck(path)
        understand(deck).mesh()
    except ModetuneError as error:
        return Row(name, reason(error), "", "", "", "", other)
    with tempfile.TemporaryDirectory() as folder:
        copy = write_edited(deck, {}, Path(folder) / "copy")
        same = "yes" if copy.read_bytes() == path.read_bytes() else "no"
        found: dict[str, str] = {}
        frequencies: dict[str, Floats] = {}
        for solver, binder in BINDERS.items():
            try:
                frequencies[solver] = solve(binder(path, ()), Path(folder) / solver)
                found[solver] = str(frequencies[solver].size)
            except ModetuneError as error:
                found[solver] = reason(error)
    said = compared(frequencies, reference(path))
    return Row(name, "yes", same, found["mystran"], found["calculix"], said, other)


def solve(solver: Solver, folder: Path) -> Floats:
    """Frequencies in Hz, rigid modes as 0. Raises ModetuneError."""
    nodes = tuple(sorted(solver.deck.summary.node_ids))[:NODES]
    for n_modes in MODES:
        analysis = ModalAnalysis(n_modes, nodes)
        place = folder / str(n_modes)
        place.mkdir(parents=True)
        solver.render({}, analysis).write(place)
        try:
            ended = run_process(
                solver.program.command(1), place, TIMEOUT_S, threading.Event()
            ).return_code
            result = solver.read({}, analysis, place, ended)
        except ModetuneError as error:
            if n_modes == MODES[-1] or "modes" not in str(error):
                raise
            continue
        assert isinstance(result, ModalResult)
        frequencies = result.modes.frequencies_hz.copy()
        frequencies[: result.n_rigid] = 0.0
        return frequencies
    raise AssertionError


def reference(path: Path) -> Floats:
    """Return frequencies in Hz from the OP2 or F06 file next to a deck, (0,) without one."""
    for other in sorted(path.parent.iterdir()):
        if other.stem.lower() != path.stem.lower():
            continue
        try:
            if other.suffix.lower() == ".op2":
                values = read_op2(other).eigenvalues
            elif other.suffix.lower() == ".f06":
                values = read_f06(other).modes.eigenvalues
            else:
                continue
        except (ModetuneError, ValueError):
            continue
        if values.size:
            return np.asarray(np.sqrt(np.maximum(values, 0.0)) / (2.0 * np.pi))
    return np.zeros(0)


def compared(found: dict[str, Floats], reference: Floats) -> str:
    """Largest relative difference of elastic frequencies, and of what it is."""
    if reference.size:
        pairs = [(f"{name} / reference", values, reference) for name, values in found.items()]
    elif len(found) == 2:
        pairs = [("calculix / mystran", found["calculix"], found["mystran"])]
    else:
        return ""
    said = []
    for name, *both in pairs:
        mine, wanted = (values[values > RIGID * values.max(initial=0.0)] for values in both)
        wanted = wanted[:COMPARED]
        if not (mine.size and wanted.size):
            said.append(f"{name}: rigid modes alone")
            continue
        apart = np.array([mine[np.argmin(np.abs(mine / f - 1.0))] / f - 1.0 for f in wanted])
        said.append(f"{name}: {100.0 * apart[np.argmax(np.abs(apart))]:+.2g} %")
    return "; ".join(said)


def reason(error: Exception) -> str:
    """The first line that says something, without folders."""
    lines = [line.strip("- ") for line in str(error).splitlines() if line.strip()]
    first = lines[1] if len(lines) > 1 and lines[0].endswith(":") else lines[0]
    return re.sub(r"(/[^\s/:,]+)+/", "", first).replace("|", "/")[:200]


def counts(rows: Sequence[Row]) -> str:
    """How many decks came through, and the reasons of the others by their number."""
    numbers = [
        f"decks {len(rows)}",
        f"read {sum(row.read == 'yes' for row in rows)}",
        f"written back {sum(row.rewritten == 'yes' for row in rows)}",
        f"MYSTRAN {sum(row.mystran.isdecimal() for row in rows)}",
        f"CalculiX {sum(row.calculix.isdecimal() for row in rows)}",
        f"either {sum(row.runs for row in rows)}",
        f"without mass {sum(row.massless for row in rows)}",
    ]
    lines = [", ".join(numbers)]
    massive = [row for row in rows if not row.massless]
    for kind in sorted({row.outside for row in massive}):
        members = [row for row in massive if row.outside == kind]
        said = kind or "nothing outside linear structural dynamics"
        lines.append(f"{said}: {len(members)}, of which {sum(r.runs for r in members)} run")
    return "\n".join(lines)


def table(rows: Iterable[Row]) -> Iterator[str]:
    """The rows as a Markdown table."""
    yield "| deck | read | written back | MYSTRAN | CalculiX | largest difference | outside |"
    yield "| --- | --- | --- | --- | --- | --- | --- |"
    for row in rows:
        yield "| " + " | ".join(asdict(row).values()) + " |"


def main(arguments: Sequence[str]) -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folders", nargs="*", type=Path)
    parser.add_argument("--cards", action="store_true")
    parser.add_argument("--json", type=Path)
    parser.add_argument("--counts", action="store_true")
    parser.add_argument("--jobs", type=int, default=1)
    asked = parser.parse_args(arguments)
    shared = Path(__file__).resolve().parent.parent.parent / "shared" / "data" / "nastran"
    with tempfile.TemporaryDirectory() as own:
        folders = asked.folders or [Path(own) if asked.cards else shared]
        if asked.cards:
            write_decks(Path(own))
        pairs = [
            (path, path.relative_to(folder).as_posix())
            for folder in folders
            for path in decks_below(folder)
        ]
        with ProcessPoolExecutor(asked.jobs) as pool:
            rows = list(pool.map(look_at, *zip(*pairs, strict=True)))
    if asked.json:
        asked.json.write_text(json.dumps([asdict(row) for row in rows], indent=1))
    if not asked.counts:
        sys.stdout.write("\n".join(table(rows)) + "\n")
    sys.stdout.write(counts(rows) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
