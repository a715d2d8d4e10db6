"""Steps within limits, against a general solver of constrained least squares."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy.optimize import minimize

from modetune.core.updating.parameter_steps import (
    INSIDE,
    Step,
    StepProblem,
    breach,
    parameter_step,
    step_within,
)


def problem(seed: int) -> StepProblem:
    noise = np.random.default_rng(seed)
    n = 4
    return StepProblem(
        sensitivity=noise.normal(size=(7, n)),
        residual=noise.normal(size=7),
        weights=noise.uniform(0.5, 2.0, 7),
        parameter_weights=np.full(n, 0.3),
        offset=np.zeros(n),
        lower=np.full(n, -0.6),
        upper=np.full(n, 0.6),
    )


def regularised(asked: StepProblem) -> Step:
    return parameter_step(asked, "regularised")


@pytest.mark.parametrize("seed", range(4))
def test_a_step_is_the_least_within_limits_and_box(seed: int) -> None:
    given = problem(seed)
    weights = given.weights.copy()
    weights[:2] = 0.0  # rows that are limits alone
    given = StepProblem(
        given.sensitivity, given.residual, weights, given.parameter_weights, given.offset,
        given.lower, given.upper,
    )  # fmt: skip
    limits = np.tile([-np.inf, np.inf], (7, 1))
    limits[:2, 0] = given.residual[:2] - 0.1  # both can move by little one way
    limits[:2, 1] = given.residual[:2] + 0.05
    step, _ = step_within(regularised, given, given.residual, given.sensitivity, limits)
    there = given.residual - given.sensitivity @ step.change
    assert not breach(there, limits).any()

    def objective(d: Any) -> float:
        z = given.residual - given.sensitivity @ d
        return float(z @ (weights * z) + 0.3 * d @ d)

    rows = given.sensitivity[:2]
    sides: Any = [
        {"type": "ineq", "fun": lambda d: 0.1 - rows @ d},
        {"type": "ineq", "fun": lambda d: 0.05 + rows @ d},
    ]
    solve: Any = minimize
    other = solve(
        objective, np.zeros(4), bounds=[(-0.6, 0.6)] * 4, constraints=sides, method="SLSQP",
        options={"ftol": 1e-14, "maxiter": 500},
    )  # fmt: skip
    # The step ends a share INSIDE before the limits; the objective follows to first order.
    assert objective(step.change) <= other.fun * (1.0 + 100.0 * INSIDE) + 1e-9


def test_without_limits_the_step_is_the_plain_one() -> None:
    given = problem(9)
    free = np.tile([-np.inf, np.inf], (7, 1))
    found, _ = step_within(regularised, given, given.residual, given.sensitivity, free)
    np.testing.assert_array_equal(found.change, regularised(given).change)


def test_a_limit_that_is_broken_draws_the_step_back() -> None:
    given = problem(5)
    limits = np.tile([-np.inf, np.inf], (7, 1))
    limits[3] = [given.residual[3] - 0.3, given.residual[3] - 0.1]
    step, _ = step_within(regularised, given, given.residual, given.sensitivity, limits)
    there = given.residual - given.sensitivity @ step.change
    assert breach(given.residual, limits)[3] == pytest.approx(0.1)
    assert not breach(there, limits).any()
