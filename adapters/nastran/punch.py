"""Eigenvectors in a punch file, `.pch` of MSC and Simcenter Nastran, `.pnh` of NASTRAN-95.

Cards of 72 columns and a line count. `$` lines head each mode: `$EIGENVECTOR`, `$SUBCASE ID = n`,
`$EIGENVALUE = value  MODE = n`. Each point takes two cards: number, type (G, or S for a scalar
point) and three components, then `-CONT-` and the other three. Of several subcases the first one
is read. A punch file has no end mark; a mode must have all points of the first one.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from modetune.adapters.nastran.eigenvectors import Shape, shape_matrix
from modetune.adapters.nastran.f06_tables import NUMBERS, number
from modetune.core.errors import SolverCrashed
from modetune.core.modes import Floats, Integers

#: Columns 73-80 count the cards; a number that ends there must not be read on into the count.
CARD_WIDTH = 72
FIELD = 18


@dataclass(frozen=True, slots=True)
class PunchedModes:
    """Punched eigenvectors, in the normalisation and the output frame (CD) of the run.

    mode_numbers: (n_modes,); eigenvalues: (n_modes,), (rad/s)^2, NaN where the cards give none;
    nodes, components: (n_dof,), components 1..6; mode_shapes: (n_dof, n_modes).
    """

    mode_numbers: Integers
    eigenvalues: Floats
    nodes: Integers
    components: Integers
    mode_shapes: Floats


def read_eigenvectors(path: Path) -> PunchedModes:
    """Read the eigenvectors of a punch file.

    Raises SolverCrashed where there are none, or where they are not whole or complex.
    """
    try:
        with path.open(encoding="latin-1", newline="\n") as stream:
            modes = _modes(stream.read().splitlines())
        shapes = [mode.shape() for mode in modes]
        if not shapes:
            raise ValueError("it has no $EIGENVECTOR cards")
        nodes, components, mode_shapes = shape_matrix(shapes, len(shapes))
    except (OSError, ValueError, OverflowError) as error:
        raise SolverCrashed(f"{path} holds no punched modes that can be used: {error}") from error
    return PunchedModes(
        mode_numbers=np.array([shape.mode for shape in shapes], dtype=np.int64),
        eigenvalues=np.array([shape.eigenvalue for shape in shapes]),
        nodes=nodes,
        components=components,
        mode_shapes=mode_shapes,
    )


class _Mode:
    """One mode while its cards are read."""

    def __init__(self, number: int, eigenvalue: float) -> None:
        self.number = number
        self.eigenvalue = eigenvalue
        self.points: list[tuple[int, str]] = []
        self.values: list[list[float]] = []

    def take(self, card: str) -> None:
        fields = [card[at : at + FIELD].strip() for at in range(FIELD, CARD_WIDTH, FIELD)]
        if not all(NUMBERS.fullmatch(field) for field in fields if field):
            raise ValueError(f"a card of mode {self.number} is {card.strip()!r}")
        values = [number(field) for field in fields if field]
        point = re.match(r"\s*(\d+)\s+([A-Z])(?:\s|$)", card)
        if point is not None and point.group(2) in ("G", "S") and 1 <= len(values) <= 3:
            self.points.append((int(point.group(1)), point.group(2)))
            self.values.append(values)
        elif card.startswith("-CONT-") and self.values and len(self.values[-1]) == 3 and values:
            self.values[-1] += values
        else:
            raise ValueError(f"a card of mode {self.number} is {card.strip()!r}")

    def shape(self) -> Shape:
        """Raises ValueError where a point is not whole."""
        for (node, kind), values in zip(self.points, self.values, strict=True):
            if len(values) != 6 and kind == "G":
                raise ValueError(f"node {node} of mode {self.number} has {len(values)} components")
        rows = [row + [0.0] * (6 - len(row)) for row in self.values]
        return Shape(
            self.number,
            self.eigenvalue,
            np.array([node for node, _ in self.points], dtype=np.int64),
            np.array([kind == "S" for _, kind in self.points], dtype=np.bool_),
            np.array(rows).reshape(-1, 6),
        )


def _modes(lines: list[str]) -> list[_Mode]:
    modes: list[_Mode] = []
    reading = False
    subcase = 0
    first: int | None = None
    for line in lines:
        card = line[:CARD_WIDTH]
        if not card.startswith("$"):
            if reading and card.strip():
                modes[-1].take(card)
            continue
        words = card[1:].replace("=", " ").split()
        if words[:1] == ["TITLE"]:
            reading = vectors = False
        elif words[:1] == ["EIGENVECTOR"]:
            vectors, reading = True, False
        elif words[:1] in (["DISPLACEMENTS"], ["ELEMENT"], ["SPCF"]):
            vectors = reading = False
        elif words[:2] == ["SUBCASE", "ID"] and len(words) > 2:
            subcase = int(words[2])
        elif words[:1] == ["REAL-IMAGINARY"] or words[:1] == ["MAGNITUDE-PHASE"]:
            raise ValueError("its modes are complex; real normal modes (SOL 103) are needed")
        elif words[:1] == ["EIGENVALUE"] and vectors:
            first = subcase if first is None else first
            reading = subcase == first
            if reading:
                modes.append(_header(words, len(modes) + 1))
    return modes


def _header(words: list[str], expected: int) -> _Mode:
    """The mode of an $EIGENVALUE card; modes are numbered upwards."""
    if len(words) < 4 or words[2] != "MODE":
        raise ValueError(f"a card is {' '.join(words)!r}, not $EIGENVALUE = value MODE = number")
    mode = int(words[3])
    if mode < expected:
        raise ValueError(f"mode {mode} follows where mode {expected} or a later one belongs")
    return _Mode(mode, number(words[1]))
