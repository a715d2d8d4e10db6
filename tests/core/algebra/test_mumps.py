"""MUMPS against PARDISO's and LAPACK's answers, what it keeps in files, and how it is found."""

from __future__ import annotations

import functools
import gc
import shutil
import weakref
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy import sparse

from modetune.core.algebra import mumps
from modetune.core.algebra.factorisation import filled_triangle
from modetune.core.algebra.mumps import FactorFiles, Mumps, MumpsLibrary
from modetune.core.algebra.pencil import Pencil
from modetune.core.errors import ModelError, SolverExhausted

needs_mumps = pytest.mark.skipif(not mumps.is_available(), reason="MUMPS is not installed here")


def files(folder: Path, name: str = "one") -> FactorFiles:
    own = folder / name
    own.mkdir()
    return FactorFiles(own, functools.partial(shutil.rmtree, own))


def whole(upper: sparse.csr_array) -> sparse.csr_array:
    return sparse.csr_array(upper + sparse.triu(upper, 1).T)


def grid(n: int, below: float = 0.0) -> sparse.csr_array:
    """The upper triangle of a square membrane of n by n points, held at its edges, less below."""
    line = sparse.diags_array([[-1.0] * (n - 1), [2.0] * n, [-1.0] * (n - 1)], offsets=[-1, 0, 1])
    one = sparse.eye_array(n)
    membrane = sparse.kron(line, one) + sparse.kron(one, line) - below * sparse.eye_array(n * n)
    return filled_triangle(sparse.csr_array(membrane))


def tied(stiffness: Any, ties: Any) -> sparse.csr_array:
    """With a multiplier a tie, which has a zero on the diagonal."""
    blocks: Any = [[stiffness, ties.T], [ties, None]]
    return filled_triangle(sparse.csr_array(sparse.block_array(blocks)))


def tied_beam() -> sparse.csr_array:
    """Bending of a beam in thirty points, and three multipliers, zeros on the diagonal, that hold
    it."""
    line = sparse.diags_array([[-1.0] * 29, [2.0] * 30, [-1.0] * 29], offsets=[-1, 0, 1])
    ties = sparse.csr_array(([1.0, 1.0, -1.0], ([0, 1, 2], [4, 15, 29])), shape=(3, 30))
    return tied(line @ line, ties)


def spread() -> sparse.csr_array:
    """A chain whose springs differ by ten powers of ten, as rotations and translations do."""
    springs = 10.0 ** np.linspace(-4.0, 6.0, 400)
    diagonal = springs + np.r_[springs[1:], 0.0]
    return sparse.csr_array(sparse.diags_array([diagonal, -springs[1:]], offsets=[0, 1]))


@needs_mumps
@pytest.mark.parametrize("given", [True, False])
@pytest.mark.parametrize("upper", [grid(40), grid(25, 1.0), tied_beam(), spread()])
def test_solutions_and_signs_are_those_of_lapack(
    upper: sparse.csr_array, given: bool, tmp_path: Path
) -> None:
    n = upper.shape[0]
    order = np.random.default_rng(0).permutation(n) if given else None
    factors = Mumps(upper, files(tmp_path), order=order)
    factors.refactor(upper.data)
    dense = whole(upper).toarray()
    assert factors.negative_pivots == np.sum(np.linalg.eigvalsh(dense) < 0.0)
    assert factors.lifted_pivots == 0
    x = np.random.default_rng(1).standard_normal((n, 3))
    out = np.empty((n, 3), order="F")
    assert factors.solve(dense @ x, out) is out
    # Rounding of a solution: 10^-16 of the condition, which is 10^10 for the chain.
    np.testing.assert_allclose(out, x, rtol=0.0, atol=1e-15 * np.linalg.cond(dense) + 1e-12)
    np.testing.assert_array_equal(factors.solve(dense @ x[:, 0]).shape, (n,))


@needs_mumps
def test_single_precision_is_near_whatever_the_units(tmp_path: Path) -> None:
    upper = grid(30)
    exact = whole(upper)
    forces = np.outer(np.ones(900), [1.0, 1e-200])
    for place, units in enumerate((1e-60, 1.0, 1e60)):
        factors = Mumps(upper, files(tmp_path, str(place)), single=True)
        factors.refactor(units * upper.data)
        error = units * exact @ factors.solve(forces) - forces
        assert (np.abs(error) <= 2e-4 * forces).all()  # 6e-8 of a condition of about 400
        assert np.abs(error[:, 0]).max() > 1e-9
        assert not factors.exact
        assert factors.held == " in single precision on disk"


