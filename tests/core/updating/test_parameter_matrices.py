"""Matrices for all parameter values against those that CalculiX stores there."""

from __future__ import annotations

import errno
import mmap
import os
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy import sparse

from modetune.core.algebra.eigen import solve_modes
from modetune.core.algebra.matrices import MatrixResult, projected, symmetric, upper_product
from modetune.core.errors import ModelError, SolverExhausted
from modetune.core.modes import Floats
from modetune.core.updating.parameter_matrices import (
    ParameterMatrices,
    Powers,
    differences,
    fit_powers,
    parameter_matrices,
)
from modetune.core.updating.sensitivity import fox_kapoor
from tests.core.matrix_decks import (
    bar,
    matrices_of,
    native_eigenvalues,
    plates,
    scaled_difference,
)

#: Factors on a thickness at which matrices are taken, spread as Chebyshev's points are.
FACTORS = (0.55, 0.75, 1.4, 1.9)
THICK = 2.0

#: All the powers of the thickness of a shell with full integration beside the constant one.
SHELL_POWERS = (-1, 1, 2, 3)


def shell_matrices(
    angle: float, second: float, folder: Path, held: bool = True
) -> ParameterMatrices:
    """Two plates, the first one's thickness the only parameter."""

    def at(factor: float) -> MatrixResult:
        return matrices_of(plates((THICK * factor, second), angle, held), folder)

    base = at(1.0)
    pairs = [differences(base, at(factor)) for factor in FACTORS]
    stiffness, mass = (
        fit_powers([pair[place] for pair in pairs], FACTORS, 1.0, SHELL_POWERS) for place in (0, 1)
    )
    return parameter_matrices(
        base,
        np.ones(1),
        [Powers(0, SHELL_POWERS, stiffness)],
        [Powers(0, SHELL_POWERS, mass)],
    )


@pytest.mark.parametrize(
    ("angle", "second"),
    [(90.0, 2.5), (50.0, 2.5), (0.0, 2.5)],
    ids=["right angle", "sharp angle", "one plane, a step in thickness"],
)
def test_shells_at_any_thickness_are_those_of_calculix(
    angle: float, second: float, tmp_path: Path
) -> None:
    affine = shell_matrices(angle, second, tmp_path)
    for factor in (0.63, 0.9, 1.2, 1.7):
        own = matrices_of(plates((THICK * factor, second), angle), tmp_path)
        # Text of 14 digits, in a fit of condition 1600: far better than the 1e-9 that is needed.
        assert max(scaled_difference(affine.at(np.array([factor])), own)) < 1e-12


@pytest.mark.parametrize("powers", [(-1, 1), (1, 2, 3), (-1, 1, 3)])
def test_fewer_powers_of_a_thickness_do_not_do_where_shells_meet(
    powers: tuple[int, ...], tmp_path: Path
) -> None:
    base, *others = (
        matrices_of(plates((THICK * factor, 2.5), 90.0), tmp_path)
        for factor in (1.0, *FACTORS[: len(powers)])
    )
    pairs = [differences(base, other) for other in others]
    shares = [
        [
            Powers(
                0,
                powers,
                fit_powers([pair[place] for pair in pairs], FACTORS[: len(powers)], 1.0, powers),
            )
        ]
        for place in (0, 1)
    ]
    affine = parameter_matrices(base, np.ones(1), *shares)
    own = matrices_of(plates((THICK * 1.2, 2.5), 90.0), tmp_path)
    assert max(scaled_difference(affine.at(np.array([1.2])), own)) > 1e-6


@pytest.mark.parametrize("held", [True, False])
def test_eigenvalue_derivatives_of_a_thickness_are_those_of_calculix_runs(
    held: bool, tmp_path: Path
) -> None:
    affine = shell_matrices(90.0, 2.5, tmp_path, held)
    first, step = 0 if held else 6, 0.01
    here = affine.at(np.ones(1))
    eigenvalues, shapes = solve_modes(here.stiffness, here.mass, first + 6)
    changes = [symmetric(upper) for upper in affine.change(np.ones(1), 0)]
    found = fox_kapoor(eigenvalues, shapes, *changes)[first:]
    slopes = []
    for width in (step, 2 * step):
        high, low = (
            native_eigenvalues(plates((THICK * (1 + move), 2.5), 90.0, held), first + 6, tmp_path)
            for move in (width, -width)
        )
        slopes.append((high - low)[first:] / (2 * width))
    expected = (4.0 * slopes[0] - slopes[1]) / 3.0
    # Seven printed digits over a width of 2 % leave 3e-5 of an eigenvalue; extrapolated central
    # differences err by step^4, times large numbers where two modes come close.
    np.testing.assert_allclose(found, expected, atol=5e-5 * eigenvalues[first + 5])


