"""A test whose sensors were spoilt on purpose is the good test again after the corrections."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from modetune.core.errors import ModesError
from modetune.core.measurement.measurement import MeasuredFrfs, Measurement
from modetune.core.measurement.response_functions import Complexes
from modetune.core.measurement.sensor_corrections import correct_sensors
from modetune.core.modes import MeasuredModes, mode_set

NODES, COMPONENTS = np.array([1, 1, 2, 3]), np.array([1, 3, 3, 3])


@pytest.fixture
def good() -> Measurement:
    rng = np.random.default_rng(3)
    shapes = rng.normal(size=(4, 2))
    modes = MeasuredModes((1, 2), mode_set([3.0, 5.0], shapes, NODES, COMPONENTS))
    values = rng.normal(size=(5, 4)) + 1j * rng.normal(size=(5, 4))
    force = (np.full(4, 3), np.full(4, 3), np.ones(4))
    # The file says that sensor 3.z looks along -z.
    signs = np.array([1.0, 1.0, 1.0, -1.0])
    frfs = MeasuredFrfs(
        "receptance", np.arange(1.0, 6.0), values, NODES, COMPONENTS, signs, *force, np.zeros(0)
    )
    return Measurement(modes, frfs=frfs, complex_shapes=shapes * (1.0 + 0.1j))


def recorded(good: Measurement, source: list[int], sign: list[float]) -> Measurement:
    """What the channels record when channel i is plugged in at sensor source[i]."""
    assert good.modes is not None
    assert good.frfs is not None
    assert good.complex_shapes is not None
    factor = np.array(sign)
    modes, frfs = good.modes.modes, good.frfs
    # A function's sign turns the recorded value into motion along the axis; the file has the
    # label's sign, the wire has that of the place.
    motion = frfs.values[:, source] * (frfs.signs[source] * factor)
    return replace(
        good,
        modes=MeasuredModes(
            (1, 2), replace(modes, mode_shapes=factor[:, None] * modes.mode_shapes[source])
        ),
        complex_shapes=factor[:, None] * good.complex_shapes[source],
        frfs=replace(frfs, values=motion / frfs.signs),
    )


def motions(test: Measurement) -> dict[tuple[int, int], Complexes]:
    """Motion along the axes by sensor."""
    frfs = test.frfs
    assert frfs is not None
    names = zip(frfs.nodes.tolist(), frfs.components.tolist(), strict=True)
    return dict(zip(names, (frfs.values * frfs.signs).T, strict=True))


def check_equal(found: Measurement, good: Measurement) -> None:
    assert found.modes is not None
    assert good.modes is not None
    np.testing.assert_array_equal(found.modes.modes.mode_shapes, good.modes.modes.mode_shapes)
    assert found.complex_shapes is not None
    assert good.complex_shapes is not None
    np.testing.assert_array_equal(found.complex_shapes, good.complex_shapes)
    by_sensor = motions(good)
    assert motions(found).keys() == by_sensor.keys()
    for sensor, motion in motions(found).items():
        np.testing.assert_array_equal(motion, by_sensor[sensor])


def test_a_reversed_sensor_gets_its_sign(good: Measurement) -> None:
    spoilt = recorded(good, [0, 1, 2, 3], [1.0, -1.0, 1.0, 1.0])
    check_equal(correct_sensors(spoilt, reverse=["1.z"]), good)


def test_a_node_reverses_all_its_directions(good: Measurement) -> None:
    spoilt = recorded(good, [0, 1, 2, 3], [-1.0, -1.0, 1.0, 1.0])
    check_equal(correct_sensors(spoilt, reverse=["1"]), good)


def test_exchanged_sensors_get_their_own_channels(good: Measurement) -> None:
    spoilt = recorded(good, [0, 2, 1, 3], [1.0, 1.0, 1.0, 1.0])
    check_equal(correct_sensors(spoilt, exchange=[("2.z", "1.z")]), good)


def test_reversed_names_are_those_after_the_exchange(good: Measurement) -> None:
    # Channel 2.z is plugged in at 1.z, which was mounted upside down.
    spoilt = recorded(good, [0, 2, 1, 3], [1.0, 1.0, -1.0, 1.0])
    check_equal(correct_sensors(spoilt, ["1.z"], [("1.z", "2.z")]), good)


def test_a_dropped_sensor_is_gone(good: Measurement) -> None:
    found = correct_sensors(good, drop=["1.z", "3"])
    assert found.modes is not None
    assert good.modes is not None
    assert motions(found).keys() == {(1, 1), (2, 3)}
    expected = good.modes.modes.mode_shapes[[0, 2]]
    np.testing.assert_array_equal(found.modes.modes.mode_shapes, expected)
    assert found.complex_shapes is not None
    assert found.complex_shapes.shape == (2, 2)


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        ({"reverse": ["2.y"]}, "the test has no sensor 2.y"),
        ({"exchange": [("1", "2.z")]}, "the test has no sensor 1"),
        ({"reverse": ["3.z"], "drop": ["3.z"]}, "the test has no sensor 3.z"),
    ],
)
def test_an_unknown_sensor_is_refused(
    good: Measurement, keys: dict[str, Any], message: str
) -> None:
    with pytest.raises(ModesError, match=message):
        correct_sensors(good, **keys)
