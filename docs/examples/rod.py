"""A tiny finite element program, for the page on adding a solver: modes of a rod, clamped at x = 0.

    python rod.py JOB

reads JOB.rod and JOB.ask, writes JOB.modes and ends with a line that says so:

    material STEEL 210000. 7.85e-9      name, Young's modulus, density
    rod STEEL 250. 5 100.               material, length, elements, area; end to end along x

Nodes are numbered 1, 2, ... from the clamped end; each moves along x.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np
from scipy.linalg import eigh

VERSION = "1.2"


def main(job: Path) -> int:
    """Solve a job; 0 whatever happens, as many programs do."""
    materials: dict[str, tuple[float, float]] = {}
    lengths, springs, masses = [], [], []
    for number, line in enumerate(job.with_suffix(".rod").read_text().splitlines(), start=1):
        match line.split():
            case ["material", name, modulus, density]:
                materials[name] = float(modulus), float(density)
            case ["rod", name, length, count, area] if name in materials:
                modulus_value, density_value = materials[name]
                size = float(length) / int(count)
                for _ in range(int(count)):
                    lengths.append(size)
                    springs.append(modulus_value * float(area) / size)
                    masses.append(density_value * float(area) * size)
            case []:
                pass
            case _:
                sys.stdout.write(f"FATAL line {number}: {line}\n")
                return 0
    n = len(springs) + 1
    stiffness, mass = np.zeros((n, n)), np.zeros((n, n))
    for i, (k, m) in enumerate(zip(springs, masses, strict=True)):
        stiffness[i : i + 2, i : i + 2] += k * np.array([[1.0, -1.0], [-1.0, 1.0]])
        mass[i : i + 2, i : i + 2] += m / 6.0 * np.array([[2.0, 1.0], [1.0, 2.0]])
    ask = json.loads(job.with_suffix(".ask").read_text())
    last = min(ask["modes"], n - 1) - 1
    eigenvalues, shapes = eigh(stiffness[1:, 1:], mass[1:, 1:], subset_by_index=(0, last))
    shapes = np.vstack([np.zeros(last + 1), shapes])
    told = {
        "mass": sum(masses),
        "eigenvalues": eigenvalues.tolist(),
        "shapes": {str(node): shapes[node - 1].tolist() for node in ask["nodes"]},
    }
    job.with_suffix(".modes").write_text(json.dumps(told))
    sys.stdout.write("ROD FINISHED\n")
    return 0


if __name__ == "__main__":
    sys.exit(main(Path(sys.argv[1])))
