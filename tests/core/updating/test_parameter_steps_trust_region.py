"""Trust-region steps: bounds, logarithms, damping, and how soon they come to known answers."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from modetune.core.modes import Floats
from modetune.core.updating.parameter_steps import (
    LEAST_DOUBT,
    Scale,
    StepProblem,
    TrustRegion,
    by_factors,
    parameter_step,
    trust_region_step,
)


def at(
    theta: Floats, sensitivity: Floats, residual: Floats, deviation: float, box: float
) -> tuple[StepProblem, Scale]:
    """A problem whose parameters are all stepped as they are."""
    n = theta.size
    step = StepProblem(
        sensitivity=sensitivity,
        residual=residual,
        weights=np.full(residual.size, deviation**-2),
        parameter_weights=np.full(n, 25.0),
        offset=theta - 1.0,
        lower=np.full(n, -box),
        upper=np.full(n, box),
    )
    return step, Scale(theta, np.zeros(n, dtype=bool))


def test_damping_is_the_campaigns_at_first_and_the_misfits_near_the_end() -> None:
    s = np.random.default_rng(1).normal(size=(6, 2))
    far, scale = at(np.ones(2), s, np.full(6, 0.05), 0.01, 1e3)  # a misfit of 25 a residual
    step = trust_region_step(far, scale, TrustRegion(1e3), 0.7)
    assert step.regularisation == 0.7
    np.testing.assert_allclose(step.change, parameter_step(far, "regularised", 0.7).change)
    near, _ = at(np.ones(2), s, np.full(6, 0.0001), 0.01, 1e3)  # ... of 1e-4
    assert trust_region_step(near, scale, TrustRegion(1e3), 0.7).regularisation == pytest.approx(
        0.7e-4
    )


def test_a_region_grows_where_promises_are_kept_and_the_radius_held_back() -> None:
    region = TrustRegion(0.2)
    assert region.after(0.2, kept=0.9) == TrustRegion(0.4, 0.1)
    assert region.after(0.1, kept=0.9) == TrustRegion(0.2, 0.1)
    assert region.after(0.2, kept=0.5) == region
    assert region.after(0.2, kept=0.1) == region.after(0.2, kept=-3.0) == TrustRegion(0.1, 4.0)
    for _ in range(5):
        region = region.after(0.1, kept=1.0)
    assert region.doubt == LEAST_DOUBT
    assert region.boldest


def test_only_bounds_of_an_order_of_magnitude_make_a_logarithm() -> None:
    lower, upper = np.array([0.5, 0.2, 0.05, 0.5]), np.array([2.0, 2.0, 11.0, 4.9])
    assert by_factors(lower, upper).tolist() == [False, True, True, False]


@given(st.integers(0, 10_000), st.integers(2, 8), st.integers(1, 6), st.floats(0.01, 3.0))
@settings(max_examples=60)
def test_no_step_leaves_bounds_or_radius(seed: int, rows: int, columns: int, radius: float) -> None:
    rng = np.random.default_rng(seed)
    theta = rng.uniform(0.1, 5.0, columns)
    scale = Scale(theta, rng.uniform(size=columns) < 0.5)
    reach = np.full(columns, radius)
    problem, _ = at(theta, rng.normal(size=(rows, columns)), rng.normal(size=rows), 0.01, 1.0)
    low = np.maximum(0.05 - theta, scale.changes(-reach))
    high = np.minimum(6.0 - theta, scale.changes(reach))
    boxed = replace(problem, lower=low, upper=high)
    change = trust_region_step(boxed, scale, TrustRegion(radius), 1.0).change
    assert (change >= low).all()
    assert (change <= high).all()
    assert np.abs(scale.steps(change)).max() <= radius * (1.0 + 1e-12)


def test_steps_and_changes_undo_each_other() -> None:
    scale = Scale(np.array([0.3, 2.0]), np.array([True, False]))
    steps = np.array([0.7, -0.2])
    np.testing.assert_allclose(scale.changes(steps), [0.3 * (np.exp(0.7) - 1.0), -0.2])
    np.testing.assert_allclose(scale.steps(scale.changes(steps)), steps, rtol=1e-14)


def test_a_power_law_is_solved_in_one_step_of_the_logarithm() -> None:
    # z = log(8) - log(theta): linear in the logarithm, so the first free step is exact.
    theta = np.ones(1)
    problem, _ = at(theta, 1.0 / theta[:, None], np.log(8.0 / theta), 1e-6, 50.0)
    problem = replace(problem, lower=0.05 - theta)
    scale = Scale(theta, np.array([True]))
    step = trust_region_step(problem, scale, TrustRegion(10.0), 0.0)
    np.testing.assert_allclose(theta + step.change, 8.0, rtol=1e-12)
    np.testing.assert_allclose(step.predicted, 0.0, atol=1e-14)


def test_more_parameters_than_responses_make_the_shortest_step() -> None:
    rng = np.random.default_rng(3)
    s, z = rng.normal(size=(3, 6)), 1e-6 * rng.normal(size=3)
    problem, scale = at(np.ones(6), s, z, 1.0, 10.0)
    step = trust_region_step(problem, scale, TrustRegion(10.0), 1.0)
    shortest = s.T @ np.linalg.solve(s @ s.T, z)
    np.testing.assert_allclose(step.change, shortest, rtol=1e-6)


def test_the_end_is_quadratic() -> None:
    # Brown's badly scaled relative: two parameters, three responses, a fit exists at (1.3, 0.8).
    truth = np.array([1.3, 0.8])

    def response(x: Floats) -> Floats:
        return np.array([x[0] * x[1], x[0] ** 2, np.exp(x[1])])

    def slopes(x: Floats) -> Floats:
        return np.array([[x[1], x[0]], [2.0 * x[0], 0.0], [0.0, np.exp(x[1])]])

    theta, region, errors = np.ones(2), TrustRegion(0.2), []
    for _ in range(8):
        residual = response(truth) - response(theta)
        problem, scale = at(theta, slopes(theta), residual, 0.01, region.radius)
        step = trust_region_step(problem, scale, region, 1.0)
        after = response(truth) - response(theta + step.change)
        before = residual @ residual
        promised = before - step.predicted @ step.predicted
        if before < 1e-28:
            break
        kept = (before - after @ after) / promised
        theta, region = theta + step.change, region.after(np.abs(step.change).max(), kept)
        errors.append(float(np.abs(theta - truth).max()))
    assert len(errors) <= 6
    assert errors[-1] < 1e-14
    # Each error of the end is below ten times the square of the one before.
    assert all(b <= max(10.0 * a * a, 1e-14) for a, b in pairwise(errors[1:]))
