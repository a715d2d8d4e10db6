"""PARDISO by itself: factors of one pattern with other values, inertia, refusals, memory."""

from __future__ import annotations

import gc
import resource

import numpy as np
import pytest
from scipy import sparse

from modetune.core.algebra import pardiso
from modetune.core.algebra.factorisation import filled_triangle
from modetune.core.algebra.pardiso import Pardiso
from modetune.core.errors import ModelError, SolverExhausted

pytestmark = pytest.mark.skipif(
    not pardiso.is_available(), reason="PARDISO is installed on x86_64 only"
)


def grid(n: int, seed: int = 0) -> sparse.csr_array:
    """A membrane of n by n points with springs of random stiffness to neighbours and to ground."""
    rng = np.random.default_rng(seed)
    number = np.arange(n * n).reshape(n, n)
    first = np.concatenate([number[:, :-1].ravel(), number[:-1].ravel()])
    second = np.concatenate([number[:, 1:].ravel(), number[1:].ravel()])
    springs = rng.uniform(1.0, 2.0, first.size)
    off = sparse.coo_array((-springs, (first, second)), shape=(n * n, n * n))
    ends = np.bincount(first, springs, n * n) + np.bincount(second, springs, n * n)
    return sparse.csr_array(off + off.T + sparse.diags_array(ends + 0.1))


@pytest.mark.parametrize("long_integers", [True, False])
def test_blocks_are_solved_to_rounding(long_integers: bool) -> None:
    matrix = grid(30)
    upper = filled_triangle(matrix)
    factors = Pardiso(upper, long_integers=long_integers)
    factors.refactor(upper.data)
    block = np.random.default_rng(1).standard_normal((900, 7))
    out = np.empty((900, 7), order="F")
    assert factors.solve(block, out) is out
    # Condition number about 100: 13 digits are left of 16, some for 7 columns.
    np.testing.assert_allclose(matrix @ out, block, atol=1e-12)
    np.testing.assert_allclose(factors.solve(block[:, 0]), out[:, 0], rtol=1e-12)
    assert factors.solve(np.zeros((900, 0))).shape == (900, 0)


def test_new_values_give_what_a_fresh_factorisation_gives() -> None:
    first, second = (filled_triangle(grid(30, seed)) for seed in (0, 1))
    again = Pardiso(first)
    again.refactor(first.data)
    again.refactor(second.data)
    fresh = Pardiso(second)
    fresh.refactor(second.data)
    force = np.ones(900)
    np.testing.assert_array_equal(again.solve(force), fresh.solve(force))


def test_negative_pivots_count_negative_eigenvalues() -> None:
    matrix = grid(12)
    exact = np.linalg.eigvalsh(matrix.toarray())
    upper = filled_triangle(matrix)
    factors = Pardiso(upper)
    diagonal = upper.indptr[:-1]
    for count in (0, 1, 17, 143, 144):
        edges = np.concatenate([[exact[0] - 1.0], exact, [exact[-1] + 1.0]])
        values = upper.data.copy()
        values[diagonal] -= 0.5 * (edges[count] + edges[count + 1])
        factors.refactor(values)
        assert (factors.negative_pivots, factors.lifted_pivots) == (count, 0)


def test_exactly_singular_matrices_show_lifted_pivots() -> None:
    upper = sparse.csr_array(np.array([[1.0, -1.0], [0.0, 1.0]]))
    factors = Pardiso(upper)
    factors.refactor(upper.data)
    assert factors.lifted_pivots == 1


@pytest.mark.parametrize(
    ("matrix", "message"),
    [
        (sparse.csr_array(np.array([[1.0, 0.0], [1.0, 1.0]])), "not an upper triangle"),
        (sparse.csr_array(np.array([[0.0, 1.0], [0.0, 1.0]])), "not an upper triangle"),
        (sparse.csr_array(np.array([[1.0, 1.0], [0.0, 0.0]])), "not an upper triangle"),
        (sparse.csr_array(np.ones((2, 3))), "square"),
        (sparse.csr_array(np.eye(2, dtype=np.complex128)), "real square"),
    ],
)
def test_what_is_not_an_upper_triangle_is_refused(matrix: sparse.csr_array, message: str) -> None:
    with pytest.raises(ModelError, match=message):
        Pardiso(matrix)


def test_values_of_another_pattern_are_refused() -> None:
    upper = filled_triangle(grid(5))
    with pytest.raises(ModelError, match="24 values for 65 entries"):
        Pardiso(upper).refactor(np.ones(24))


@pytest.mark.parametrize(
    ("number", "kind", "words"),
    [
        (-2, SolverExhausted, "not enough memory"),
        (-8, SolverExhausted, "too many entries"),
        (-4, ModelError, "it is singular"),
        (-3, ModelError, "ordered"),
        (-77, ModelError, "unknown"),
    ],
)
def test_error_numbers_become_sentences(
    number: int, kind: type[Exception], words: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    # PARDISO cannot be made to run out of memory on purpose: its answer is replaced.
    monkeypatch.setattr(pardiso._Handle, "call", lambda *_: number)
    with pytest.raises(kind, match=words):
        Pardiso(filled_triangle(grid(4)))


def test_factors_too_long_for_short_integers_are_made_with_long_ones(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    real = pardiso._Handle.call

    def overflow(handle: pardiso._Handle, phase: int, *rest: object) -> int:
        if phase == 22 and not handle.long_integers:
            return -8
        return real(handle, phase, *rest)  # type: ignore[arg-type]  # passed on as they came

    monkeypatch.setattr(pardiso._Handle, "call", overflow)
    matrix = grid(10)
    upper = filled_triangle(matrix)
    factors = Pardiso(upper)
    factors.refactor(upper.data)
    np.testing.assert_allclose(matrix @ factors.solve(np.ones(100)), 1.0, rtol=1e-12)


def test_memory_goes_with_the_object() -> None:
    upper = filled_triangle(grid(120))

    def factors_and_size() -> int:
        factors = Pardiso(upper)
        factors.refactor(upper.data)
        assert factors.factor_entries > upper.nnz
        return factors.memory.peak

    size = factors_and_size()
    gc.collect()
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
    for _ in range(30):
        factors_and_size()
    grown = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 - before
    # Thirty that stayed would add thirty times the size; some is the allocators' play.
    assert size > 5e6
    assert grown < 5 * size


def test_a_count_of_entries_that_overflowed_is_made_whole() -> None:
    factors = Pardiso(sparse.csr_array(sparse.eye_array(5)))
    assert factors.factor_entries < 100
    # As seen with 6,039,001 equations: 28.0 GB foreseen in single precision, 27.0 GB of files.
    factors._handle.iparm[17], factors._foreseen = -1_843_660_065, 28_032_503_808 // 4
    assert 4 * factors.factor_entries == pytest.approx(26_985_098_104, rel=1e-3)
