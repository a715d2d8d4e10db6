"""Complex shapes: how far from real they are, and the real ones nearest to them."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from modetune.core.correlation.complexity import (
    modal_phase_collinearity,
    real_shapes,
)
from modetune.core.measurement.response_functions import Complexes
from modetune.core.modes import Floats

entries = st.floats(-1e3, 1e3, allow_subnormal=False)
shapes = arrays(np.float64, (5, 2), elements=entries)
phases = st.floats(-np.pi / 2 + 0.01, np.pi / 2 - 0.01)


def column(*values: complex) -> Complexes:
    return np.array(values, dtype=np.complex128)[:, None]


@given(shapes, phases)
def test_a_real_shape_with_one_phase_is_fully_collinear(real: Floats, phase: float) -> None:
    turned = real * np.exp(1j * phase)
    np.testing.assert_allclose(modal_phase_collinearity(turned), 1.0, atol=1e-9)


@given(shapes, phases)
def test_a_turned_real_shape_is_found_again_with_its_sign(real: Floats, phase: float) -> None:
    found = real_shapes(real * np.exp(1j * phase))
    np.testing.assert_allclose(found, real, atol=1e-9 * max(1.0, np.abs(real).max()))


@given(shapes)
def test_real_shapes_come_back_as_they_are(real: Floats) -> None:
    np.testing.assert_array_equal(real_shapes(real), real)
    np.testing.assert_array_equal(real_shapes(real.astype(np.complex128)), real)


def test_collinearity_is_nought_where_half_the_points_are_a_quarter_behind() -> None:
    # S_xx = S_yy and S_xy = 0, so the formula of Juang and Pappa gives 0
    assert modal_phase_collinearity(column(1, 1j))[0] == pytest.approx(0.0, abs=1e-15)


def test_collinearity_follows_its_formula() -> None:
    # x = (1, 1), y = (0, 0.5): S_xx = 2, S_yy = 0.25, S_xy = 0.5
    shape = column(1, 1 + 0.5j)
    assert modal_phase_collinearity(shape)[0] == pytest.approx((1.75**2 + 4 * 0.25) / 2.25**2)


def test_the_real_part_is_the_largest_over_all_phases() -> None:
    random = np.random.default_rng(4)
    shape = random.normal(size=(8, 1)) + 1j * random.normal(size=(8, 1))
    tried = [np.linalg.norm((shape * np.exp(-1j * a)).real) for a in np.linspace(0, np.pi, 721)]
    assert np.linalg.norm(real_shapes(shape)) == pytest.approx(max(tried), rel=1e-4)


def test_neither_scale_nor_phase_changes_the_collinearity() -> None:
    random = np.random.default_rng(5)
    shape = random.normal(size=(8, 3)) + 0.3j * random.normal(size=(8, 3))
    expected = modal_phase_collinearity(shape)
    for factor in (1e-200, 1e150j, -3.0 + 4.0j):
        np.testing.assert_allclose(modal_phase_collinearity(shape * factor), expected, rtol=1e-12)


def test_shapes_that_are_zero_or_have_no_rows_are_taken_for_real() -> None:
    np.testing.assert_array_equal(modal_phase_collinearity(np.zeros((4, 2), complex)), [1.0, 1.0])
    np.testing.assert_array_equal(modal_phase_collinearity(np.zeros((0, 2), complex)), [1.0, 1.0])
    assert real_shapes(np.zeros((0, 2), complex)).shape == (0, 2)
