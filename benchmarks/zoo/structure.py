"""A structure to update, drawn at random, and the pieces of its deck.

Lengths in mm, forces in N, masses in t. Every family is a function of a random generator, so a
structure is its family and a seed. None is meant to look like the aircraft, the launcher or the
fixture: they are symmetric, stand on soft mounts, carry offset masses, are preloaded or layered,
or come from a mesher.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

Generator = np.random.Generator


@dataclass(frozen=True, slots=True)
class Structure:
    """A structure to update.

    deck: its text, or arrays of a model of matrices; parameters: candidates as in a campaign
    file; sensors: nodes at which a test may measure; n_modes: elastic modes of the test. truth: of
    the parameters, where the family draws it; with_shapes: whether shapes are compared.
    """

    family: str
    deck: str | dict[str, Any]
    parameters: tuple[dict[str, Any], ...]
    sensors: tuple[int, ...]
    n_modes: int
    solver: str = "calculix"
    truth: dict[str, float] | None = None
    with_shapes: bool = True


def modulus(material: str) -> dict[str, Any]:
    return {"name": f"E_{material}", "quantity": "youngs_modulus", "material": material}


def rows(items: Iterable[Sequence[object]]) -> str:
    """Lines of a deck, at most sixteen entries each."""
    lines = []
    for item in items:
        words = [f"{word:.10g}" if isinstance(word, float) else str(word) for word in item]
        parts = [words[at : at + 12] for at in range(0, len(words), 12)]
        lines += [", ".join(part) + ("," if part is not parts[-1] else "") for part in parts]
    return "\n".join(lines) + "\n"


def material(name: str, rng: Generator) -> str:
    """A metal or polymer with moduli of its own."""
    young, density = [(71e3, 2.7e-9), (207e3, 7.85e-9), (113e3, 4.43e-9), (3e3, 1.2e-9)][
        int(rng.integers(4))
    ]
    return f"*MATERIAL, NAME={name}\n*ELASTIC\n{young * rng.uniform(0.9, 1.1):.6g}, 0.31\n" + (
        f"*DENSITY\n{density:.6g}\n"
    )


def elements(kind: str, name: str, numbers: Iterable[int], table: Sequence[Sequence[int]]) -> str:
    chosen = [(number, *table[number - 1]) for number in numbers]
    return f"*ELEMENT, TYPE={kind}, ELSET={name}\n{rows(chosen)}"


def spread(rng: Generator, nodes: Sequence[int], n: int) -> tuple[int, ...]:
    chosen = rng.choice(np.array(nodes), size=min(n, len(nodes)), replace=False)
    return tuple(sorted(int(node) for node in chosen))


TWO_MODULI = (modulus("LOWER"), modulus("UPPER"))
