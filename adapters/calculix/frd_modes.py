"""The modes in a result file (.frd) of CalculiX: frequencies in Hz, and displacements at nodes.

Each mode is a block `100C ... MODAL` with its frequency and the number of nodes, and lines ` -1`
with a node in ten columns and three values in twelve each; the block DISP is read.
"""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np

from modetune.adapters.regular_file import open_regular, read_errors
from modetune.core.modes import Floats, Integers, ModeSet, mode_set


def read_frd(path: Path) -> ModeSet:
    """The modes of a file, mass-normalised as ccx writes them. Raises ValueError, with the line."""
    frequencies: list[float] = []
    shapes: list[dict[int, list[float]]] = []
    inside = closed = modal = False
    frequency = 0.0
    with read_errors("it", ValueError):
        with open_regular(path) as file, io.TextIOWrapper(file, encoding="latin-1") as source:
            for number, line in enumerate(source, start=1):
                try:
                    if line.startswith("  100C"):
                        frequency, modal = float(line[12:24]), "MODAL" in line
                    elif line.startswith(" -4"):
                        inside = modal and line[5:13].strip() == "DISP"
                        if inside:
                            frequencies.append(frequency)
                            shapes.append({})
                    elif line.startswith(" -3"):
                        inside = False
                    elif inside and line.startswith(" -1"):
                        motion = [float(line[13 + 12 * k : 25 + 12 * k]) for k in range(3)]
                        shapes[-1][int(line[3:13])] = motion
                    closed = line.strip() == "9999"
                except ValueError as error:
                    raise ValueError(f"line {number}: {error}") from error
    if not shapes or not closed:
        said = "ends before its closing line" if shapes else "holds no displacements of modes"
        raise ValueError(f"it {said}")
    nodes = sorted(shapes[0])
    if any(sorted(shape) != nodes for shape in shapes):
        raise ValueError("its modes are at different nodes")
    values = np.array([[shape[node] for node in nodes] for shape in shapes])
    return mode_set(
        frequencies,
        values.reshape(len(shapes), -1).T,
        np.repeat(nodes, 3),
        np.tile((1, 2, 3), len(nodes)),
        normalisation="mass",
    )


def read_frd_points(path: Path) -> tuple[Integers, Floats]:
    """Nodes (n,) and their coordinates (n, 3), block 2C. Raises ValueError, with the line."""
    nodes: list[int] = []
    places: list[list[float]] = []
    inside = False
    with read_errors("it", ValueError):
        with open_regular(path) as file, io.TextIOWrapper(file, encoding="latin-1") as source:
            for number, line in enumerate(source, start=1):
                try:
                    if inside and line.startswith(" -1"):
                        nodes.append(int(line[3:13]))
                        places.append([float(line[13 + 12 * k : 25 + 12 * k]) for k in range(3)])
                    elif inside:
                        break
                    inside = inside or line.startswith("    2C")
                except ValueError as error:
                    raise ValueError(f"line {number}: {error}") from error
    return np.array(nodes, dtype=np.int64), np.array(places).reshape(-1, 3)
