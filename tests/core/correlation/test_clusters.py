"""Clusters of close modes: any rotation of the solver's or the test's shapes is undone."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import ortho_group

from modetune.core.correlation.clusters import (
    paired_clusters,
    rotation_onto,
    rotation_to_test,
)
from modetune.core.correlation.pairing import Pairing, pair_by_shape
from modetune.core.modes import CLOSE, Floats, ModeSet, close_sets, mode_set
from modetune.core.updating.responses.response import Residual
from modetune.core.updating.sensitivity import ModeDerivatives
from modetune.core.updating.weighting import even_weighting
from tests.core.updating.compared import residual, residual_sensitivity

NODES = np.repeat(np.arange(1, 5), 2)
COMPONENTS = np.tile([1, 2], 4)
HZ = np.array([10.0, 10.0, 25.0, 40.0, 40.0])
SPLIT = 0.002
WEIGHTING = even_weighting(5, 8, SPLIT, 0.05)


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


def test_modes_are_close_along_a_chain_of_neighbours_whatever_their_order() -> None:
    sets = close_sets(np.array([5.0, 1.0, 1.0 + 1e-3, 4.0, 4.007, 4.014]), CLOSE)
    assert [item.tolist() for item in sets] == [[1, 2], [3, 4, 5], [0]]


@given(st.floats(-np.pi, np.pi), st.integers(0, 20))
def test_shapes_are_turned_on_to_those_of_another_solution(angle: float, seed: int) -> None:
    wanted = shapes(seed)
    given_shapes = turned(wanted, angle) * np.array([1.0, 1.0, -1.0, 1.0, 1.0])
    rotation = rotation_onto(given_shapes, wanted, HZ)
    np.testing.assert_allclose(given_shapes @ rotation, wanted, atol=1e-12)
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(5), atol=1e-12)
    assert not rotation[:3, 3:].any()  # modes that are far apart are not mixed


@given(st.floats(-np.pi, np.pi), st.integers(0, 20))
def test_computed_modes_lie_as_the_tests_whatever_rotation_and_scale_these_have(
    angle: float, seed: int
) -> None:
    computed = modes(shapes(seed))
    measured = replace(
        modes(turned(shapes(seed), angle) * np.array([2.0, -0.3, 1.0, 5.0, 1.0])),
        frequencies_hz=np.array([10.0, 10.1, 25.0, 40.0, 40.4]),  # the test splits them
    )
    rotation = rotation_to_test(measured, computed, pair_by_shape(measured, computed), SPLIT)
    assert rotation is not None
    after = modes(np.real(computed.mode_shapes) @ rotation)
    pairing = pair_by_shape(measured, after)
    np.testing.assert_allclose(pairing.mac, 1.0, atol=1e-10)


def test_one_measured_member_takes_its_direction_and_the_other_is_what_is_left() -> None:
    computed = modes(shapes(1))
    measured = modes(turned(shapes(1), 0.7)).select([0, 2])
    rotation = rotation_to_test(measured, computed, pair_by_shape(measured, computed), SPLIT)
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
    rotation = rotation_to_test(one, computed, pair_by_shape(one, computed), SPLIT)
    assert rotation is not None
    after = np.real(computed.mode_shapes) @ rotation
    again = mode_set([10.0, 10.0], after, [1, 1, 2, 2], [1, 2, 1, 2])
    place = int(pair_by_shape(one, again).computed[0])
    np.testing.assert_allclose(after[[1, 3], place], 0.0, atol=1e-12)
    both = mode_set([10.0, 10.0], [[1.0, 1.0], [2.0, 2.0]], [1, 2], [1, 1])
    assert rotation_to_test(both, computed, pair_by_shape(both, computed), SPLIT) is None


def test_modes_of_their_own_eigenvalues_are_left_alone() -> None:
    computed = mode_set([10.0, 11.0], np.eye(2), [1, 2], [1, 1])
    assert rotation_to_test(computed, computed, pair_by_shape(computed, computed), SPLIT) is None


def test_a_cluster_that_neither_side_splits_is_not_turned() -> None:
    computed = modes(shapes(2))
    measured = modes(turned(shapes(2), 0.7))
    pairing = pair_by_shape(measured, computed)
    assert rotation_to_test(measured, computed, pairing, SPLIT) is None
    clusters = paired_clusters(measured, computed, pairing, SPLIT)
    assert [item.tolist() for item in clusters] == [[0, 1], [2], [3, 4]]
    np.testing.assert_allclose(pairing.mac, 1.0, atol=1e-12)


def test_modes_that_the_test_cannot_split_are_one_cluster_though_the_model_splits_them() -> None:
    computed = replace(modes(shapes(2)), frequencies_hz=np.array([9.0, 11.0, 25.0, 39.0, 42.0]))
    measured = modes(shapes(2))
    pairing = pair_by_shape(measured, computed)
    clusters = paired_clusters(measured, computed, pairing, SPLIT)
    assert [item.tolist() for item in clusters] == [[0, 1], [2], [3, 4]]


def test_no_mode_of_a_turned_cluster_goes_to_a_mode_far_away() -> None:
    # Turned by 45 degrees it has a MAC of 0.5 with its members, and of 0.6 with a mode far away,
    # which sensors on an axis cannot tell from one of them.
    far = np.sqrt(0.6) * np.eye(8)[0] + np.sqrt(0.4) * np.eye(8)[5]
    model = mode_set(
        [10.0, 10.0, 90.0], np.column_stack([np.eye(8)[0], np.eye(8)[1], far]), NODES, COMPONENTS
    )
    pair = np.eye(8)[:, :2] @ np.array([[1.0, -1.0], [1.0, 1.0]]) / np.sqrt(2.0)
    pairing = pair_by_shape(mode_set([10.2, 10.2], pair, NODES, COMPONENTS), model)
    assert sorted(pairing.computed.tolist()) == [0, 1]
    np.testing.assert_allclose(pairing.judged_mac, 1.0)


def state(test_angle: float, model_angle: float, seed: int) -> tuple[Residual, Floats, Pairing]:
    """A model of three parameters beside a noisy test, both turned within their clusters."""
    noise = np.random.default_rng(seed)
    test = shapes(seed) + 0.05 * noise.normal(size=(8, 5))
    measured = replace(modes(turned(test, test_angle)), frequencies_hz=1.03 * HZ)
    computed = modes(turned(shapes(seed), model_angle))
    pairing = pair_by_shape(measured, computed)
    # K' of each parameter in the space of the modes, and what moves outside of it.
    inner, outer = noise.normal(size=(3, 5, 5)), noise.normal(size=(3, 8, 5))
    inside = np.stack([turned(turned(k + k.T, model_angle).T, model_angle) for k in inner])
    slopes = np.diagonal(inside, axis1=1, axis2=2).T * np.square(HZ)[:, None]
    moves = np.stack([turned(item, model_angle) for item in outer], axis=-1)
    found = pairing.computed
    derivatives = ModeDerivatives(slopes[found], moves[:, found])
    return (
        residual(measured, computed, pairing, WEIGHTING),
        residual_sensitivity(measured, computed, pairing, WEIGHTING, derivatives),
        pairing,
    )


@given(st.floats(-np.pi, np.pi), st.floats(-np.pi, np.pi), st.integers(0, 20))
def test_no_rotation_inside_a_cluster_changes_step_misfit_or_agreement(
    test_angle: float, model_angle: float, seed: int
) -> None:
    one, sensitivity, pairing = state(0.0, 0.0, seed)
    other, turned_sensitivity, again = state(test_angle, model_angle, seed)
    assert other.misfit == pytest.approx(one.misfit, rel=1e-9)
    for found, matrix in ((one, sensitivity), (other, turned_sensitivity)):
        assert found.values.size == matrix.shape[0]
    normal = sensitivity.T @ (one.weights[:, None] * sensitivity)
    np.testing.assert_allclose(
        turned_sensitivity.T @ (other.weights[:, None] * turned_sensitivity),
        normal,
        rtol=1e-9,
        atol=1e-9 * normal.max(),
    )
    gradient = sensitivity.T @ (one.weights * one.values)
    np.testing.assert_allclose(
        turned_sensitivity.T @ (other.weights * other.values),
        gradient,
        rtol=1e-9,
        atol=1e-9 * np.abs(gradient).max(),
    )
    np.testing.assert_allclose(again.judged_mac, pairing.judged_mac, rtol=1e-9)
