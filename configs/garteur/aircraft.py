"""The GARTEUR SM-AG19 testbed as solid elements, from its published dimensions.

An aluminium aircraft of plates on a box (Balmes and Wright 1997; dimensions as four independent
models of it agree): fuselage 1500 x 50 x 150 mm, wing 2000 x 100 x 10 mm on top of it with its
middle 600 mm from the nose, wing-tip drums 400 x 100 x 10 mm on the wing at y = +-950 mm, fin
300 mm high and 10 mm thick at the tail end, tailplane 400 x 100 x 10 mm on the fin. Parts share
nodes at their joints. Each part is a property group with its own material.

x runs from nose to tail, y to starboard, z up, z = 0 on the fuselage axis; units mm, t, s (MPa).
The constraining layer, the added masses and the steel wing plate of the real structure are left
out, as in the thesis's model.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]

YOUNGS_MODULUS = 71_000.0
POISSONS_RATIO = 0.3
DENSITY = 2.81e-9
GROUPS = ("FUSELAGE", "WING", "FIN", "TAILPLANE", "DRUMS")


@dataclass(frozen=True, slots=True)
class AircraftMesh:
    """Mesh sizes in mm: in the plates' planes, the number of layers through a plate, and the
    height of the fuselage's elements."""

    size: float
    layers: int
    fuselage_height: float


#: 28,374 nodes and 20,580 elements (the thesis's model: 29,028 and 20,540).
FINE = AircraftMesh(size=10.0, layers=2, fuselage_height=10.0)
#: 2,356 nodes and 1,108 elements, for tests.
COARSE = AircraftMesh(size=25.0, layers=1, fuselage_height=50.0)
MESHES = {"fine": FINE, "coarse": COARSE}


@dataclass(frozen=True, slots=True)
class AircraftBlock:
    """A rectangular block of one group: the grid lines of its elements along each axis."""

    group: str
    x: Floats
    y: Floats
    z: Floats


@dataclass(frozen=True, slots=True)
class Aircraft:
    """nodes: (n_nodes, 3), mm, numbered from 1; elements: (n, 8) node numbers of each group."""

    nodes: Floats
    elements: dict[str, Integers]


def _lines(*stations: float, size: float) -> Floats:
    """Grid lines through all stations, evenly spaced at about `size` between them."""
    pieces = [np.array(stations[:1])]
    for start, end in pairwise(stations):
        count = max(1, round((end - start) / size))
        pieces.append(np.linspace(start, end, count + 1)[1:])
    return np.asarray(np.concatenate(pieces))


def _mirrored(lines: Floats) -> Floats:
    """Lines at both signs; the first may be 0."""
    return np.asarray(np.unique(np.concatenate([-lines, lines])))


def blocks(mesh: AircraftMesh) -> list[AircraftBlock]:
    """The aircraft's blocks; grid lines of neighbours coincide on their common faces."""
    size = mesh.size
    fin_half = [0.0, 5.0] if mesh.layers == 2 else [5.0]
    across = [*fin_half, *_lines(5.0, 25.0, size=min(size, 20.0))[1:]]
    wing_x = _lines(550.0, 650.0, size=size)
    tail_x = _lines(1400.0, 1500.0, size=size)
    wing_y = _lines(25.0, 900.0, 1000.0, size=size)
    tail_y = _lines(5.0, 200.0, size=size)
    drum = (_lines(400.0, 550.0, 650.0, 800.0, size=size), _lines(900.0, 1000.0, size=size))

    def plate(bottom: float) -> Floats:
        return np.linspace(bottom, bottom + 10.0, mesh.layers + 1)

    return [
        AircraftBlock(
            "FUSELAGE",
            _lines(0.0, 550.0, 650.0, 1400.0, 1500.0, size=size),
            _mirrored(np.array(across)),
            _lines(-75.0, 75.0, size=mesh.fuselage_height),
        ),
        AircraftBlock("WING", wing_x, _mirrored(np.concatenate([across, wing_y[1:]])), plate(75.0)),
        AircraftBlock("FIN", tail_x, _mirrored(np.array(fin_half)), _lines(75.0, 375.0, size=size)),
        AircraftBlock(
            "TAILPLANE", tail_x, _mirrored(np.array([*fin_half, *tail_y[1:]])), plate(375.0)
        ),
        AircraftBlock("DRUMS", drum[0], drum[1], plate(85.0)),
        AircraftBlock("DRUMS", drum[0], -drum[1][::-1], plate(85.0)),
    ]


def aircraft(mesh: AircraftMesh) -> Aircraft:
    """Nodes and elements; nodes at one place are one node."""
    points, cells = [], []
    offset = 0
    for block in blocks(mesh):
        grid = np.stack(np.meshgrid(block.x, block.y, block.z, indexing="ij"), axis=-1)
        shape = (block.x.size, block.y.size, block.z.size)
        numbers = offset + np.arange(grid[..., 0].size).reshape(shape)
        corners = [
            numbers[i : shape[0] - 1 + i, j : shape[1] - 1 + j, k : shape[2] - 1 + k].ravel()
            for k in (0, 1)
            for i, j in ((0, 0), (1, 0), (1, 1), (0, 1))
        ]
        points.append(grid.reshape(-1, 3))
        cells.append((block.group, np.stack(corners, axis=1)))
        offset += numbers.size
    nodes, merged = np.unique(np.round(np.concatenate(points), 6), axis=0, return_inverse=True)
    merged = merged.ravel() + 1
    elements = {
        group: np.concatenate([merged[corners] for name, corners in cells if name == group])
        for group in GROUPS
    }
    return Aircraft(np.asarray(nodes, dtype=np.float64), elements)


def calculix_deck(mesh: AircraftMesh) -> str:
    """The aircraft as a complete CalculiX deck, free-free, first 18 modes."""
    model = aircraft(mesh)
    lines = ["*HEADING", "GARTEUR SM-AG19 testbed; units mm, t, s, MPa", "*NODE, NSET=NALL"]
    places = enumerate(model.nodes.tolist(), 1)
    lines += [f"{i}, {x:.10g}, {y:.10g}, {z:.10g}" for i, (x, y, z) in places]
    first = 1
    for group in GROUPS:
        lines.append(f"*ELEMENT, TYPE=C3D8I, ELSET={group}")
        rows = model.elements[group].tolist()
        lines += [str([number, *row])[1:-1] for number, row in enumerate(rows, first)]
        first += len(rows)
    for group in GROUPS:
        lines += [
            f"*MATERIAL, NAME={group}",
            "*ELASTIC",
            f"{YOUNGS_MODULUS:.1f}, {POISSONS_RATIO}",
            "*DENSITY",
            f"{DENSITY}",
            f"*SOLID SECTION, ELSET={group}, MATERIAL={group}",
        ]
    lines += ["*STEP", "*FREQUENCY", "18", "*NODE FILE", "U", "*END STEP"]
    return "\n".join(lines) + "\n"


def write_decks(folder: Path) -> None:
    """Write garteur_coarse.inp and garteur_fine.inp."""
    for name, mesh in MESHES.items():
        (folder / f"garteur_{name}.inp").write_text(calculix_deck(mesh), encoding="utf-8")


def node_at(model: Aircraft, places: Iterable[tuple[float, float, float]]) -> list[int]:
    """Numbers of the nodes nearest to these places, mm."""
    return [int(np.argmin(np.sum((model.nodes - place) ** 2, axis=1))) + 1 for place in places]
