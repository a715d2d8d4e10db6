"""ModeSolver: first and later models, against LAPACK; modes that a start lacks; refusals."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import nullcontext
from typing import Any

import numpy as np
import pytest
from scipy import sparse
from scipy.linalg import block_diag, eigh

from modetune.core.algebra import pardiso
from modetune.core.algebra.eigen import ModeSolver, SolvedModes
from modetune.core.algebra.matrices import upper_triangle
from modetune.core.algebra.pencil import Pencil, triangle_product
from modetune.core.errors import ModelError
from modetune.core.modes import Floats
from tests.core.algebra.test_eigen_repeated import nothing_random_beside
from tests.superlu import superlu_only

N = 420  # above the size up to which models are solved whole


@pytest.fixture(params=[nullcontext, superlu_only], ids=["pardiso", "superlu"])
def program(request: pytest.FixtureRequest) -> Iterator[None]:
    """Each test by both programs, where both are there."""
    context: Any = request.param
    with context():
        yield


def upper(matrix: Floats) -> sparse.csr_array:
    return upper_triangle(sparse.csr_array(matrix))


def free_frame(n: int = N, seed: int = 0, pair: float = 0.0) -> tuple[Floats, Floats]:
    """A free chain with random springs to near neighbours and random masses, and its copy.

    pair: how much softer the copy is, relative, so that eigenvalues come in close pairs.
    """
    rng = np.random.default_rng(seed)
    half = n // 2
    k = np.zeros((half, half))
    for reach in (1, 2, 5):
        for i in range(half - reach):
            spring = rng.uniform(0.5, 2.0) * 1e4
            k[np.ix_([i, i + reach], [i, i + reach])] += spring * np.array([[1, -1], [-1, 1]])
    m = np.diag(rng.uniform(0.5, 1.5, half))
    return block_diag(k, (1.0 - pair) * k), block_diag(m, m)


def exact(k: Floats, m: Floats, n_modes: int) -> Floats:
    """By LAPACK; with unknowns without mass by mu = 1 / (lambda + 1)."""
    mu = eigh(m, k + m, eigvals_only=True)[::-1][:n_modes]
    return np.asarray(1.0 / mu - 1.0)


def agrees(solved: SolvedModes, k: Floats, m: Floats, n_modes: int = 8) -> None:
    """Eigenvalues as LAPACK's, shapes that meet the equation and are orthonormal."""
    expected = exact(k, m, n_modes)
    # Of the largest eigenvalue (about 10^5) rounding leaves 10^-11.
    np.testing.assert_allclose(solved.eigenvalues, expected, rtol=1e-8, atol=1e-8)
    np.testing.assert_allclose(solved.shapes.T @ m @ solved.shapes, np.eye(n_modes), atol=1e-9)
    forces = k @ solved.shapes - m @ solved.shapes * solved.eigenvalues
    # Residuals of shapes are allowed 2e-5 before the last solution.
    assert np.abs(forces).max() < 2e-4 * np.abs(k).max() * np.abs(solved.shapes).max()
    assert solved.counted


@pytest.mark.parametrize("pair", [0.0, 2e-4])
@pytest.mark.usefixtures("program")
def test_rigid_repeated_and_close_modes_are_found(pair: float) -> None:
    # 2e-4 in stiffness is 0.01 % in frequency.
    k, m = free_frame(pair=pair)
    solved = ModeSolver().solve(upper(k), upper(m), 8)
    agrees(solved, k, m)
    assert solved.shift < 0.0


@pytest.mark.usefixtures("program")
def test_a_later_model_from_the_modes_of_the_first_is_as_from_nothing() -> None:
    k, m = free_frame()
    d = np.arange(N) < N // 4  # a quarter of the structure becomes 8 % stiffer
    changed = k + 0.08 * k * np.outer(d, d)
    changed += np.diag(-changed.sum(axis=1))  # rows of a free structure add up to zero
    solver = ModeSolver()
    first = solver.solve(upper(k), upper(m), 12)
    from_start = solver.solve(upper(changed), upper(m), 8, start=first.shapes)
    assert (from_start.way, from_start.counted) == ("start", True)
    agrees(from_start, changed, m)
    from_nothing = ModeSolver().solve(upper(changed), upper(m), 8, shift=from_start.shift)
    assert from_nothing.way == "random"
    np.testing.assert_allclose(from_start.eigenvalues, from_nothing.eigenvalues, 1e-8, 1e-8)
    assert from_start.solutions < 3 * 16


