"""What a test tells of parameters: closed forms, and intervals that hold the truth."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from modetune.core.errors import CampaignError
from modetune.core.modes import Floats
from modetune.core.updating.identifiability import (
    Identifiability,
    collinearity,
    identifiability,
    remaining_step,
)
from modetune.core.updating.parameter_steps import (
    LinearForm,
    StepProblem,
    parameter_covariance,
    parameter_step,
)


def told(sensitivity: Floats, deviation: float = 1.0, factor: float = 1.0) -> Identifiability:
    """Of measurements and parameters of unit deviation, at values of 1."""
    rows, columns = sensitivity.shape
    return identifiability(
        sensitivity, np.ones(rows), np.full(columns, deviation), np.ones(columns), factor
    )


def test_the_share_of_one_parameter_is_by_the_information_of_both_sides() -> None:
    # One measurement with sensitivity 2, deviation 0.5; prior deviation 0.25: information of the
    # test (2 / 0.5)^2 = 16, of the prior 1 / 0.25^2 = 16, so half of the answer is the test's.
    found = identifiability(np.array([[2.0]]), np.array([4.0]), np.array([0.25]), np.array([1.3]))
    np.testing.assert_allclose(found.test_shares, [0.5])
    np.testing.assert_allclose(found.singular_values, [1.0])
    # Three times the prior's weight: 16 / (16 + 48).
    again = identifiability(
        np.array([[2.0]]), np.array([4.0]), np.array([0.25]), np.array([1.3]), 3.0
    )
    np.testing.assert_allclose(again.test_shares, [0.25])


@given(st.integers(0, 10_000), st.integers(1, 7), st.integers(1, 5), st.floats(0.1, 10.0))
@settings(max_examples=50)
def test_the_resolution_is_its_definition(
    seed: int, rows: int, columns: int, factor: float
) -> None:
    noise = np.random.default_rng(seed)
    s, w = noise.normal(size=(rows, columns)), noise.uniform(0.5, 2.0, rows)
    d = noise.uniform(0.1, 1.0, columns)
    found = identifiability(s, w, d, np.ones(columns), factor)
    information = s.T @ np.diag(w) @ s
    expected = np.linalg.solve(information + factor * np.diag(d**-2), information)
    np.testing.assert_allclose(found.resolution, expected, atol=1e-9)
    assert found.n_told <= min(rows, columns) + 1e-9


def test_two_parameters_that_do_the_same_share_the_answer_and_are_named() -> None:
    found = told(np.array([[30.0, 30.0, 0.0], [0.0, 0.0, 30.0]]))
    # Together they have 1800 / 1801 of one answer, each half of that; the third 900 / 901.
    np.testing.assert_allclose(found.test_shares, [900 / 1801, 900 / 1801, 900 / 901])
    (unseen,) = found.unseen
    assert set(unseen.members) == {0, 1}
    np.testing.assert_allclose(unseen.changes, [1.0, -1.0])
    assert unseen.seen == pytest.approx(0.0, abs=1e-9)
    assert found.condition == np.inf


def test_a_modulus_and_a_density_can_only_be_told_as_a_ratio() -> None:
    # All eigenvalues go with E / rho: the columns are opposite whatever the mode.
    found = told(np.outer(np.ones(4), [50.0, -50.0]))
    (unseen,) = found.unseen
    np.testing.assert_allclose(unseen.changes, [1.0, 1.0])
    assert found.collinearity.indices.tolist() == [np.inf]


def test_changes_are_relative_to_the_parameters_own_values() -> None:
    # The combination (1, -1) of deviations 0.1 and 0.2 at the values 0.5 and 2.0.
    s = np.array([[1000.0, 500.0]])
    found = identifiability(s, np.ones(1), np.array([0.1, 0.2]), np.array([0.5, 2.0]))
    (unseen,) = found.unseen
    np.testing.assert_allclose(unseen.changes, [1.0, -0.5])  # 0.1 / 0.5 against -0.2 / 2.0


def test_unseen_combinations_are_told_apart_although_singular_vectors_mix_them() -> None:
    # Nothing sees column 0; columns 1 and 2 do the same; column 3 is seen well.
    s = np.zeros((5, 4))
    s[0, 1:3], s[1, 3] = 20.0, 20.0
    members = sorted(tuple(sorted(item.members)) for item in told(s).unseen)
    assert members == [(0,), (1, 2)]


def test_a_well_posed_sensitivity_has_nothing_unseen() -> None:
    found = told(np.diag([30.0, 20.0, 10.0]))
    assert found.unseen == ()
    assert found.condition == pytest.approx(3.0)
    assert found.collinearity.whole == pytest.approx(1.0)
    np.testing.assert_allclose(found.collinearity.indices, 1.0)


def test_the_remaining_step_is_least_squares_where_the_test_sees() -> None:
    noise = np.random.default_rng(4)
    s, z, w = noise.normal(size=(6, 3)), noise.normal(size=6), noise.uniform(50.0, 200.0, 6)
    expected = np.linalg.solve(s.T @ (w[:, None] * s), s.T @ (w * z))
    far = np.full(3, 1e3)
    found = remaining_step(s, z, w, np.full(3, 0.5), -far, far)
    np.testing.assert_allclose(found, expected, rtol=1e-9)
    # A parameter that hardly moves anything is not asked to move far.
    s[:, 2] *= 1e-6
    assert remaining_step(s, z, w, np.full(3, 0.5), -far, far)[2] == pytest.approx(0.0, abs=1e-3)


def test_the_remaining_step_leaves_a_parameter_that_its_bound_holds() -> None:
    noise = np.random.default_rng(5)
    s, z, w = noise.normal(size=(6, 2)), noise.normal(size=6), np.full(6, 100.0)
    far = np.full(2, 1e3)
    sign = np.sign(remaining_step(s, z, w, np.ones(2), -far, far)[0])
    lower, upper = (-far, far * [0.0, 1.0]) if sign > 0.0 else (-far * [0.0, 1.0], far)
    found = remaining_step(s, z, w, np.ones(2), lower, upper)
    # The other one goes where it is best alone.
    assert found[0] == 0.0
    assert found[1] == pytest.approx(s[:, 1] @ z / (s[:, 1] @ s[:, 1]))


def test_without_a_prior_what_is_determined_at_all_is_the_tests() -> None:
    found = told(np.array([[1e-3, 0.0], [0.0, 0.0]]), factor=0.0)
    np.testing.assert_allclose(found.test_shares, [1.0, 0.0])


def test_a_sensitivity_of_zeros_is_all_prior() -> None:
    found = told(np.zeros((3, 2)))
    np.testing.assert_allclose(found.test_shares, 0.0)
    assert [item.members for item in found.unseen] in ([(0,), (1,)], [(1,), (0,)])
    assert found.collinearity.indices.size == 0


@pytest.mark.parametrize("degrees", [10.0, 30.0, 60.0, 90.0, 120.0])
def test_the_index_of_a_pair_is_by_its_angle(degrees: float) -> None:
    turned = np.deg2rad(degrees)
    pair = np.array([[1.0, 5.0 * np.cos(turned)], [0.0, 5.0 * np.sin(turned)]])
    # The cosines' matrix has eigenvalues 1 -+ |cos|.
    expected = 1.0 / np.sqrt(1.0 - abs(np.cos(turned)))
    np.testing.assert_allclose(collinearity(pair).indices, [expected], rtol=1e-9)


def test_a_triple_is_collinear_though_none_of_its_pairs_is() -> None:
    # Third = first + second: pairs have cosines 0 and 0.707, the triple is dependent.
    found = collinearity(np.array([[1.0, 0.0, 1.0], [0.0, 1.0, 1.0], [0.0, 0.0, 0.0]]))
    assert found.above(20.0) == (((0, 1, 2), np.inf),)
    assert found.whole == np.inf


def test_a_triple_is_not_told_where_a_pair_of_it_already_is() -> None:
    found = collinearity(np.array([[1.0, 1.0, 0.0], [0.0, 0.0, 1.0]]))
    assert found.above(20.0) == (((0, 1), np.inf),)


@given(st.integers(0, 10_000))
@settings(max_examples=30)
def test_indices_do_not_know_units_signs_or_lengths(seed: int) -> None:
    noise = np.random.default_rng(seed)
    s = noise.normal(size=(6, 4))
    scale = noise.uniform(0.1, 10.0, 4) * noise.choice([-1.0, 1.0], 4)
    np.testing.assert_allclose(
        np.sort(collinearity(s).indices), np.sort(collinearity(s * scale).indices), rtol=1e-7
    )


def test_three_of_many_are_left_out_and_pairs_are_not() -> None:
    many = np.random.default_rng(0).normal(size=(150, 101))
    found = collinearity(many)
    assert (found.members[:, 2] == -1).all()
    assert found.indices.size == 50


@pytest.mark.parametrize(
    ("weights", "deviations"),
    [(np.ones(3), np.ones(2)), (np.ones(2), np.ones(3)), (np.ones(2), np.array([1.0, np.nan]))],
)
def test_what_does_not_fit_together_is_refused(weights: Floats, deviations: Floats) -> None:
    with pytest.raises(CampaignError):
        identifiability(np.eye(2), weights, deviations, np.ones(2))


# -- Intervals over many noisy twins of a chain of six masses between walls.

SPRINGS = np.array([1500.0, 1600.0, 1400.0, 1700.0, 1300.0, 1500.0, 1300.0])
MASSES = np.array([1.8, 2.4, 1.6, 1.2, 1.1, 0.9])
TWINS = 200
DEVIATION = 0.002


def chain(theta: Floats) -> tuple[Floats, Floats]:
    """Eigenvalues (6,) of the chain whose first springs are scaled, and their derivatives."""
    k = SPRINGS.copy()
    k[: theta.size] *= theta
    stiffness = np.diag(k[:-1] + k[1:]) - np.diag(k[1:-1], 1) - np.diag(k[1:-1], -1)
    root = np.sqrt(MASSES)
    eigenvalues, vectors = np.linalg.eigh(stiffness / np.outer(root, root))
    walls = np.vstack([np.zeros(6), vectors / root[:, None], np.zeros(6)])
    stretch = np.diff(walls, axis=0)[: theta.size]
    return eigenvalues, (SPRINGS[: theta.size, None] * stretch**2).T


def estimate(
    measured: Floats, form: LinearForm, deviations: Floats, n_modes: int, iterations: int = 30
) -> tuple[Floats, Floats]:
    """Parameters (n,) and their standard errors from frequencies, by steps as a campaign's."""
    n = deviations.size
    theta, weights = np.ones(n), np.full(n_modes, (2.0 * DEVIATION) ** -2)
    lam_m, prior = measured[:n_modes], deviations**-2
    for _ in range(iterations):
        lam, slopes = chain(theta)
        s = slopes[:n_modes] / lam_m[:, None]
        problem = StepProblem(
            s,
            (lam_m - lam[:n_modes]) / lam_m,
            weights,
            prior,
            theta - 1.0,
            np.full(n, -0.3),
            np.full(n, 0.3),
        )
        change = parameter_step(problem, form).change
        theta = np.maximum(theta + change, 0.1)
        if np.abs(change).max() < 1e-9:
            break
    held = prior if form == "pulled_to_initial" else None
    covariance = parameter_covariance(s, 1.0 / weights, weights, held)
    return theta, np.sqrt(np.diag(covariance))


