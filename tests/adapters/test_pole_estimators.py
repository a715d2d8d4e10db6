"""Poles through sdypy-EMA: bands, scales, and what it cannot do."""

from __future__ import annotations

import numpy as np
import pytest

from modetune.adapters.pole_estimators import lscf_poles
from modetune.core.errors import CampaignError
from modetune.core.measurement.response_functions import Complexes, NormalModes, modal_frf
from modetune.core.modes import Floats

FREQUENCIES, DAMPING = np.array([20.0, 60.0, 60.6, 110.0]), np.array([0.01, 0.005, 0.006, 0.02])
TRUE = 2.0 * np.pi * FREQUENCIES * (-DAMPING + 1j * np.sqrt(1.0 - DAMPING**2))


def accelerances(lines: Floats) -> Complexes:
    shapes = np.random.default_rng(5).normal(size=(9, 4))
    modes = NormalModes((2.0 * np.pi * FREQUENCIES) ** 2, shapes, DAMPING)
    return modal_frf(lines, modes, np.arange(9), [0], "accelerance")[:, :, 0]


def nearest(poles: Complexes, wanted: complex) -> complex:
    return complex(poles[np.abs(poles - wanted).argmin()])


@pytest.mark.parametrize(("low", "high"), [(0.0, 150.0), (15.0, 130.0), (50.0, 130.0)])
def test_exact_functions_give_the_poles_in_any_band(low: float, high: float) -> None:
    lines = np.arange(low, high + 0.05, 0.1)
    orders = lscf_poles(lines, accelerances(lines), 30)
    assert len(orders) == 30
    for wanted in TRUE[(low < FREQUENCIES) & (high > FREQUENCIES)].tolist():
        # Modes outside the band are a smooth rest that a polynomial fits to about six digits.
        assert nearest(orders[-1], wanted) == pytest.approx(wanted, rel=1e-5)


def test_poles_do_not_depend_on_the_scale_of_a_function_or_on_units_of_frequency() -> None:
    lines = np.arange(5.0, 130.0, 0.1)
    values = accelerances(lines)
    plain = lscf_poles(lines, values, 20)[-1]
    scaled = lscf_poles(lines, values * np.logspace(-6, 6, 9), 20)[-1]
    kilo = lscf_poles(1000.0 * lines, values, 20)[-1]
    for wanted in TRUE.tolist():
        assert nearest(scaled, wanted) == pytest.approx(nearest(plain, wanted), rel=1e-7)
        assert nearest(kilo, 1000.0 * wanted) == pytest.approx(1000.0 * wanted, rel=1e-5)


def test_nothing_is_printed_or_drawn(capfd: pytest.CaptureFixture[str]) -> None:
    lines = np.arange(5.0, 130.0, 0.5)
    lscf_poles(lines, accelerances(lines), 10)
    assert capfd.readouterr() == ("", "")


def test_only_poles_of_positive_frequency_are_given() -> None:
    lines = np.arange(5.0, 130.0, 0.5)
    orders = lscf_poles(lines, accelerances(lines), 10)
    assert all((poles.imag > 0.0).all() for poles in orders)


def test_uneven_lines_are_refused() -> None:
    lines = np.geomspace(5.0, 130.0, 400)
    with pytest.raises(CampaignError, match="not evenly spaced"):
        lscf_poles(lines, accelerances(lines), 10)


@pytest.mark.parametrize("order", [1, 50])
def test_an_order_that_does_not_fit_the_lines_is_refused_with_the_range(order: int) -> None:
    lines = np.linspace(5.0, 130.0, 60)
    with pytest.raises(CampaignError, match="does not fit 60 lines in the band: choose 2 to 29"):
        lscf_poles(lines, accelerances(lines), order)
