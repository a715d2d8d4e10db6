"""Correlation of frequency responses."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from modetune.core.errors import ModesError
from modetune.core.measurement.response_functions import NormalModes, frac, modal_frf

LINES = np.linspace(5.0, 60.0, 400)


def responses(frequency_hz: float = 20.0, lines: Any = LINES) -> Any:
    """Two modes seen at three outputs from two inputs."""
    shapes = np.array([[1.0, 1.0], [2.0, -1.0], [0.5, 3.0]])
    eigenvalues = (2.0 * np.pi * np.array([frequency_hz, 45.0])) ** 2
    modes = NormalModes(eigenvalues, shapes, np.array([0.02, 0.02]))
    return modal_frf(lines, modes, [0, 1, 2], [0, 1])


@given(factor=st.complex_numbers(min_magnitude=1e-6, max_magnitude=1e6))
def test_frac_is_one_for_scaled_copies(factor: complex) -> None:
    np.testing.assert_allclose(frac(responses(), factor * responses()), np.ones((3, 2)))


def test_frac_falls_as_a_resonance_moves_away() -> None:
    values = [frac(responses(), responses(20.0 + shift))[0, 0] for shift in (0.1, 0.5, 2.0)]
    assert 1.0 > values[0] > values[1] > values[2]


@pytest.mark.parametrize(
    ("measured", "computed"),
    [
        (responses(), responses()[:, :2]),
        (responses()[:, 0], responses()[:, 0]),
        (responses() * np.nan, responses()),
        (responses(), responses() * 0.0),
        (responses()[:0], responses()[:0]),
    ],
)
def test_responses_that_cannot_be_compared_have_no_frac(measured: Any, computed: Any) -> None:
    with pytest.raises(ModesError):
        frac(measured, computed)
