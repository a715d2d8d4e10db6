"""Makes the launcher's test data: the coarse launcher with moduli that no campaign knows.

    python -m modetune.configs.launcher.twin FOLDER

writes measured.csv (0.2 % noise on frequencies, 2 % of each shape's root mean square on its
entries, seeded) and exact.csv as they stand beside this file, by one run of CalculiX. The moduli
are such that the model's first three frequencies are off as in the thesis's Table 23.
"""

from __future__ import annotations

import sys
from pathlib import Path

from modetune.adapters.solver import ModalAnalysis
from modetune.adapters.test_files.modes_csv import write_modes_csv
from modetune.configs.launcher.launcher import COARSE, SENSORS, LauncherMesh, write_deck
from modetune.configs.measuring import noisy, signed, true_modes
from modetune.core.modes import ModeSet
from modetune.core.parameters import Parameter

#: Young's moduli relative to the model's 71,000 MPa, by material.
TRUTH = {
    "BASE": 0.90, "ARMS": 0.78, "GUSSETS": 1.15, "FITTING": 0.80, "RAIL_BOTTOM": 0.85,
    "RAIL_WEB": 0.92, "RAIL_TOP": 1.08, "RIBS": 0.80, "DUCT": 0.90, "GUIDES": 1.10,
}  # fmt: skip
N_MEASURED = 6
SEED = 2026
FREQUENCY_NOISE = 0.002
SHAPE_NOISE = 0.02


def truth_modes(mesh: LauncherMesh = COARSE) -> ModeSet:
    """The first six modes of the true launcher at the sensors, by CalculiX; mass-normalised."""
    parameters = tuple(
        Parameter(name, "youngs_modulus", "material", (name,), 0.5, 2.0, 0.2) for name in TRUTH
    )
    analysis = ModalAnalysis(N_MEASURED + 2, tuple(range(1, len(SENSORS) + 1)))
    modes = true_modes(lambda file: write_deck(file, mesh), parameters, TRUTH, analysis)
    return modes.select(range(N_MEASURED))


def write_twin(folder: Path, mesh: LauncherMesh = COARSE) -> None:
    """Write both test files."""
    modes = truth_modes(mesh)
    said = [
        "Test of the true launcher, made by twin.py; the first 6 modes at 26 triaxial sensors",
        "relative to the model: " + ", ".join(f"{name} {value:g}" for name, value in TRUTH.items()),
    ]
    numbers = range(1, N_MEASURED + 1)
    write_modes_csv(folder / "exact.csv", numbers, signed(modes), [*said, "exact"])
    write_modes_csv(
        folder / "measured.csv",
        numbers,
        noisy(signed(modes), FREQUENCY_NOISE, SHAPE_NOISE, SEED),
        [*said, f"noise: frequencies {FREQUENCY_NOISE}, shapes {SHAPE_NOISE}, seed {SEED}"],
    )


if __name__ == "__main__":
    write_twin(Path(sys.argv[1]))
