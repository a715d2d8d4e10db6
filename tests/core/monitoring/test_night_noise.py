"""The correlation of nights, and changes fitted under it."""

from __future__ import annotations

import numpy as np
import pytest

from modetune.core.monitoring.night_noise import (
    NoiseLaw,
    fit_changes,
    night_positions,
    noise_laws,
    whiten_nights,
)

RNG = np.random.default_rng(0)


def test_prior_probabilities_of_all_laws_sum_to_one() -> None:
    assert sum(law.prior for law in noise_laws()) == pytest.approx(1.0)


def test_whitening_makes_nights_independent() -> None:
    positions = np.array([0.0, 1.0, 2.0, 5.0, 6.0])
    whitening = NoiseLaw(0.8, 0.75, 1.0).whitening(positions)
    matrix = 0.75 * 0.8 ** np.abs(np.subtract.outer(positions, positions))
    np.fill_diagonal(matrix, 1.0)
    assert np.allclose(whitening @ matrix @ whitening.T, np.eye(5), atol=1e-12)
    # An AR(1) series: x_k - 0.8 x_(k-1), over the root of 1 - 0.8^2.
    last = NoiseLaw(0.8, 1.0, 1.0).whitening(np.arange(4.0))[-1]
    assert np.allclose(last, np.array([0.0, 0.0, -0.8, 1.0]) / 0.6)


def test_positions_count_nights_and_keep_gaps() -> None:
    day = 86400.0
    assert night_positions(day * np.array([0, 1, 2, 2, 5, 6])).tolist() == [0, 1, 2, 3, 6, 7]
    assert night_positions(np.zeros(3)).tolist() == [0, 1, 2]


@pytest.mark.parametrize("ramp", [False, True])
def test_a_change_is_that_of_generalised_least_squares(ramp: bool) -> None:
    n, law = 20, NoiseLaw(0.6, 0.75, 1.0)
    positions, sizes = np.arange(float(n)), RNG.uniform(0.5, 2.0, n)
    values = RNG.standard_normal((n, 2))
    design = np.column_stack([np.ones(n), RNG.standard_normal(n)])
    nights = np.array([12, 19])
    starts = np.array([10, 12])
    whitened = whiten_nights(law, positions, sizes, values, design, nights)
    found = fit_changes(whitened, starts, nights, ramp)
    for place, (start, night) in enumerate(zip(starts, nights, strict=True)):
        seen = np.arange(night + 1)
        matrix = 0.75 * 0.6 ** np.abs(np.subtract.outer(seen, seen))
        np.fill_diagonal(matrix, 1.0)
        matrix = matrix * np.outer(sizes[seen], sizes[seen])
        length = night + 1 - start
        shape = np.where(seen >= start, (seen - start + 1.0) / length if ramp else 1.0, 0.0)
        x = np.column_stack([design[seen], shape])
        information = x.T @ np.linalg.solve(matrix, x)
        expected = np.linalg.solve(information, x.T @ np.linalg.solve(matrix, values[seen]))
        assert np.allclose(found.change[place], expected[-1])
        assert found.information[place] == pytest.approx(1.0 / np.linalg.inv(information)[-1, -1])
        assert found.noise[place].sum() == pytest.approx(found.information[place])
