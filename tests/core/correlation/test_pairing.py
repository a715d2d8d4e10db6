"""Pairing of measured and computed modes."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from modetune.core.correlation.pairing import (
    LostMode,
    Pairing,
    close_modes,
    pair_by_order,
    pair_by_shape,
    pair_by_tracking,
)
from modetune.core.errors import ModesError
from modetune.core.modes import ModeSet, mode_set


def sines(frequencies: list[float], order: list[int], noise: float = 0.0) -> ModeSet:
    """Sine shapes of a string at 20 places, numbered by `order`."""
    x = np.linspace(0.0, np.pi, 22)[1:-1]
    shapes = np.stack([np.sin(n * x) for n in order], axis=1)
    shapes = shapes + noise * np.random.default_rng(0).normal(size=shapes.shape)
    return mode_set(frequencies, shapes, np.arange(20), np.full(20, 3))


@given(st.permutations(range(1, 7)), st.integers(0, 2**31))
@settings(max_examples=25)
def test_pairs_do_not_depend_on_order_sign_or_scale(order: list[int], seed: int) -> None:
    noise = np.random.default_rng(seed)
    measured = sines([10.0 * n for n in range(1, 7)], list(range(1, 7)))
    scaled = sines([10.5 * n for n in order], order)
    shapes = scaled.mode_shapes * noise.uniform(0.1, 50.0, 6) * noise.choice([-1.0, 1.0], 6)
    computed = mode_set(scaled.frequencies_hz, shapes, scaled.nodes, scaled.components)
    pairing = pair_by_shape(measured, computed)
    assert [order[place] for place in pairing.computed] == list(range(1, 7))
    np.testing.assert_allclose(pairing.mac, 1.0)


def test_pairing_is_one_to_one_where_two_modes_like_the_same() -> None:
    # Both measured shapes resemble sine 1 most; one of them must take the next best.
    x = np.linspace(0.0, np.pi, 22)[1:-1]
    shapes = np.stack([np.sin(x), np.sin(x) + 0.8 * np.sin(2 * x)], axis=1)
    measured = mode_set([10.0, 20.0], shapes, np.arange(20), np.full(20, 3))
    pairing = pair_by_shape(measured, sines([10.0, 20.0, 30.0], [1, 2, 3]))
    assert pairing.computed.tolist() == [0, 1]
    assert "answers another measured mode better" in pairing.reasons[1]


def test_frequency_breaks_the_tie_of_equal_shapes() -> None:
    measured = sines([10.0, 20.0], [1, 2])
    computed = sines([31.0, 20.0, 10.1], [1, 2, 1])
    assert pair_by_shape(measured, computed).computed.tolist() == [2, 1]


def test_a_mode_missed_by_the_solver_is_lost() -> None:
    with pytest.raises(LostMode, match=r"the measured mode at 30 Hz"):
        pair_by_shape(sines([10.0, 20.0, 30.0], [1, 2, 3]), sines([10.0, 20.0, 40.0], [1, 2, 4]))


def test_fewer_computed_than_measured_modes_are_a_lost_mode() -> None:
    with pytest.raises(LostMode, match="compute more modes"):
        pair_by_order(sines([1.0, 2.0], [1, 2]), sines([1.0], [1]))


def test_turned_close_modes_are_found_in_their_common_space() -> None:
    measured = sines([10.0, 20.0, 20.1], [1, 2, 3])
    x = np.linspace(0.0, np.pi, 22)[1:-1]
    two, three = np.sin(2 * x), np.sin(3 * x)
    shapes = np.stack([np.sin(x), two + three, two - three], axis=1)
    computed = mode_set([10.0, 20.0, 20.1], shapes, np.arange(20), np.full(20, 3))
    pairing = pair_by_shape(measured, computed)
    np.testing.assert_allclose(pairing.mac, [1.0, 0.5, 0.5], atol=1e-12)
    np.testing.assert_allclose(pairing.subspace_mac, 1.0)
    assert "in the space of close elastic modes 2, 3" in pairing.reasons[1]


def test_without_shapes_the_order_of_frequency_decides() -> None:
    measured = mode_set([30.0, 10.0, 20.0])
    computed = sines([21.0, 11.0, 31.0, 41.0], [2, 1, 3, 4])
    pairing = pair_by_order(measured, computed)
    assert pairing.computed.tolist() == [2, 1, 0]
    assert np.isnan(pairing.mac).all()


def test_tracking_follows_shapes_that_change_places() -> None:
    before = sines([10.0, 20.0, 30.0], [1, 2, 3])
    pairing = pair_by_order(mode_set([10.0, 20.0, 30.0]), before)
    after = sines([10.0, 21.0, 22.0], [1, 3, 2])
    again = pair_by_tracking(pairing, before, after)
    assert again.computed.tolist() == [0, 2, 1]
    assert "now elastic mode 3 (was 2)" in again.reasons[1]


def test_tracking_does_not_invent_a_continuation() -> None:
    before = sines([10.0, 20.0], [1, 2])
    pairing = pair_by_order(mode_set([10.0, 20.0]), before)
    with pytest.raises(LostMode, match="does not continue"):
        pair_by_tracking(pairing, before, sines([10.0, 20.0], [1, 7]))


def test_no_common_sensor_is_told() -> None:
    computed = sines([10.0], [1])
    elsewhere = mode_set([10.0], np.ones((2, 1)), [100, 101], [1, 1])
    with pytest.raises(ModesError, match="no sensor"):
        pair_by_shape(elsewhere, computed)


def test_a_computed_mode_that_rests_at_all_sensors_is_no_partner() -> None:
    computed = sines([10.0, 20.0, 30.0], [1, 2, 3])
    shapes = computed.mode_shapes.copy()
    shapes[:, 1] = 0.0  # in the plane, where the sensors measure across it
    still = mode_set([10.0, 20.0, 30.0], shapes, computed.nodes, computed.components)
    pairing = pair_by_shape(sines([10.0, 30.0], [1, 3]), still)
    assert pairing.computed.tolist() == [0, 2]


def test_turned_close_modes_are_judged_by_their_space() -> None:
    measured = sines([10.0, 20.0, 20.1], [1, 2, 3])
    x = np.linspace(0.0, np.pi, 22)[1:-1]
    two, three = np.sin(2 * x), np.sin(3 * x)
    shapes = np.stack([np.sin(x), two + three, two - three], axis=1)
    computed = mode_set([10.0, 20.0, 20.1], shapes, np.arange(20), np.full(20, 3))
    np.testing.assert_allclose(pair_by_shape(measured, computed).judged_mac, 1.0)


def test_close_modes_are_within_their_width() -> None:
    frequencies = np.array([10.0, 10.1, 12.0])
    assert close_modes(frequencies, 0).tolist() == [0, 1]
    assert close_modes(frequencies, 2).tolist() == [2]


def test_a_shape_of_rounding_resembles_nothing() -> None:
    # A torsion mode of beams on one axis turns and does not move: its translations are noise.
    generator = np.random.default_rng(4)
    shapes = generator.normal(size=(12, 3))
    shapes[:, 1] = 1e-13 * generator.normal(size=12)
    modes = mode_set(np.array([1.0, 2.0, 3.0]), shapes, np.arange(1, 13), np.ones(12))
    before = Pairing(np.arange(3), np.arange(3), np.full(3, np.nan), np.full(3, np.nan), ("",) * 3)
    with pytest.raises(LostMode, match="the elastic mode at 2 Hz"):
        pair_by_tracking(before, modes, modes)
    kept = before.computed[[0, 2]]
    pairing = Pairing(np.arange(2), kept, np.full(2, np.nan), np.full(2, np.nan), ("",) * 2)
    np.testing.assert_array_equal(pair_by_tracking(pairing, modes, modes).computed, kept)


def test_a_lost_mode_names_the_pair_that_took_its_likeness() -> None:
    """The measured mode at 30 Hz resembles sine 2 most, which is the pair of the one at 20 Hz."""
    x = np.linspace(0.0, np.pi, 22)[1:-1]
    shapes = np.stack([np.sin(x), np.sin(2 * x), np.sin(2 * x) + 0.7 * np.sin(5 * x)], axis=1)
    measured = mode_set([10.0, 20.0, 30.0], shapes, np.arange(20), np.full(20, 3))
    computed = sines([10.0, 20.0, 40.0], [1, 2, 4])
    text = r"left for it is 0\.00.*20 Hz, with MAC 0\.67, is the pair of the measured mode at 20 Hz"
    with pytest.raises(LostMode, match=text):
        pair_by_shape(measured, computed)


def test_a_roll_about_the_line_of_the_sensors_is_no_pair() -> None:
    """Its motion there, 5e-7 of bending's, happens to look like the measured mode at 30 Hz."""
    measured = sines([10.0, 20.0, 30.0], [1, 2, 3])
    computed = sines([10.0, 20.0, 29.0, 40.0], [1, 2, 3, 4])
    rolls = computed.mode_shapes * np.array([1.0, 1.0, 5e-7, 1.0])
    roll = mode_set(
        computed.frequencies_hz, rolls, computed.nodes, computed.components, normalisation="mass"
    )
    with pytest.raises(LostMode, match="the measured mode at 30 Hz"):
        pair_by_shape(measured, roll)
    small = computed.mode_shapes * np.array([1.0, 1.0, 5e-5, 1.0])
    local = mode_set(
        computed.frequencies_hz, small, computed.nodes, computed.components, normalisation="mass"
    )
    assert pair_by_shape(measured, local).computed.tolist() == [0, 1, 2]
