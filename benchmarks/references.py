"""Normal modes that another program computed for a deck, from files next to it.

Sources, in this order: an OP2 or F06 file of the deck's name, with shapes where it has them; a
table `*references.csv` in one of the folders above (columns deck, source, mode, frequency_hz),
whose first column ends the deck's path.
"""

from __future__ import annotations

import csv
import re
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
from scipy.optimize import linear_sum_assignment

from modetune.adapters.nastran.deck import NastranDeck, read_deck
from modetune.adapters.nastran.f06 import read_f06
from modetune.adapters.nastran.model import REDUCTIONS
from modetune.adapters.nastran.op2 import read_op2
from modetune.adapters.nastran.results import unit_modes
from modetune.core.correlation.correlation import mac
from modetune.core.errors import ModelError, ModetuneError
from modetune.core.modes import Floats, ModeSet

#: Modes of the reference below this share of the first elastic frequency found are rigid.
RIGID = 0.1
#: Number of compared elastic modes.
COMPARED = 10
#: Number of rigid modes of a free structure.
N_RIGID = 6
#: Shapes are compared from this number of degrees of freedom a mode.
FREEDOMS = 3
#: A pair of shapes below this MAC is no pair.
PAIRED = 0.5
#: A mode whose largest compared motion is below this share of its largest is not seen.
AT_REST = 1e-3
#: What is right, as a share of a frequency.
RIGHT = 0.01
#: A file names its program within these bytes.
HEAD = 10_000
#: Solutions whose table of real eigenvalues is not of normal modes: buckling.
BUCKLING = re.compile(r"\s*SOL\s+(105|5|SEBUCKL)\b", re.IGNORECASE)
#: Parts of a deck, each of which Nastran reduces to its boundary and, if asked, some of its modes.
SUPERELEMENTS = re.compile(r"^\s*(BEGIN\s+(BULK\s+)?SUPER|SESET\b)", re.IGNORECASE | re.MULTILINE)


@dataclass(frozen=True, slots=True)
class Reference:
    """Modes of a deck by another program; without shapes n_dof is 0."""

    source: str
    modes: ModeSet


@dataclass(frozen=True, slots=True)
class Difference:
    """How far modes are from the reference's: worst relative error, or why they cannot be right."""

    worst: float
    reason: str = ""

    @property
    def right(self) -> bool:
        return not self.reason and abs(self.worst) <= RIGHT

    def __str__(self) -> str:
        return self.reason or f"{100.0 * self.worst:+.2g} %"


def reference(path: Path) -> Reference | None:
    """Return the normal modes that lie next to a deck, None without any.

    Those of a reduced model (ASET, OMIT, superelements) are not the ones of the whole model, which
    modetune runs.
    """
    try:
        deck = read_deck(path)
    except ModelError:
        return None
    parts = SUPERELEMENTS.search(path.read_text(encoding="latin-1"))
    if _buckles(deck) or deck.named(*REDUCTIONS) or parts:
        return None
    for other in sorted(path.parent.iterdir()):
        if other.stem.lower() != path.stem.lower() or other == path:
            continue
        modes = _printed(other)
        if modes is not None and modes.n_modes:
            return Reference(other.name, modes)
    for folder in path.parents:
        for table in sorted(folder.glob("*references.csv")):
            for name, (source, frequencies_hz) in _table(table).items():
                if path.as_posix().endswith(f"/{name}"):
                    return Reference(source, _frequencies(np.array(frequencies_hz)))
    return None


