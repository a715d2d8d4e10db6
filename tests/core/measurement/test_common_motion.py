"""What two sets of sensors both see: the same motion, measured along other directions."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from modetune.core.correlation.correlation import mac
from modetune.core.measurement.common_motion import (
    CommonMotion,
    common_motion,
    directions_of,
    turn_between,
)
from modetune.core.measurement.measurement import TestGeometry
from modetune.core.modes import Floats, ModeSet, common_dofs, mode_set

NONE = np.zeros((0, 2), dtype=np.int64), np.zeros((0, 3), dtype=np.int64)


def geometry(places: Floats, frames: Floats, nodes: Any = None, metres: float = np.nan) -> Any:
    numbers = np.arange(1, len(places) + 1) if nodes is None else np.asarray(nodes)
    return TestGeometry(numbers, places, frames, *NONE, metres)


def measured(
    motion: Floats, test: TestGeometry, components: tuple[int, ...] = (1, 2, 3)
) -> ModeSet:
    """What sensors of a test see of a motion (n_nodes, 3, n_modes) in its global axes."""
    rows = [
        (node, component, test.frames[place, (component - 1) % 3] @ motion[place])
        for place, node in enumerate(test.nodes.tolist())
        for component in components
    ]
    nodes, names, shapes = zip(*rows, strict=True)
    return mode_set(np.arange(1.0, motion.shape[2] + 1), np.array(shapes), nodes, names)


def compared(
    a: ModeSet, b: ModeSet, first: TestGeometry, second: TestGeometry
) -> tuple[CommonMotion, Floats]:
    """What both see, and the MAC there."""
    rotation, _ = turn_between(first, second)
    found = common_motion(a, b, directions_of(a, first), directions_of(b, second) @ rotation.T)
    return found, mac(*found.of(a, b))


def by_name(a: ModeSet, b: ModeSet) -> Floats:
    rows, others = common_dofs(a, b)
    return np.asarray(mac(a.mode_shapes[rows], b.mode_shapes[others]))


RANDOM = np.random.default_rng(17)
UNTURNED = np.tile(np.eye(3), (12, 1, 1))
#: A pipe's ring of twelve points; radial, tangential and axial directions at each.
ANGLES = np.arange(12) * np.pi / 6.0
RING = np.stack([np.cos(ANGLES), np.sin(ANGLES), 0.3 * np.cos(2.0 * ANGLES)], axis=1)
CYLINDRICAL = np.array(
    [[[np.cos(t), np.sin(t), 0.0], [-np.sin(t), np.cos(t), 0.0], [0.0, 0.0, 1.0]] for t in ANGLES]
)
MOTION = RANDOM.normal(size=(12, 3, 4))


def test_cylindrical_axes_against_global_ones_are_the_same_motion() -> None:
    first, second = geometry(RING, UNTURNED), geometry(RING, CYLINDRICAL)
    a, b = measured(MOTION, first), measured(MOTION, second)
    found, table = compared(a, b, first, second)
    np.testing.assert_allclose(*found.of(a, b), atol=1e-12)
    np.testing.assert_allclose(np.diag(table), 1.0, atol=1e-12)
    assert len(found.dofs) == 36
    assert np.diag(by_name(a, b)).max() < 0.8  # what names alone would make of it


def test_euler_angles_and_rotations_about_them_are_directions_too() -> None:
    frames = Rotation.from_euler("zyx", RANDOM.uniform(-180, 180, (12, 3)), degrees=True)
    first, second = geometry(RING, UNTURNED), geometry(RING, frames.as_matrix())
    a, b = measured(MOTION, first, (4, 5, 6)), measured(MOTION, second, (4, 5, 6))
    found, table = compared(a, b, first, second)
    np.testing.assert_allclose(np.diag(table), 1.0, atol=1e-12)
    assert {component for _, component in found.dofs} == {4, 5, 6}
    # Translations of one test say nothing of rotations of the other.
    assert common_motion(a, measured(MOTION, second), *[np.eye(3)[[0, 1, 2] * 12]] * 2).dofs == ()


@pytest.mark.parametrize("swapped", [False, True])
def test_a_sensor_across_a_skin_is_compared_with_three_along_the_axes(swapped: bool) -> None:
    """A blade: one accelerometer a point, along the surface's normal, called z."""
    normals = Rotation.random(12, random_state=3).as_matrix()
    first, second = geometry(RING, UNTURNED), geometry(RING, normals)
    a, b = measured(MOTION, first), measured(MOTION, second, (3,))
    sides = [(a, first), (b, second)]
    (one, here), (other, there) = reversed(sides) if swapped else sides
    found, table = compared(one, other, here, there)
    np.testing.assert_allclose(np.diag(table), 1.0, atol=1e-12)
    assert found.dofs == tuple((node, 3) for node in range(1, 13))
    used = found.used_second if swapped else found.used_first
    assert used.size == 36  # each of the three takes part


