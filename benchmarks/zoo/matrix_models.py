"""Families of matrices: chains, a mechanism, masses alike in two directions, soft joints."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from benchmarks.zoo.structure import Generator, Structure

from modetune.core.modes import Floats


def chain(rng: Generator) -> Structure:
    """A building of many storeys as matrices, a spring a candidate."""
    n = int(rng.integers(5, 9))
    stiffness, mass = np.zeros((n, n)), np.diag(rng.uniform(0.5, 2.0, n))
    parts: dict[str, Any] = {}
    for place in range(n):
        own = spring(n, place - 1, place, float(rng.uniform(800, 2000)))
        stiffness += own
        parts[f"k{place + 1}"] = {"stiffness": own}
    return matrices("chain", stiffness, mass, parts, [f"k{p + 1}" for p in range(0, n, 2)], n)


def mechanism(rng: Generator) -> Structure:
    """Two free beams of masses joined by a hinge: three modes at zero in the plane, not two."""
    n = 12
    stiffness, mass = np.zeros((n, n)), np.diag(rng.uniform(0.8, 1.2, n))
    groups = {"left": np.zeros((n, n)), "right": np.zeros((n, n))}
    value = float(rng.uniform(2e4, 6e4))
    for place in range(n - 2):
        if place + 1 == n // 2:
            continue  # the hinge: no bending across it
        bend = np.zeros(n)
        bend[place : place + 3] = 1.0, -2.0, 1.0
        groups["left" if place < n // 2 else "right"] += value * np.outer(bend, bend)
    stiffness = groups["left"] + groups["right"]
    parts = {name: {"stiffness": own} for name, own in groups.items()}
    return matrices("mechanism", stiffness, mass, parts, list(parts), 5)


def polar_masses(rng: Generator) -> Structure:
    """Masses alike in x and y: every mode twice, by matrices."""
    n = 6
    alike: Floats = np.zeros((n, n))
    parts: dict[str, Any] = {}
    for place in range(n):
        alike += spring(n, place - 1, place, 1000.0 + 100.0 * place)
    both = np.eye(2)
    half = {"low": range(n // 2), "high": range(n // 2, n)}
    for name, places in half.items():
        own = sum((spring(n, p - 1, p, 1000.0 + 100.0 * p) for p in places), np.zeros((n, n)))
        parts[name] = {"stiffness": np.kron(own, both)}
    dofs = [f"{place + 1}.{axis}" for place in range(n) for axis in "xy"]
    mass = np.kron(np.diag(rng.uniform(0.5, 1.5, n)), both)
    return matrices("polar_masses", np.kron(alike, both), mass, parts, list(parts), 6, dofs)


def assembly(rng: Generator) -> Structure:
    """Two free chains of stiff springs joined by soft joints, whose stiffness is sought."""
    n = 10
    stiffness, mass = np.zeros((n, n)), np.diag(rng.uniform(0.5, 2.0, n))
    for first, second in [
        *zip(range(4), range(1, 5), strict=True),
        *zip(range(5, 9), range(6, 10), strict=True),
    ]:
        stiffness += spring(n, first, second, float(rng.uniform(3e4, 6e4)))
    parts: dict[str, Any] = {}
    for place, (first, second) in enumerate([(0, 5), (2, 7), (4, 9)], start=1):
        own = spring(n, first, second, float(rng.uniform(1e3, 4e3)))
        stiffness += own
        parts[f"joint{place}"] = {"stiffness": own}
    return matrices("assembly", stiffness, mass, parts, list(parts), 6)


def spring(n: int, first: int, second: int, value: float) -> Floats:
    """The stiffness (n, n) of a spring between two unknowns; -1 is the ground."""
    ends = np.zeros(n)
    ends[second] = 1.0
    if first >= 0:
        ends[first] = -1.0
    return value * np.outer(ends, ends)


def matrices(
    family: str,
    stiffness: Floats,
    mass: Floats,
    parts: dict[str, Any],
    sought: Sequence[str],
    n_modes: int,
    dofs: Sequence[str] | None = None,
) -> Structure:
    model = {"stiffness": stiffness, "mass": mass, "parts": parts}
    if dofs is not None:
        model["dofs"] = list(dofs)
    n_nodes = len(stiffness) // (2 if dofs else 1)
    parameters = tuple({"name": name, "quantity": "matrix_factor", "part": name} for name in sought)
    return Structure(
        family,
        model,
        parameters,
        tuple(range(1, n_nodes + 1)),
        min(n_modes, len(stiffness) - 2),
        "matrices",
    )