def coverage(
    form: LinearForm,
    truths: Floats,
    deviations: Floats,
    n_modes: int,
    seed: int,
    iterations: int = 30,
) -> Floats:
    """Share of twins whose 95 % interval holds the truth, (n_parameters,)."""
    noise = np.random.default_rng(seed)
    held = np.zeros(deviations.size)
    for truth in truths:
        # A relative deviation of a frequency is twice that of its eigenvalue.
        measured = chain(truth)[0] * (1.0 + DEVIATION * noise.normal(size=6)) ** 2
        theta, errors = estimate(measured, form, deviations, n_modes, iterations)
        held += np.abs(theta - truth) <= 1.959964 * errors  # the normal law's 97.5 % point
    return np.asarray(held / len(truths))


def test_the_intervals_of_least_squares_hold_the_truth_in_95_of_100_twins() -> None:
    truths = np.tile([1.2, 0.85, 1.1], (TWINS, 1))
    held = coverage("weighted_least_squares", truths, np.full(3, 0.3), 6, seed=1)
    # 200 draws at 0.95: one standard deviation is 0.015.
    assert (held >= 0.90).all()
    assert (held <= 0.99).all()
    assert held.mean() == pytest.approx(0.95, abs=0.03)


def test_damping_alone_does_not_change_where_updating_ends_but_stopping_it_early_does() -> None:
    truths = np.tile([1.2, 0.85, 1.1], (TWINS, 1))
    ended = coverage("regularised", truths, np.full(3, 0.3), 6, seed=1)
    free = coverage("weighted_least_squares", truths, np.full(3, 0.3), 6, seed=1)
    np.testing.assert_allclose(ended, free, atol=0.01)
    # One step of four frequencies for four springs: what the test hardly sees has not moved yet.
    early = coverage(
        "regularised",
        np.tile([1.3, 0.7, 1.3, 0.8], (TWINS, 1)),
        np.full(4, 0.02),
        5,
        seed=1,
        iterations=1,
    )
    assert early.min() < 0.5


def test_a_pull_keeps_its_promise_for_truths_as_uncertain_as_it_was_told() -> None:
    # Seven springs, six frequencies: no test alone can tell them; the prior holds the rest.
    deviations = np.full(7, 0.05)
    truths = 1.0 + 0.05 * np.random.default_rng(5).normal(size=(TWINS, 7))
    held = coverage("pulled_to_initial", truths, deviations, 6, seed=2)
    assert held.mean() == pytest.approx(0.95, abs=0.03)
    assert (held >= 0.90).all()
    assert (held <= 0.99).all()


def test_a_pull_that_was_told_too_small_a_deviation_misses_the_truth() -> None:
    deviations = np.full(7, 0.02)
    truths = 1.0 + 0.1 * np.random.default_rng(5).normal(size=(TWINS, 7))  # five times as far
    held = coverage("pulled_to_initial", truths, deviations, 6, seed=2)
    assert held.max() < 0.9
