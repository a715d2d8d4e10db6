"""Solving with one factorisation: accuracy, singular matrices, threads, both programs."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import sparse

from modetune.core.algebra.factorisation import (
    factorise,
    filled_triangle,
    symmetric_factors,
    symmetric_matrix,
)
from modetune.core.errors import ModelError
from tests.superlu import superlu_only


def chain(n: int, grounded: bool = True) -> sparse.csr_array:
    """Stiffness of n masses in a row with unit springs, the first held to ground or not."""
    diagonal = np.full(n, 2.0)
    diagonal[-1] = 1.0
    if not grounded:
        diagonal[0] = 1.0
    off = np.full(n - 1, -1.0)
    whole: Any = np.diag(diagonal) + np.diag(off, 1) + np.diag(off, -1)
    return sparse.csr_array(whole)


PROGRAMS = pytest.mark.parametrize("program", [nullcontext, superlu_only])


@PROGRAMS
def test_a_chain_pulled_at_its_end_stretches_evenly(program: type[Any]) -> None:
    force = np.zeros(50)
    force[-1] = 1.0
    with program():
        factors = factorise(chain(50))
    # n unit springs in series under unit force: x_i = i.
    np.testing.assert_allclose(factors.solve(force), np.arange(1.0, 51.0), rtol=1e-12)


@PROGRAMS
def test_an_indefinite_matrix_with_zeros_on_its_diagonal_is_solved(program: type[Any]) -> None:
    rng = np.random.default_rng(1)
    constraint: Any = sparse.csr_array(rng.standard_normal((30, 4)))
    matrix: Any = sparse.block_array([[chain(30), constraint], [constraint.T, None]])
    sides = rng.standard_normal((34, 3))
    with program():
        solution = factorise(matrix).solve(sides)
    np.testing.assert_allclose(matrix @ solution, sides, atol=1e-10)


@PROGRAMS
@pytest.mark.parametrize("n", [2, 5, 100, 1000])
def test_a_free_structure_is_singular(program: type[Any], n: int) -> None:
    with program(), pytest.raises(ModelError, match="singular"):
        factorise(chain(n, grounded=False))


def test_both_programs_are_named_and_forcing_ends_with_its_context() -> None:
    with superlu_only():
        assert factorise(chain(3)).solver == "superlu"
    pytest.importorskip("pypardiso", reason="PARDISO is installed on x86_64 only")
    assert factorise(chain(3)).solver == "pardiso"


# Neighbours 1e12 apart leave a diagonal that is taken for rounding of its row, by design.
@given(st.lists(st.floats(-5.5, 5.5), min_size=8, max_size=8))
def test_units_of_the_unknowns_change_neither_answer_nor_condition(exponents: list[float]) -> None:
    scale = 10.0 ** np.array(exponents)
    scaled = sparse.csr_array(sparse.diags_array(scale) @ chain(8) @ sparse.diags_array(scale))
    force = np.arange(1.0, 9.0)
    plain, other = factorise(chain(8)), factorise(scaled)
    np.testing.assert_allclose(other.solve(scale * force) * scale, plain.solve(force), rtol=1e-10)
    assert other.condition == pytest.approx(plain.condition, rel=1e-6)


def test_the_condition_is_that_of_the_scaled_matrix() -> None:
    matrix = chain(40).toarray()
    scale = 1.0 / np.sqrt(np.diag(matrix))
    exact = float(np.linalg.cond(matrix * scale[:, None] * scale, 1))
    # Higham 1988: the estimate is a lower bound, rarely below a third.
    assert exact / 3.0 <= factorise(matrix).condition <= exact * (1.0 + 1e-9)


def test_sparse_and_dense_right_hand_sides_of_many_columns_agree() -> None:
    sides = sparse.random_array((90, 150), density=0.1, rng=np.random.default_rng(3))
    factors = factorise(chain(90))
    np.testing.assert_allclose(factors.solve(sides), factors.solve(sides.toarray()), atol=1e-12)


def test_threads_may_factorise_and_solve_at_once() -> None:
    shared = factorise(chain(500))

    def answer(n: int) -> tuple[float, float]:
        own = factorise(chain(n)).solve(np.ones(n))
        return float(own[-1]), float(shared.solve(np.ones(500))[-1])

    with ThreadPoolExecutor(4) as pool:
        sizes = list(range(200, 260))
        answers = list(pool.map(answer, sizes))
    # Unit load on every mass: the end moves by 1 + 2 + ... + n.
    expected = [(n * (n + 1) / 2.0, 500 * 501 / 2.0) for n in sizes]
    np.testing.assert_allclose(answers, expected, rtol=1e-9)


def test_a_nearly_singular_matrix_is_solved_where_the_caller_insists() -> None:
    nearly = sparse.diags_array([1.0, 1.0]) + np.array([[0.0, 1.0], [1.0, 1e-15]])
    with pytest.raises(ModelError, match="singular"):
        factorise(nearly)
    assert factorise(nearly, singular_condition=np.inf).condition > 1e14


@pytest.mark.parametrize(
    ("matrix", "message"),
    [
        (np.zeros((2, 3)), "square"),
        (np.zeros((0, 0)), "square"),
        (np.ones((2, 2, 2)), "3 axes"),
        (np.array([[1.0, np.nan], [np.nan, 1.0]]), "not finite"),
        (np.array([[2.0, 1.0], [0.0, 2.0]]), "not symmetric"),
        (np.eye(2) * (1.0 + 0.1j), "must be real"),
        (np.diag([1.0, 0.0, 2.0, 0.0]), "counted from 0: 1, 3"),
    ],
)
def test_a_matrix_that_cannot_be_factorised_is_refused(matrix: Any, message: str) -> None:
    with pytest.raises(ModelError, match=message):
        factorise(matrix)


@pytest.mark.parametrize("rhs", [np.ones(4), np.ones((5, 2, 2)), np.full(5, np.inf)])
def test_a_right_hand_side_that_does_not_fit_is_refused(rhs: Any) -> None:
    with pytest.raises(ModelError, match="right-hand side"):
        factorise(chain(5)).solve(rhs)


def test_symmetric_matrix_sorts_and_adds_up_entries_given_twice() -> None:
    twice = sparse.coo_array(([1.0, 2.0, 4.0], ([0, 0, 1], [0, 0, 1])), shape=(2, 2))
    np.testing.assert_array_equal(symmetric_matrix(twice, "stiffness").toarray(), np.diag([3, 4]))


@PROGRAMS
def test_a_free_aeroplane_is_singular_and_its_shifted_stiffness_is_not(
    program: type[AbstractContextManager[None]], shared_data: Path
) -> None:
    with np.load(shared_data / "garteur/mystran/gart_KM.npz") as file:
        shape = tuple(file["shape"].tolist())
        k = sparse.csr_array((file["KGG_data"], (file["KGG_row"], file["KGG_col"])), shape=shape)
        m = sparse.csr_array((file["MGG_data"], (file["MGG_row"], file["MGG_col"])), shape=shape)
    with pytest.raises(ModelError, match="316 rows hold only zeros"):
        factorise(k)
    active = np.flatnonzero(abs(k).sum(axis=1) > 0.0)
    k, m = k[active][:, active], m[active][:, active]
    with program():
        with pytest.raises(ModelError, match="condition number"):
            factorise(k)
        shifted = sparse.csr_array(k + 1e3 * m)
        force = np.ones(active.size)
        np.testing.assert_allclose(shifted @ factorise(shifted).solve(force), force, atol=1e-6)


@PROGRAMS
def test_symmetric_factors_solve_and_count_for_one_model_after_the_other(
    program: type[Any],
) -> None:
    upper = filled_triangle(chain(60))
    exact = np.linalg.eigvalsh(chain(60).toarray())
    block = np.random.default_rng(4).standard_normal((60, 3))
    with program():
        factors = symmetric_factors(upper)
        for count in (0, 1, 30):
            edges = np.concatenate([[-1.0], exact])
            shift = 0.5 * (edges[count] + edges[count + 1])
            values = upper.data.copy()
            values[upper.indptr[:-1]] -= shift
            factors.refactor(values)
            assert (factors.negative_pivots, factors.lifted_pivots) == (count, 0)
            out = np.empty((60, 3), order="F")
            solution = factors.solve(block, out)
            shifted = chain(60).toarray() - shift * np.eye(60)
            # Half-way between eigenvalues the condition is below 10^4.
            np.testing.assert_allclose(shifted @ out, block, atol=1e-10)
            np.testing.assert_array_equal(solution, out)


def test_the_upper_triangle_has_every_diagonal_entry() -> None:
    matrix = sparse.csr_array(np.array([[0.0, 2.0], [2.0, 3.0]]))
    upper = filled_triangle(matrix)
    assert upper.nnz == 3
    np.testing.assert_array_equal(upper.toarray(), [[0.0, 2.0], [0.0, 3.0]])
