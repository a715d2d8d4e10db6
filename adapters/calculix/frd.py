"""The .frd file of a modal job: requested, checked, read, and converted by ccx2paraview.

ccx2paraview takes missing lines for zeros, so lines are counted before it sees them. It runs as a
separate program (`convert.py`).

Each mode is a block `100C ... MODAL` with its frequency and the number of nodes, and lines ` -1`
with a node in ten columns and three values in twelve each; the block DISP is read.
"""

from __future__ import annotations

import io
import sys
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from modetune.adapters.paraview import ELEMENT, NODE, SHAPE
from modetune.adapters.process import read_log, run_process
from modetune.adapters.regular_file import open_regular, read_errors
from modetune.adapters.solver import Command
from modetune.core.errors import NoResult
from modetune.core.modes import Floats, Integers, ModeSet, mode_set

if TYPE_CHECKING:
    import pyvista

END = "*END STEP\n"
#: Runs ccx2paraview.
CONVERTER = "modetune.adapters.calculix.convert"
#: ccx2paraview's name for displacements.
DISPLACEMENT = "U"
#: Far above what files take that fit a disk: about a minute for a million nodes and a mode.
TIMEOUT_S = 24 * 3600.0
REMEDY = "remove its folder and run the same command again, which takes the shapes from the store"


def with_frd(text: str) -> str:
    """The text of a modal job that writes shapes to its .frd file too.

    Shells and beams as in the deck, not expanded, and all in global axes.
    """
    return text.removesuffix(END) + f"*NODE FILE, OUTPUT=2D, GLOBAL=YES\nU\n{END}"


def convert_frd(frd: Path, n_modes: int, folder: Path) -> Iterator[pyvista.UnstructuredGrid]:
    """The grid of each mode with its shape, as ccx2paraview makes it of a modal job's .frd.

    folder: empty, for files in between. Raises NoResult where the file is not whole.
    """
    import pyvista

    nodes, elements, n_held = count_frd(frd)
    if n_held < n_modes:
        raise NoResult(f"{frd} holds {n_held} modes, {n_modes} were computed: {REMEDY}")
    command = Command((sys.executable, "-P", "-m", CONVERTER, str(frd.resolve())))
    finished = run_process(command, folder, TIMEOUT_S, threading.Event())
    for mode in range(1, n_modes + 1):
        path = folder / f"{mode}.vtu"
        if finished.return_code != 0 or not path.is_file():
            text = read_log(folder).strip().rpartition("\n")[2]
            raise NoResult(f"ccx2paraview could not convert {frd} ({text.strip()}): {REMEDY}")
        grid = pyvista.read(path)
        assert isinstance(grid, pyvista.UnstructuredGrid)
        yield _named(grid, nodes, elements, frd)


def _named(
    grid: pyvista.UnstructuredGrid, nodes: Integers, elements: Integers, frd: Path
) -> pyvista.UnstructuredGrid:
    """A grid of ccx2paraview's with the names that all of modetune's have."""
    shape = np.asarray(grid.point_data[DISPLACEMENT]) if DISPLACEMENT in grid.point_data else None
    sizes = grid.n_points, grid.n_cells
    if shape is None or sizes != (nodes.size, elements.size):
        raise NoResult(f"ccx2paraview made something else of {frd}: {REMEDY}")
    grid.clear_data()
    grid.point_data[SHAPE] = shape
    grid.point_data[NODE] = nodes
    grid.cell_data[ELEMENT] = elements
    return grid


def count_frd(frd: Path) -> tuple[Integers, Integers, int]:
    """Return nodes (n,) and elements (n_elements,) of a .frd file and its number of modes.

    Raises NoResult where it cannot be read or is cut short.
    """
    blocks: dict[str, list[int]] = {"2C": [], "3C": []}
    n_modes, rows, inside, line = 0, 0, "", ""
    try:
        with open_regular(frd) as file, io.TextIOWrapper(file, encoding="latin-1") as source:
            for line in source:
                word = line[:6].strip()
                if inside in blocks and line.startswith(" -1"):
                    blocks[inside].append(int(line[3:13]))
                elif inside == "100C" and line.startswith(" -1"):
                    rows += 1
                elif word in ("2C", "3C", "100C"):
                    inside, rows = word, 0
                elif word == "-3" and inside == "100C":
                    n_modes, inside = n_modes + 1, ""
                    _check_rows(frd, n_modes, rows, len(blocks["2C"]))
                elif word == "-3":
                    inside = ""
    except (OSError, ValueError) as error:
        raise NoResult(f"{frd} cannot be read ({error}): {REMEDY}") from error
    if line.strip() != "9999" or inside or not all(blocks.values()):
        raise NoResult(f"{frd} ends before its closing line: {REMEDY}")
    nodes, elements = (np.array(blocks[name], dtype=np.int64) for name in ("2C", "3C"))
    if (np.diff(nodes) <= 0).any():  # ccx2paraview takes results in ascending order
        raise NoResult(f"{frd}: the nodes do not ascend: {REMEDY}")
    return nodes, elements, n_modes


def _check_rows(frd: Path, mode: int, rows: int, expected: int) -> None:
    if rows != expected:
        raise NoResult(f"{frd}: mode {mode} has shapes at {rows} of {expected} nodes: {REMEDY}")


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
        text = "ends before its closing line" if shapes else "holds no displacements of modes"
        raise ValueError(f"it {text}")
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