@pytest.mark.usefixtures("program")
def test_a_pair_of_equal_modes_may_be_cut() -> None:
    # Eight modes are four pairs: the seventh and the eighth are equal.
    k, m = free_frame()
    solver = ModeSolver()
    first = solver.solve(upper(k), upper(m), 7)
    agrees(first, k, m, 7)
    for columns in (7, 6):  # with as many start shapes as modes, and with too few to use
        again = solver.solve(upper(k), upper(m), 7, start=first.shapes[:, :columns])
        agrees(again, k, m, 7)


def lacking(shapes: Floats, m: Floats, modes: Floats) -> Floats:
    """Shapes without any part of some modes."""
    return shapes - modes @ (modes.T @ m @ shapes)


def test_a_mode_that_the_start_lacks_is_found() -> None:
    k, m = free_frame()
    every = ModeSolver().solve(upper(k), upper(m), 12).shapes
    for lost in (0, 3, 6):
        start = np.delete(lacking(every, m, every[:, [lost]]), lost, axis=1)
        solved = ModeSolver().solve(upper(k), upper(m), 8, -5.0, start)
        np.testing.assert_allclose(solved.eigenvalues, exact(k, m, 8), rtol=1e-8, atol=1e-8)


def test_random_vectors_that_see_nothing_are_caught_by_the_count(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    # A start without a part of mode 3, and nothing beside it: no Krylov space can hold it.
    k, m = free_frame(pair=0.1)
    every = ModeSolver().solve(upper(k), upper(m), 12).shapes
    start = np.delete(every, 3, axis=1)
    nothing_random_beside(monkeypatch)
    trusting = ModeSolver(count=False).solve(upper(k), upper(m), 8, -5.0, start)
    assert (trusting.way, trusting.counted) == ("start", False)
    expected = exact(k, m, 9)
    # Steps from rounding may bring it back; if not, the next mode stands in its place.
    assert trusting.eigenvalues[-1] >= expected[7] * (1.0 - 1e-8)
    solved = ModeSolver().solve(upper(k), upper(m), 8, -5.0, start)
    np.testing.assert_allclose(solved.eigenvalues, expected[:8], rtol=1e-8, atol=1e-8)
    assert solved.counted


@pytest.mark.parametrize("kind", ["orthogonal", "random", "zero", "few", "same"])
def test_a_bad_start_ends_with_the_right_modes(kind: str) -> None:
    k, m = free_frame()
    rng = np.random.default_rng(4)
    every = ModeSolver().solve(upper(k), upper(m), 20).shapes
    start = {
        "orthogonal": every[:, 8:20],
        "random": rng.standard_normal((N, 12)),
        "zero": np.zeros((N, 12)),
        "few": every[:, :3],
        "same": np.repeat(every[:, :1], 12, axis=1),
    }[kind]
    agrees(ModeSolver().solve(upper(k), upper(m), 8, start=start), k, m)


@pytest.mark.usefixtures("program")
def test_most_unknowns_may_lack_mass() -> None:
    k, m = free_frame(930, pair=0.1)
    without = np.arange(930) % 3 != 0
    m[without] = 0.0
    pencil = Pencil(upper(k), upper(m))
    assert pencil.n_with_mass == 310
    solver = ModeSolver()
    first = solver.solve(upper(k), upper(m), 8)
    agrees(first, k, m)
    again = solver.solve(upper(k), upper(1.1 * m), 8, start=first.shapes)
    assert again.way == "start"
    agrees(again, k, 1.1 * m)


@pytest.mark.usefixtures("program")
def test_a_large_model_with_few_masses_is_condensed_to_them() -> None:
    k, m = free_frame(pair=0.1)
    m[np.arange(N) % 10 != 0] = 0.0
    solved = ModeSolver().solve(upper(k), upper(m), 8)
    assert solved.way == "condensed"
    agrees(solved, k, m)
    with pytest.raises(ModelError, match="50 modes were asked of a model with 42 unknowns"):
        ModeSolver().solve(upper(k), upper(m), 50)
    assert ModeSolver().solve_available(upper(k), upper(m), 50).eigenvalues.size == 42


@pytest.mark.usefixtures("program")
def test_negative_eigenvalues_of_a_preloaded_model_are_found() -> None:
    # Pressed beyond buckling: two eigenvalues near -600, below any shift of a free structure.
    k, m = free_frame(pair=0.1)
    k[0, 0] -= 2e4
    k[N // 2, N // 2] -= 2e4
    solver = ModeSolver()
    solved = solver.solve(upper(k), upper(m), 8, shift=-1.0)
    expected = eigh(k, m, eigvals_only=True)[:8]
    assert expected[1] < -100.0
    assert solved.shift < expected[0]
    np.testing.assert_allclose(solved.eigenvalues, expected, rtol=1e-8, atol=1e-8)
    np.testing.assert_allclose(
        ModeSolver().solve(upper(k), upper(m), 8).eigenvalues, expected, rtol=1e-8, atol=1e-8
    )
    again = solver.solve(upper(k), upper(m), 8, start=solved.shapes)
    assert again.way == "start"
    np.testing.assert_allclose(again.eigenvalues, expected, rtol=1e-8, atol=1e-8)


@pytest.mark.parametrize("n", [40, N])
def test_inverse_is_that_of_the_last_model_at_its_shift(n: int) -> None:
    k, m = free_frame(n)
    solver = ModeSolver()
    with pytest.raises(ModelError, match="no model has been solved yet"):
        solver.inverse(np.ones(n))
    for factor in (1.0, 1.3):
        solved = solver.solve(upper(factor * k), upper(m), 8)
        block = np.random.default_rng(5).standard_normal((n, 5))
        # Condition number about 10^5 between the shift and the largest eigenvalue.
        forces = (factor * k - solved.shift * m) @ solver.inverse(block)
        np.testing.assert_allclose(forces, block, atol=1e-9)


def test_a_model_of_another_sparsity_may_follow() -> None:
    solver = ModeSolver()
    for n in (N, N + 40, 60):
        k, m = free_frame(n)
        agrees(solver.solve(upper(k), upper(m), 8), k, m)


def test_later_models_are_ordered_once(monkeypatch: pytest.MonkeyPatch) -> None:
    if not pardiso.is_available():
        pytest.skip("PARDISO is installed on x86_64 only")
    phases: list[int] = []
    real = pardiso._Handle.call

    def spy(handle: pardiso._Handle, phase: int, *rest: Any) -> int:
        phases.append(phase)
        return real(handle, phase, *rest)

    monkeypatch.setattr(pardiso._Handle, "call", spy)
    k, m = free_frame()
    solver = ModeSolver()
    first = solver.solve(upper(k), upper(m), 8)
    for factor in (1.01, 1.02):
        solver.solve(upper(factor * k), upper(m), 8, start=first.shapes)
    assert phases.count(11) == 1
    # Estimate, shift, count after; then count before and shift for each start.
    assert phases.count(22) == 3 + 2 * 2


def test_runs_repeat_to_the_last_digit() -> None:
    k, m = free_frame()
    runs = [ModeSolver().solve(upper(k), upper(m), 8) for _ in range(2)]
    np.testing.assert_array_equal(runs[0].shapes, runs[1].shapes)


def test_products_with_a_triangle_are_those_of_the_symmetric_matrix() -> None:
    k, _ = free_frame(50)
    block = np.random.default_rng(6).standard_normal((50, 3))
    # Sums of some eleven terms of 1e4: rounding of 1e-16 of that.
    np.testing.assert_allclose(triangle_product(upper(k), block), k @ block, atol=1e-10)
    np.testing.assert_allclose(triangle_product(upper(k), block[:, 0]), k @ block[:, 0], atol=1e-10)


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (lambda k, m: (k, -m), "it is not a mass matrix"),
        (lambda k, m: (k, 0.0 * m), "nothing that moves"),
        (lambda k, m: (k, m[:-1, :-1]), "not one model"),
        (lambda k, m: (np.nan * k, m), "not finite"),
    ],
)
def test_what_is_no_model_is_refused(spoil: Any, message: str) -> None:
    k, m = spoil(*free_frame())
    with pytest.raises(ModelError, match=message):
        ModeSolver().solve(upper(k), upper(m), 8)


def test_both_triangles_are_refused() -> None:
    k, m = free_frame()
    with pytest.raises(ModelError, match="stiffness matrix is not an upper triangle"):
        ModeSolver().solve(sparse.csr_array(k), upper(m), 8)


@pytest.mark.usefixtures("program")
def test_a_mechanism_without_mass_is_named() -> None:
    k, m = free_frame()
    empty = k.copy()
    empty[7], empty[:, 7], m[7] = 0.0, 0.0, 0.0
    with pytest.raises(ModelError, match="singular"):
        ModeSolver().solve(upper(empty), upper(m), 8)
    # Two unknowns on a rod of their own, without mass, that nothing holds.
    loose = k.copy()
    loose[[7, 8]], loose[:, [7, 8]], m[8] = 0.0, 0.0, 0.0
    loose[np.ix_([7, 8], [7, 8])] = 1e4 / 3.0 * np.array([[1.0, -1.0], [-1.0, 1.0]])
    with pytest.raises(ModelError, match="singular"):
        ModeSolver().solve(upper(loose), upper(m), 8)
