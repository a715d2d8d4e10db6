"""Makes the launcher's test data: another model than the campaigns', of another mesh and joints.

    python -m modetune.configs.launcher.twin FOLDER

writes measured.csv, the copy in this folder (0.2 % noise on frequencies, 2 % of each shape's
root mean square on its entries, seeded), by one run of CalculiX.

The true launcher is three bodies with separate meshes, which share no nodes: the base, the
stand and the beam. Where the model's parts share nodes, the stand's feet are tied to the base on
the patches of their bolts only, and the beam lies on four pads between it and the fitting, each of
its own stiffness: flexible joints that the model does not have. It carries masses that the model
does not have, its moduli differ, and it was tested without the control unit that the model carries
on soft mounts. The free numbers (moduli, pads, masses, the unit's mass and frequencies) are from a
search by least squares on reduced models of both, for frequency errors and MAC values before
updating as in the thesis's Tables 22 and 23, and for an end within its bounds.
"""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path
from typing import BinaryIO

import numpy as np

from modetune.adapters.solver import ModalAnalysis
from modetune.adapters.test_files.modes_csv import write_modes_csv
from modetune.configs.launcher.lattice import Lattice, LatticePart, Place, lattice
from modetune.configs.launcher.launcher import (
    SENSORS,
    THICKNESSES,
    X_STATIONS,
    Y_STATIONS,
    Z_STATIONS,
    LauncherModel,
    assembled,
    node_at,
    parts,
    write_model,
)
from modetune.configs.measuring import noisy, signed, true_modes
from modetune.core.modes import ModeSet

#: Young's moduli over the model's 71,000 MPa.
TRUTH = {
    "BASE": 1.145, "ARMS": 1.095, "GUSSETS": 1.014, "FITTING": 1.055, "RAIL_BOTTOM": 0.977,
    "RAIL_WEB": 1.145, "RAIL_TOP": 1.142, "RIBS": 0.907, "DUCT": 1.154, "GUIDES": 1.158,
}  # fmt: skip
#: The same of the pads, which lie between these places of x and y, mm, on the fitting.
PADS = {
    "PAD_FRONT_LEFT": ((0.0, 100.0), (-40.0, 0.0), 0.765),
    "PAD_FRONT_RIGHT": ((0.0, 100.0), (0.0, 60.0), 1.523),
    "PAD_REAR_LEFT": ((-100.0, 0.0), (-40.0, 0.0), 0.106),
    "PAD_REAR_RIGHT": ((-100.0, 0.0), (0.0, 60.0), 0.054),
}
PAD_LOW, PAD_HIGH = 285.0, 300.0
#: Masses, t, that the model does not have; on the guides.
MASSES: dict[Place, float] = {
    (x, y, 415.0): mass
    for x, mass in ((-1200.0, 0.000373), (300.0, 0.00031)) for y in (-80.0, 80.0)
}  # fmt: skip
#: Lengths of the elements' edges of beam, stand and base, mm.
SIZES = (30.0, 26.0, 36.0)
#: Places in x of the bolts' patches of the feet, mm; in y they are from 80 to 180 on both sides.
PATCHES_X = ((-250.0, -150.0), (-50.0, 50.0), (150.0, 250.0))
BEAM = ("RAIL_BOTTOM", "RAIL_WEB", "RAIL_TOP", "RIBS", "DUCT", "GUIDES")
#: Groups whose faces are tied, apart from others of their body.
FEET, SADDLE = "FEET", "SADDLE"
N_MEASURED = 6
SEED = 2026
FREQUENCY_NOISE = 0.002
SHAPE_NOISE = 0.02


def bodies() -> list[tuple[list[LatticePart], Lattice]]:
    """Beam, stand and base, each with its lattice."""
    beam: list[LatticePart] = []
    stand: list[LatticePart] = []
    base: list[LatticePart] = []
    for part in parts():
        if part.group == "FITTING":
            high = (part.high[0], part.high[1], PAD_LOW)
            stand.append(replace(part, high=high))
        elif part.group == "RAIL_BOTTOM":
            (low, high), saddle = (part.low, part.high), 150.0
            for group, x_low, x_high in (
                (part.group, low[0], -saddle),
                (SADDLE, -saddle, saddle),
                (part.group, saddle, high[0]),
            ):
                ends = (x_low, *low[1:]), (x_high, *high[1:])
                beam.append(replace(part, group=group, low=ends[0], high=ends[1]))
        elif part.group == "ARMS" and part.high[2] == part.low[2]:
            stand.append(replace(part, group=FEET))
        else:
            (beam if part.group in BEAM else base if part.group == "BASE" else stand).append(part)
    for group, (x, y, _) in PADS.items():
        low, high = (x[0], y[0], PAD_LOW), (x[1], y[1], PAD_HIGH)
        stand.append(LatticePart(group, low, high, tetrahedra=True))
    heights = sorted((*Z_STATIONS, PAD_LOW))
    lattices = [lattice((X_STATIONS, Y_STATIONS, heights), size) for size in SIZES]
    return list(zip((beam, stand, base), lattices, strict=True))


