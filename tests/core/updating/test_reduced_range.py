"""Reduced models that hold over a range, against full solutions all over it."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import sparse
from scipy.stats import qmc

from modetune.core.modes import Floats
from modetune.core.updating.parameter_matrices import ParameterMatrices
from modetune.core.updating.reduced_basis import ReducedRange, reduce_over
from tests.core.updating.test_reduced_basis import MODELS, Full

ACCURACY = 1e-6


def points(affine: ParameterMatrices, count: int, width: float = 0.5) -> Floats:
    """Values within 1 - width and 1 + width."""
    unit = qmc.Sobol(affine.reference.size, rng=np.random.default_rng(3)).random(count)
    return np.asarray(1.0 + width * (2.0 * unit - 1.0))


def over(full: Full, thetas: Floats, accuracy: float = ACCURACY) -> ReducedRange:
    observer = sparse.csr_array(sparse.eye_array(full.shapes.shape[0], format="csr")[full.rows])
    n_modes = full.eigenvalues.size
    return reduce_over(
        full.affine, thetas, full.reduced(), n_modes, full.n_rigid, observer, accuracy
    )


@pytest.fixture(
    scope="module",
    params=[(name, held) for name in MODELS for held in (True, False)],
    ids=lambda item: f"{item[0]}, {'held' if item[1] else 'free'}",
)
def full(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Full:
    name, held = request.param
    affine = MODELS[str(name)](tmp_path_factory.mktemp("matrices"), bool(held))
    return Full.at(affine, [1.0] * affine.reference.size)


def test_frequencies_hold_all_over_the_range_and_the_estimate_tells_where_they_do(
    full: Full,
) -> None:
    affine, thetas = full.affine, points(full.affine, 256)
    found = over(full, thetas)
    assert found.errors[-1] <= ACCURACY < found.errors[0]
    for theta in points(affine, 32)[1:]:
        there = Full.at(affine, theta.tolist())
        values, _, estimate = found.modes(theta, full.eigenvalues.size)
        own = slice(full.n_rigid, None)
        missed = np.max(np.abs(np.sqrt(values[own] / there.eigenvalues[own]) - 1.0))
        # One factor holds for all sets: the worst of a few hundred was off by 20.
        assert missed < 10.0 * ACCURACY
        assert missed < 30.0 * estimate + 1e-8


def test_outside_of_the_range_the_estimate_says_so(full: Full) -> None:
    found = over(full, points(full.affine, 32, width=0.1))
    far = Full.at(full.affine, [0.3, 2.5, 0.3, 2.5][: full.theta.size])
    values, _, estimate = found.modes(far.theta, full.eigenvalues.size)
    own = slice(full.n_rigid, full.n_rigid + 8)
    missed = np.max(np.abs(np.sqrt(values[own] / far.eigenvalues[own]) - 1.0))
    assert missed > 100.0 * ACCURACY
    assert estimate > 100.0 * ACCURACY
