"""Modes that come several times: a square bar of CalculiX, copies of one part, and in vain."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy import sparse
from scipy.linalg import block_diag, eigh

from modetune.core.algebra import eigen
from modetune.core.algebra.eigen import ModeSolver, SolvedModes
from modetune.core.algebra.krylov import RitzPairs, with_random
from modetune.core.algebra.matrices import MatrixResult, symmetric, upper_triangle
from modetune.core.errors import ModelError
from modetune.core.modes import Floats
from tests.core.matrix_decks import bar, matrices_of
from tests.superlu import superlu_only


def square_bar(held: bool) -> str:
    """The bar of 10 x 8 mm with 10 x 10 mm: it bends alike in both directions."""
    lines = bar([1.2, 0.8, 1.2], held=held)[0].splitlines()
    end = next(i for i, line in enumerate(lines) if line.startswith("*ELEMENT"))
    for i in range(1, end):
        *others, z = lines[i].split(",")
        lines[i] = ",".join([*others, f" {1.25 * float(z)}"])
    return "\n".join(lines) + "\n"


@pytest.fixture(scope="module", params=[True, False], ids=["held", "free"])
def square(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Any:
    """Matrices as ccx stores them, and their eigenvalues by LAPACK."""
    result = matrices_of(square_bar(request.param), tmp_path_factory.mktemp("square"))
    k, m = result.stiffness.toarray(), result.mass.toarray()
    # Incompatible modes have mass, but M is singular all the same: by 1 / (lambda + 1e8).
    inverted = eigh(m, k + 1e8 * m, eigvals_only=True)[::-1][:40]
    return result, 1.0 / inverted - 1e8


def agrees(solved: SolvedModes, stiffness: Any, mass: Any, expected: Floats) -> None:
    """Eigenvalues as LAPACK's, shapes orthonormal and each an eigenvector."""
    assert solved.counted
    n_modes = expected.size
    # Residuals are allowed 2e-5: eigenvalues have its square, 4e-10, over gaps of some percent.
    # The computed eigenvalues of rigid modes are below 1 (1e-16 of the largest), here and there.
    np.testing.assert_allclose(solved.eigenvalues, expected, rtol=1e-8, atol=5.0)
    shapes = solved.shapes
    np.testing.assert_allclose(shapes.T @ (mass @ shapes), np.eye(n_modes), atol=1e-9)
    energies = shapes.T @ (stiffness @ shapes)
    largest = abs(expected[-1])
    np.testing.assert_allclose(energies, np.diag(expected), rtol=0, atol=1e-8 * largest + 5.0)


@pytest.mark.parametrize("n_modes", range(1, 21))
def test_a_square_bar_has_each_bending_mode_twice(
    square: tuple[MatrixResult, Floats], n_modes: int
) -> None:
    result, expected = square
    held = expected[0] > 1e6
    # The bar is what it is taken for: pairs of bending modes, after six rigid ones or none.
    first = 0 if held else 6
    pair = expected[first : first + 2]
    np.testing.assert_allclose(pair[0], pair[1], rtol=1e-8)
    solved = ModeSolver().solve(result.upper_stiffness, result.upper_mass, n_modes)
    assert solved.way.startswith("random")
    agrees(solved, result.stiffness, result.mass, expected[:n_modes])


@pytest.mark.parametrize("n_modes", [8, 12, 16])
def test_a_square_bar_has_them_twice_by_superlu_and_from_a_start_too(
    square: tuple[MatrixResult, Floats], n_modes: int
) -> None:
    result, expected = square
    with superlu_only():
        solver = ModeSolver()
        first = solver.solve(result.upper_stiffness, result.upper_mass, n_modes)
        agrees(first, result.stiffness, result.mass, expected[:n_modes])
        softer = sparse.csr_array(0.97 * result.upper_stiffness)
        again = solver.solve(softer, result.upper_mass, n_modes, start=first.shapes)
        assert again.way == "start"
        agrees(again, 0.97 * result.stiffness, result.mass, 0.97 * expected[:n_modes])


