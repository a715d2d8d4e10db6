"""Repeated modes: any rotation of the solver's or the test's shapes is undone."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import ortho_group

from modetune.core.correlation.pairing import pair_by_shape
from modetune.core.correlation.repeated import repeated_modes, rotation_onto, rotation_to_test
from modetune.core.modes import Floats, ModeSet, mode_set

NODES = np.repeat(np.arange(1, 5), 2)
COMPONENTS = np.tile([1, 2], 4)
HZ = np.array([10.0, 10.0, 25.0, 40.0, 40.0])


def shapes(seed: int) -> Floats:
    """Five shapes at eight degrees of freedom, orthonormal as with unit masses there."""
    return np.asarray(ortho_group.rvs(8, random_state=seed)[:, :5])


def turned(mode_shapes: Floats, angle: float) -> Floats:
    """The first pair turned by an angle, the last by twice that and mirrored."""
    found = mode_shapes.copy()
    for first, last, by, side in ((0, 1, angle, 1.0), (3, 4, 2.0 * angle, -1.0)):
        cos, sin = np.cos(by), np.sin(by)
        pair = np.array([[cos, -sin], [side * sin, side * cos]])
        found[:, first : last + 1] = mode_shapes[:, first : last + 1] @ pair
    return found


def modes(mode_shapes: Floats) -> ModeSet:
    return mode_set(HZ, mode_shapes, NODES, COMPONENTS)


def test_modes_are_repeated_where_printed_digits_cannot_tell_them() -> None:
    sets = repeated_modes(np.array([1.0, 1.0 + 1e-7, 1.001, 4.0, 4.0, 4.0 * (1.0 + 4e-7)]))
    assert [item.tolist() for item in sets] == [[0, 1], [2], [3, 4, 5]]


@given(st.floats(-np.pi, np.pi), st.integers(0, 20))
def test_shapes_are_turned_on_to_those_of_another_solution(angle: float, seed: int) -> None:
    wanted = shapes(seed)
    given_shapes = turned(wanted, angle) * np.array([1.0, 1.0, -1.0, 1.0, 1.0])
    rotation = rotation_onto(given_shapes, wanted, np.square(HZ))
    np.testing.assert_allclose(given_shapes @ rotation, wanted, atol=1e-12)
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(5), atol=1e-12)
    assert not rotation[:3, 3:].any()  # modes of other eigenvalues are not mixed


@given(st.floats(-np.pi, np.pi), st.integers(0, 20))
def test_computed_modes_lie_as_the_tests_whatever_rotation_and_scale_these_have(
    angle: float, seed: int
) -> None:
    computed = modes(shapes(seed))
    measured = modes(turned(shapes(seed), angle) * np.array([2.0, -0.3, 1.0, 5.0, 1.0]))
    rotation = rotation_to_test(measured, computed, pair_by_shape(measured, computed))
    assert rotation is not None
    after = modes(np.real(computed.mode_shapes) @ rotation)
    pairing = pair_by_shape(measured, after)
    np.testing.assert_allclose(pairing.mac, 1.0, atol=1e-10)


def test_one_measured_member_takes_its_direction_and_the_other_is_what_is_left() -> None:
    computed = modes(shapes(1))
    measured = modes(turned(shapes(1), 0.7)).select([0, 2])
    rotation = rotation_to_test(measured, computed, pair_by_shape(measured, computed))
    assert rotation is not None
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(5), atol=1e-12)
    after = np.real(computed.mode_shapes) @ rotation
    found = pair_by_shape(measured, modes(after))
    np.testing.assert_allclose(found.mac, 1.0, atol=1e-10)


def test_sensors_that_see_one_direction_alone_tell_one_member() -> None:
    # Equal masses in two directions: the pair moves along x and along y, sensors look along x.
    along = np.array([[1.0, 0.0], [0.0, 1.0], [2.0, 0.0], [0.0, 2.0]]) @ np.array(
        [[0.6, -0.8], [0.8, 0.6]]
    )
    computed = mode_set([10.0, 10.0], along, [1, 1, 2, 2], [1, 2, 1, 2])
    one = mode_set([10.0], [[1.0], [2.0]], [1, 2], [1, 1])
    rotation = rotation_to_test(one, computed, pair_by_shape(one, computed))
    assert rotation is not None
    after = np.real(computed.mode_shapes) @ rotation
    again = mode_set([10.0, 10.0], after, [1, 1, 2, 2], [1, 2, 1, 2])
    place = int(pair_by_shape(one, again).computed[0])
    np.testing.assert_allclose(after[[1, 3], place], 0.0, atol=1e-12)
    both = mode_set([10.0, 10.0], [[1.0, 1.0], [2.0, 2.0]], [1, 2], [1, 1])
    assert rotation_to_test(both, computed, pair_by_shape(both, computed)) is None


def test_modes_of_their_own_eigenvalues_are_left_alone() -> None:
    computed = mode_set([10.0, 11.0], np.eye(2), [1, 2], [1, 1])
    assert rotation_to_test(computed, computed, pair_by_shape(computed, computed)) is None
