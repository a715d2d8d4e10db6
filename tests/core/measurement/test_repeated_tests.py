"""Repeated tests: their mean, and how exactly it is known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from modetune.core.errors import ModesError
from modetune.core.measurement.measurement import MeasuredDeviations, RepeatedTests
from modetune.core.measurement.repeated_tests import check_alike, mean_of_tests, measurement_of
from modetune.core.modes import Floats, MeasuredModes, mode_set

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


def mean_of(tests: list[MeasuredModes]) -> tuple[MeasuredModes, MeasuredDeviations]:
    mean = mean_of_tests(tests, [f"{place}.csv" for place in range(len(tests))])
    assert mean.modes is not None
    assert mean.deviations is not None
    return mean.modes, mean.deviations


def table(hz: Floats) -> RepeatedTests:
    n, m = hz.shape
    places = tuple(f"t.csv, line {row + 2}" for row in range(n))
    return RepeatedTests(places, tuple(range(1, m + 1)), hz, np.full((n, m), np.nan))


def test_the_mean_is_known_as_exactly_as_it_scatters() -> None:
    n = 4
    off, told = [], []
    for seed in range(300):
        mean, deviations = mean_of(repetitions(n, seed))
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
    one, two = mean_of(tests), mean_of([tests[0], *turned[1:]])
    np.testing.assert_allclose(two[0].modes.mode_shapes, one[0].modes.mode_shapes)
    np.testing.assert_allclose(two[1].shapes, one[1].shapes)


def test_frequencies_alone_may_be_repeated_and_one_that_never_changed_borrows() -> None:
    tests = [MeasuredModes((1, 2), mode_set(np.array([10.0, hz]))) for hz in (20.0, 20.1, 19.9)]
    mean, deviations = mean_of(tests)
    assert mean.modes.frequencies_hz.tolist() == [10.0, 20.0]
    # s^2 of the second is 0.005^2; the first has none of its own, but 4 of 6 of the mean's.
    expected = 0.005 * np.sqrt(np.array([4 * 0.5, 2 + 4 * 0.5]) / 6.0 / 3.0)
    np.testing.assert_allclose(deviations.frequencies, expected)
    assert np.isnan(deviations.shapes).all()


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda t: replace(t, numbers=(1, 2, 3)), "it has mode 3, and the first only 1, 2, 4"),
        (
            lambda t: replace(t, modes=t.modes.rows(range(19))),
            r"its sensors are others \(it lacks 20.x\)",
        ),
        (
            lambda t: replace(t, modes=t.modes.rows(range(19, -1, -1))),
            "its sensors are others, or in another order",
        ),
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
        check_alike(first, change(second))  # type: ignore[operator]


def test_copies_tell_nothing() -> None:
    (only,) = repetitions(1)
    with pytest.raises(ModesError, match="identical"):
        mean_of([only, only])


def test_a_test_may_lack_a_mode() -> None:
    one, two, three = repetitions(3)
    short = replace(two, numbers=(1, 4), modes=two.modes.select([0, 2]))
    mean, deviations = mean_of([one, short, three])
    both, _ = mean_of([one, three])
    # What the other modes tell of the missing one is a share of 0.002 beside two that were found.
    assert mean.modes.frequencies_hz[1] == pytest.approx(both.modes.frequencies_hz[1], rel=2e-4)
    np.testing.assert_allclose(mean.modes.mode_shapes[:, 1], both.modes.mode_shapes[:, 1])
    assert (deviations.shapes > 0.0).all()
    gone = replace(one, numbers=(1, 4), modes=one.modes.select([0, 2]))
    with pytest.raises(ModesError, match="mode 2 was found in fewer than two of 3 tests"):
        mean_of([one, gone, short])


def test_the_covariance_of_the_mean_is_that_of_a_test_over_their_number() -> None:
    random, n = np.random.default_rng(3), 400
    root = 0.003 * np.array([[1.0, 0.0, 0.0], [0.9, 0.4, 0.0], [0.8, -0.3, 0.5]])
    found = measurement_of(table(HZ * (1.0 + random.standard_normal((n, 3)) @ root.T)))
    assert found.deviations is not None
    assert found.deviations.correlation is not None
    expected = root @ root.T
    sizes = np.sqrt(np.diag(expected))
    # Of 400 tests: deviations to 1 / sqrt(800), correlations to less than 1 / sqrt(400); 4 sigma.
    np.testing.assert_allclose(found.deviations.frequencies, sizes / 20.0, rtol=4 / 800**0.5)
    np.testing.assert_allclose(
        found.deviations.correlation, expected / np.outer(sizes, sizes), atol=4 / 20.0
    )
    assert found.notes == ()


def test_correlations_that_few_tests_show_by_chance_are_drawn_to_none() -> None:
    random, largest = np.random.default_rng(5), []
    for _ in range(50):
        found = measurement_of(table(HZ * (1.0 + 0.002 * random.standard_normal((4, 3)))))
        assert found.deviations is not None
        assert found.deviations.correlation is not None
        np.linalg.cholesky(found.deviations.correlation)  # positive definite with 4 tests
        largest.append(np.abs(found.deviations.correlation - np.eye(3)).max())
    # The largest of three correlations of 4 independent tests is 0.8 in the middle.
    assert np.median(largest) < 0.6


def test_two_tests_determine_no_correlation() -> None:
    # All correlations of two rows are 1 or -1, so that their matrix has rank one.
    found = measurement_of(table(HZ * (1.0 + np.array([[0.001, -0.002, 0.003], [0.0, 0.0, 0.0]]))))
    assert found.deviations is not None
    assert found.deviations.correlation is not None
    np.testing.assert_array_equal(found.deviations.correlation, np.eye(3))


def test_tests_that_drift_are_worth_less_and_said_so() -> None:
    random, n = np.random.default_rng(7), 60
    drift = np.cumsum(random.standard_normal(n))
    drift *= 0.002 / drift.std()
    hz: Floats = HZ * (1.0 + drift[:, None] + 1e-4 * random.standard_normal((n, 3)))
    found, shuffled = measurement_of(table(hz)), measurement_of(table(hz[random.permutation(n)]))
    assert shuffled.notes == ()
    assert found.deviations is not None
    assert shuffled.deviations is not None
    assert "the 60 tests drift: each resembles the one before it" in found.notes[0]
    assert (found.deviations.frequencies > 2.0 * shuffled.deviations.frequencies).all()


def test_wrong_and_missing_values_are_told_with_their_line() -> None:
    random = np.random.default_rng(1)
    apart = 0.002 * random.standard_normal((30, 1)) + 1e-4 * random.standard_normal((30, 3))
    hz = np.asarray(HZ * (1.0 + apart), dtype=np.float64)
    hz[4, 1] *= 1.006  # within the scatter of mode 2, but not beside modes 1 and 3 of that test
    hz[7, 2] = np.nan
    found = measurement_of(table(hz))
    assert found.notes[0] == "of 30 tests not all found every mode: mode 3 in 1 not"
    assert found.notes[1].startswith("t.csv, line 6: mode 2 at 12.0")
    assert "is left out: the other tests" in found.notes[1]
    assert len(found.notes) == 2
    assert found.repeats is not None
    assert found.repeats.used is not None
    assert np.argwhere(~found.repeats.used).tolist() == [[4, 1], [7, 2]]
