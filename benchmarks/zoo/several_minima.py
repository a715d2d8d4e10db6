"""Families of matrices whose misfit has several minima, saddles or valleys.

Each is a model of matrices whose shapes are measured at a few unknowns, and a truth that may lie
far from the model's values.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from benchmarks.zoo.matrix_models import matrices, spring
from benchmarks.zoo.structure import Generator, Structure

from modetune.core.modes import Floats

#: Truths of parameters that are far from the model: 30 to 60 % off, either way.
FAR = ((0.45, 0.7), (1.3, 1.6))


def far_truth(rng: Generator, names: list[str]) -> dict[str, float]:
    """Draw true values 30 to 60 % off."""
    return {name: float(rng.uniform(*FAR[int(rng.integers(2))])) for name in names}


def sectors(rng: Generator) -> Structure:
    """Six blades on a disc in three exchangeable pairs, frequencies alone: six permutations."""
    n = 7
    blade, mass = float(rng.uniform(800, 1500)), float(rng.uniform(0.8, 1.2))
    stiffness = spring(n, -1, 0, 10.0 * blade)
    parts = {}
    for pair in range(3):
        own = spring(n, 0, 1 + pair, blade) + spring(n, 0, 4 + pair, blade)
        stiffness = stiffness + own
        parts[f"pair{pair + 1}"] = {"stiffness": own}
    masses = np.diag([float(rng.uniform(3.0, 6.0)), *[mass] * 6])
    made = matrices("sectors", stiffness, masses, parts, list(parts), n)
    values = np.array([0.8, 1.0, 1.2]) * rng.uniform(0.95, 1.05, 3)
    truth = dict(zip(parts, rng.permutation(values).tolist(), strict=True))
    return replace(made, n_modes=n, truth=truth, with_shapes=False)


def mirrored_beam(rng: Generator) -> Structure:
    """A simply supported beam of masses, weaker in one half: as well in the other, by frequencies.

    The model is symmetric, so its own start lies on a ridge between both answers.
    """
    n = 9
    value = float(rng.uniform(2e4, 6e4))
    halves = {"left": np.zeros((n, n)), "right": np.zeros((n, n))}
    middle: Floats = np.zeros((n, n))
    for place in range(n):
        bend = np.zeros(n + 2)
        bend[place : place + 3] = 1.0, -2.0, 1.0
        own = value * np.outer(bend[1:-1], bend[1:-1])
        if place == n // 2:
            middle += own
        else:
            halves["left" if place < n // 2 else "right"] += own
    parts = {name: {"stiffness": own} for name, own in halves.items()}
    whole = sum(halves.values(), middle)
    made = matrices("mirrored_beam", whole, np.eye(n), parts, list(parts), 5)
    weak = float(rng.uniform(0.6, 0.85))
    truth = dict(zip(parts, rng.permutation([weak, 1.0]).tolist(), strict=True))
    return replace(made, truth=truth, with_shapes=False)


def soil_building(rng: Generator) -> Structure:
    """A shear building that sways and rocks on soil springs, five parameters far off."""
    storeys, height = int(rng.integers(5, 9)), 3.0
    n = storeys + 2  # the base's sway and rocking, then the storeys
    value, mass = float(rng.uniform(2e3, 4e3)), np.ones(n)
    names = ["k1", "k2", "k3"]
    parts: dict[str, Floats] = {name: np.zeros((n, n)) for name in names}
    for storey in range(storeys):
        drift = np.zeros(n)
        drift[storey + 2] = 1.0
        drift[0 if storey == 0 else storey + 1] -= 1.0
        drift[1] = -height
        parts[names[3 * storey // storeys]] += value * np.outer(drift, drift)
    heights = height * np.arange(1, storeys + 1)
    mass[0], mass[1] = 2.0, 0.1 * float(heights @ heights)
    parts["soil_x"] = np.diag([float(rng.uniform(1.0, 3.0)) * value, *[0.0] * (n - 1)])
    rocking = float(rng.uniform(0.2, 1.0)) * value * float(heights[-1]) ** 2
    parts["soil_r"] = np.diag([0.0, rocking, *[0.0] * (n - 2)])
    given = {name: {"stiffness": own} for name, own in parts.items()}
    whole = sum(parts.values(), np.zeros((n, n)))
    made = matrices("soil_building", whole, np.diag(mass), given, list(given), 4)
    return replace(made, truth=far_truth(rng, list(given)))


def series_springs(rng: Generator) -> Structure:
    """A mass on two springs in series: only their compliance is determined, a curved valley."""
    n = 4
    value = float(rng.uniform(800, 2000))
    parts = {
        "near": {"stiffness": spring(n, -1, 0, value)},
        "far": {"stiffness": spring(n, 0, 1, value * float(rng.uniform(0.8, 1.2)))},
        "top": {"stiffness": spring(n, 1, 2, value)},
    }
    stiffness = spring(n, 2, 3, value) + sum(
        (part["stiffness"] for part in parts.values()), np.zeros((n, n))
    )
    mass = np.diag([1e-6, *rng.uniform(0.8, 1.2, 3)])
    made = matrices("series_springs", stiffness, mass, parts, list(parts), 3)
    return replace(made, n_modes=3, with_shapes=False)


def far_frame(rng: Generator) -> Structure:
    """A chain whose springs are all 30 to 60 % off."""
    n = int(rng.integers(6, 10))
    stiffness, mass = np.zeros((n, n)), np.diag(rng.uniform(0.5, 2.0, n))
    parts = {}
    for place in range(n):
        own = spring(n, place - 1, place, float(rng.uniform(800, 2000)))
        stiffness += own
        parts[f"k{place + 1}"] = {"stiffness": own}
    names = [f"k{place + 1}" for place in range(0, n, 2)]
    made = matrices("far_frame", stiffness, mass, parts, names, 5)
    return replace(made, truth=far_truth(rng, names))
