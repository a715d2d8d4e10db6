"""The least cost of an assignment, against SciPy's own method on every kind of table."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import linear_sum_assignment

from modetune.core.assignment import least_cost


@pytest.mark.parametrize("shape", [(1, 1), (3, 3), (3, 7), (7, 3), (0, 4), (4, 0)])
@pytest.mark.parametrize("ties", [False, True])
def test_no_assignment_costs_less(shape: tuple[int, int], ties: bool) -> None:
    rng = np.random.default_rng(0)
    for _ in range(50):
        cost = rng.standard_normal(shape)
        cost = np.round(cost) if ties else cost
        rows, columns = least_cost(cost)
        best = cost[linear_sum_assignment(cost)].sum()
        assert cost[rows, columns].sum() == pytest.approx(best, abs=1e-12)
        assert rows.size == columns.size == np.unique(columns).size == min(shape)
        assert (np.diff(rows) > 0).all()


def test_pairs_that_cost_infinitely_much_are_avoided_and_nan_is_refused() -> None:
    table = np.array([[np.inf, 1.0], [0.0, 0.5]])
    assert least_cost(table)[1].tolist() == [1, 0]
    with pytest.raises(ValueError, match="invalid"):
        least_cost(np.array([[np.nan, 1.0], [0.0, 0.5]]))
