"""Strain gauges of a campaign: two nodes, whose distance grows by the strain."""

from __future__ import annotations

import numpy as np

from modetune.adapters.solver import Deck
from modetune.core.errors import ModelError
from modetune.core.modes import Floats, Integers


def elongation(name: str, deck: Deck) -> tuple[Integers, Integers, Floats]:
    """Return nodes, components and factors of the strain between two nodes, named as `12-13`.

    The strain is (u_b - u_a) . t / l, with t the direction from a to b and l their distance.
    Raises ModelError.
    """
    first, _, second = name.partition("-")
    if not (first.isdecimal() and second.isdecimal()) or first == second:
        raise ModelError(f"{name!r} is not two nodes such as 12-13")
    ends, mesh = np.array([node_number(first, deck), node_number(second, deck)]), deck.mesh()
    if not mesh.nodes.size:
        raise ModelError("the model has no geometry, which strains need")
    at = mesh.coordinates[mesh.rows(ends)]
    length = float(np.linalg.norm(at[1] - at[0]))
    if not length:
        raise ModelError(f"nodes {first} and {second} lie at one place")
    along = (at[1] - at[0]) / length**2
    factors = [
        sign * (mesh.frames.get(int(node), np.eye(3)) @ along)
        for node, sign in zip(ends, (-1.0, 1.0), strict=True)
    ]
    return np.repeat(ends, 3), np.tile(np.arange(1, 4), 2), np.concatenate(factors)


def node_number(text: str, deck: Deck) -> int:
    """Return the node of the model that a text names. Raises ModelError."""
    node = int(text) if text.isdecimal() else 0
    if node not in deck.summary.node_ids:
        raise ModelError(f"the model has no node {text}")
    return node