def test_moduli_and_densities_scale_what_calculix_stores(tmp_path: Path) -> None:
    base = matrices_of(bar([1.0, 1.0])[0], tmp_path)
    stiff = differences(base, matrices_of(bar([2.0, 1.0])[0], tmp_path))
    heavy = differences(base, matrices_of(bar([1.0, 1.0], [1.0, 2.0])[0], tmp_path))
    assert stiff[1].nnz == heavy[0].nnz == 0  # dust left none
    affine = parameter_matrices(
        base,
        np.ones(2),
        [Powers(0, (1,), (stiff[0],))],
        [Powers(1, (1,), (heavy[1],))],
    )
    own = matrices_of(bar([1.3, 1.0], [1.0, 0.7])[0], tmp_path)
    assert max(scaled_difference(affine.at(np.array([1.3, 0.7])), own)) < 1e-12


def n_bytes(matrices: ParameterMatrices) -> int:
    """Memory of all arrays."""
    uppers = (matrices.base.upper_stiffness, matrices.base.upper_mass)
    own = sum(a.data.nbytes + a.indices.nbytes + a.indptr.nbytes for a in uppers)
    parts = (*matrices.stiffness, *matrices.mass)
    own += sum(part.places.nbytes + part.values.nbytes for part in parts)
    return own + matrices.base.nodes.nbytes + matrices.base.components.nbytes


def test_parts_of_all_elements_take_less_memory_than_the_base_again(tmp_path: Path) -> None:
    count = 5
    base = matrices_of(bar([1.0] * count)[0], tmp_path)
    shares = []
    for column in range(count):
        moduli = [2.0 if place == column else 1.0 for place in range(count)]
        share = differences(base, matrices_of(bar(moduli)[0], tmp_path))[0]
        shares.append(Powers(column, (1,), (share,)))
    affine = parameter_matrices(base, np.ones(count), shares, [])
    alone = parameter_matrices(base, np.ones(count), [], [])
    # Entries between nodes of two materials count twice, which one row of nodes in four are here.
    assert n_bytes(affine) < 2.0 * n_bytes(alone)
    # Neighbours of equal modulus cancel each other in entries that are there once one is stiffer.
    assert affine.base.upper_stiffness.nnz > base.upper_stiffness.nnz
    whole = affine.at(np.full(count, 1.7))
    expected = replace(base, upper_stiffness=sparse.csr_array(1.7 * base.upper_stiffness))
    assert max(scaled_difference(whole, expected)) < 1e-12


def random_upper(seed: int, n: int = 30, density: float = 0.2) -> sparse.csr_array:
    random = np.random.default_rng(seed)
    full = random.normal(size=(n, n)) * (random.uniform(size=(n, n)) < density) + np.eye(n)
    return sparse.csr_array(np.triu(full))


def random_affine() -> ParameterMatrices:
    names = np.arange(1, 31), np.ones(30, dtype=np.int64)
    base = MatrixResult(random_upper(0), random_upper(1), *names)
    several = Powers(1, (-1, 1, 3), tuple(random_upper(seed) for seed in (2, 3, 4)))
    linear = Powers(0, (1,), (random_upper(5, density=0.02),))
    return parameter_matrices(base, np.array([1.0, 0.8]), [linear, several], [several])


def test_all_values_share_one_pattern_whatever_entries_are_zero() -> None:
    affine = random_affine()
    base, moved = affine.at(affine.reference), affine.at(np.array([0.0, 1.7]))
    for one, other in (
        (base.upper_stiffness, moved.upper_stiffness),
        (base.upper_mass, moved.upper_mass),
    ):
        assert np.shares_memory(one.indices, other.indices)
        assert np.shares_memory(one.indptr, other.indptr)
        assert one.nnz == other.nnz
    original = random_upper(0)
    # Entries that the base lacks are zeros there.
    assert base.upper_stiffness.nnz > original.nnz
    np.testing.assert_array_equal(base.upper_stiffness.toarray(), original.toarray())


def test_matrices_are_the_sum_of_powers_and_their_derivatives() -> None:
    affine, theta = random_affine(), np.array([1.3, 1.1])
    found = affine.at(theta).upper_stiffness.toarray()
    expected = random_upper(0).toarray() + 0.3 * random_upper(5, density=0.02).toarray()
    for seed, power in ((2, -1), (3, 1), (4, 3)):
        expected += (1.1**power - 0.8**power) * random_upper(seed).toarray()
    np.testing.assert_allclose(found, expected, atol=1e-14)
    step = 1e-4
    for column in (0, 1):
        move = step * np.eye(2)[column]
        ends = [affine.at(theta + sign * move) for sign in (1, -1)]
        first, second = affine.change(theta, column), affine.change(theta, column, order=2)
        for place, name in enumerate(("upper_stiffness", "upper_mass")):
            high, low = (getattr(end, name).toarray() for end in ends)
            middle = getattr(affine.at(theta), name).toarray()
            # Central differences err by step^2 and by rounding over step (squared).
            np.testing.assert_allclose(first[place].toarray(), (high - low) / (2 * step), atol=1e-7)
            np.testing.assert_allclose(
                second[place].toarray(), (high - 2 * middle + low) / step**2, atol=1e-6
            )
    assert affine.is_linear(0)
    assert not affine.is_linear(1)


