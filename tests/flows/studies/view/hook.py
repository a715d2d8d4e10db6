"""A hook of bricks, clamped at its foot, and its test in axes that are turned and moved.

    python -m tests.flows.studies.view.hook FOLDER

writes the campaign: deck, modes, points in the test's own axes, response functions, and a campaign
file with comments of its user's.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from modetune.adapters.test_files.geometry_csv import write_geometry_csv
from modetune.adapters.test_files.hdf5 import write_test_hdf5
from modetune.adapters.test_files.modes_csv import write_modes_csv
from modetune.core.measurement.measurement import MeasuredFrfs, Measurement, TestGeometry
from modetune.core.measurement.response_functions import NormalModes, modal_frf
from modetune.core.modes import Floats, Integers, mode_set
from modetune.flows.campaign.campaign import load_campaign
from modetune.flows.updating.mode_source import model_modes

EDGE = 10.0
#: Lowest and highest brick of each block, in x, y, z.
BLOCKS = (((0, 0, 0), (2, 2, 8)), ((2, 0, 6), (7, 2, 8)), ((5, 0, 3), (7, 2, 6)))
#: From the model's axes to the test's: nothing that an eye would guess.
TURN = Rotation.from_euler("xyz", (35.0, -50.0, 110.0), degrees=True)
MOVED = np.array([300.0, -120.0, 40.0])
DAMPING = 0.01
CAMPAIGN = """\
# The hook of the crane in hall 2, tested by Ana in May
name: hook
model: {deck: hook.inp, solver: calculix, units: mm-t-s, eigensolver: solver}   # S355
test:
  modes: [modes.csv, points.csv, frfs.h5]
  length: mm
  use: [1, 2, 3, 4]   # the fifth is weak
  # no idea yet how the test's axes lie
  sensors: {align: none, unmapped: leave_out, rotation: [ROTATION], translation: [MOVED]}
parameters:
  - {name: E_foot, quantity: youngs_modulus, material: FOOT, bounds: [0.5, 1.5]}
  - {name: E_arm, quantity: youngs_modulus, material: ARM, bounds: [0.5, 1.5]}
residuals: {frequency_weight: 1.0, shape_weight: 0.1}
update: {max_iterations: 8}
report: {page: false}
"""


@dataclass(frozen=True, slots=True)
class Hook:
    """Where the campaign stands, and the places (n, 3) of the model's nodes 1 to n."""

    campaign: Path
    coordinates: Floats
    elements: Integers
    sensors: Integers


def bricks() -> tuple[Floats, Integers, Integers]:
    """Nodes, elements (rows of nodes from 0), and whether each is of the foot."""
    cells = sorted(
        {
            (x, y, z)
            for low, high in BLOCKS
            for x in range(low[0], high[0])
            for y in range(low[1], high[1])
            for z in range(low[2], high[2])
        }
    )
    corners = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0, 0, 1], [1, 0, 1], [1, 1, 1],
                        [0, 1, 1]])  # fmt: skip
    grid = (np.array(cells)[:, None] + corners[None]).reshape(-1, 3)
    places, rows = np.unique(grid, axis=0, return_inverse=True)
    foot = np.array([x < 2 for x, _, _ in cells])
    return EDGE * places, rows.reshape(-1, 8), foot


def deck(coordinates: Floats, elements: Integers, foot: Integers, moduli: tuple[float, ...]) -> str:
    lines = ["*NODE"]
    lines += [f"{row}, {x:g}, {y:g}, {z:g}" for row, (x, y, z) in enumerate(coordinates, start=1)]
    for name, of_it in (("FOOT", foot), ("ARM", ~foot)):
        lines.append(f"*ELEMENT, TYPE=C3D8I, ELSET={name}")
        for row in np.flatnonzero(of_it):
            lines.append(f"{row + 1}, " + ", ".join(str(n + 1) for n in elements[row]))
    for name, modulus in zip(("FOOT", "ARM"), moduli, strict=True):
        lines += [f"*MATERIAL, NAME={name}", "*ELASTIC", f"{modulus:g}, 0.3", "*DENSITY",
                  "7.85e-9", f"*SOLID SECTION, ELSET={name}, MATERIAL={name}"]  # fmt: skip
    held = np.flatnonzero(coordinates[:, 2] == 0.0) + 1
    lines += ["*BOUNDARY", *(f"{node}, 1, 3" for node in held)]
    lines += ["*STEP", "*FREQUENCY", "6", "*NODE FILE", "U", "*END STEP", ""]
    return "\n".join(lines)


