"""Latin hypercubes: points with one point in each stratum of every parameter.

McKay, Beckman, Conover 1979: of n points each parameter's n equal parts of the unit interval hold
one each, in random order, at a random place in its part.
"""

from __future__ import annotations

import numpy as np

from modetune.core.modes import Floats


def latin_hypercube(n: int, n_parameters: int, rng: np.random.Generator) -> Floats:
    """n points in the unit cube, (n, n_parameters), by a child of the generator."""
    rng = rng.spawn(1)[0]  # as SciPy draws them, whose points earlier versions stored
    places = rng.uniform(size=(n, n_parameters))
    strata = np.stack([rng.permutation(np.arange(1, n + 1)) for _ in range(n_parameters)], axis=1)
    return np.asarray((strata - places) / n)
