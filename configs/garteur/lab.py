"""Makes what a test lab would send of the coarse aircraft: its points and response functions.

    python -m modetune.configs.garteur.lab FOLDER

writes the deck aircraft.inp and lab.unv, a universal file: accelerances at 39 sensors from two
shakers, 1 % noise, seed 2026, from CalculiX's modes of the aircraft with moduli that the campaign
does not know (TRUTH). The lab numbers its points from 1, measures in metres from the tail forwards,
and knows its points to 2 mm; one accelerometer at the nose is tilted by 30 degrees.
"""

from __future__ import annotations

import sys
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from modetune.adapters.test_files.universal.file import write_universal
from modetune.configs.claims import Claim
from modetune.configs.garteur.aircraft import COARSE, aircraft, calculix_deck, node_at
from modetune.configs.garteur.twin import truth_modes
from modetune.configs.measuring import accelerances, noisy_functions
from modetune.core.measurement.measurement import Measurement, TestGeometry
from modetune.core.modes import Floats, ModeSet
from modetune.core.storage.campaign_record import CampaignRecord

#: Young's moduli relative to the nominal 71,000 MPa.
TRUTH = {"FUSELAGE": 1.15, "WING": 0.9, "FIN": 0.8, "TAILPLANE": 0.9, "DRUMS": 1.0}
#: Lowest and highest frequency of the identification, Hz.
BAND_HZ = (3.0, 57.0)
#: Identified frequencies, and moduli that the test sees, are to be right within these shares.
IDENTIFIED, UPDATED = 1e-3, 0.02
SEED = 2026
NOISE = 0.01
POINT_NOISE_MM = 2.0
#: Elastic modes of the responses, in addition to the six rigid ones, which respond between
#: resonances; those above the measured band are the residual.
N_MODES = 20
DAMPING = 0.004
LINES_HZ = np.arange(3.0, 60.0, 0.03125)
#: Of each point: its place, mm, and the directions measured there.
POINTS: tuple[tuple[float, float, float, str], ...] = (
    *(
        (x, side * y, 85.0, "z")
        for y in (300.0, 600.0, 875.0)
        for side in (-1, 1)
        for x in (550.0, 650.0)
    ),
    *((x, side * 950.0, 95.0, "xz") for side in (-1, 1) for x in (400.0, 800.0)),
    (0.0, 25.0, 75.0, "z"),
    *((x, 25.0, 75.0, "yz") for x in (375.0, 1000.0, 1500.0)),
    *((x, 5.0, z, "y") for z in (225.0, 375.0) for x in (1400.0, 1500.0)),
    *((x, side * 200.0, 385.0, "xz") for side in (-1, 1) for x in (1400.0, 1500.0)),
)
#: Points joined by lines: edges of the wing, drums, fuselage, fin, tailplane.
OUTLINE = (
    (13, 9, 5, 1, 3, 7, 11, 15), (14, 10, 6, 2, 4, 8, 12, 16), (13, 14), (15, 16),
    (17, 18, 19, 20), (20, 22, 24, 23, 21), (25, 23, 27), (26, 24, 28), (25, 26), (27, 28),
)  # fmt: skip
#: The lab's axes as rows in the aircraft's: x forwards, y to starboard, z upwards; from the tail.
LAB_AXES = np.diag((-1.0, -1.0, 1.0))
TAIL = np.array((1500.0, 0.0, 0.0))
#: The point whose accelerometer is tilted about the aircraft's y axis, and by how much.
TILTED, TILT_DEGREES = 17, 30.0
#: Shakers: at a drum's end upwards, at the fin's top sideways; point numbers and components.
SHAKERS = ((16, 3), (23, 2))


def true_modes() -> ModeSet:
    """The modes that the responses are made of, six rigid ones first, at the lab's points."""
    return truth_modes([point[:3] for point in POINTS], N_MODES, TRUTH, rigid=True)


