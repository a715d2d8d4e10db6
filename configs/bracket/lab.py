"""Makes a lab's data of the bracket: 69 channels, two hammer points, local axes.

    python -m modetune.configs.bracket.lab FOLDER

writes lab.unv, a universal file: accelerances at 23 triaxial accelerometers, 1 % noise, seed 2026,
of a bracket that is not the model: tetrahedra of two thirds the size, moduli that no campaign knows
(TRUTH). The lab numbers its points from 1, measures in metres, and its axes are turned and moved.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from modetune.adapters.solver import ModalAnalysis
from modetune.adapters.test_files.universal.file import write_universal
from modetune.configs.bracket.bracket import (
    HEIGHT,
    LENGTH,
    MATERIALS,
    RIB_AT,
    RIB_THICK,
    THICK,
    WIDTH,
    calculix_deck,
    mesh,
)
from modetune.configs.measuring import accelerances, noisy_functions, true_modes
from modetune.core.measurement.measurement import Measurement, TestGeometry
from modetune.core.modes import ModeSet
from modetune.core.parameters import Parameter

#: Young's moduli relative to the deck's.
TRUTH = {"BASE": 0.93, "WALL": 1.06, "RIB": 0.85}
#: Edge of the true bracket's tetrahedra, mm.
SIZE = 6.0
SEED, NOISE, DAMPING = 2026, 0.01, 0.005
#: How well the lab knows its points, mm.
POINT_NOISE_MM = 0.5
#: Elastic modes of the responses, in addition to the six rigid ones, which respond between
#: resonances; those above the measured band are the residual.
N_MODES = 16
#: Lowest and highest frequency of the identification, Hz.
BAND_HZ = (1000.0, 7400.0)
LINES_HZ = np.arange(800.0, 7600.0, 4.0)
MIDDLE = RIB_AT + RIB_THICK / 2.0
#: The accelerometers' places, mm: on the base, on the back and the top of the wall, on the rib.
POINTS: tuple[tuple[float, float, float], ...] = (
    *((x, y, THICK) for x in (30.0, 60.0, 90.0, LENGTH) for y in (0.0, 55.0, WIDTH)),
    *((0.0, y, z) for z in (35.0, 70.0) for y in (0.0, MIDDLE, 55.0, WIDTH)),
    *((0.0, y, HEIGHT + THICK) for y in (0.0, WIDTH)),
    (38.0, MIDDLE, 38.0),
)
#: Lines between the points.
OUTLINE = (
    (1, 2), (2, 3), (4, 5), (5, 6), (7, 8), (8, 9), (10, 11), (11, 12), (1, 4), (4, 7), (7, 10),
    (2, 5), (5, 8), (8, 11), (3, 6), (6, 9), (9, 12), (13, 14), (14, 15), (15, 16), (17, 18),
    (18, 19), (19, 20), (13, 17), (14, 18), (15, 19), (16, 20), (17, 21), (20, 22), (21, 22),
    (1, 13), (3, 16),
)  # fmt: skip
#: A point x of the model, mm, is LAB_AXES @ (x - LAB_ORIGIN) / 1000 in the lab's file.
LAB_AXES = Rotation.from_euler("xyz", (90.0, 0.0, 50.0), degrees=True).as_matrix()
LAB_ORIGIN = np.array((LENGTH, 0.0, -40.0))
#: Where the hammer strikes: number of the point and component in the lab's axes.
HAMMERS = ((12, 2), (21, 1))


def true_bracket_modes() -> tuple[ModeSet, list[int]]:
    """The true bracket's modes by CalculiX, six rigid ones first, mass-normalised, and the points'
    nodes."""
    model = mesh(SIZE, POINTS)
    off = np.linalg.norm(model.coordinates[None] - np.array(POINTS)[:, None], axis=2)
    nodes = [int(node) for node in np.argmin(off, axis=1) + 1]
    assert off.min(axis=1).max() < 1e-6
    parameters = tuple(
        Parameter(name, "youngs_modulus", "material", (name,), 0.5, 2.0, 0.2) for name in MATERIALS
    )
    analysis = ModalAnalysis(6 + N_MODES, tuple(sorted(nodes)))
    text = calculix_deck(model)
    modes = true_modes(lambda file: file.write(text.encode()), parameters, TRUTH, analysis, True)
    return modes, nodes


def lab_measurement() -> Measurement:
    """Points and response functions as the lab sends them."""
    random = np.random.default_rng(SEED)
    modes, nodes = true_bracket_modes()
    motion = np.array(
        [modes.mode_shapes[[_row(modes, node, k) for k in (1, 2, 3)]] for node in nodes]
    )  # (n_points, 3, n_modes), the model's axes
    shapes = np.einsum("ij,pjm->pim", LAB_AXES, motion).reshape(-1, modes.n_modes)
    sensors = [(point, k) for point in range(1, len(POINTS) + 1) for k in (1, 2, 3)]
    forces = [shapes[sensors.index(hammer)] for hammer in HAMMERS]
    columns = [accelerances(LINES_HZ, modes, shapes, force, DAMPING) for force in forces]
    places = np.array(POINTS) + POINT_NOISE_MM * random.standard_normal((len(POINTS), 3))
    values = np.concatenate(columns, axis=1)
    return Measurement(
        geometry=TestGeometry(
            nodes=np.arange(1, len(POINTS) + 1),
            coordinates=1e-3 * (places - LAB_ORIGIN) @ LAB_AXES.T,
            frames=np.tile(np.eye(3), (len(POINTS), 1, 1)),
            lines=np.array(OUTLINE),
            metres=1.0,
        ),
        frfs=noisy_functions(LINES_HZ, values, sensors, HAMMERS, NOISE, random),
    )


def _row(modes: ModeSet, node: int, component: int) -> int:
    return int(np.flatnonzero((modes.nodes == node) & (modes.components == component))[0])


def write_lab(folder: Path) -> None:
    """Write lab.unv."""
    write_universal(folder / "lab.unv", lab_measurement())


if __name__ == "__main__":
    write_lab(Path(sys.argv[1]))
