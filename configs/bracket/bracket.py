"""Writes the bracket's deck: a base, a wall and a rib of three metals, meshed by gmsh, free.

    python -m modetune.configs.bracket.bracket FOLDER

writes bracket.inp: quadratic tetrahedra (C3D10), mm-t-s. The rib is out of the middle, so that the
bracket lies over itself in one way only.
"""

from __future__ import annotations

import signal
import sys
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from modetune.core.errors import CampaignError
from modetune.core.modes import Floats, Integers

#: Of each part: Young's modulus, MPa; Poisson's ratio; density, t/mm3.
MATERIALS = {
    "BASE": (71000.0, 0.33, 2.70e-9),
    "WALL": (205000.0, 0.29, 7.85e-9),
    "RIB": (112000.0, 0.34, 4.43e-9),
}
#: Edge of the model's tetrahedra, mm.
SIZE = 9.0
#: mm: thickness of both plates, length of the base, width, height of the wall, legs of the rib.
THICK, LENGTH, WIDTH, HEIGHT, LEG = 8.0, 120.0, 80.0, 100.0, 60.0
#: Where the rib begins across the width, and its thickness, mm.
RIB_AT, RIB_THICK = 22.0, 6.0


@dataclass(frozen=True, slots=True)
class TetrahedralMesh:
    """coordinates: (n, 3), mm, of nodes 1 to n; parts: (n_elements, 10) node numbers, by name."""

    coordinates: Floats
    parts: dict[str, Integers]


def mesh(size: float = SIZE, points: Sequence[tuple[float, float, float]] = ()) -> TetrahedralMesh:
    """The bracket in tetrahedra with edges of this length, mm, and nodes at these points.

    Raises CampaignError where gmsh is not installed.
    """
    try:
        import gmsh
    except ImportError as error:
        raise CampaignError("the bracket's mesh requires gmsh: pip install gmsh") from error
    gmsh.initialize(interruptible=False)
    signal.signal(signal.SIGPIPE, signal.SIG_IGN)  # gmsh lets a closed pipe end the process
    try:
        gmsh.option.setNumber("General.Terminal", 0)
        shape = gmsh.model.occ
        solids = [
            (3, shape.addBox(0, 0, 0, LENGTH, WIDTH, THICK)),
            (3, shape.addBox(0, 0, THICK, THICK, WIDTH, HEIGHT)),
            (3, _rib(shape)),
        ]
        _, made = shape.fragment(solids, [(0, shape.addPoint(*point)) for point in points])
        shape.synchronize()
        gmsh.option.setNumber("Mesh.MeshSizeMax", size)
        gmsh.option.setNumber("Mesh.MeshSizeMin", size / 2.0)
        gmsh.model.mesh.generate(3)
        gmsh.model.mesh.setOrder(2)
        numbers, places, _ = gmsh.model.mesh.getNodes()
        rank = np.zeros(int(numbers.max()) + 1, dtype=np.int64)
        rank[np.asarray(numbers, dtype=np.int64)] = np.arange(1, numbers.size + 1)
        parts = {}
        for name, pieces in zip(MATERIALS, made, strict=False):
            held = [gmsh.model.mesh.getElements(3, tag)[2][0] for _, tag in pieces]
            table = rank[np.concatenate(held).astype(np.int64)].reshape(-1, 10)
            parts[name] = table[:, [0, 1, 2, 3, 4, 5, 6, 7, 9, 8]]  # CalculiX's order of edges
    finally:
        gmsh.finalize()
    return TetrahedralMesh(np.reshape(places, (-1, 3)), parts)


def _rib(shape: Any) -> int:
    """A right triangle between base and wall, drawn across the width."""
    corners = [(THICK, THICK), (THICK + LEG, THICK), (THICK, THICK + LEG)]
    points = [shape.addPoint(x, RIB_AT, z) for x, z in corners]
    lines = [shape.addLine(points[k], points[(k + 1) % 3]) for k in range(3)]
    face = shape.addPlaneSurface([shape.addCurveLoop(lines)])
    swept = shape.extrude([(2, face)], 0, RIB_THICK, 0)
    return next(int(tag) for dimension, tag in swept if dimension == 3)


def calculix_deck(model: TetrahedralMesh) -> str:
    """The deck: a set and a material a part, and fifteen modes; BASE_NEAR has the metal of BASE."""
    lines = ["*HEADING", "Bracket of three metals; mm, t, s", "*NODE, NSET=NALL"]
    lines += _rows([n, *place] for n, place in enumerate(model.coordinates.tolist(), start=1))
    first = 1
    for name, table in model.parts.items():
        lines.append(f"*ELEMENT, TYPE=C3D10, ELSET={name}")
        lines += _rows([n, *row] for n, row in enumerate(table.tolist(), start=first))
        first += len(table)
    for name in model.parts:
        modulus, ratio, density = MATERIALS[name.partition("_")[0]]
        lines += [f"*MATERIAL, NAME={name}", "*ELASTIC", f"{modulus}, {ratio}"]
        lines += ["*DENSITY", f"{density}", f"*SOLID SECTION, ELSET={name}, MATERIAL={name}"]
    return "\n".join([*lines, "*STEP", "*FREQUENCY", "15", "*END STEP", ""])


def _rows(table: Iterable[list[float]]) -> list[str]:
    return [", ".join(f"{entry:.10g}" for entry in row) for row in table]


def write_decks(folder: Path) -> None:
    """Write bracket.inp."""
    (folder / "bracket.inp").write_text(calculix_deck(mesh()))


if __name__ == "__main__":
    write_decks(Path(sys.argv[1]))