def lab_measurement() -> Measurement:
    """Points and response functions as the lab sends them."""
    random = np.random.default_rng(SEED)
    places = np.array([point[:3] for point in POINTS])
    nodes = node_at(aircraft(COARSE), [point[:3] for point in POINTS])
    modes = true_modes()
    names = [
        (number, "xyz".index(direction) + 1)
        for number, point in enumerate(POINTS, start=1)
        for direction in point[3]
    ]
    frames = np.tile(LAB_AXES.T, (len(POINTS), 1, 1))  # sensors look along the aircraft's axes
    tilt = Rotation.from_euler("y", TILT_DEGREES, degrees=True).as_matrix()
    frames[TILTED - 1] = tilt @ frames[TILTED - 1]
    at = dict(zip(range(1, len(POINTS) + 1), nodes, strict=True))
    shapes = np.array([_motion(modes, at[point], point, component) for point, component in names])
    forces = [names.index(shaker) for shaker in SHAKERS]
    columns = [accelerances(LINES_HZ, modes, shapes, shapes[row], DAMPING) for row in forces]
    moved = places + POINT_NOISE_MM * random.standard_normal(places.shape)
    return Measurement(
        geometry=TestGeometry(
            nodes=np.arange(1, len(POINTS) + 1),
            coordinates=1e-3 * (moved - TAIL) @ LAB_AXES.T,
            frames=frames,
            lines=np.array([pair for line in OUTLINE for pair in pairwise(line)]),
            metres=1.0,
        ),
        frfs=noisy_functions(
            LINES_HZ, np.concatenate(columns, axis=1), names, SHAKERS, NOISE, random
        ),
    )


def _motion(modes: ModeSet, node: int, number: int, component: int) -> Floats:
    """Motion (n_modes,) along a sensor."""
    direction = np.eye(3)[component - 1]
    if number == TILTED:
        tilt = Rotation.from_euler("y", TILT_DEGREES, degrees=True).as_matrix()
        direction = tilt[component - 1]
    rows = [np.flatnonzero((modes.nodes == node) & (modes.components == k))[0] for k in (1, 2, 3)]
    return np.asarray(direction @ modes.mode_shapes[rows])


def write_lab(folder: Path) -> None:
    """Write lab.unv."""
    write_universal(folder / "lab.unv", lab_measurement())


def write_first_campaign(folder: Path) -> None:
    """Write what docs/first-campaign.md begins with: lab.unv, and the deck aircraft.inp."""
    write_lab(folder)
    (folder / "aircraft.inp").write_text(calculix_deck(COARSE))


def claims(record: CampaignRecord) -> list[Claim]:
    """Compare the results with the truth behind the responses."""
    measured = record.test.modes.frequencies_hz
    truth = true_modes().frequencies_hz[6 : 6 + measured.size]
    off = measured / truth - 1.0
    moduli = np.array([TRUTH[name.removeprefix("E_").upper()] for name in record.parameters.names])
    errors = record.updated / moduli - 1.0
    seen = record.standard_errors < UPDATED
    return [
        Claim(
            f"all {measured.size} modes below 57 Hz are identified within {IDENTIFIED:.1%}",
            measured.size == 8 and bool(np.abs(off).max() < IDENTIFIED),
            f"worst {100.0 * np.abs(off).max():.3f} %, two of them 0.1 % apart",
        ),
        Claim(
            f"moduli that the test sees are found within {UPDATED:.0%}",
            bool(seen.sum() >= 3 and np.abs(errors[seen]).max() < UPDATED),
            _listed(record, errors, seen),
        ),
        Claim(
            "what the test does not see is told by its standard error",
            bool(np.all(np.abs(errors[~seen]) < 3.0 * record.standard_errors[~seen])),
            _listed(record, errors, ~seen),
        ),
    ]


def _listed(record: CampaignRecord, errors: Floats, which: NDArray[np.bool_]) -> str:
    return "; ".join(
        f"{name} {100.0 * errors[place]:+.1f} % (standard error "
        f"{100.0 * record.standard_errors[place]:.1f} %)"
        for place, name in enumerate(record.parameters.names)
        if which[place]
    )


if __name__ == "__main__":
    write_first_campaign(Path(sys.argv[1]))
