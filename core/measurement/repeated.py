"""A test that was repeated: the mean of its modes, and how exactly that is known.

Frequencies are averaged. Shapes are brought to the first test's scale and sign (by least squares,
the modal scale factor) before. With n tests the deviation of a mean is s / sqrt(n), s the standard
deviation of what was averaged. Few tests tell s of one mode badly, so it is drawn to that of all
modes, as if four more tests had scattered as modes do on average (moderated variance, Smyth 2004):

    s_i^2 <- ((n - 1) s_i^2 + 4 mean(s^2)) / (n - 1 + 4).

What all tests have wrong alike (the suspension, a sensor on another place) does not show in it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from modetune.core.errors import ModesError
from modetune.core.measurement.measurement import MeasuredDeviations
from modetune.core.modes import Floats, MeasuredModes

#: Tests that the scatter of all modes counts for, beside those of the mode itself.
BORROWED = 4
#: Repeated tests differ by less: frequencies relatively, and shapes from MAC 1.
APART, UNLIKE = 0.1, 0.3


def mean_of_tests(tests: Sequence[MeasuredModes]) -> tuple[MeasuredModes, MeasuredDeviations]:
    """The mean of two or more tests of the same modes at the same sensors.

    Raises ModesError where they are not, or where nothing scatters.
    """
    first, n = tests[0], len(tests)
    for other in tests[1:]:
        _check_alike(first, other)
    hz = np.stack([test.modes.frequencies_hz for test in tests])
    mean_hz = hz.mean(axis=0)
    frequencies = _of_mean(np.var(hz / mean_hz, axis=0, ddof=1), n)
    shapes = np.full(mean_hz.size, np.nan)
    modes = replace(first.modes, frequencies_hz=mean_hz)
    if first.has_shapes:
        scaled = np.stack([_scaled(np.real(first.modes.mode_shapes), test) for test in tests])
        mean = scaled.mean(axis=0)
        variances = np.mean(np.var(scaled, axis=0, ddof=1), axis=0) / np.mean(mean**2, axis=0)
        shapes = _of_mean(variances, n)
        modes = replace(modes, mode_shapes=mean)
    if not (frequencies > 0.0).all() or (shapes == 0.0).any():
        raise ModesError("the repeated tests are the same; they tell nothing of what scatters")
    return MeasuredModes(first.numbers, modes), MeasuredDeviations(frequencies, shapes)


def _check_alike(first: MeasuredModes, other: MeasuredModes) -> None:
    one, two = first.modes, other.modes
    if first.numbers != other.numbers:
        has, wanted = (", ".join(map(str, test.numbers)) for test in (other, first))
        raise ModesError(f"modes {has}, and not {wanted}")
    if not (
        np.array_equal(one.nodes, two.nodes) and np.array_equal(one.components, two.components)
    ):
        raise ModesError("its sensors are others, or in another order")
    far = np.flatnonzero(np.abs(two.frequencies_hz / one.frequencies_hz - 1.0) > APART)
    if far.size:
        place = int(far[0])
        raise ModesError(
            f"mode {first.numbers[place]} at {two.frequencies_hz[place]:g} Hz, and at "
            f"{one.frequencies_hz[place]:g} Hz in the first"
        )
    if not first.has_shapes:
        return
    a, b = one.mode_shapes, two.mode_shapes
    mac = np.sum(a * b, axis=0) ** 2 / (np.sum(a**2, axis=0) * np.sum(b**2, axis=0))
    if (mac < 1.0 - UNLIKE).any():
        place = int(np.argmin(mac))
        raise ModesError(f"mode {first.numbers[place]} has another shape (MAC {mac[place]:.2f})")


def _scaled(wanted: Floats, test: MeasuredModes) -> Floats:
    own = np.real(test.modes.mode_shapes)
    return np.asarray(own * (np.sum(wanted * own, axis=0) / np.sum(own**2, axis=0)))


def _of_mean(variances: Floats, n: int) -> Floats:
    """Standard deviations of means of n from the variances of what was averaged."""
    drawn = ((n - 1) * variances + BORROWED * variances.mean()) / (n - 1 + BORROWED)
    return np.asarray(np.sqrt(drawn / n))
