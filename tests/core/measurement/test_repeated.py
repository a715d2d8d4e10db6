"""Repeated tests: their mean, and how exactly it is known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from modetune.core.errors import ModesError
from modetune.core.measurement.repeated import mean_of_tests
from modetune.core.modes import MeasuredModes, mode_set

HZ = np.array([5.0, 12.0, 31.0])


def repetitions(
    n: int, seed: int = 0, noise: float = 0.002, rough: float = 0.02
) -> list[MeasuredModes]:
    """Tests of one structure, each scaled anyhow, frequencies and shapes with noise."""
    random = np.random.default_rng(seed)
    true = np.random.default_rng(9).normal(size=(20, 3))
    found = []
    for _ in range(n):
        shapes = true + rough * np.sqrt(np.mean(true**2, axis=0)) * random.standard_normal((20, 3))
        hz = HZ * (1.0 + noise * random.standard_normal(3))
        scale = random.choice([-1.0, 1.0], 3) * random.uniform(0.1, 9.0, 3)
        modes = mode_set(hz, scale * shapes, np.arange(1, 21), np.ones(20))
        found.append(MeasuredModes((1, 2, 4), modes))
    return found


def test_the_mean_is_known_as_exactly_as_it_scatters() -> None:
    n = 4
    off, told = [], []
    for seed in range(300):
        mean, deviations = mean_of_tests(repetitions(n, seed))
        off.append(mean.modes.frequencies_hz / HZ - 1.0)
        told.append((deviations.frequencies, deviations.shapes))
    # 300 means of 4: their own scatter is 0.002 / 2, known to 1 / sqrt(600).
    np.testing.assert_allclose(np.std(off, axis=0), 0.001, rtol=0.15)
    frequencies, shapes = np.sqrt(np.mean(np.square(told), axis=0))
    np.testing.assert_allclose(frequencies, 0.001, rtol=0.1)
    # The scale takes one of 20 entries.
    np.testing.assert_allclose(shapes, 0.01 * np.sqrt(19 / 20), rtol=0.05)


def test_scale_and_sign_of_a_test_mean_nothing() -> None:
    tests = repetitions(3)
    turned = [
        replace(t, modes=replace(t.modes, mode_shapes=-7.0 * t.modes.mode_shapes)) for t in tests
    ]
    one, two = mean_of_tests(tests), mean_of_tests([tests[0], *turned[1:]])
    np.testing.assert_allclose(two[0].modes.mode_shapes, one[0].modes.mode_shapes)
    np.testing.assert_allclose(two[1].shapes, one[1].shapes)


def test_frequencies_alone_may_be_repeated_and_one_that_never_changed_borrows() -> None:
    tests = [MeasuredModes((1, 2), mode_set(np.array([10.0, hz]))) for hz in (20.0, 20.1, 19.9)]
    mean, deviations = mean_of_tests(tests)
    assert mean.modes.frequencies_hz.tolist() == [10.0, 20.0]
    # s^2 of the second is 0.005^2; the first has none of its own, but 4 of 6 of the mean's.
    expected = 0.005 * np.sqrt(np.array([4 * 0.5, 2 + 4 * 0.5]) / 6.0 / 3.0)
    np.testing.assert_allclose(deviations.frequencies, expected)
    assert np.isnan(deviations.shapes).all()


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda t: replace(t, numbers=(1, 2, 3)), "modes 1, 2, 3, and not 1, 2, 4"),
        (lambda t: replace(t, modes=t.modes.rows(range(19))), "its sensors are others"),
        (lambda t: replace(t, modes=t.modes.select([0, 2, 1])), "mode 2 at 3.* Hz"),
        (
            lambda t: replace(t, modes=replace(t.modes, mode_shapes=t.modes.mode_shapes[::-1])),
            "has another shape",
        ),
    ],
)
def test_other_tests_are_refused(change: object, said: str) -> None:
    first, second = repetitions(2)
    with pytest.raises(ModesError, match=said):
        mean_of_tests([first, change(second)])  # type: ignore[operator]


def test_copies_tell_nothing() -> None:
    (only,) = repetitions(1)
    with pytest.raises(ModesError, match="the same"):
        mean_of_tests([only, only])