def copies(count: int, n: int = 90) -> tuple[sparse.csr_array, sparse.csr_array]:
    """Free chains with the same random springs and masses: each mode `count` times."""
    rng = np.random.default_rng(3)
    springs = rng.uniform(0.5, 2.0, n - 1) * 1e4
    diagonal = np.append(springs, 0.0) + np.append(0.0, springs)
    k = np.diag(diagonal) - np.diag(springs, 1) - np.diag(springs, -1)
    m = np.diag(rng.uniform(0.5, 1.5, n))
    full = [sparse.csr_array(block_diag(*[a] * count)) for a in (k, m)]
    return upper_triangle(full[0]), upper_triangle(full[1])


@pytest.mark.parametrize("count", [4, 7])
@pytest.mark.parametrize("n_modes", [3, 10, 25, 41])
def test_modes_of_several_equal_parts_are_all_found(count: int, n_modes: int) -> None:
    k, m = copies(count)
    solved = ModeSolver().solve(k, m, n_modes)
    part = eigh(symmetric(k).toarray(), symmetric(m).toarray(), eigvals_only=True)
    assert solved.counted
    np.testing.assert_allclose(solved.eigenvalues, part[:n_modes], rtol=1e-8, atol=1e-6)
    gram = solved.shapes.T @ (symmetric(m) @ solved.shapes)
    np.testing.assert_allclose(gram, np.eye(n_modes), atol=1e-9)


def one_direction(monkeypatch: pytest.MonkeyPatch) -> None:
    """As from one start vector in exact arithmetic: of equal eigenvalues one direction is seen."""
    real = eigen._random_pairs

    def seen(pencil: Any, n_modes: int) -> RitzPairs:
        pairs = real(pencil, 40)
        apart = pairs.inverted[1:] < pairs.inverted[:-1] * (1.0 - 1e-7)
        own = np.flatnonzero(np.append(True, apart))[:n_modes]
        return replace(
            pairs,
            inverted=pairs.inverted[own],
            vectors=pairs.vectors[:, own],
            images=pairs.images[:, own],
            residuals=pairs.residuals[own],
        )

    monkeypatch.setattr(eigen, "_random_pairs", seen)


def nothing_random_beside(monkeypatch: pytest.MonkeyPatch) -> None:
    """Random vectors are drawn where there are no shapes, and none beside shapes."""

    def only(shapes: Floats, count: int, turn: int = 0) -> Floats:
        return shapes.copy(order="F") if shapes.shape[1] else with_random(shapes, count, turn)

    monkeypatch.setattr(eigen, "with_random", only)


@pytest.mark.parametrize("blocks", [2, eigen.BLOCKS])
def test_whatever_a_space_misses_is_found_in_one_round_or_several(
    monkeypatch: pytest.MonkeyPatch, blocks: int
) -> None:
    one_direction(monkeypatch)
    monkeypatch.setattr(eigen, "BLOCKS", blocks)  # spaces of six blocks take several rounds
    turns: list[int] = []
    real = with_random

    def spy(shapes: Floats, count: int, turn: int = 0) -> Floats:
        turns.append(turn)
        return real(shapes, count, turn)

    monkeypatch.setattr(eigen, "with_random", spy)
    k, m = copies(4)
    solved = ModeSolver().solve(k, m, 8)
    assert solved.way == "random, again"
    expected = eigh(symmetric(k).toarray(), symmetric(m).toarray(), eigvals_only=True)[:8]
    np.testing.assert_allclose(solved.eigenvalues, expected, rtol=1e-8, atol=1e-6)
    assert (max(turns) > 0) == (blocks == 2)


def test_modes_that_are_not_found_in_any_round_are_said_to_be_missing(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    one_direction(monkeypatch)
    nothing_random_beside(monkeypatch)
    k, m = copies(4)
    with pytest.raises(ModelError, match=r"8 modes were looked for, but of the eigenvalues below"):
        ModeSolver().solve(k, m, 8)