@needs_mumps
def test_files_hold_the_factors_and_go_with_them(tmp_path: Path) -> None:
    kept = [Mumps(grid(40), files(tmp_path, "a")), Mumps(grid(30), files(tmp_path, "b"))]
    for factors, upper in zip(kept, (grid(40), grid(30)), strict=True):
        factors.refactor(upper.data)
        held = sum(file.stat().st_size for file in factors.files.folder.iterdir())
        assert 8 * factors.factor_entries <= held <= 1.01 * factors.disk
        assert factors.memory > 12 * upper.nnz
    for factors, upper in zip(kept, (grid(40), grid(30)), strict=True):  # after both were made
        ones = np.ones(upper.shape[0])
        np.testing.assert_allclose(whole(upper) @ factors.solve(ones), 1.0, rtol=1e-11)
        factors.refactor(2.0 * upper.data)
        np.testing.assert_allclose(2.0 * whole(upper) @ factors.solve(ones), 1.0, rtol=1e-11)
    kept.clear()
    del factors
    gc.collect()
    assert not list(tmp_path.iterdir())


@needs_mumps
def test_values_are_given_up_before_mumps_takes_its_memory(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    upper = grid(40)
    pencil = Pencil(upper, sparse.csr_array(sparse.eye_array(upper.shape[0])))
    pencil._factors = Mumps(upper, files(tmp_path))
    made, given_up = list[weakref.ref[Any]](), list[bool]()
    values, run = Pencil._values, MumpsLibrary.run

    def watched(self: Pencil, shift: float) -> Any:
        found = values(self, shift)
        made.append(weakref.ref(found))
        return found

    def told(self: MumpsLibrary, structure: Any, job: int) -> int:
        given_up.extend(one() is None for one in made)
        return run(self, structure, job)

    monkeypatch.setattr(Pencil, "_values", watched)
    monkeypatch.setattr(MumpsLibrary, "run", told)
    pencil.factorise(-1.0)
    assert given_up == [True]


@needs_mumps
def test_pivots_as_good_as_zero_are_counted(tmp_path: Path) -> None:
    free = sparse.diags_array([np.r_[1.0, np.full(8, 2.0), 1.0], np.full(9, -1.0)], offsets=[0, 1])
    upper = sparse.csr_array(free)
    factors = Mumps(upper, files(tmp_path))
    factors.refactor(upper.data)
    assert factors.lifted_pivots == 1


@needs_mumps
def test_room_that_is_too_small_is_made_larger(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of many multipliers, ordered first, all pivots have to wait."""
    n = 150
    rows = np.arange(n)
    ties = sparse.csr_array((np.ones(n), (rows, rows)), shape=(n, n * n))
    upper = tied(whole(grid(n)), ties)
    order = np.r_[np.arange(n * n, n * n + n), np.arange(n * n)]
    jobs = []
    run = mumps.MumpsLibrary.run

    def spy(self: mumps.MumpsLibrary, told: object, job: int) -> int:
        error = run(self, told, job)
        jobs.append((job, error))
        return error

    monkeypatch.setattr(mumps.MumpsLibrary, "run", spy)
    monkeypatch.setattr(mumps, "_SPARE", (0, 10, 200, 2000))
    factors = Mumps(upper, files(tmp_path), order=order)
    factors.refactor(upper.data)
    tried = [error for job, error in jobs if job == 2]
    assert len(tried) > 1
    assert tried[-1] == 0
    assert set(tried[:-1]) <= {-8, -9}
    assert factors.negative_pivots == n  # a multiplier each (Benzi, Golub and Liesen 2005, 3.3)


@pytest.mark.parametrize(
    ("number", "kind", "words"),
    [
        (-13, SolverExhausted, "not enough memory"),
        (-90, SolverExhausted, "free some disk"),
        (-10, ModelError, "pivot is zero"),
        (-53, ModelError, "MUMPS reports error -53"),
    ],
)
def test_error_numbers_become_sentences(
    number: int, kind: type[Exception], words: str, tmp_path: Path
) -> None:
    error = mumps._as_error(number, 0, 16, tmp_path)
    assert isinstance(error, kind)
    assert words in str(error)


@needs_mumps
def test_what_is_not_such_a_matrix_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ModelError, match="upper triangle"):
        Mumps(whole(grid(4)), files(tmp_path))
    factors = Mumps(grid(4), files(tmp_path, "two"))
    with pytest.raises(ModelError, match="3 values for"):
        factors.refactor(np.ones(3))


def test_without_the_library_it_is_told_what_to_install(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    mumps.mumps_library.cache_clear()
    monkeypatch.setattr(mumps, "_HEADERS", tmp_path)
    try:
        assert not mumps.is_available()
        with pytest.raises(SolverExhausted, match="install MUMPS"):
            Mumps(grid(4), files(tmp_path))
        for text in (
            "int nothing;",
            '#define MUMPS_VERSION "5.5.1"\ntypedef struct {??} D_STRUC_C;',
        ):
            (tmp_path / "dmumps_c.h").write_text(text)
            (tmp_path / "mumps_int_def.h").write_text("")
            assert not mumps.is_available()
    finally:
        mumps.mumps_library.cache_clear()
