"""Sensors upside down and exchanged are found, and nothing where there is no mistake."""

from __future__ import annotations

import numpy as np
import pytest

from modetune.core.correlation.correlation import mac, subspace_mac
from modetune.core.correlation.sensor_errors import sensor_errors
from modetune.core.modes import Floats

N_SENSORS = 12


def string_shapes(n_modes: int = 4) -> Floats:
    """Shapes of a string at sensors of which none is the mirror image of another."""
    places = (np.arange(1, N_SENSORS + 1) / (N_SENSORS + 1.7)) ** 1.1
    return np.stack([np.sin(np.pi * (n + 1) * places) for n in range(n_modes)], axis=1)


def alone(shapes: Floats) -> list[Floats]:
    """Each mode answered by one computed mode."""
    return [shapes[:, [mode]] for mode in range(shapes.shape[1])]


def test_a_sensor_turned_round_is_named_with_the_mac_of_each_mode() -> None:
    computed = string_shapes()
    measured = computed.copy()
    measured[4] *= -1.0
    (found,) = sensor_errors(measured, alone(computed))
    assert found.rows == (4,)
    assert found.before == pytest.approx(np.diag(mac(measured, computed)))
    # By hand: with share s of the squared length in the row, the cosine is 1 - 2 s.
    shares = computed[4] ** 2 / np.sum(computed**2, axis=0)
    assert found.before == pytest.approx((1.0 - 2.0 * shares) ** 2)
    assert found.after == pytest.approx(np.ones(4))


def test_two_exchanged_sensors_are_named() -> None:
    computed = string_shapes()
    measured = computed.copy()
    measured[[2, 7]] = computed[[7, 2]]
    (found,) = sensor_errors(measured, alone(computed))
    assert found.rows == (2, 7)
    assert found.before == pytest.approx(np.diag(mac(measured, computed)))
    assert found.after == pytest.approx(np.ones(4))


def test_several_mistakes_are_found_one_after_the_other() -> None:
    computed = string_shapes()
    measured = computed.copy()
    measured[[1, 9]] *= -1.0
    found = sensor_errors(measured, alone(computed))
    assert sorted(error.rows for error in found) == [(1,), (9,)]
    assert found[1].before == pytest.approx(found[0].after)
    assert found[1].after == pytest.approx(np.ones(4))


@pytest.mark.parametrize("seed", range(10))
def test_sound_sensors_with_noise_are_not_suspected(seed: int) -> None:
    computed = string_shapes()
    noise = np.random.default_rng(seed).standard_normal(computed.shape)
    assert sensor_errors(computed + 0.1 * noise, alone(computed)) == ()


@pytest.mark.parametrize("seed", range(10))
def test_a_mistake_is_found_under_noise(seed: int) -> None:
    computed = string_shapes()
    measured = computed + 0.05 * np.random.default_rng(seed).standard_normal(computed.shape)
    measured[4] *= -1.0
    assert [error.rows for error in sensor_errors(measured, alone(computed))] == [(4,)]


def test_close_modes_that_turned_are_judged_by_their_space() -> None:
    computed = string_shapes()
    measured = computed.copy()
    measured[:, :2] = computed[:, :2] @ np.array([[0.8, -0.6], [0.6, 0.8]])
    spaces = [computed[:, :2], computed[:, :2], computed[:, [2]], computed[:, [3]]]
    assert sensor_errors(measured, spaces) == ()
    measured[5] *= -1.0
    (found,) = sensor_errors(measured, spaces)
    assert found.rows == (5,)
    assert found.before[0] == pytest.approx(subspace_mac(measured[:, 0], computed[:, :2]))
    assert found.after == pytest.approx(np.ones(4))


