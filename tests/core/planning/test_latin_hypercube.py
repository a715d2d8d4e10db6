"""Latin hypercubes by their definition, and beside SciPy's bit for bit."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import qmc

from modetune.core.planning.latin_hypercube import latin_hypercube


@pytest.mark.parametrize(("n", "n_parameters"), [(1, 1), (7, 3), (64, 12)])
def test_every_stratum_of_every_parameter_holds_one_point(n: int, n_parameters: int) -> None:
    points = latin_hypercube(n, n_parameters, np.random.default_rng(n))
    assert points.shape == (n, n_parameters)
    # In strata of width 1/n, (j/n, (j+1)/n]: rounding up gives each of 1..n once.
    assert (np.sort(np.ceil(points * n), axis=0) == np.arange(1, n + 1)[:, None]).all()


@pytest.mark.parametrize(("n", "n_parameters", "seed"), [(1, 2, 0), (11, 5, 3), (63, 40, 2024)])
def test_points_are_those_of_scipy(n: int, n_parameters: int, seed: int) -> None:
    # Stored evaluations of earlier versions are found again only at the same bits.
    theirs = qmc.LatinHypercube(n_parameters, rng=np.random.default_rng(seed)).random(n)
    assert (latin_hypercube(n, n_parameters, np.random.default_rng(seed)) == theirs).all()
