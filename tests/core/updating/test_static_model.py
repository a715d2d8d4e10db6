"""Static readings by closed forms, and their derivatives against complex steps."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy import sparse

from modetune.core.algebra.matrices import MatrixResult
from modetune.core.errors import ModelError
from modetune.core.modes import Floats
from modetune.core.updating.observation import observe
from modetune.core.updating.parameter_matrices import (
    ParameterMatrices,
    Powers,
    parameter_matrices,
)
from modetune.core.updating.static_model import LoadCase, Reading, StaticModel

STIFFNESS, L = 2.1e11 * 8.0e-10, 0.6  # E I in N m2, and m
ROOT_SPRING = 900.0  # N m/rad, of the size of EI / L: both matter


def beam(n: int) -> tuple[Floats, list[tuple[int, int]]]:
    """EI times the stiffness of n Euler elements, free; nodes 1.., components z and ry."""
    h = L / n
    own = (
        STIFFNESS
        / h**3
        * np.array(
            [
                [12, 6 * h, -12, 6 * h],
                [6 * h, 4 * h**2, -6 * h, 2 * h**2],
                [-12, -6 * h, 12, -6 * h],
                [6 * h, 2 * h**2, -6 * h, 4 * h**2],
            ]
        )
    )
    whole = np.zeros((2 * n + 2, 2 * n + 2))
    for k in range(n):
        whole[2 * k : 2 * k + 4, 2 * k : 2 * k + 4] += own
    return whole, [(node, component) for node in range(1, n + 2) for component in (3, 5)]


def matrices_of(
    full: list[Floats], dofs: list[tuple[int, int]], powers: tuple[int, ...] = (1,)
) -> ParameterMatrices:
    """K = sum of theta_j^p K_j; the mass plays no part."""
    upper = [sparse.csr_array(np.triu(item)) for item in full]
    nodes, components = np.array(dofs).T
    whole = sparse.csr_array(np.triu(sum(full[1:], full[0])))
    base = MatrixResult(whole, sparse.csr_array(sparse.eye_array(len(dofs))), nodes, components)
    parts = [Powers(column, powers, (item,)) for column, item in enumerate(upper)]
    return parameter_matrices(base, np.ones(len(full)), parts, [])


def reading(node: int, component: int, load: int = 0) -> Reading:
    one = np.array([1.0])
    return Reading("u", load, np.array([node]), np.array([component]), one, 0.0, 1.0, 1.0)


def cantilever() -> tuple[ParameterMatrices, int]:
    """A beam whose root is a rotational spring: parameters EI and the spring."""
    n = 5
    bending, dofs = beam(n)
    spring = np.zeros_like(bending)
    spring[1, 1] = ROOT_SPRING
    return matrices_of([bending[1:, 1:], spring[1:, 1:]], dofs[1:]), n + 1


def test_a_cantilever_on_a_rotational_spring_is_the_closed_form() -> None:
    matrices, tip = cantilever()
    force, moment = -30.0, 4.0
    loads = [
        LoadCase.of_forces([(tip, 3, force, "a")]),
        LoadCase.of_forces([(tip, 5, moment, "b")]),
    ]
    readings = [reading(tip, 3), reading(tip, 3, 1), reading(tip, 5), reading(tip, 5, 1)]
    model = StaticModel.of(matrices.base, observe, loads, readings)
    a, b = 1.3, 0.7
    values, slopes = model.values(matrices, np.array([a, b]))
    bend, turn = a * STIFFNESS, b * ROOT_SPRING
    # w = F L^3 / 3 EI + F L^2 / k, and the others by the same superposition.
    parts = np.array(
        [
            [force * L**3 / 3 / bend, force * L**2 / turn],
            [moment * L**2 / 2 / bend, moment * L / turn],
            [force * L**2 / 2 / bend, force * L / turn],
            [moment * L / bend, moment / turn],
        ]
    )
    # Euler elements are exact at nodes: only rounding times the condition, about 1e6, is left.
    np.testing.assert_allclose(values, parts.sum(axis=1), rtol=1e-9)
    np.testing.assert_allclose(slopes, -parts / [a, b], rtol=1e-8)


@pytest.mark.parametrize("powers", [(1,), (3,), (-1,)])
def test_derivatives_are_those_of_complex_steps(powers: tuple[int, ...]) -> None:
    generator = np.random.default_rng(4)
    n = 7
    full = []
    for _ in range(3):
        root = generator.normal(size=(n, n))
        full.append(root @ root.T)
    matrices = matrices_of(full, [(k, 1) for k in range(1, n + 1)], powers)
    load = LoadCase.of_forces([(2, 1, 1.5, "a"), (5, 1, -0.5, "b")])
    gauge = Reading("e", 0, np.array([1, 6]), np.array([1, 1]), np.array([-2.0, 2.0]), 0, 1, 1)
    model = StaticModel.of(matrices.base, observe, [load], [reading(3, 1), gauge])
    theta = np.array([0.8, 1.1, 1.4])
    values, slopes = model.values(matrices, theta)

    def solved(at: Any) -> Any:
        k = sum(value ** powers[0] * item for value, item in zip(at, full, strict=True))
        u = np.linalg.solve(k, np.eye(n)[1] * 1.5 - np.eye(n)[4] * 0.5)
        return np.array([u[2], 2.0 * (u[5] - u[0])])

    np.testing.assert_allclose(values, solved(theta), rtol=1e-9)
    steps = [solved(theta + 1e-30j * np.eye(3)[column]).imag / 1e-30 for column in range(3)]
    np.testing.assert_allclose(slopes, np.array(steps).T, rtol=1e-8)


def test_a_beam_on_two_springs_tilts_as_a_lever() -> None:
    """Stiff beside its springs: u at each end is what the lever gives, R / k."""
    bending, dofs = beam(4)
    left, right = np.zeros_like(bending), np.zeros_like(bending)
    left[0, 0], right[-2, -2] = 200.0, 300.0
    matrices = matrices_of([1e6 * bending, left, right], dofs)
    load = LoadCase.of_forces([(2, 3, -10.0, "a")])  # at L / 4
    model = StaticModel.of(matrices.base, observe, [load], [reading(1, 3), reading(5, 3)])
    values, slopes = model.values(matrices, np.array([1.0, 2.0, 0.5]))
    # Statically determinate: reactions do not depend on stiffness. EI L^-3 is 1e9 of the springs.
    np.testing.assert_allclose(values, [-7.5 / 400.0, -2.5 / 150.0], rtol=1e-4)
    np.testing.assert_allclose(
        slopes[:, 1:], [[7.5 / 800.0, 0.0], [0.0, 5.0 / 150.0]], rtol=1e-4, atol=1e-7
    )


def test_a_free_structure_and_a_held_place_are_refused_in_words() -> None:
    bending, dofs = beam(3)
    free = matrices_of([bending], dofs)
    load = LoadCase.of_forces([(4, 3, 1.0, "deck.bdf, line 7")])
    model = StaticModel.of(free.base, observe, [load], [reading(4, 3)])
    with pytest.raises(ModelError, match="singular"):
        model.values(free, np.ones(1))
    with pytest.raises(ModelError, match=r"u: 4\.x is held in place"):
        StaticModel.of(free.base, observe, [load], [reading(4, 1)])
    held = LoadCase.of_forces([(4, 2, 1.0, "deck.bdf, line 7")])
    with pytest.raises(ModelError, match=r"deck\.bdf, line 7: 4\.y is held"):
        StaticModel.of(free.base, observe, [held], [reading(4, 3)])
