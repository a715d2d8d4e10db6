"""Parameter steps against the thesis's closed forms, bounds, L-curve and covariance."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import lsq_linear

from modetune.core.errors import CampaignError
from modetune.core.updating.parameter_steps import (
    LinearForm,
    StepProblem,
    l_curve,
    least_squares_in,
    parameter_covariance,
    parameter_step,
)

FORMS: tuple[LinearForm, ...] = (
    "pseudo_inverse",
    "weighted_least_squares",
    "minimum_norm",
    "regularised",
    "pulled_to_initial",
)


def problem(rows: int, columns: int, seed: int = 0, box: float = 1e6) -> StepProblem:
    noise = np.random.default_rng(seed)
    return StepProblem(
        sensitivity=noise.normal(size=(rows, columns)),
        residual=noise.normal(size=rows),
        weights=noise.uniform(0.5, 2.0, rows),
        parameter_weights=noise.uniform(0.5, 2.0, columns),
        offset=0.1 * noise.normal(size=columns),
        lower=np.full(columns, -box),
        upper=np.full(columns, box),
    )


def test_overdetermined_forms_are_the_normal_equations() -> None:
    p = problem(9, 4)
    s, z, w, t = p.sensitivity, p.residual, np.diag(p.weights), np.diag(p.parameter_weights)
    expected = {
        "pseudo_inverse": np.linalg.solve(s.T @ s, s.T @ z),  # thesis (34)
        "weighted_least_squares": np.linalg.solve(s.T @ w @ s, s.T @ w @ z),  # (41)
        "regularised": np.linalg.solve(s.T @ w @ s + 0.3 * t, s.T @ w @ z),  # (48)
        "pulled_to_initial": np.linalg.solve(
            s.T @ w @ s + 0.3 * t, s.T @ w @ z - 0.3 * t @ p.offset
        ),  # (52)
    }
    for form in FORMS:
        if form in expected:
            step = parameter_step(p, form, 0.3)
            np.testing.assert_allclose(step.change, expected[form], rtol=1e-9, err_msg=form)
            np.testing.assert_allclose(step.predicted, z - s @ step.change)


def test_underdetermined_minimum_norm_is_by_the_parameters_weights() -> None:
    p = problem(3, 6)
    s, inverse = p.sensitivity, np.diag(1.0 / p.parameter_weights)
    expected = inverse @ s.T @ np.linalg.solve(s @ inverse @ s.T, p.residual)  # thesis (45)
    np.testing.assert_allclose(parameter_step(p, "minimum_norm").change, expected, rtol=1e-9)
    plain = s.T @ np.linalg.solve(s @ s.T, p.residual)  # thesis (43)
    np.testing.assert_allclose(parameter_step(p, "pseudo_inverse").change, plain, rtol=1e-9)


@given(st.integers(0, 10_000), st.sampled_from(FORMS), st.integers(2, 8), st.integers(1, 6))
@settings(max_examples=60)
def test_no_step_leaves_its_box(seed: int, form: LinearForm, rows: int, columns: int) -> None:
    p = problem(rows, columns, seed, box=0.05)
    change = parameter_step(p, form, 0.1).change
    assert (change >= p.lower).all()
    assert (change <= p.upper).all()


def test_the_boxed_step_is_the_best_in_the_box_and_not_a_clipped_one() -> None:
    # Strongly correlated columns: clipping the free solution is far from the best in the box.
    s = np.array([[1.0, 0.9], [0.9, 1.0]])
    p = StepProblem(
        s,
        np.array([1.0, 0.0]),
        np.ones(2),
        np.ones(2),
        np.zeros(2),
        np.full(2, -0.5),
        np.full(2, 0.5),
    )
    change = parameter_step(p, "weighted_least_squares").change
    grid = np.stack(np.meshgrid(*2 * [np.linspace(-0.5, 0.5, 401)]), axis=-1).reshape(-1, 2)
    misfits = np.sum((p.residual - grid @ s.T) ** 2, axis=1)
    assert np.sum((p.residual - s @ change) ** 2) <= misfits.min() + 1e-9


def test_a_parameter_whose_bounds_meet_stays_where_it_is() -> None:
    p = problem(6, 3)
    lower, upper = p.lower.copy(), p.upper.copy()
    lower[1] = upper[1] = 0.0
    for form in FORMS:
        change = parameter_step(replace(p, lower=lower, upper=upper), form).change
        assert change[1] == 0.0
    all_fixed = replace(p, lower=np.zeros(3), upper=np.zeros(3))
    assert not parameter_step(all_fixed, "regularised").change.any()


def test_rank_and_condition_are_told() -> None:
    p = problem(6, 3)
    s = p.sensitivity.copy()
    s[:, 2] = s[:, 0] + s[:, 1]
    step = parameter_step(replace(p, sensitivity=s), "weighted_least_squares")
    assert step.rank == 2
    assert step.condition > 1e10
    assert parameter_step(p, "weighted_least_squares").rank == 3


@pytest.mark.parametrize("seed", range(5))
def test_the_l_curve_finds_the_noise_level_of_a_hilbert_matrix(seed: int) -> None:
    # Hansen's kind of problem: exact solution of ones, data with 1e-4 noise.
    n = 8
    s = 1.0 / (np.arange(1.0, 2 * n + 1)[:, None] + np.arange(float(n))[None, :])
    noise = 1e-4 * np.random.default_rng(seed).normal(size=2 * n)
    p = StepProblem(
        s,
        s @ np.ones(n) + noise,
        np.ones(2 * n),
        np.ones(n),
        np.zeros(n),
        np.full(n, -1e9),
        np.full(n, 1e9),
    )
    chosen = parameter_step(p, "regularised", "l_curve")
    free = parameter_step(p, "weighted_least_squares")
    error, free_error = (float(np.linalg.norm(x.change - 1.0)) for x in (chosen, free))
    # The answer's length is 2.8; without regularisation noise drowns it.
    assert error < 1.1
    assert free_error > 100.0 * error
    curve = l_curve(p)
    assert (np.diff(curve.misfits) >= -1e-12).all()
    assert (np.diff(curve.sizes) <= 1e-12).all()


def test_covariance_matches_the_spread_of_many_noisy_fits() -> None:
    p = problem(12, 3)
    s, variances = p.sensitivity, 1.0 / p.weights
    noise = np.random.default_rng(5).normal(size=(4000, 12)) * np.sqrt(variances)
    w = np.diag(p.weights)
    fits = noise @ (w @ s @ np.linalg.inv(s.T @ w @ s))
    # 4000 samples tell a variance within about 1 / sqrt(2000) = 2 %; 10 % is safe.
    np.testing.assert_allclose(
        np.cov(fits.T).diagonal(),
        parameter_covariance(s, variances, p.weights).diagonal(),
        rtol=0.1,
    )


def test_covariance_knows_the_emphasis_of_the_step() -> None:
    p = problem(12, 3)
    s, variances = p.sensitivity, 1.0 / p.weights
    weights = p.weights * np.where(np.arange(12) < 4, 1.0, 0.1)
    noise = np.random.default_rng(6).normal(size=(4000, 12)) * np.sqrt(variances)
    w = np.diag(weights)
    fits = noise @ (w @ s @ np.linalg.inv(s.T @ w @ s))
    found = parameter_covariance(s, variances, weights).diagonal()
    np.testing.assert_allclose(np.cov(fits.T).diagonal(), found, rtol=0.1)
    assert (found > parameter_covariance(s, variances, p.weights).diagonal()).all()


def test_a_parameter_with_next_to_no_effect_leaves_the_others_known() -> None:
    s = np.array([[1.0, 0.5, 1e-6], [0.3, 2.0, 3e-6], [1.0, -1.0, 2e-6]])
    errors = np.sqrt(parameter_covariance(s, np.ones(3), np.ones(3)).diagonal())
    assert errors[2] == np.inf
    alone = np.sqrt(parameter_covariance(s[:, :2], np.ones(3), np.ones(3)).diagonal())
    # Mixed with the third by parts of 1e-6, the square of which is rounding.
    np.testing.assert_allclose(errors[:2], alone, rtol=1e-10)


def test_a_parameter_without_effect_has_an_infinite_error_and_a_prior_bounds_it() -> None:
    s = np.array([[1.0, 0.0], [2.0, 0.0]])
    covariance = parameter_covariance(s, np.ones(2), np.ones(2))
    assert covariance[0, 0] == pytest.approx(0.2)
    assert covariance[1, 1] == np.inf
    held = parameter_covariance(s, np.ones(2), np.ones(2), np.array([25.0, 25.0]))
    assert held[1, 1] == pytest.approx(0.04)


def test_shapes_and_values_are_checked_at_the_door() -> None:
    p = problem(4, 2)
    with pytest.raises(CampaignError, match="4 entries"):
        replace(p, residual=np.zeros(3))
    with pytest.raises(CampaignError, match="2 entries"):
        replace(p, lower=np.zeros(3))
    with pytest.raises(CampaignError, match="finite"):
        replace(p, residual=np.full(4, np.nan))
    with pytest.raises(CampaignError, match="above its upper"):
        replace(p, lower=np.full(2, 2e6))


@pytest.mark.parametrize("prior", [None, np.array([2.0, 1.0, 3.0, 0.5])])
def test_what_is_held_has_no_variance_and_the_rest_that_of_the_condition(prior: Any) -> None:
    random = np.random.default_rng(4)
    slopes, variances = random.standard_normal((9, 4)), random.uniform(0.5, 2.0, 9)
    held = np.array([[1.0, 0.5, 0.0, -0.3], [0.0, 0.0, 1.0, 0.0]])
    free = parameter_covariance(slopes, variances, 1.0 / variances, prior)
    found = parameter_covariance(slopes, variances, 1.0 / variances, prior, held)
    # Of a normal distribution under the condition held d = 0.
    across = free @ held.T
    wanted = free - across @ np.linalg.solve(held @ across, across.T)
    np.testing.assert_allclose(found, wanted, atol=1e-12)
    unseen = parameter_covariance(slopes * [0.0, 1.0, 1.0, 1.0], variances, 1.0 / variances)
    assert np.isinf(unseen[0, 0])


@pytest.mark.parametrize("seed", range(20))
def test_least_squares_in_bounds_are_those_of_the_bounded_variable_method(seed: int) -> None:
    """Columns of sizes four decades apart, bounds of which some leave no room, and some none."""
    rng = np.random.default_rng(seed)
    n = int(rng.integers(1, 12))
    rows = rng.standard_normal((n + 3, n)) * 10.0 ** rng.uniform(-2.0, 2.0, n)
    target = 3.0 * rng.standard_normal(n + 3)
    lower, upper = -rng.uniform(0.0, 1.0, n), rng.uniform(0.0, 1.0, n)
    closed = rng.random(n) < 0.2
    upper[closed] = lower[closed]
    upper[rng.random(n) < 0.1] = np.inf
    found = least_squares_in(lower, upper, rows, target)
    assert (found >= lower).all()
    assert (found <= upper).all()
    best, room = lower.copy(), lower < upper
    if room.any():
        left = target - rows[:, ~room] @ lower[~room]
        bounds = lower[room], upper[room]
        best[room] = lsq_linear(rows[:, room], left, bounds, method="bvls", tol=1e-14).x
    # No sum of squares is less, but for rounding of numbers of this size.
    ours, theirs = (np.linalg.norm(rows @ x - target) for x in (found, best))
    assert ours <= theirs + 1e-13 * np.linalg.norm(target)
