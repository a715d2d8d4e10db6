"""A survey of Nastran decks: reading, writing back, runs by MYSTRAN and CalculiX.

    python -m benchmarks.corpus [FOLDERS]      decks below folders, those of the shared data if none
    python -m benchmarks.corpus --cards        one small deck a card (card_decks.py)

prints a Markdown row per deck: whether it is read, whether it is written back byte for byte, the
number of modes from each solver or the first reason for having none, and the largest difference of
the first ten elastic frequencies from those of the program that made the files next to the deck
(references.py). Modes are compared one to one, by their shapes where the files have them, and a
missing mode counts as wrong. Where a solver is more than 1 % off, the deck is solved once more with
every edge cut in half (halved.py): an error that this change exceeds is counted separately, and
listed by element, as the mesh decides there. `--json FILE` writes the rows, `--counts` prints only
the sums. Decks outside linear structural dynamics are recognised by their cards (outside.py) and
counted separately.
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
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
from benchmarks.card_decks import write_decks
from benchmarks.halved import BEAMS, CORNERS, halved_deck
from benchmarks.outside import outside
from benchmarks.references import Reference, difference, needed, reference

from modetune.adapters.nastran.deck import NastranDeck, read_deck, write_edited
from modetune.adapters.nastran.model import understand
from modetune.adapters.nastran.solver import mystran_solver
from modetune.adapters.process import run_process
from modetune.adapters.solver import ModalAnalysis, Solver
from modetune.adapters.translation.solver import translated_solver
from modetune.core.errors import ModetuneError
from modetune.core.modes import ModeSet
from modetune.core.parameters import Parameter
from modetune.core.updating.job_results import ModalResult

#: Number of requested modes; a small model has fewer.
MODES = (10, 6, 4, 2, 1)
#: Number of nodes with requested shapes: to check that shapes are read, and to compare them.
NODES, SHAPE_NODES = 3, 100
#: Fields of GRID: its number, and the frame of its results.
IDENT, FRAME = 1, 6
TIMEOUT_S = 120.0
#: Part of the message about a model that has no modes.
MASSLESS = "nothing in the model has mass"
SUFFIXES = (".bdf", ".dat", ".nas")
#: Elements by which decks are counted.
KINDS = (*sorted(BEAMS), *CORNERS, "CROD", "CONROD", "CQUAD8", "CTRIA6", "CSHEAR", "CBUSH")
#: The solvers in the column of differences.
LETTERS = {"mystran": "M", "calculix": "C"}
BINDERS: dict[str, Callable[[Path, tuple[Parameter, ...]], Solver]] = {
    "mystran": mystran_solver,
    "calculix": translated_solver,
}


@dataclass(frozen=True, slots=True)
class Row:
    """The outcome of a deck. A solver's column has the number of modes, or the reason for none.

    difference: of each solver from the reference, or of CalculiX from MYSTRAN without a reference;
    source: of the reference; right: the solvers within 1 % of it; meshed: those of the others whose
    error is smaller than what half the element size changes. elements: kinds of the deck.
    """

    deck: str
    read: str
    rewritten: str
    mystran: str
    calculix: str
    difference: str
    outside: str = ""
    source: str = ""
    right: tuple[str, ...] = ()
    meshed: tuple[str, ...] = ()
    elements: tuple[str, ...] = ()

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
    """Read, write back and run a deck, and compare its modes."""
    logging.disable(logging.WARNING)
    other = outside(path)
    try:
        deck = read_deck(path)
        understand(deck).mesh()
    except ModetuneError as error:
        return Row(name, reason(error), "", "", "", "", other)
    known = reference(path)
    found: dict[str, ModeSet] = {}
    told: dict[str, str] = {}
    meshed: list[str] = []
    with tempfile.TemporaryDirectory() as folder:
        copy = write_edited(deck, {}, Path(folder) / "copy")
        same = "yes" if copy.read_bytes() == path.read_bytes() else "no"
        nodes, n_modes = compared_nodes(deck, known), needed(known.modes) if known else 0
        for solver, binder in BINDERS.items():
            try:
                found[solver] = solve(binder(path, ()), Path(folder) / solver, nodes, n_modes)
                told[solver] = str(found[solver].n_modes)
            except ModetuneError as error:
                told[solver] = reason(error)
                continue
            if known and meshed_alike(path, binder, Path(folder) / "half", found[solver], known):
                meshed.append(solver)
    if known is None:
        both = difference(found["calculix"], found["mystran"]) if len(found) == 2 else ""
        return Row(name, "yes", same, told["mystran"], told["calculix"], str(both), other)
    apart = {solver: difference(modes, known.modes) for solver, modes in found.items()}
    text = "; ".join(f"{LETTERS[solver]} {one}" for solver, one in apart.items())
    right = tuple(solver for solver, one in apart.items() if one.right)
    return Row(
        name, "yes", same, told["mystran"], told["calculix"], text, other, known.source, right,
        tuple(meshed), tuple(sorted({card.name for card in deck.named(*KINDS)})),
    )  # fmt: skip


def meshed_alike(
    path: Path,
    binder: Callable[[Path, tuple[Parameter, ...]], Solver],
    folder: Path,
    found: ModeSet,
    known: Reference,
) -> bool:
    """Return whether modes are wrong by no more than half the element size changes them."""
    apart = difference(found, known.modes)
    if apart.right or apart.reason:
        return False
    folder.mkdir(exist_ok=True)
    try:
        halved_deck(path, folder / path.name)
        half = solve(binder(folder / path.name, ()), folder / binder.__name__)
    except ModetuneError:
        return False
    rigid = int(np.count_nonzero(found.frequencies_hz == 0.0))
    few = found.select(np.arange(min(found.n_modes, rigid + len(known.modes.frequencies_hz))))
    return abs(difference(half, few).worst) >= abs(apart.worst)


def compared_nodes(deck: NastranDeck, known: Reference | None) -> tuple[int, ...]:
    """Return nodes whose results are in the basic frame: of the reference, if it has shapes."""
    wanted = set() if known is None else set(known.modes.nodes.tolist())
    nodes = []
    for card in deck.named("GRID"):
        number, frame = deck.number(card, IDENT), deck.number(card, FRAME)
        if number is not None and not frame:
            nodes.append(int(number))
    chosen = sorted(wanted.intersection(nodes)) or sorted(nodes)[:NODES]
    return tuple(chosen[:: max(len(chosen) // SHAPE_NODES, 1)])


def solve(solver: Solver, folder: Path, nodes: tuple[int, ...] = (), at_least: int = 0) -> ModeSet:
    """Modes at these nodes, rigid ones at 0 Hz. Raises ModetuneError."""
    nodes = nodes or tuple(sorted(solver.deck.summary.node_ids))[:NODES]
    for n_modes in (at_least, *MODES) if at_least > MODES[0] else MODES:
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
        frequencies_hz = result.modes.frequencies_hz.copy()
        frequencies_hz[: result.n_rigid] = 0.0
        return replace(result.modes, frequencies_hz=frequencies_hz)
    raise AssertionError


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
    known = [row for row in rows if row.source and not row.outside]
    right = [f"{solver} {sum(solver in row.right for row in known)}" for solver in BINDERS]
    either = sum(bool(row.right) for row in known)
    lines.append(f"with a reference {len(known)}, within 1 %: {', '.join(right)}, either {either}")
    meshed = [f"{solver} {sum(solver in row.meshed for row in known)}" for solver in BINDERS]
    lines.append(f"of the others, within what half the element size changes: {', '.join(meshed)}")
    return "\n".join([*lines, "", *by_element(known)])


def by_element(known: Sequence[Row]) -> Iterator[str]:
    """The decks with a reference by their elements, as a Markdown table."""
    yield "| element | decks | " + " | ".join(
        f"{solver}: right, within a halving, wrong" for solver in BINDERS
    ) + " |"  # fmt: skip
    yield "| --- |" + " --- |" * (1 + len(BINDERS))
    for kind in sorted({kind for row in known for kind in row.elements}):
        own = [row for row in known if kind in row.elements]
        cells = []
        for solver in BINDERS:
            right = sum(solver in row.right for row in own)
            meshed = sum(solver in row.meshed for row in own)
            cells.append(f"{right}, {meshed}, {len(own) - right - meshed}")
        yield f"| {kind} | {len(own)} | {' | '.join(cells)} |"


def table(rows: Iterable[Row]) -> Iterator[str]:
    """The rows as a Markdown table."""
    yield "| deck | read | written back | MYSTRAN | CalculiX | difference | outside | reference |"
    yield "| --- | --- | --- | --- | --- | --- | --- | --- |"
    for row in rows:
        cells = {name: text for name, text in asdict(row).items() if isinstance(text, str)}
        yield "| " + " | ".join(cells.values()) + " |"


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