def test_scale_and_sign_of_the_shapes_do_not_count() -> None:
    computed = string_shapes()
    measured = computed.copy()
    measured[4] *= -1.0
    scaled = measured * np.array([-3.0, 1e-4, 1e4, 1.0])
    (found,) = sensor_errors(scaled, alone(computed))
    (plain,) = sensor_errors(measured, alone(computed))
    assert found.rows == plain.rows
    assert found.before == pytest.approx(plain.before)


def test_mistakes_that_cannot_be_told_apart_are_not_named() -> None:
    # Two sensors move, as far: to turn the first or the second gives the same MAC.
    computed = np.zeros((8, 1))
    computed[[2, 6]] = 1.0
    measured = computed.copy()
    measured[2] = -1.0
    measured[0] = 0.1
    computed[0] = 0.1
    assert sensor_errors(measured, alone(computed)) == ()


def test_few_sensors_accuse_none() -> None:
    computed = string_shapes(2)[:5]
    measured = computed * np.array([[1.0], [1.0], [-1.0], [1.0], [1.0]])
    assert sensor_errors(measured, alone(computed)) == ()


def plate(n_sensors: int, seed: int, n_modes: int = 8) -> tuple[Floats, Floats]:
    """Test and model of a plate at random places: noise of 3 %, and a model that mixes its modes.

    Closed form, sin sin; measured shapes turn by 0.3 among neighbours as model error makes them.
    """
    rng = np.random.default_rng(seed)
    x, y = rng.uniform(0.05, 0.95, (2, n_sensors))
    waves = sorted((i * i + 1.7 * j * j, i, j) for i in range(1, 6) for j in range(1, 6))
    computed = np.stack(
        [np.sin(np.pi * i * x) * np.sin(np.pi * j * y) for _, i, j in waves[:n_modes]], axis=1
    )
    mixed = rng.normal(0.0, 0.15, (n_modes, n_modes)) + np.eye(n_modes)
    measured = computed @ mixed
    rms = np.sqrt(np.mean(measured**2, axis=0))
    return measured + 0.03 * rms * rng.standard_normal(measured.shape), computed


def test_one_sensor_of_10_to_200_is_found_and_sound_ones_are_left_alone() -> None:
    # benchmarks/sensor_errors.py counts more; seeds are fixed, so these counts are exact.
    false, missed = 0, 0
    for n_sensors, n_modes in ((10, 4), (30, 8), (100, 8), (200, 8)):
        for seed in range(10):
            measured, computed = plate(n_sensors, seed, n_modes)
            false += bool(sensor_errors(measured, alone(computed), computed))
            moving = int(np.argsort(np.abs(measured).mean(axis=1))[n_sensors // 2])
            measured[moving] *= -1.0
            found = sensor_errors(measured, alone(computed), computed)
            missed += [error.rows for error in found] != [(moving,)]
    assert false == 0
    assert missed <= 2  # of 40: at ten sensors others may explain one that hardly moves


def test_a_sensor_that_hardly_moves_is_not_remarked() -> None:
    computed = string_shapes()
    computed[3] *= 0.02
    for seed in range(10):
        noise = 0.03 * np.random.default_rng(seed).standard_normal(computed.shape)
        measured = computed + noise * np.sqrt(np.mean(computed**2, axis=0))
        measured[3] = -measured[3]
        assert sensor_errors(measured, alone(computed)) == ()


def test_repeated_modes_turned_at_will_are_no_mistake() -> None:
    rng = np.random.default_rng(8)
    _, computed = plate(60, 3)
    for angle in np.linspace(0.0, np.pi, 7):
        turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
        measured = computed.copy()
        measured[:, 2:4] = computed[:, 2:4] @ turn
        measured += 0.02 * rng.standard_normal(measured.shape)
        spaces = [computed[:, 2:4] if mode in (2, 3) else computed[:, [mode]] for mode in range(8)]
        assert sensor_errors(measured, spaces, computed) == ()
        measured[11] *= -1.0
        assert [item.rows for item in sensor_errors(measured, spaces, computed)] == [(11,)]
