"""The six-mass system: masses and springs of Table 1, and the test that chapter 3 makes of it.

    python -m modetune.configs.six_mass.system FOLDER

writes the models (analytical.yaml, experimental.yaml, six_mass.yaml) and the test data
(measured.csv, all_measured.csv), the copies in this folder.

The thesis shows the connections in a figure that its text does not have. The arrangement here is a
choice. Ten springs between different pairs, every mass held:

    ground - k8 - m6 - k5 - m4 - k9 - ground,     m6 - k7 - m5 - k2 - m4,
    ground - k6 - m2 - k4 - m1 - k3 - m3 - k10 - ground,     m2 - k1 - m4

Of the arrangements looked at (a local search over all ways to place ten springs) it is among those
that come nearest to the thesis's MAC before updating in Tables 3 and 12 together, and of these the
one whose Error Matrix Method is like the thesis's, too; none has its numbers to two digits.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

from modetune.adapters.matrices.deck import read_deck
from modetune.adapters.test_files.modes_csv import write_modes_csv
from modetune.core.algebra.eigen import solve_modes
from modetune.core.modes import ModeSet, mode_set

#: Thesis Table 1: analytical and experimental values, kg and N/m.
MASSES = {
    "m1": (2.0, 1.8), "m2": (2.5, 2.4), "m3": (1.1, 1.6),
    "m4": (1.2, 1.2), "m5": (1.5, 1.1), "m6": (1.0, 0.9),
}  # fmt: skip
SPRINGS = {
    "k1": (1100.0, 1500.0), "k2": (1000.0, 1600.0), "k3": (1250.0, 1400.0),
    "k4": (5000.0, 6500.0), "k5": (1400.0, 1300.0), "k6": (1100.0, 1500.0),
    "k7": (2000.0, 1300.0), "k8": (1000.0, 400.0), "k9": (3000.0, 2200.0),
    "k10": (3000.0, 3800.0),
}  # fmt: skip
BETWEEN = {
    "k1": ("m2", "m4"), "k2": ("m4", "m5"), "k3": ("m1", "m3"), "k4": ("m1", "m2"),
    "k5": ("m4", "m6"), "k6": ("ground", "m2"), "k7": ("m5", "m6"), "k8": ("ground", "m6"),
    "k9": ("ground", "m4"), "k10": ("ground", "m3"),
}  # fmt: skip
#: Springs that inverse eigensensitivity corrects (Table 11); all else is known in that case.
UPDATED = ("k1", "k2", "k3", "k4")
#: What is measured for it: these modes at these masses.
MODES, SENSORS = (2, 3, 4), (1, 2, 3)

ANALYTICAL, EXPERIMENTAL = 0, 1


def model_text(title: str, column: int, erroneous: tuple[str, ...] = ()) -> str:
    """Return a model file: one column of Table 1, with the analytical value for some springs."""
    lines = [f"# Six masses and ten springs, thesis Table 1: {title}; kg, N/m.", "masses:"]
    lines += [f"  {name}: {values[column]}" for name, values in MASSES.items()]
    lines.append("springs:")
    for name, values in SPRINGS.items():
        value = values[ANALYTICAL if name in erroneous else column]
        ends = ", ".join(BETWEEN[name])
        lines.append(f"  {name}: {{between: [{ends}], stiffness: {value}}}")
    return "\n".join(lines) + "\n"


MODELS = {
    "analytical.yaml": model_text("analytical values", ANALYTICAL),
    "experimental.yaml": model_text("experimental values", EXPERIMENTAL),
    "six_mass.yaml": model_text(
        "experimental values but for k1 to k4 (Table 11)", EXPERIMENTAL, UPDATED
    ),
}


def modes_of(model: Path) -> ModeSet:
    """All six modes of a model file, mass-normalised, at all six masses."""
    system = read_deck(model).model
    eigenvalues, shapes = solve_modes(system.stiffness, system.mass, len(MASSES))
    frequencies_hz = np.sqrt(eigenvalues) / (2.0 * np.pi)
    return mode_set(frequencies_hz, shapes, system.nodes, system.components, normalisation="mass")


def write_system(folder: Path) -> None:
    """Write models and test data."""
    for name, text in MODELS.items():
        (folder / name).write_text(text)
    modes = modes_of(folder / "experimental.yaml")
    message = "Modes of experimental.yaml, made by system.py without noise"
    write_modes_csv(folder / "all_measured.csv", range(1, 7), modes, [message, "mass-normalised"])
    measured = modes.select([number - 1 for number in MODES])
    sensors = measured.rows(np.flatnonzero(np.isin(measured.nodes, SENSORS)))
    write_modes_csv(folder / "measured.csv", MODES, sensors, [message])


if __name__ == "__main__":
    write_system(Path(sys.argv[1]))