def write_hook(folder: Path) -> Hook:
    """Deck, test and campaign in a folder; costs one run of CalculiX."""
    coordinates, elements, foot = bricks()
    (folder / "hook.inp").write_text(deck(coordinates, elements, foot, (2.1e5, 2.1e5)))
    (folder / "true.inp").write_text(deck(coordinates, elements, foot, (1.8e5, 2.3e5)))
    free = np.flatnonzero(coordinates[:, 2] > 0.0)
    sensors = free[:: free.size // 14][:14]
    nodes = np.repeat(sensors + 1, 3)
    components = np.tile([1, 2, 3], sensors.size)

    angles = TURN.inv().as_euler("xyz", degrees=True)
    turned = TURN.inv()
    told = CAMPAIGN.replace("ROTATION", ", ".join(f"{value:.6f}" for value in angles))
    moved = -turned.apply(MOVED)
    told = told.replace("MOVED", ", ".join(f"{value:.6f}" for value in moved))
    campaign = folder / "hook.yaml"
    campaign.write_text(told)

    points = TURN.apply(coordinates[sensors]) + MOVED
    numbers = 100 + np.arange(1, sensors.size + 1)
    lines = np.stack([numbers[:-1], numbers[1:]], axis=1)
    geometry = TestGeometry(numbers, points, np.tile(np.eye(3), (sensors.size, 1, 1)), lines,
                            np.zeros((0, 3), dtype=np.int64), 0.001)  # fmt: skip
    write_geometry_csv(folder / "points.csv", geometry)
    # The modes of the true hook at the sensors, by its own campaign.
    true = folder / "true.yaml"
    true.write_text(
        "name: real\nmodel: {deck: true.inp, solver: calculix, units: mm-t-s}\n"
        "test: {modes: modes.csv}\n"
        "parameters: [{name: E, quantity: youngs_modulus, material: FOOT, bounds: [0.5, 2]}]\n"
    )
    blank = mode_set([1.0] * 5, np.ones((nodes.size, 5)), nodes, components)
    write_modes_csv(folder / "modes.csv", tuple(range(1, 6)), blank, ())
    of_true = load_campaign(true)
    found = of_true.case.sensors.observe(model_modes(of_true, {"E": 1.0}).elastic)
    shapes = found.mode_shapes[:, :5].reshape(sensors.size, 3, 5)
    seen = np.einsum("ij,pjm->pim", TURN.as_matrix(), shapes).reshape(-1, 5)
    hz = found.frequencies_hz[:5]
    at_points = np.repeat(numbers, 3)
    write_modes_csv(
        folder / "modes.csv", tuple(range(1, 6)), mode_set(hz, seen, at_points, components), ()
    )
    at = np.linspace(0.6 * hz[0], 1.1 * hz[-1], 1500)
    modes = NormalModes((2.0 * np.pi * hz) ** 2, seen, np.full(5, DAMPING))
    values = modal_frf(at, modes, np.arange(nodes.size), np.array([0]), "accelerance")
    values = values.reshape(at.size, -1)
    n, one = nodes.size, np.ones(nodes.size)
    frfs = MeasuredFrfs("accelerance", at, values, at_points, components, one,
                        np.full(n, at_points[0]), np.full(n, 1), one, np.zeros((0, 0)))  # fmt: skip
    write_test_hdf5(folder / "frfs.h5", Measurement(frfs=frfs))
    for name in ("true.inp", "true.yaml"):
        (folder / name).unlink()
    return Hook(campaign, coordinates, elements, sensors)


if __name__ == "__main__":
    write_hook(Path(sys.argv[1]))