@pytest.mark.parametrize("metres", [0.001, np.nan])
def test_a_test_with_all_of_its_axes_turned_moved_and_in_millimetres_is_the_same(
    metres: float,
) -> None:
    """A mast whose second test calls upwards x."""
    turn = Rotation.from_euler("xyz", [20.0, 80.0, -35.0], degrees=True).as_matrix()
    first = geometry(RING, UNTURNED, metres=1.0 if np.isfinite(metres) else np.nan)
    second = geometry(1000.0 * RING @ turn.T + [5e3, -2e3, 7.0], UNTURNED, metres=metres)
    turned = np.einsum("ij,njm->nim", turn, MOTION)
    a, b = measured(MOTION, first), measured(turned, second)
    rotation, said = turn_between(first, second)
    np.testing.assert_allclose(rotation, turn.T, atol=1e-9)
    degrees = np.degrees(np.arccos((np.trace(turn) - 1.0) / 2.0))
    assert f"turned by {degrees:.3g} degrees, as 12 common points lie" in said
    np.testing.assert_allclose(np.diag(compared(a, b, first, second)[1]), 1.0, atol=1e-9)


@pytest.mark.parametrize("flip", [1.0, -1.0])
def test_points_on_a_line_turn_the_least(flip: float) -> None:
    """A shaft along x in one test and along z in the other, also the other way round."""
    line = np.zeros((5, 3))
    line[:, 0] = [0.0, 1.0, 2.5, 3.0, 7.0]
    other = np.roll(line, 2, axis=1) * flip  # along z
    five = np.tile(np.eye(3), (5, 1, 1))
    rotation, said = turn_between(geometry(line, five), geometry(other, five))
    np.testing.assert_allclose(rotation @ [0.0, 0.0, flip], [1.0, 0.0, 0.0], atol=1e-12)
    np.testing.assert_allclose(rotation @ [0.0, 1.0, 0.0], [0.0, 1.0, 0.0], atol=1e-12)
    assert "about the line of the points stays open" in said
    half, _ = turn_between(geometry(line, five), geometry(-line, five))
    np.testing.assert_allclose(half @ line.T, -line.T, atol=1e-12)
    assert np.linalg.det(half) == pytest.approx(1.0)


def test_points_that_do_not_fit_leave_the_axes_and_are_doubted() -> None:
    other = geometry(RANDOM.permutation(RING) * [1.0, 2.0, 3.0], UNTURNED)
    rotation, said = turn_between(geometry(RING, UNTURNED), other)
    np.testing.assert_array_equal(rotation, np.eye(3))
    assert said.startswith("doubtful")
    few = geometry(RING[:2], UNTURNED[:2])
    np.testing.assert_array_equal(turn_between(geometry(RING, UNTURNED), few)[0], np.eye(3))


def test_a_hand_measured_place_turns_nothing() -> None:
    rough = RING + RANDOM.uniform(-0.004, 0.004, RING.shape)
    rotation, said = turn_between(geometry(RING, UNTURNED), geometry(rough, UNTURNED))
    np.testing.assert_array_equal(rotation, np.eye(3))
    assert said == ""


def test_directions_that_nothing_spans_are_left_out() -> None:
    """Two sensors ten degrees apart do not tell the motion across them."""
    a = mode_set([1.0], [[1.0], [2.0]], [1, 1], [1, 3])
    near = np.array([[1.0, 0.0, 0.0], [np.cos(0.17), np.sin(0.17), 0.0]])
    b = mode_set([1.0], [[1.0], [1.0]], [1, 1], [1, 2])
    axes = np.eye(3)[[0, 2]]
    found = common_motion(a, b, axes, near)
    assert found.dofs == ((1, 1),)
    assert (found.used_first.tolist(), found.used_second.tolist()) == ([0], [0])
    across = np.eye(3)[[1, 0]]
    nothing = common_motion(a.rows([1]), b, axes[1:], across)
    assert (nothing.dofs, nothing.first.shape, nothing.second.shape) == ((), (0, 1), (0, 2))


def test_a_sensor_that_looks_backwards_gets_its_sign() -> None:
    first, second = geometry(RING, UNTURNED), geometry(RING, -UNTURNED)
    a, b = measured(MOTION, first), measured(MOTION, second)
    found, _ = compared(a, b, first, second)
    np.testing.assert_allclose(found.of(a, b)[1], a.mode_shapes, atol=1e-15)
