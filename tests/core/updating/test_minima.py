"""Minima, saddles, paths and exchanges of misfits with closed forms."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from modetune.core.modes import Floats
from modetune.core.updating.minima import (
    RISE,
    MisfitAt,
    beyond_saddle,
    exchange,
    exchanges,
    joined,
    minima_of,
    negative_curvature,
    polished,
)


@dataclass
class Squares:
    """The sum of squares of residuals z(x), by complex steps; counts evaluations."""

    residuals: Callable[[Floats], Floats]
    n: int
    reach: float = 3.0
    count: int = field(default=0)

    def __post_init__(self) -> None:
        self.lower, self.upper = np.full(self.n, -self.reach), np.full(self.n, self.reach)

    def value(self, x: Floats) -> float:
        self.count += 1
        return float(np.sum(self.residuals(x) ** 2))

    def sample(self, x: Floats) -> MisfitAt | None:
        self.count += 1
        steps = x[:, None] + 1e-30j * np.eye(self.n)
        slopes = np.stack([np.imag(self.residuals(s)) / 1e-30 for s in steps.T], axis=1)
        z = self.residuals(x)
        return MisfitAt(float(z @ z), 2.0 * slopes.T @ z, 2.0 * slopes.T @ slopes)


def wells(depth: float = 100.0) -> Squares:
    """Minima at (1, 0) and (-1, 0), a saddle of this height between them."""
    return Squares(lambda x: np.array([np.sqrt(depth) * (x[0] ** 2 - 1.0), x[1]]), 2)


def series() -> Squares:
    """Two springs in series, logarithms of stiffness: 1/k1 + 1/k2 = 2, to a thousandth."""
    return Squares(lambda x: np.array([1e3 * (np.exp(-x[0]) + np.exp(-x[1]) - 2.0)]), 2)


def sectors(values: tuple[float, ...]) -> Squares:
    """The power sums of exchangeable parts, which determine them but for their order."""
    powers = np.arange(1, len(values) + 1)
    sums = [float(np.sum(np.array(values) ** power)) for power in powers]

    def residuals(x: Floats) -> Floats:
        return np.array([3000.0 * (np.sum(x**p) - s) for p, s in zip(powers, sums, strict=True)])

    return Squares(residuals, len(values))


def test_polishing_ends_at_the_minimum_within_the_bounds() -> None:
    place, value = polished(wells(), np.array([0.4, 2.0]))
    np.testing.assert_allclose(place, [1.0, 0.0], atol=1e-4)
    assert value < 1e-6
    narrow = wells()
    narrow.upper = np.array([0.5, 3.0])
    place, value = polished(narrow, np.array([0.4, 2.0]))
    # Polishing ends below 1e-5 of the misfit, 56.25, whose root is 0.024.
    np.testing.assert_allclose(place, [0.5, 0.0], atol=0.03)
    assert value == pytest.approx(100.0 * 0.75**2, rel=2e-5)


def test_polishing_ends_at_a_known_minimum_to_which_a_short_step_leads() -> None:
    known = polished(wells(), np.array([0.4, 2.0]))
    misfit = wells()
    assert polished(misfit, np.array([1.01, 0.01]), known) is known
    assert misfit.count == 1  # the point itself
    far = wells()
    assert polished(far, np.array([1.5, 0.01]), known) is known
    assert far.count > 2  # steps that are too long first
    place, value = polished(wells(), np.array([-1.01, 0.01]), known)
    np.testing.assert_allclose(place, [-1.0, 0.0], atol=1e-4)
    assert value < 1e-6


def test_polishing_where_nothing_is_determined_stays() -> None:
    flat = Squares(lambda x: np.array([100.0 * (x[0] - 0.2), 0.0 * x[1]]), 2)
    place, _ = polished(flat, np.array([0.0, 0.7]))
    np.testing.assert_allclose(place, [0.2, 0.7], atol=1e-6)


def test_a_saddle_is_left_to_both_sides_and_a_minimum_is_not() -> None:
    misfit = wells()
    direction = negative_curvature(misfit, np.zeros(2))
    assert direction is not None
    np.testing.assert_allclose(np.abs(direction), [1.0, 0.0], atol=1e-6)
    ends = [polished(misfit, place)[0] for place in beyond_saddle(misfit, np.zeros(2))]
    assert sorted(round(end[0], 4) for end in ends) == [-1.0, 1.0]
    assert beyond_saddle(misfit, np.array([1.0, 0.0])) == []


def test_curvature_counts_only_where_no_bound_holds() -> None:
    # -x^2 falls away from 0 on both sides; at the upper bound the gradient holds x there.
    misfit = Squares(lambda x: np.array([np.sqrt(100.0 - 10.0 * x[0] ** 2), x[1]]), 2, reach=1.0)
    assert negative_curvature(misfit, np.array([1.0, 0.0])) is None
    assert len(beyond_saddle(misfit, np.zeros(2))) == 2


@pytest.mark.parametrize(("depth", "one"), [(0.9 * RISE, True), (1.1 * RISE, False)])
def test_two_wells_are_one_minimum_below_the_rise(depth: float, one: bool) -> None:
    assert joined(wells(depth), np.array([1.0, 0.0]), np.array([-1.0, 0.0])) is one


def test_a_curved_valley_is_followed() -> None:
    misfit = series()
    a, b = 0.6, 3.0
    ends = [np.log([k, 1.0 / (2.0 - 1.0 / k)]) for k in (a, b)]
    # The misfit on the straight line is thousands of times the limit.
    assert misfit.value(0.5 * (ends[0] + ends[1])) > 1e3 * RISE
    assert joined(misfit, *ends)
    assert misfit.count < 150


@given(st.permutations(range(3)))
def test_permutations_are_separate_minima(order: list[int]) -> None:
    values = np.array([0.8, 1.0, 1.3])
    other = values[order]
    assert joined(sectors((0.8, 1.0, 1.3)), values, other) is bool((other == values).all())


def test_a_high_point_between_two_minima_does_not_join_them() -> None:
    misfit = wells()
    points = [np.array([1.0, 0.0]), np.array([-1.0, 0.0]), np.zeros(2), np.array([1.0, 1e-4])]
    values = np.array([misfit.value(point) for point in points])
    labels = minima_of(points, values, lambda a, b: joined(misfit, points[a], points[b]))
    assert labels[0] == labels[3] != labels[1]
    assert labels[2] in (0, 1)


def test_ends_that_failed_are_of_no_minimum() -> None:
    points = [np.zeros(1), np.ones(1)]
    labels = minima_of(points, np.array([0.0, np.inf]), lambda a, b: True)
    assert labels.tolist() == [0, -1]


@pytest.mark.parametrize("n", [2, 3, 4])
def test_all_orders_of_exchangeable_values_are_found(n: int) -> None:
    values = (0.7, 0.95, 1.2, 1.6)[:n]
    found = exchanges(sectors(values), np.array(values))
    assert len(found) == [1, 5, 23][n - 2]
    assert len({tuple(place) for place in found}) == len(found)
    for place in found:
        np.testing.assert_array_equal(np.sort(place), values)


def test_equal_values_have_fewer_orders() -> None:
    values = (0.7, 0.7, 1.2)
    assert len(exchanges(sectors(values), np.array(values))) == 2


def test_a_mirror_image_composes_from_a_known_permutation() -> None:
    # Parts change places two at a time, so no exchange of a single pair has the same misfit.
    misfit = Squares(
        lambda x: (
            100.0
            * np.array([x[0] + x[2] - 2.0, x[1] + x[3] - 2.2, (x[0] - x[2]) * (x[1] - x[3]) - 0.08])
        ),
        4,
    )
    place = np.array([1.1, 1.3, 0.9, 0.9])
    assert exchanges(misfit, place) == []
    (mirrored,) = exchanges(misfit, place, [np.array([2, 3, 0, 1])])
    np.testing.assert_array_equal(mirrored, [0.9, 0.9, 1.1, 1.3])


@given(st.permutations(range(5)))
def test_an_exchange_is_the_permutation_between_two_points(order: list[int]) -> None:
    values = np.array([0.5, 0.8, 1.0, 1.4, 2.0])
    found = exchange(values, values[order])
    assert found is not None
    np.testing.assert_array_equal(values[found], values[order])
    assert exchange(values, values + 0.1) is None
