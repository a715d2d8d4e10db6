"""How near to each other sensors may be: two next to each other tell the same twice."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy
from numpy.typing import NDArray

from modetune.core.modes import Floats, Integers

Bools = NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class Spacing:
    """Places of candidates, and how far apart those of different nodes must be.

    nodes: (n,), one node may stand several times, once a direction; coordinates: (n, 3);
    distance: the deck's length, 0 where anything goes. Directions at one node are never too near.
    """

    nodes: Integers
    coordinates: Floats
    distance: float = 0.0

    def blocked(self, chosen: Sequence[int]) -> Bools:
        """Which candidates (n,) are chosen already, or too near to one that is."""
        taken = np.zeros(self.nodes.size, dtype=np.bool_)
        for place in chosen:
            if self.distance > 0.0:
                apart = np.linalg.norm(self.coordinates - self.coordinates[place], axis=1)
                taken |= (apart < self.distance) & (self.nodes != self.nodes[place])
            taken[place] = True
        return taken

    def thinned(self, worth: Floats) -> Integers:
        """Candidates, ascending, that are far enough apart: the worthiest first, (n_kept,).

        worth: (n,).
        """
        if self.distance <= 0.0:
            return np.arange(self.nodes.size)
        # Rounding must not decide among the equals of a symmetric structure.
        order = np.lexsort((np.arange(worth.size), -np.round(worth, 9)))
        free = np.ones(self.nodes.size, dtype=np.bool_)
        tree, kept = scipy.spatial.KDTree(self.coordinates), []
        for place in order.tolist():
            if free[place]:
                kept.append(place)
                near = np.array(tree.query_ball_point(self.coordinates[place], self.distance))
                apart = np.linalg.norm(self.coordinates[near] - self.coordinates[place], axis=1)
                other = self.nodes[near] != self.nodes[place]
                free[near[other & (apart < self.distance)]] = False
        return np.sort(np.array(kept, dtype=np.int64))
