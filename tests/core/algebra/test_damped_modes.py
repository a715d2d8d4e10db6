"""Damped modes against LAPACK on the whole problem, closed forms and complex steps."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy import linalg, sparse

from modetune.core.algebra.damped_modes import (
    DampedSystem,
    damped_modes,
    ratio_slope,
)
from modetune.core.errors import ModesError


def chain(n: int) -> tuple[Any, Any]:
    """Stiffness and mass of a fixed-free chain with uneven springs and masses."""
    k = np.linspace(900.0, 1500.0, n)
    stiffness = np.zeros((n, n))
    for j in range(n):
        stiffness[j, j] += k[j]
        if j:
            stiffness[j - 1, j - 1] += k[j]
            stiffness[j, j - 1] -= k[j]
            stiffness[j - 1, j] -= k[j]
    return stiffness, np.diag(np.linspace(1.0, 2.0, n))


def between(n: int, i: int, j: int, value: float) -> Any:
    row = np.zeros(n)
    row[i] = 1.0
    row[j] -= 1.0 if j != i else 0.0
    return value * np.outer(row, row)


def system(*arrays: Any) -> DampedSystem:
    return DampedSystem(*(sparse.csr_array(item) for item in arrays))


def whole(k: Any, m: Any, c: Any, h: Any) -> Any:
    """All roots above the axis, by LAPACK on the generalised state space."""
    n = len(k)
    zero, one = np.zeros((n, n)), np.eye(n)
    a = np.block([[zero, one], [-(k + 1j * h), -c]])
    b = np.block([[one, zero], [zero, m]])
    roots = linalg.eigvals(a, b)
    return np.array(sorted((s for s in roots if s.imag > 0.0), key=lambda s: float(s.imag)))


@pytest.mark.parametrize("n_real", [4, 9])
def test_local_dampers_give_lapacks_roots_from_a_few_real_modes(n_real: int) -> None:
    n = 9
    k, m = chain(n)
    c = between(n, 2, 3, 2.0) + between(n, 8, 8, 1.2)
    h = 0.04 * between(n, 5, 4, 1300.0)
    _, shapes = linalg.eigh(k, m)
    found = damped_modes(system(k, m, c, h), shapes[:, :n_real], np.arange(3))
    # Roots are simple and well apart: 1e-13 in the residual is about as much of s.
    np.testing.assert_allclose(found.roots, whole(k, m, c, h)[:3], rtol=1e-11)
    assert (found.damping_ratios > 1e-3).all()


def test_one_mass_is_the_closed_form() -> None:
    mass, stiffness, damper = 2.0, 800.0, 6.0
    one = np.ones((1, 1))
    given = system(stiffness * one, mass * one, damper * one, 0.0 * one)
    found = damped_modes(given, one / np.sqrt(mass), np.array([0]))
    ratio = damper / (2.0 * np.sqrt(stiffness * mass))
    assert found.damping_ratios[0] == pytest.approx(ratio, rel=1e-14)
    # Structural: s^2 = -w^2 (1 + i eta), so zeta = sin(atan(eta) / 2).
    given = system(stiffness * one, mass * one, 0.0 * one, 0.3 * stiffness * one)
    found = damped_modes(given, one / np.sqrt(mass), np.array([0]))
    assert found.damping_ratios[0] == pytest.approx(np.sin(np.arctan(0.3) / 2.0), rel=1e-13)


def test_proportional_damping_leaves_shapes_real() -> None:
    k, m = chain(6)
    lam, shapes = linalg.eigh(k, m)
    found = damped_modes(system(k, m, 0.2 * m + 2e-4 * k, 0.0 * k), shapes, np.arange(6))
    w = np.sqrt(lam)
    np.testing.assert_allclose(found.damping_ratios, 0.1 / w + 1e-4 * w, rtol=1e-12)
    assert np.abs(found.shapes.imag).max() < 1e-9 * np.abs(found.shapes).max()


def test_derivatives_of_ratios_are_differences_of_lapacks() -> None:
    n = 7
    k, m = chain(n)
    c, h = between(n, 1, 2, 1.5), 0.05 * between(n, 6, 5, 1400.0)
    zero = np.zeros((n, n))
    spring, mass = between(n, 3, 2, 1100.0), np.diag(np.eye(n)[4])
    parts = [(spring, zero, zero, zero), (zero, mass, zero, zero),
             (zero, zero, c, zero), (zero, zero, zero, h)]  # fmt: skip

    def moved(place: int, step: float) -> tuple[Any, ...]:
        return tuple(a + step * b for a, b in zip((k, m, c, h), parts[place], strict=True))

    _, shapes = linalg.eigh(k, m)
    base = system(k, m, c, h)
    found = damped_modes(base, shapes[:, :5], np.arange(3))
    for place, part in enumerate(parts):
        step = 1e-5
        above, below = whole(*moved(place, step))[:3], whole(*moved(place, -step))[:3]
        ratios = [-s.real / np.abs(s) for s in (above, below)]
        wanted = (ratios[0] - ratios[1]) / (2.0 * step)
        slopes = [
            ratio_slope(s, base.slope(s, found.shapes[:, mode], system(*part)))
            for mode, s in enumerate(found.roots)
        ]
        # Central differences of 1e-5: LAPACK's 1e-14 over the step, and the step squared.
        np.testing.assert_allclose(slopes, wanted, rtol=1e-5, atol=2e-8)


def test_an_overdamped_mode_is_said_to_be_so() -> None:
    one = np.ones((1, 1))
    with pytest.raises(ModesError, match="overdamped"):
        damped_modes(system(one, one, 5.0 * one, 0.0 * one), one, np.array([0]))


def test_equal_oscillators_joined_by_a_damper_are_told_apart_by_the_test() -> None:
    """Real modes are any two; damped ones move together (zeta 0.01) or against each other."""
    one = np.eye(2)
    c = 0.02 * one + between(2, 0, 1, 0.1)
    given, shapes = system(one, one, c, 0.0 * one), one
    like = np.array([-0.12 + 0.99j, -0.008 + 1.0j])
    found = damped_modes(given, shapes, np.arange(2), like)
    np.testing.assert_allclose(found.damping_ratios, [0.11, 0.01], rtol=1e-12)
    slopes = [
        ratio_slope(s, given.slope(s, x, system(0 * one, 0 * one, between(2, 0, 1, 1.0), 0 * one)))
        for s, x in zip(found.roots, found.shapes.T, strict=True)
    ]
    np.testing.assert_allclose(slopes, [1.0, 0.0], atol=1e-10)
    with pytest.raises(ModesError, match="mixes modes 1 and 2"):
        damped_modes(given, shapes, np.arange(2))


def test_a_repeated_damped_mode_has_its_ratio_and_a_shape_with_mass() -> None:
    one = np.eye(3)
    turned, _ = np.linalg.qr(np.array([[1.0, 2.0, 0.3], [0.5, -1.0, 2.0], [1.0, 0.1, 0.4]]))
    k = turned @ np.diag([1.0, 1.0, 4.0]) @ turned.T
    found = damped_modes(system(k, one, 0.04 * one, 0.0 * one), turned, np.arange(3))
    np.testing.assert_allclose(found.damping_ratios, [0.02, 0.02, 0.01], rtol=1e-10)


def test_an_overdamped_mode_beside_others_is_named() -> None:
    k, m = chain(4)
    _, shapes = linalg.eigh(k, m)
    whole_modes = np.linalg.inv(shapes)
    c = whole_modes.T @ np.diag([0.1, 500.0, 0.1, 0.1]) @ whole_modes
    given = system(k, m, c, 0.0 * k)
    assert damped_modes(given, shapes, np.array([0, 2])).roots.size == 2
    with pytest.raises(ModesError, match="mode 2 of the model is overdamped"):
        damped_modes(given, shapes, np.array([1]))
