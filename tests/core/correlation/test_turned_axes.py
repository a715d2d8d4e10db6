"""Axes of a whole test that are wrong: every turn of a cube is found, and none where none is."""

from __future__ import annotations

import numpy as np
import pytest

from modetune.core.correlation.sensor_errors import turn_name, turned_axes, turns
from modetune.core.modes import Floats

#: Motions of twelve points in space in five modes, whatever moves so.
MOTION = np.random.default_rng(4).standard_normal((12, 3, 5))
NONE = np.eye(3)


def seen(matrix: Floats, axes: tuple[int, ...] = (0, 1, 2), points: int = 12) -> Floats:
    """What sensors along these axes tell of the first points, their directions turned."""
    directions = np.eye(3)[list(axes)] @ matrix.T
    return np.concatenate([directions @ motion for motion in MOTION[:points]])


def test_there_are_24_turns_and_each_is_once() -> None:
    found = turns()
    assert np.array_equal(found[0], NONE)
    assert len({matrix.tobytes() for matrix in found}) == 24
    for matrix in found:
        np.testing.assert_array_equal(matrix @ matrix.T, NONE)


@pytest.mark.parametrize("place", range(24))
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_all_48_ways_are_found(place: int, sign: float) -> None:
    truth = turns()[place]
    measured = sign * seen(truth) + 0.03 * np.random.default_rng(place).standard_normal((36, 5))
    found = turned_axes(measured, seen)
    if place == 0:
        assert found is None
        return
    assert found is not None
    (matrix,) = found.matrices
    np.testing.assert_array_equal(matrix, truth)
    assert found.mac > 0.99


def test_a_turn_that_sensors_cannot_see_is_not_named() -> None:
    only_z = turned_axes(seen(NONE, (2,)), lambda matrix: seen(matrix, (2,)))
    assert only_z is None
    # Sensors along z in a model that has no other motion: most turns cannot be tried at all.
    lacking = turned_axes(seen(NONE, (2,)), lambda m: seen(m, (2,)) if abs(m[2, 2]) > 0.5 else None)
    assert lacking is None


def test_turns_that_nothing_tells_apart_are_all_named() -> None:
    quarter = next(m for m in turns() if turn_name(m) == "turned by 90 degrees about z")
    # Along x and z alone nothing tells where y went, nor with it the common sign of both.
    found = turned_axes(seen(quarter, (0, 2)), lambda matrix: seen(matrix, (0, 2)))
    assert found is not None
    assert found.told[0] == "turned by 90 degrees about z"
    assert len(found.matrices) == 2
    alone = turned_axes(seen(quarter, (0,)), lambda matrix: seen(matrix, (0,)))
    assert alone is not None
    assert len(alone.matrices) == 8  # x to y or to -y, times four turns about it


def test_the_words_say_what_a_turn_does() -> None:
    z = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    assert turn_name(z) == "turned by 90 degrees about z"
    assert turn_name(z.T) == "turned by -90 degrees about z"
    assert turn_name(np.diag([1.0, -1.0, -1.0])) == (
        "turned by 180 degrees about x, or x alone reversed"
    )
    cycle = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    assert turn_name(cycle) == "exchanged in turn (x is y, y is z, z is x)"
    assert len({turn_name(matrix) for matrix in turns()}) == 24
