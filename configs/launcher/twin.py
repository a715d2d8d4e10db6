"""Makes the launcher's test data: the coarse launcher with moduli that no campaign knows.

    python -m modetune.configs.launcher.twin FOLDER

writes measured.csv (0.2 % noise on frequencies, 2 % of each shape's root mean square on its
entries, seeded) and exact.csv as they stand beside this file, by one run of CalculiX. The moduli
are such that the model's first three frequencies are off as in the thesis's Table 23.
"""

from __future__ import annotations

import sys
import tempfile
import threading
from dataclasses import replace
from pathlib import Path

import numpy as np

from modetune.adapters.calculix.solver import calculix_solver
from modetune.adapters.modes_csv import write_modes_csv
from modetune.adapters.process import run_process
from modetune.adapters.solver import ModalAnalysis
from modetune.configs.launcher.launcher import COARSE, SENSORS, Mesh, write_deck
from modetune.core.modes import ModeSet
from modetune.core.parameters import Parameter
from modetune.core.results import ModalResult

#: Young's moduli relative to the model's 71,000 MPa, by material.
TRUTH = {
    "BASE": 0.90, "ARMS": 0.78, "GUSSETS": 1.15, "FITTING": 0.80, "RAIL_BOTTOM": 0.85,
    "RAIL_WEB": 0.92, "RAIL_TOP": 1.08, "RIBS": 0.80, "DUCT": 0.90, "GUIDES": 1.10,
}  # fmt: skip
N_MEASURED = 6
SEED = 2026
FREQUENCY_NOISE = 0.002
SHAPE_NOISE = 0.02


def truth_modes(mesh: Mesh = COARSE) -> ModeSet:
    """The first six modes of the true launcher at the sensors, by CalculiX; mass-normalised."""
    parameters = tuple(
        Parameter(name, "youngs_modulus", "material", (name,), 0.5, 2.0, 0.2) for name in TRUTH
    )
    analysis = ModalAnalysis(N_MEASURED + 2, tuple(range(1, len(SENSORS) + 1)))
    with tempfile.TemporaryDirectory(prefix="modetune-") as name:
        folder = Path(name)
        deck = folder / "twin.inp"
        with deck.open("wb") as file:
            write_deck(file, mesh)
        solver = calculix_solver(deck, parameters)
        solver.write(TRUTH, analysis, folder)
        finished = run_process(solver.command(1), folder, 3600.0, threading.Event())
        result = solver.read(TRUTH, analysis, folder, finished.return_code)
    assert isinstance(result, ModalResult)
    return result.elastic.select(range(N_MEASURED))


def noisy(modes: ModeSet) -> ModeSet:
    """The same modes as a test would measure them."""
    noise = np.random.default_rng(SEED)
    shapes = _signed(modes).mode_shapes
    rms = np.sqrt(np.mean(shapes**2, axis=0))
    return replace(
        modes,
        frequencies_hz=modes.frequencies_hz
        * (1.0 + FREQUENCY_NOISE * noise.standard_normal(modes.n_modes)),
        mode_shapes=shapes + SHAPE_NOISE * rms * noise.standard_normal(shapes.shape),
        normalisation="unknown",
    )


def _signed(modes: ModeSet) -> ModeSet:
    """The solver's sign means nothing; with one of our own the files can be made anywhere."""
    largest = np.argmax(np.abs(modes.mode_shapes), axis=0)
    signs = np.sign(modes.mode_shapes[largest, np.arange(modes.n_modes)])
    return replace(modes, mode_shapes=modes.mode_shapes * signs)


def write_twin(folder: Path, mesh: Mesh = COARSE) -> None:
    """Write both test files."""
    modes = truth_modes(mesh)
    said = [
        "Test of the true launcher, made by twin.py; the first 6 modes at 26 triaxial sensors",
        "relative to the model: " + ", ".join(f"{name} {value:g}" for name, value in TRUTH.items()),
    ]
    numbers = range(1, N_MEASURED + 1)
    write_modes_csv(folder / "exact.csv", numbers, _signed(modes), [*said, "exact"])
    write_modes_csv(
        folder / "measured.csv", numbers, noisy(modes),
        [*said, f"noise: frequencies {FREQUENCY_NOISE}, shapes {SHAPE_NOISE}, seed {SEED}"],
    )  # fmt: skip


if __name__ == "__main__":
    write_twin(Path(sys.argv[1]))
