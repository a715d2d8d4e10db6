"""Which columns of a sensitivity tell something that the others do not: closed forms."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from modetune.core.errors import CampaignError
from modetune.core.modes import Floats
from modetune.core.updating.subset import collinear_groups, forward_selection, qr_order

DEGREES = np.pi / 180.0


def plane(*angles: float) -> Floats:
    """Unit columns at these angles (degrees) in a plane."""
    turned = DEGREES * np.array(angles)
    return np.array([np.cos(turned), np.sin(turned)])


def test_pivoting_takes_orthogonal_columns_by_their_length() -> None:
    found = qr_order(np.diag([2.0, 5.0, 3.0]))
    assert found.order.tolist() == [1, 2, 0]
    np.testing.assert_allclose(found.added, [5.0, 3.0, 2.0])
    np.testing.assert_allclose(found.shares, 1.0)
    assert found.rank == 3


def test_what_a_column_adds_is_the_sine_of_its_angle() -> None:
    # A column of length 2 at 0 degrees, one of length 1 at 30: sin 30 = 0.5 of it is new.
    found = qr_order(plane(0.0, 30.0) * [2.0, 1.0])
    assert found.order.tolist() == [0, 1]
    np.testing.assert_allclose(found.added, [2.0, 0.5])
    np.testing.assert_allclose(found.shares, [1.0, 0.5])


def test_a_column_that_repeats_another_comes_last_and_adds_nothing() -> None:
    s = np.array([[3.0, -1.5, 0.0], [0.0, 0.0, 1.0], [0.0, 0.0, 0.0]])
    found = qr_order(s)
    assert found.order.tolist() == [0, 2, 1]
    assert found.rank == 2
    assert found.shares[2] == 0.0


def test_more_columns_than_rows_have_the_rank_of_the_rows() -> None:
    found = qr_order(plane(0.0, 90.0, 45.0, 10.0) * [4.0, 3.0, 1.0, 1.0])
    assert found.rank == 2
    assert sorted(found.order.tolist()) == [0, 1, 2, 3]
    assert found.added[2:].tolist() == [0.0, 0.0]


@given(st.integers(0, 10_000), st.integers(2, 8), st.integers(1, 6))
@settings(max_examples=40)
def test_pivoting_keeps_the_volume_of_the_columns(seed: int, rows: int, columns: int) -> None:
    s = np.random.default_rng(seed).normal(size=(max(rows, columns), columns))
    found = qr_order(s)
    assert sorted(found.order.tolist()) == list(range(columns))
    # The product of |R_ii| is the volume, which is that of the singular values.
    volume = np.prod(np.linalg.svd(s, compute_uv=False))
    np.testing.assert_allclose(np.prod(found.added), volume, rtol=1e-8)


def test_forward_selection_finds_the_columns_a_residual_is_made_of() -> None:
    s = np.random.default_rng(7).normal(size=(12, 8))
    order, misfits = forward_selection(s, 3.0 * s[:, 5] - 2.0 * s[:, 2])
    assert set(order[:2].tolist()) == {2, 5}
    assert order.size == 2
    assert misfits[-1] < 1e-20 * misfits[0]


def test_the_misfits_of_forward_selection_are_those_of_least_squares() -> None:
    noise = np.random.default_rng(3)
    s, z = noise.normal(size=(10, 6)), noise.normal(size=10)
    order, misfits = forward_selection(s, z, least_gain=0.0)
    for count in range(order.size + 1):
        chosen = s[:, order[:count]]
        left = z - chosen @ np.linalg.lstsq(chosen, z, rcond=None)[0] if count else z
        assert misfits[count] == pytest.approx(left @ left)


def test_each_turn_takes_the_column_that_lowers_least_squares_most() -> None:
    noise = np.random.default_rng(11)
    s, z = noise.normal(size=(9, 5)), noise.normal(size=9)
    order, _ = forward_selection(s, z, least_gain=0.0)
    for turn in range(order.size):
        left = {}
        for other in set(range(5)) - set(order[:turn].tolist()):
            columns = s[:, [*order[:turn].tolist(), other]]
            left[other] = np.linalg.lstsq(columns, z, rcond=None)[1].item()
        assert min(left, key=lambda column: left[column]) == order[turn]


def test_the_misfit_falls_by_the_angle_to_the_residual() -> None:
    order, misfits = forward_selection(plane(90.0, 60.0), np.array([2.0, 0.0]), most=1)
    assert order.tolist() == [1]
    np.testing.assert_allclose(misfits, [4.0, 3.0])  # 4 sin^2 60


def test_columns_that_say_nothing_of_the_residual_are_not_chosen() -> None:
    s = np.eye(4)[:, 1:]
    order, _ = forward_selection(s, np.array([1.0, 0.0, 0.0, 0.05]))  # 0.25 % of the misfit
    assert order.size == 0
    assert forward_selection(s, np.zeros(4))[0].size == 0


def test_bounds_limit_what_a_column_explains() -> None:
    # Of z = (4, 3) the first column may take 1 of 4: (4 - 1)^2 + 0 + 3^2 is left, then 3^2.
    order, misfits = forward_selection(np.eye(2), np.array([4.0, 3.0]), upper=[1.0, np.inf])
    assert order.tolist() == [1, 0]
    np.testing.assert_allclose(misfits, [25.0, 16.0, 9.0])


def test_a_repeated_column_is_chosen_once() -> None:
    s = np.array([[1.0, 2.0, 0.0], [1.0, 2.0, 0.0], [0.0, 0.0, 1.0]])
    order, _ = forward_selection(s, np.array([3.0, 3.0, 1.0]), least_gain=0.0)
    assert order.size == 2
    assert len({0, 1} & set(order.tolist())) == 1


def test_like_columns_form_a_group_whatever_their_length_and_sign() -> None:
    s = np.array([[1.0, 0.0, -7.0], [2.0, 1.0, -14.0], [0.0, 3.0, 0.0]])
    assert collinear_groups(s, 1.0) == ((0, 2),)


def test_groups_reach_as_far_as_neighbours_do() -> None:
    # cos 15 = 0.966: neighbours are alike, the ends (30 degrees, 0.866) through the middle one.
    assert collinear_groups(plane(0.0, 15.0, 30.0, 90.0)) == ((0, 1, 2),)
    assert collinear_groups(plane(0.0, 20.0)) == ()  # cos 20 = 0.940


def test_columns_of_zeros_are_alike_with_nothing() -> None:
    assert collinear_groups(np.array([[0.0, 0.0, 1.0], [0.0, 0.0, 1.0]])) == ()


@pytest.mark.parametrize("wrong", [np.zeros((0, 3)), np.zeros((3, 0)), np.full((2, 2), np.nan)])
def test_what_is_no_sensitivity_is_refused(wrong: Floats) -> None:
    for choose in (qr_order, collinear_groups):
        with pytest.raises(CampaignError):
            choose(wrong)
    with pytest.raises(CampaignError):
        forward_selection(wrong, np.zeros(wrong.shape[0]))


def test_a_residual_of_another_length_is_refused() -> None:
    with pytest.raises(CampaignError, match="must have 2 finite entries"):
        forward_selection(np.eye(2), np.zeros(3))