def difference(found: ModeSet, wanted: ModeSet) -> Difference:
    """Compare elastic modes one to one: by MAC where both have shapes, otherwise in order.

    Of the modes found, those at 0 Hz are rigid.
    """
    mine = found.select(np.flatnonzero(found.frequencies_hz > 0.0))
    floor = RIGID * float(mine.frequencies_hz.min(initial=np.inf))
    rigid = wanted.frequencies_hz < floor
    if rigid.any() and np.count_nonzero(rigid) != found.n_modes - mine.n_modes:
        text = f"{found.n_modes - mine.n_modes} rigid modes in place of {np.count_nonzero(rigid)}"
        return Difference(np.nan, text)
    theirs = wanted.select(np.flatnonzero(~rigid)[:COMPARED])
    if mine.n_modes < theirs.n_modes:
        return Difference(np.nan, f"{theirs.n_modes - mine.n_modes} modes are missing")
    if not theirs.n_modes:
        return Difference(0.0)
    columns = np.arange(theirs.n_modes)
    common = np.array([dof in set(dofs(mine)) for dof in dofs(theirs)], dtype=np.bool_)
    place = {dof: row for row, dof in enumerate(dofs(mine))}
    rows = [place[dof] for dof, both in zip(dofs(theirs), common, strict=True) if both]
    shapes, own = theirs.mode_shapes[common], mine.mode_shapes[rows]
    seen = bool(np.abs(shapes).any(axis=0).all() and np.abs(own).any(axis=0).all())
    if seen and len(rows) >= FREEDOMS * theirs.n_modes:
        table = mac(shapes, own)
        # CalculiX has no rotations: what only they show is paired by its frequency.
        at_rest = np.abs(shapes).max(axis=0) < AT_REST * np.abs(theirs.mode_shapes).max(axis=0)
        near = 1.0 - np.abs(mine.frequencies_hz[None] / theirs.frequencies_hz[:, None] - 1.0)
        table[at_rest] = np.maximum(near[at_rest], 0.0)
        _, columns = linear_sum_assignment(-table)
        # Within a cluster only the span is defined, and its frequencies are alike.
        shared = np.where(near > 1.0 - RIGHT, table, 0.0).sum(axis=1)
        pairs = np.maximum(table[np.arange(columns.size), columns], shared)
        if (pairs < PAIRED).any():
            lost = theirs.frequencies_hz[np.argmin(pairs)]
            return Difference(np.nan, f"no mode has the shape of the one at {lost:.4g} Hz")
    apart = mine.frequencies_hz[columns] / theirs.frequencies_hz - 1.0
    return Difference(float(apart[np.argmax(np.abs(apart))]))


def needed(wanted: ModeSet) -> int:
    """Return the number of modes to compute for a comparison with these."""
    return min(wanted.n_modes, N_RIGID + COMPARED)


def dofs(modes: ModeSet) -> list[tuple[int, int]]:
    """Return node and component of each row of the shapes."""
    return list(zip(modes.nodes.tolist(), modes.components.tolist(), strict=True))


def _buckles(deck: NastranDeck) -> bool:
    return any(BUCKLING.match(deck.lines[place].text) for place in deck.executive)


def _printed(path: Path) -> ModeSet | None:
    """Return the modes in a result file, None where it is none or has no modes.

    MYSTRAN is a solver of this survey, so its files are no reference. Its OP2 files do not name it.
    """
    if path.suffix.lower() not in (".op2", ".f06"):
        return None
    text = path.with_suffix(".F06") if path.with_suffix(".F06").exists() else path
    if b"MYSTRAN" in text.read_bytes()[:HEAD] or "mystran" in path.parent.name.lower():
        return None
    try:
        if path.suffix.lower() == ".op2":
            found = read_op2(path)
        else:
            found = read_f06(path).modes
        values = found.eigenvalues
    except (ModetuneError, ValueError):
        return None
    try:
        return unit_modes(found)
    except ValueError:  # not every mode has a shape
        return _frequencies(np.sqrt(np.maximum(values, 0.0)) / (2.0 * np.pi))


def _frequencies(frequencies_hz: Floats) -> ModeSet:
    none = np.zeros(0, dtype=np.int64)
    shapes = np.zeros((0, frequencies_hz.size))
    return ModeSet(np.asarray(frequencies_hz), shapes, none, none, np.zeros(0))


@cache
def _table(path: Path) -> dict[str, tuple[str, list[float]]]:
    """Return source and frequencies in Hz of each deck of a table."""
    found: dict[str, tuple[str, list[float]]] = {}
    with path.open(newline="") as stream:
        for row in csv.DictReader(stream):
            found.setdefault(row["deck"], (row["source"], []))[1].append(float(row["frequency_hz"]))
    return found
