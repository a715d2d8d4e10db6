"""Makes the twin's test data: the coarse aircraft with moduli that the campaign does not know.

    python -m modetune.configs.garteur.twin FOLDER

writes twin_measured.csv (exact) and twin_noisy.csv (0.2 % noise on frequencies, 2 % of each
shape's root mean square on its entries, seed 2026), the copies in this folder.
"""

from __future__ import annotations

import sys
from collections.abc import Iterable, Mapping
from pathlib import Path

from modetune.adapters.solver import ModalAnalysis
from modetune.adapters.test_files.modes_csv import write_modes_csv
from modetune.configs.garteur.aircraft import COARSE, GROUPS, aircraft, calculix_deck, node_at
from modetune.configs.measuring import noisy, true_modes
from modetune.core.modes import ModeSet
from modetune.core.parameters import Parameter

#: Young's moduli relative to the nominal 71,000 MPa.
TRUTH = {"FUSELAGE": 1.20, "WING": 0.85, "FIN": 1.10, "TAILPLANE": 0.90, "DRUMS": 1.25}
N_MEASURED = 8
SEED = 2026
FREQUENCY_NOISE = 0.002
SHAPE_NOISE = 0.02

#: Forty places, mm: wing edges, drum ends, fuselage top, fin, tailplane.
SENSORS: tuple[tuple[float, float, float], ...] = (
    *(
        (x, side * y, 85.0)
        for y in (100.0, 300.0, 500.0, 700.0, 875.0)
        for side in (-1, 1)
        for x in (550.0, 650.0)
    ),
    *((x, side * 950.0, 95.0) for side in (-1, 1) for x in (400.0, 800.0)),
    *((x, 25.0, 75.0) for x in (0.0, 250.0, 500.0, 750.0, 1000.0, 1250.0, 1500.0)),
    *((x, 5.0, z) for z in (225.0, 375.0) for x in (1400.0, 1500.0)),
    *((x, side * 200.0, 385.0) for side in (-1, 1) for x in (1400.0, 1500.0)),
    (1450.0, 5.0, 385.0),
)


def truth_modes(
    places: Iterable[tuple[float, float, float]] = SENSORS,
    n_modes: int = N_MEASURED,
    truth: Mapping[str, float] = TRUTH,
    rigid: bool = False,
) -> ModeSet:
    """The first elastic modes of the aircraft with the true moduli, by CalculiX.

    At the nodes next to these places, mm; mass-normalised; rigid: after the six rigid ones.
    """
    parameters = tuple(
        Parameter(g, "youngs_modulus", "material", (g,), 0.5, 2.0, 0.2) for g in GROUPS
    )
    nodes = tuple(sorted(set(node_at(aircraft(COARSE), places))))
    analysis = ModalAnalysis(6 + n_modes + 2, nodes)
    text = calculix_deck(COARSE)
    modes = true_modes(lambda file: file.write(text.encode()), parameters, truth, analysis, rigid)
    return modes.select(range(n_modes + 6 * rigid))


def write_twin(folder: Path) -> None:
    """Write both test files."""
    modes = truth_modes()
    truth = ", ".join(f"{group} {value}" for group, value in TRUTH.items())
    texts = ["Twin of the coarse GARTEUR aircraft, made by twin.py with relative moduli", truth]
    numbers = range(1, N_MEASURED + 1)
    write_modes_csv(folder / "twin_measured.csv", numbers, modes, [*texts, "exact"])
    write_modes_csv(
        folder / "twin_noisy.csv",
        numbers,
        noisy(modes, FREQUENCY_NOISE, SHAPE_NOISE, SEED),
        [*texts, f"noise: frequencies {FREQUENCY_NOISE}, shapes {SHAPE_NOISE}, seed {SEED}"],
    )


if __name__ == "__main__":
    write_twin(Path(sys.argv[1]))