def test_numbers_in_files_are_those_in_memory(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    affine = random_affine()
    outside = affine.in_files(tmp_path)
    assert not list(tmp_path.iterdir())  # files have no names
    assert outside.n_bytes == affine.n_bytes
    for theta in (affine.reference, np.array([1.3, 1.1])):
        for one, other in zip(
            (*matrices_at(affine, theta), *affine.change(theta, 1)),
            (*matrices_at(outside, theta), *outside.change(theta, 1)),
            strict=True,
        ):
            np.testing.assert_array_equal(one.toarray(), other.toarray())
    part = outside.stiffness[1]
    for array in (outside.base.upper_stiffness.data, part.places, part.values):
        assert isinstance(based(array), mmap.mmap)

    def full(*_: int) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "posix_fallocate", full)
    with pytest.raises(SolverExhausted, match=r"entries of matrices .*GB: No space left"):
        affine.in_files(tmp_path)


def matrices_at(affine: ParameterMatrices, theta: Floats) -> tuple[sparse.csr_array, ...]:
    found = affine.at(theta)
    return found.upper_stiffness, found.upper_mass


def based(array: Any) -> Any:
    """What has the memory of an array."""
    while isinstance(array, np.ndarray):
        array = array.base
    return array


def test_products_with_an_upper_triangle_are_those_of_the_whole() -> None:
    upper, block = random_upper(7), np.random.default_rng(8).normal(size=(30, 40))
    whole = upper.toarray() + np.triu(upper.toarray(), 1).T
    np.testing.assert_array_equal(symmetric(upper).toarray(), whole)
    np.testing.assert_allclose(upper_product(upper, block), whole @ block, atol=1e-13)
    np.testing.assert_allclose(projected(upper, block), block.T @ whole @ block, atol=1e-12)
    few = sparse.csr_array((np.array([2.0]), (np.array([3]), np.array([9]))), shape=(30, 30))
    own = 2.0 * (np.outer(block[3], block[9]) + np.outer(block[9], block[3]))
    np.testing.assert_allclose(projected(few, block), own, atol=1e-13)
    theta = np.array([1.3, 1.1])
    affine = random_affine()
    for found, change in zip(
        affine.products(theta, 1, block), affine.change(theta, 1), strict=True
    ):
        np.testing.assert_allclose(found, symmetric(change) @ block, atol=1e-13)


def test_powers_are_fitted_from_as_many_samples() -> None:
    powers, values, reference = (-2, 1, 3), (0.6, 1.5, 2.0), 0.9
    truth = [random_upper(seed) for seed in (11, 12, 13)]
    samples = [
        sparse.csr_array(
            np.sum(
                [(v**k - reference**k) * a.toarray() for k, a in zip(powers, truth, strict=True)],
                axis=0,
            )
        )
        for v in values
    ]
    for found, expected in zip(fit_powers(samples, values, reference, powers), truth, strict=True):
        np.testing.assert_allclose(found.toarray(), expected.toarray(), atol=1e-13)


def test_values_that_do_not_tell_powers_apart_are_refused() -> None:
    a = random_upper(1)
    with pytest.raises(ModelError, match="2 powers are fitted to 1 matrices"):
        fit_powers([a], [2.0], 1.0, (1, 2))
    with pytest.raises(ModelError, match=r"values 2, 2 do not separate the powers 1, 2"):
        fit_powers([a, a], [2.0, 2.0], 1.0, (1, 2))


def test_parts_of_another_model_are_refused() -> None:
    names = np.arange(1, 31), np.ones(30, dtype=np.int64)
    base = MatrixResult(random_upper(0), random_upper(1), *names)
    with pytest.raises(ModelError, match="does not have the base's 30 equations"):
        parameter_matrices(base, np.ones(1), [Powers(0, (1,), (random_upper(0, 29),))], [])


def test_room_that_dropped_zeros_leave_behind_the_entries_changes_nothing() -> None:
    """As CSR may have it: arrays longer than the last pointer."""
    whole = sparse.csr_array(np.triu(np.array([[4.0, -1.0], [-1.0, 3.0]])))
    roomy = whole.copy()
    roomy.data, roomy.indices = np.append(whole.data, 7.0), np.append(whole.indices, 1)
    base = MatrixResult(roomy, whole, np.array([1, 2]), np.array([3, 3]))
    found = parameter_matrices(base, np.ones(1), [Powers(0, (1,), (whole,))], [])
    np.testing.assert_array_equal(found.base.upper_stiffness.toarray(), whole.toarray())
    assert found.stiffness[0].places.tolist() == [0, 1, 2]
