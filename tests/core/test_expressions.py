"""Derivatives of expressions against complex steps and differences of values."""

from __future__ import annotations

import cmath
import math
from typing import Any

import numpy as np
import pytest

from modetune.core.errors import ModelError
from modetune.core.expressions import FUNCTIONS, evaluate, slopes

VALUES = {"r": 0.7, "b": 0.4}
NAMES: dict[str, Any] = {
    **{name: getattr(cmath, name) for name in FUNCTIONS if hasattr(cmath, name)},
    "pi": math.pi,
}
EXPRESSIONS = (
    "r**4", "pi / 4 * (r**4 - 0.3**4)", "b * r**3 / 12", "-r / (b + r)", "(2 - r)**-1.5", "r**b",
    "b**r", "(b * r)**(r + b)", "(r - 1.1)**3", "sqrt(r) * exp(b * r)", "log(r) + log10(b + r)",
    "sin(r) * cos(b * r) * tan(r)", "asin(r) + acos(r * b) - atan(r / b)",
    "sinh(r) / cosh(r) + tanh(b * r)**2", "3 * b + 2", "+r - 0.5 * (r + b)",
)  # fmt: skip


@pytest.mark.parametrize("name", ["r", "b"])
@pytest.mark.parametrize("expression", EXPRESSIONS)
def test_slopes_are_those_of_a_complex_step(expression: str, name: str) -> None:
    first, second = slopes(expression, VALUES, name)
    code = compile(expression, "expression", "eval")
    stepped = {**NAMES, **VALUES, name: VALUES[name] + 1e-30j}
    # The expressions of this file alone.
    expected = complex(eval(code, {"__builtins__": {}}, stepped)).imag / 1e-30
    assert first == pytest.approx(expected, rel=1e-13, abs=1e-15)
    step = 1e-5
    ends = [
        slopes(expression, {**VALUES, name: VALUES[name] + sign * step}, name)[0]
        for sign in (1, -1)
    ]
    # The third derivative times step^2 / 6, and rounding over the step.
    assert second == pytest.approx((ends[0] - ends[1]) / (2 * step), rel=1e-7, abs=1e-8)


@pytest.mark.parametrize(
    ("expression", "at", "expected"),
    [
        ("min(r, 2 * b)", 0.7, (1.0, 0.0)),
        ("min(r, 2 * b)", 0.9, (0.0, 0.0)),
        ("max(r**2, b, 0.1)", 0.9, (1.8, 2.0)),
        ("abs(r - 1)", 0.7, (-1.0, 0.0)),
        ("(r - 0.7)**2", 0.7, (0.0, 2.0)),
        ("(r - 0.7)**1 + r**0", 0.7, (1.0, 0.0)),
    ],
)
def test_slopes_of_one_side_and_at_zeros(
    expression: str, at: float, expected: tuple[float, float]
) -> None:
    assert slopes(expression, {**VALUES, "r": at}, "r") == pytest.approx(expected, abs=1e-15)


def test_a_place_without_a_derivative_is_refused() -> None:
    assert evaluate("sqrt(r - 0.7)", VALUES) == 0.0
    with pytest.raises(ModelError, match=r"has no derivative in r at r = 0\.7"):
        slopes("sqrt(r - 0.7)", VALUES, "r")
    assert np.isfinite(slopes("sqrt(r - 0.7) + b", VALUES, "b")).all()
