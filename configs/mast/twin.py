"""Makes the mast's three tests: the mast with values that no campaign knows, by CalculiX.

    python -m modetune.configs.mast.twin FOLDER

writes measured.csv and prints the readings of dial gauges and balance in mast.yaml.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

from modetune.adapters.solver import ModalAnalysis
from modetune.adapters.test_files.modes_csv import write_modes_csv
from modetune.configs.claims import Claim
from modetune.configs.mast.mast import MATERIALS, PARTS, calculix_deck, sensors
from modetune.configs.measuring import noisy, signed, true_modes
from modetune.core.modes import Floats, ModeSet
from modetune.core.storage.campaign_record import CampaignRecord

#: Relative to the model.
TRUTH = {"E_MAST": 0.92, "rho_HEAD": 1.3, "MOUNT_SIDE": 1.25, "MOUNT_UP": 0.85}
N_MEASURED = 8
SEED = 2026
FREQUENCY_NOISE, SHAPE_NOISE, GAUGE_NOISE, WEIGHING_NOISE = 0.002, 0.03, 0.01, 0.005
#: Of the campaign's parameters, the true value that each represents.
TRUE_VALUES = {
    "E_mast": TRUTH["E_MAST"],
    "rho_head": TRUTH["rho_HEAD"],
    "k_side": TRUTH["MOUNT_SIDE"],
    "k_up": TRUTH["MOUNT_UP"],
}
#: Standard errors within which all four values lie in 95 of 100 tests: the normal distribution's
#: 1 - 0.05 / 8 quantile (Bonferroni).
JOINT_95 = 2.50
#: Nodes of the head and the foot with gauges.
GAUGES = (47, 518, 2, 558)


def truth_modes() -> ModeSet:
    """The first modes of the true mast at the accelerometers."""
    text = calculix_deck(TRUTH).encode()
    analysis = ModalAnalysis(N_MEASURED, tuple(sensors()))
    return true_modes(lambda file: file.write(text), (), {}, analysis)


def truth_displacements() -> dict[int, Floats]:
    """(3,) at each gauge, mm, by a static run."""
    with tempfile.TemporaryDirectory(prefix="modetune-") as name:
        (Path(name) / "pull.inp").write_text(calculix_deck(TRUTH, frequencies=False))
        subprocess.run(["ccx", "-i", "pull"], cwd=name, check=True, stdout=subprocess.DEVNULL)
        lines = (Path(name) / "pull.dat").read_text().splitlines()
    rows = [line.split() for line in lines if len(line.split()) == 4 and line.split()[0].isdigit()]
    return {int(row[0]): np.array(row[1:], dtype=np.float64) for row in rows}


def truth_mass() -> float:
    """Of the true mast, t: bricks fill their boxes."""
    return sum(
        float(np.prod(np.subtract(part.high, part.low)))
        * MATERIALS[part.group][1]
        * TRUTH.get(f"rho_{part.group}", 1.0)
        for part in PARTS
    )


def claims(record: CampaignRecord) -> list[Claim]:
    """The updated values compared with the true ones, which the campaign does not know."""
    values = zip(record.parameters.names, record.updated, record.standard_errors, strict=True)
    apart = {name: (value - TRUE_VALUES[name]) / error for name, value, error in values}
    trusted = record.trust is not None and record.trust.verdict == "trusted"
    return [
        Claim(
            "the true values are 8 % less, 30 % more, 25 % more and 15 % less than the deck's; the "
            f"updated ones are within {JOINT_95:.1f} standard errors of them (joint 95 % interval)",
            all(abs(distance) <= JOINT_95 for distance in apart.values()),
            ", ".join(f"{name} {distance:+.1f}" for name, distance in apart.items()),
        ),
        Claim(
            "the test determines all four parameters",
            trusted,
            "not judged" if record.trust is None else record.trust.verdict,
        ),
    ]


def write_twin(folder: Path) -> None:
    """Write the modal test, and print the other two."""
    texts = [
        "Test of the true mast, made by twin.py; the first 8 modes at 10 triaxial sensors",
        f"noise: frequencies {FREQUENCY_NOISE}, shapes {SHAPE_NOISE} of their rms, seed {SEED}",
    ]
    measured = noisy(signed(truth_modes()), FREQUENCY_NOISE, SHAPE_NOISE, SEED)
    write_modes_csv(folder / "measured.csv", range(1, N_MEASURED + 1), measured, texts)
    noise = np.random.default_rng(SEED)
    moved = truth_displacements()
    largest = max(float(np.abs(moved[node]).max()) for node in GAUGES)
    for node in GAUGES:
        for name, value in zip("xyz", moved[node].tolist(), strict=True):
            read = value + GAUGE_NOISE * largest * noise.standard_normal()
            sys.stdout.write(f"{node}.{name}: {read:.4f}\n")
    weighed = truth_mass() * (1.0 + WEIGHING_NOISE * noise.standard_normal())
    sys.stdout.write(f"mass: {weighed:.4e}\n")


if __name__ == "__main__":
    write_twin(Path(sys.argv[1]))
