"""Writes the mast's deck: a foot on four soft mounts, a mast, and a head full of instruments.

    python -m modetune.configs.mast.mast FOLDER

writes mast.inp: bricks (C3D8I) on springs at four corners, mm-t-s. A *STATIC step pulls at the head
as the rope of the static test does.
"""

from __future__ import annotations

import sys
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

import numpy as np

from modetune.configs.launcher.lattice import LatticePart, lattice

#: Young's modulus, MPa, and density, t/mm3, of each part; Poisson's ratio is 0.3.
MATERIALS = {"FOOT": (205000.0, 7.85e-9), "MAST": (71000.0, 2.7e-9), "HEAD": (20000.0, 1.5e-9)}
PARTS = (
    LatticePart("FOOT", (0.0, 0.0, 0.0), (200.0, 160.0, 20.0)),
    LatticePart("MAST", (70.0, 60.0, 20.0), (130.0, 100.0, 420.0)),
    LatticePart("HEAD", (50.0, 40.0, 420.0), (150.0, 120.0, 500.0)),
)
STATIONS = (
    (0.0, 50.0, 70.0, 130.0, 150.0, 200.0),
    (0.0, 40.0, 60.0, 100.0, 120.0, 160.0),
    (0.0, 20.0, 420.0, 500.0),
)
SIZE = 20.0
#: Of the springs at a corner: along x and y, and along z, N/mm.
MOUNTS = {"MOUNT_SIDE": ((1, 2), 900.0), "MOUNT_UP": ((3,), 1500.0)}
#: What the rope pulls with along x and y, N.
PULL = (60.0, 40.0)
#: Corners of foot, mast and head with accelerometers and dial gauges, mm.
PLACES = (
    (0.0, 0.0, 20.0), (200.0, 0.0, 20.0), (0.0, 160.0, 20.0), (200.0, 160.0, 20.0),
    (70.0, 60.0, 220.0), (130.0, 100.0, 220.0),
    (50.0, 40.0, 500.0), (150.0, 40.0, 500.0), (50.0, 120.0, 500.0), (150.0, 120.0, 500.0),
)  # fmt: skip


def sensors() -> list[int]:
    """Nodes at the places, in their order."""
    return [_numbers()[_POINTS.key(place)] for place in PLACES]


def calculix_deck(truth: Mapping[str, float] | None = None, frequencies: bool = True) -> str:
    """The deck; truth: what moduli (E_NAME), densities (rho_NAME) and springs are multiplied by;
    frequencies: whether a step asks for ten modes."""
    by = dict(truth or {})
    numbers = _numbers()
    places = _POINTS.coordinates(np.array(list(numbers)))
    lines = ["*HEADING", "Mast on soft mounts; mm, t, s", "*NODE, NSET=NALL"]
    lines += _rows([n, *place] for n, place in zip(numbers.values(), places.tolist(), strict=True))
    first = 1
    for part in PARTS:
        (table,) = _POINTS.elements(part)
        lines.append(f"*ELEMENT, TYPE=C3D8I, ELSET={part.group}")
        rows = [[numbers[key] for key in row] for row in table.tolist()]
        lines += _rows([n, *row] for n, row in enumerate(rows, start=first))
        first += len(rows)
    corners = [numbers[_POINTS.key((x, y, 0.0))] for x in (0.0, 200.0) for y in (0.0, 160.0)]
    for name, (directions, stiffness) in MOUNTS.items():
        for direction in directions:
            lines.append(f"*ELEMENT, TYPE=SPRING1, ELSET={name}_{direction}")
            lines += _rows([first + k, node] for k, node in enumerate(corners))
            first += len(corners)
            lines += [f"*SPRING, ELSET={name}_{direction}", str(direction)]
            lines.append(f"{stiffness * by.get(name, 1.0):.6f}")  # ccx asks for the point
    for name, (modulus, density) in MATERIALS.items():
        lines += [f"*MATERIAL, NAME={name}", "*ELASTIC"]
        lines += [f"{modulus * by.get(f'E_{name}', 1.0):.10g}, 0.3", "*DENSITY"]
        lines.append(f"{density * by.get(f'rho_{name}', 1.0):.10g}")
        lines.append(f"*SOLID SECTION, ELSET={name}, MATERIAL={name}")
    head = sensors()[-1]
    lines += ["*NSET, NSET=GAUGES", *_rows([node] for node in sensors())]
    lines += ["*STEP", "*STATIC", "*CLOAD", f"{head}, 1, {PULL[0]}", f"{head}, 2, {PULL[1]}"]
    lines += ["*NODE PRINT, NSET=GAUGES", "U", "*END STEP"]
    if frequencies:
        lines += ["*STEP", "*FREQUENCY", "10", "*END STEP"]
    return "\n".join([*lines, ""])


_POINTS = lattice(STATIONS, SIZE)


def _numbers() -> dict[int, int]:
    """Node numbers by the lattice's keys."""
    keys = np.unique(np.concatenate([_POINTS.nodes(part) for part in PARTS]))
    return {key: number for number, key in enumerate(keys.tolist(), start=1)}


def _rows(table: Iterable[Sequence[float]]) -> list[str]:
    return [", ".join(f"{entry:.10g}" for entry in row) for row in table]


def write_decks(folder: Path) -> None:
    """Write mast.inp."""
    (folder / "mast.inp").write_text(calculix_deck(), encoding="utf-8")


if __name__ == "__main__":
    write_decks(Path(sys.argv[1]))
