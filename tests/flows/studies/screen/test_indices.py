"""Indices of functions whose effects are known in closed form."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from itertools import permutations
from typing import get_args

import numpy as np
import pytest

from modetune.core.errors import CampaignError, ModesError
from modetune.core.modes import Floats
from modetune.flows.studies.screen.design import Design, make_design
from modetune.flows.studies.screen.indices import Indices, design_indices, varies
from modetune.flows.studies.screen.request import ScreeningMethod

SLOPES = np.array([3.0, -1.0, 0.25])
LOWER, UPPER = np.array([0.5, 0.8, 0.0]), np.array([1.5, 1.2, 2.0])
#: What each parameter moves y = SLOPES x by over its bounds.
WIDTHS = SLOPES * (UPPER - LOWER)


def indices(
    method: ScreeningMethod,
    function: Callable[[Floats], Floats],
    lower: Floats,
    upper: Floats,
    points: int,
    levels: int | None = None,
    seed: int = 1,
) -> Indices:
    rng = np.random.default_rng(seed)
    design = make_design(method, lower, upper, rng, points, levels)
    return design_indices(design, function(design.points)[:, None], rng)


def linear(points: Floats) -> Floats:
    return np.asarray(7.0 + points @ SLOPES)


def ishigami(x: Floats) -> Floats:
    return np.asarray(
        np.sin(x[:, 0]) + 7.0 * np.sin(x[:, 1]) ** 2 + 0.1 * x[:, 2] ** 4 * np.sin(x[:, 0])
    )


def test_sobol_indices_of_the_ishigami_function_are_those_of_its_integrals() -> None:
    # Ishigami and Homma 1990: variances of the terms with a = 7, b = 0.1 on [-pi, pi].
    a, b, pi4, pi8 = 7.0, 0.1, np.pi**4, np.pi**8
    one, two, both = 0.5 * (1 + b * pi4 / 5) ** 2, a**2 / 8, b**2 * pi8 * (1 / 18 - 1 / 50)
    total = one + two + both
    ends = np.full(3, np.pi)
    found = indices("sobol", ishigami, -ends, ends, 2048 * 5)
    first, most = found.measure("first")[0], found.measure("total")[0]
    np.testing.assert_allclose(first, np.array([one, two, 0.0]) / total, atol=0.02)
    np.testing.assert_allclose(most, np.array([one + both, two, both]) / total, atol=0.02)
    assert (found.measure("total_confidence")[0] < 0.08).all()
    assert found.used == 2048 * 5


def test_sobol_indices_of_the_g_function_are_products_of_its_variances() -> None:
    # Saltelli and Sobol 1995: V_i = 1 / (3 (1 + a_i)^2), V = prod(1 + V_i) - 1.
    a = np.array([0.0, 1.0, 4.5, 9.0])
    parts = 1.0 / (3.0 * (1.0 + a) ** 2)
    total = np.prod(1.0 + parts) - 1.0

    def g(x: Floats) -> Floats:
        return np.asarray(np.prod((np.abs(4.0 * x - 2.0) + a) / (1.0 + a), axis=1))

    found = indices("sobol", g, np.zeros(4), np.ones(4), 2048 * 6)
    np.testing.assert_allclose(found.measure("first")[0], parts / total, atol=0.03)
    np.testing.assert_allclose(
        found.measure("total")[0], parts * np.prod(1.0 + parts) / (1.0 + parts) / total, atol=0.03
    )


@pytest.mark.parametrize(
    ("method", "points", "tolerance"),
    [("morris", 40, 1e-9), ("sobol", 5 * 1024, 0.02), ("lhs", 50, 1e-9)],
)
def test_every_method_moves_a_linear_response_by_slope_times_range(
    method: ScreeningMethod, points: int, tolerance: float
) -> None:
    found = indices(method, linear, LOWER, UPPER, points)
    np.testing.assert_allclose(found.moves[0], np.abs(WIDTHS), rtol=tolerance)


def test_morris_of_a_linear_response_has_its_slopes_and_no_spread() -> None:
    found = indices("morris", linear, LOWER, UPPER, 40)
    np.testing.assert_allclose(found.measure("mu")[0], WIDTHS, rtol=1e-9)
    np.testing.assert_allclose(found.measure("mu_star")[0], np.abs(WIDTHS), rtol=1e-9)
    np.testing.assert_allclose(found.measure("sigma")[0], 0.0, atol=1e-9)


def test_morris_of_a_square_has_the_two_effects_of_its_grid() -> None:
    # Four levels step by 2/3: effects of x^2 are 2/3 from 0 and 4/3 from 1/3, equally likely.
    found = indices("morris", lambda x: x[:, 0] ** 2 + 0.0 * x[:, 1], np.zeros(2), np.ones(2), 600)
    assert found.measure("mu_star")[0, 0] == pytest.approx(1.0, abs=0.06)
    assert found.measure("sigma")[0, 0] == pytest.approx(1.0 / 3.0, abs=0.01)
    assert found.measure("mu_star")[0, 1] == 0.0


@pytest.mark.parametrize("levels", [4, 10])
def test_morris_designs_and_effects_are_those_of_salib(levels: int) -> None:
    """Of a product and a sine, at bounds that differ in size; SALib reads our design and tells the
    same effects, its interval by drawing 100 times (good to 7 %) where ours is their limit."""
    from SALib.analyze.morris import analyze

    lower, upper = np.array([0.0, 2.0, -5.0]), np.array([1.0, 2.5, 95.0])
    design = make_design("morris", lower, upper, np.random.default_rng(3), 400, levels)
    x = design.points
    unit = (x - lower) / (upper - lower)
    on_grid = unit * (levels - 1)
    np.testing.assert_allclose(on_grid, np.round(on_grid), atol=1e-9)
    moves = np.diff(unit.reshape(-1, 4, 3), axis=1)
    half = levels / 2 / (levels - 1)
    np.testing.assert_allclose(np.sort(np.abs(moves), axis=1)[:, -1], half)  # each one once
    np.testing.assert_allclose(np.abs(moves).sum(axis=(1, 2)), 3 * half)
    assert 0.4 < (moves > 0.0).sum() / 300 < 0.6
    assert {tuple(order) for order in np.abs(moves).argmax(axis=2)} == set(permutations(range(3)))
    y = x[:, 0] * x[:, 1] ** 3 + np.sin(0.1 * x[:, 2])
    found = design_indices(design, y[:, None], np.random.default_rng(0))
    theirs = analyze(design.problem, x, y, num_levels=levels, seed=1)
    for name in ("mu", "mu_star", "sigma"):
        np.testing.assert_allclose(found.measure(name)[0], np.asarray(theirs[name]), rtol=1e-9)
    confidence = np.asarray(theirs["mu_star_conf"])
    np.testing.assert_allclose(found.measure("mu_star_confidence")[0], confidence, rtol=0.25)


def test_latin_hypercube_of_a_linear_response_has_its_shares_of_the_spread() -> None:
    found = indices("lhs", linear, LOWER, UPPER, 2000)
    # Independent uniform parameters: coefficients are shares of the standard deviation.
    np.testing.assert_allclose(
        found.measure("regression")[0], WIDTHS / np.linalg.norm(WIDTHS), atol=0.01
    )
    assert found.explained[0] == pytest.approx(1.0)


def test_rank_correlation_sees_a_curve_that_regression_does_not_explain() -> None:
    found = indices("lhs", lambda x: np.exp(12.0 * x[:, 0]), np.zeros(2), np.ones(2), 200)
    assert found.measure("rank_correlation")[0, 0] == pytest.approx(1.0)  # monotonic
    assert found.explained[0] < 0.7


@pytest.mark.parametrize("method", ["morris", "sobol"])
def test_a_failed_point_leaves_out_its_whole_block(method: ScreeningMethod) -> None:
    design = make_design(method, LOWER, UPPER, np.random.default_rng(5), 200)
    responses = np.sin(linear(design.points))[:, None]
    each = int(np.sum(design.blocks == 0))
    gone = 3 * each + 1  # one point of the fourth block
    without = replace(
        design, points=design.points[design.blocks != 3], blocks=design.blocks[design.blocks != 3]
    )
    expected = design_indices(without, responses[design.blocks != 3], np.random.default_rng(1))
    responses[gone] = np.nan
    found = design_indices(design, responses, np.random.default_rng(1))
    np.testing.assert_array_equal(found.values, expected.values)
    assert found.used == len(design.points) - each


@pytest.mark.parametrize("method", ["morris", "sobol", "lhs"])
def test_too_few_good_points_are_told(method: ScreeningMethod) -> None:
    design = make_design(method, LOWER, UPPER, np.random.default_rng(5), 60)
    responses = np.full((len(design.points), 1), np.nan)
    responses[0] = 1.0
    with pytest.raises(ModesError, match=f"{len(responses) - 1} of {len(responses)} points failed"):
        design_indices(design, responses, np.random.default_rng(1))


@pytest.mark.parametrize("method", ["morris", "sobol", "lhs"])
def test_a_response_that_nothing_moves_has_no_effects(method: ScreeningMethod) -> None:
    found = indices(method, lambda x: np.full(len(x), 0.1), LOWER, UPPER, 60)
    assert not found.values.any()
    assert not found.moves.any()
    assert not varies(np.full((4, 1), 0.1 + 0.2)).any()


@pytest.mark.parametrize("method", get_args(ScreeningMethod))
def test_designs_lie_in_their_bounds_and_come_again_from_their_seed(
    method: ScreeningMethod,
) -> None:
    first, second, other = (
        make_design(method, LOWER, UPPER, np.random.default_rng(seed), 90) for seed in (4, 4, 5)
    )
    assert (first.points >= LOWER - 1e-12).all()
    assert (first.points <= UPPER + 1e-12).all()
    np.testing.assert_array_equal(first.points, second.points)
    drawn = method in ("morris", "sobol", "lhs")
    assert drawn == (not np.array_equal(first.points, other.points))


@pytest.mark.parametrize(
    ("method", "points", "n"),
    # Three parameters: trajectories of 4, base samples of 5 in a power of two.
    [("local", 90, 0), ("morris", 90, 88), ("sobol", 90, 80), ("lhs", 90, 90),
     ("morris", None, 40), ("sobol", None, 320), ("lhs", None, 30)],
)  # fmt: skip
def test_designs_have_at_most_the_points_that_were_asked_for(
    method: ScreeningMethod, points: int | None, n: int
) -> None:
    design = make_design(method, LOWER, UPPER, np.random.default_rng(1), points)
    assert len(design.points) == len(design.blocks) == n


@pytest.mark.parametrize(
    ("method", "points", "levels", "said"),
    [
        ("morris", 7, None, "at least 8"),
        ("sobol", 39, None, "at least 40"),
        ("lhs", 4, None, "at least 5"),
        ("lhs", 0, None, "expected one or more"),
        ("morris", 40, 3, "even"),
        ("sobol", 80, 4, "has no levels"),
        ("lhs", 10**9, None, "maximum is"),
    ],
)
def test_a_design_that_cannot_be_is_refused_with_a_remedy(
    method: ScreeningMethod, points: int, levels: int | None, said: str
) -> None:
    with pytest.raises(CampaignError, match=said):
        make_design(method, LOWER, UPPER, np.random.default_rng(1), points, levels)


def test_one_parameter_can_be_screened_by_every_method() -> None:
    lower, upper = np.array([0.5]), np.array([1.5])
    for method in get_args(ScreeningMethod)[1:]:
        found = indices(method, lambda x: 2.0 * x[:, 0], lower, upper, 60)
        assert found.moves[0, 0] == pytest.approx(2.0, rel=0.35)


def test_a_design_knows_its_problem_as_salib_wants_it() -> None:
    design = Design("lhs", np.zeros((0, 2)), np.zeros(0, np.int64), LOWER[:2], UPPER[:2], 0)
    assert design.problem == {
        "num_vars": 2, "names": ["0", "1"], "bounds": [[0.5, 1.5], [0.8, 1.2]],
    }  # fmt: skip
