"""e2's slope: the thesis's for relative values, and the same in all units for the others."""

from __future__ import annotations

import numpy as np
import pytest

from modetune.core.updating.criteria import slope
from modetune.core.updating.responses.response import Residual, residual_of, stacked


def residual(
    values: tuple[float, ...], unit: float = 1.0, load: tuple[float, ...] = ()
) -> Residual:
    """Frequencies, and displacements in a unit of length."""
    z, y = np.array(values), unit * np.array(load)
    noise = np.full(z.size, 1.6e-5)
    parts = [residual_of("frequencies", ["f"] * z.size, None, z, np.ones(z.size), noise)]
    if y.size:
        noise = np.full(y.size, (0.02 * unit) ** 2)
        names, ones = ["u"] * y.size, np.ones(y.size)
        parts.append(residual_of("static", names, None, y, ones, noise, measured=unit * ones))
    return stacked([parts])


def test_the_slope_of_frequencies_is_the_plain_norm_a_parameter() -> None:
    before, after = residual((0.03, 0.04)), residual((0.0, 0.0))
    assert slope(after, before, 2) == pytest.approx(0.025)


@pytest.mark.parametrize("unit", [1.0, 1e3, 25.4])
def test_the_slope_is_the_same_in_millimetres_and_metres(unit: float) -> None:
    before = residual((0.03, 0.04), unit, (0.1, -0.2))
    after = residual((0.03, 0.04), unit, (0.08, -0.2))
    # One deviation of a displacement, 0.02, is as much as one of an eigenvalue, 0.004.
    assert slope(after, before, 1) == pytest.approx(0.004)