def write_truth(file: BinaryIO) -> None:
    """Write the true launcher as a complete CalculiX deck."""
    model = assembled(bodies())
    factors = TRUTH | {FEET: TRUTH["ARMS"], SADDLE: TRUTH["RAIL_BOTTOM"]}
    factors |= {group: factor for group, (_, _, factor) in PADS.items()}
    shells = THICKNESSES | {FEET: THICKNESSES["ARMS"], SADDLE: THICKNESSES["RAIL_BOTTOM"]}
    write_model(file, model, factors, shells, [*_ties(model), *_masses(model)])


def _ties(model: LauncherModel) -> list[str]:
    """The base's nodes on the feet's faces, the pads' on the beam's; shells' faces are masters."""
    across = np.abs(model.nodes)
    on_base = np.isin(np.arange(1, len(model.nodes) + 1), model.elements["BASE"][0])
    bolted = on_base & (model.nodes[:, 2] == 20.0) & (across[:, 1] >= 80.0) & (across[:, 1] <= 180)
    bolted &= np.any([(low <= model.nodes[:, 0]) & (model.nodes[:, 0] <= high)
                      for low, high in PATCHES_X], axis=0)  # fmt: skip
    pads = np.unique(np.concatenate([model.elements[group][0].ravel() for group in PADS]))
    slaves = {
        FEET: np.flatnonzero(bolted) + 1,
        SADDLE: pads[model.nodes[pads - 1, 2] == PAD_HIGH],
    }
    lines = []
    for group, nodes in slaves.items():
        lines += [f"*SURFACE, NAME={group}_FACES", f"{group}, SNEG"]
        lines += [f"*SURFACE, NAME={group}_NODES, TYPE=NODE", *map(str, nodes)]
        # Faces lie half a thickness, 5 and 2.5 mm, below their nodes.
        lines.append(f"*TIE, NAME={group}, POSITION TOLERANCE=6, ADJUST=NO")
        lines.append(f"{group}_NODES, {group}_FACES")
    return lines


def _masses(model: LauncherModel) -> list[str]:
    first = sum(len(rows) for kinds in model.elements.values() for rows in kinds) + 1
    lines = []
    for number, (place, mass) in enumerate(MASSES.items()):
        lines.append(f"*ELEMENT, TYPE=MASS, ELSET=MASS_{number}")
        lines.append(f"{first + number}, {node_at(model.nodes, place)}")
        lines += [f"*MASS, ELSET=MASS_{number}", f"{mass:g}"]
    return lines


def truth_modes() -> ModeSet:
    """The first six modes of the true launcher at the sensors, by CalculiX; mass-normalised."""
    analysis = ModalAnalysis(N_MEASURED + 2, tuple(range(1, len(SENSORS) + 1)))
    return true_modes(write_truth, (), {}, analysis).select(range(N_MEASURED))


def write_twin(folder: Path) -> None:
    """Write the test file."""
    values = TRUTH | {group: factor for group, (_, _, factor) in PADS.items()}
    texts = [
        "Test of the true launcher, made by twin.py; the first 6 modes at 26 triaxial sensors",
        "moduli over the model's: " + ", ".join(f"{name} {v:g}" for name, v in values.items()),
        "masses, kg: " + ", ".join(f"{1000 * mass:g} at {at}" for at, mass in MASSES.items()),
        f"noise: frequencies {FREQUENCY_NOISE}, shapes {SHAPE_NOISE}, seed {SEED}",
    ]
    modes = noisy(signed(truth_modes()), FREQUENCY_NOISE, SHAPE_NOISE, SEED)
    write_modes_csv(folder / "measured.csv", range(1, N_MEASURED + 1), modes, texts)


if __name__ == "__main__":
    write_twin(Path(sys.argv[1]))
