"""Modes by factors in single precision, against those in double precision and what bounds them."""

from __future__ import annotations

import functools
import gc
import shutil
import tempfile
import tracemalloc
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import sparse

from modetune.core.algebra import eigen, pardiso
from modetune.core.algebra import factor_room as rooms
from modetune.core.algebra.eigen import ModeSolver, SolvedModes, similar_vectors
from modetune.core.algebra.factor_room import FactorRoom, factor_room
from modetune.core.algebra.krylov import GUARD, block_davidson
from modetune.core.algebra.matrices import upper_triangle
from modetune.core.algebra.mumps import FactorFiles
from modetune.core.algebra.pardiso import Pardiso
from modetune.core.errors import ModelError, SolverExhausted
from modetune.core.modes import Floats

pytestmark = pytest.mark.skipif(
    not pardiso.is_available(), reason="PARDISO is installed on x86_64 only"
)
Pair = tuple[sparse.csr_array, sparse.csr_array]
Structure = Callable[..., Pair]
Held = NDArray[np.bool_]
MODES = 10


def springs(shape: tuple[int, int, int], held: Held, axes: tuple[float, ...]) -> Pair:
    """Points of a grid with three displacements each, springs along and across its edges.

    held: (nx, ny, nz), which points are left out; axes: stiffness of edges along each axis.
    """
    count = int(np.prod(shape))
    number = np.arange(count).reshape(shape)
    stiffness = sparse.csr_array((3 * count, 3 * count))
    for axis, stiff in enumerate(axes):
        ends = [np.delete(number, where, axis).ravel() for where in (-1, 0)]
        edge = np.arange(ends[0].size)
        signs = np.r_[np.ones(edge.size), -np.ones(edge.size)]
        for component in range(3):
            places = 3 * np.concatenate(ends) + component
            size = (edge.size, 3 * count)
            incidence = sparse.csr_array((signs, (np.r_[edge, edge], places)), shape=size)
            share = stiff if component == axis else 0.3 * stiff
            stiffness = stiffness + share * (incidence.T @ incidence)
    kept = np.flatnonzero(np.repeat(~held.ravel(), 3))
    mass = sparse.diags_array(np.full(kept.size, 2e-6)).tocsr()
    return upper_triangle(sparse.csr_array(stiffness[kept][:, kept])), sparse.csr_array(mass)


def mounted_box(stiff: float = 1.0) -> Pair:
    """A solid on four mounts a hundred thousand times as soft as it is: six modes far below."""
    k, m = springs((14, 12, 9), np.zeros((14, 12, 9), dtype=bool), (3e5 * stiff, 2e5, 2.5e5))
    number = np.arange(14 * 12 * 9).reshape((14, 12, 9))
    mounts = np.zeros(k.shape[0])
    for component, mount in enumerate((2.0, 2.0, 3.0)):
        mounts[3 * number[::13, ::11, 0].ravel() + component] = mount
    return sparse.csr_array(k + sparse.diags_array(mounts)), m


def square_bar(stiff: float = 1.0) -> Pair:
    """A square bar held at both ends: each bending mode twice."""
    held = np.zeros((40, 6, 6), dtype=bool)
    held[0] = held[-1] = True
    return springs((40, 6, 6), held, (2e5 * stiff, 1e5, 1e5))


def bracket(stiff: float = 1.0) -> Pair:
    """An angle bracket of solids, its foot held."""
    held = np.zeros((16, 10, 18), dtype=bool)
    held[4:, :, 4:] = True  # what is between both legs
    held[:, :, 0] = True
    return springs((16, 10, 18), held, (2e5, 1.7e5, 2.1e5 * stiff))


STRUCTURES = [mounted_box, square_bar, bracket]


def room(folder: Path, memory: float, single: bool | None = None) -> FactorRoom:
    def files() -> FactorFiles:
        own = Path(tempfile.mkdtemp(dir=folder))
        return FactorFiles(own, functools.partial(shutil.rmtree, own, ignore_errors=True))

    return FactorRoom(int(memory), 10**9, files, "`run.memory_gb`", single=single)


@pytest.fixture
def factorised(monkeypatch: pytest.MonkeyPatch) -> list[bool]:
    """Whether each factorisation was in double precision."""
    exact: list[bool] = []
    refactor = Pardiso.refactor

    def spy(self: Pardiso, values: Floats) -> None:
        exact.append(self.exact)
        refactor(self, values)

    monkeypatch.setattr(Pardiso, "refactor", spy)
    return exact


def agrees(found: SolvedModes, pair: Pair) -> None:
    """With LAPACK-checked double precision to 1e-8, and with the bound that it tells."""
    k, m = (sparse.csr_array(a + sparse.triu(a, 1).T) for a in pair)
    direct = ModeSolver().solve(pair[0], pair[1], found.eigenvalues.size)
    assert direct.counted
    rounding = 1e-15 * float(np.max(k.diagonal() / m.diagonal()))
    np.testing.assert_allclose(
        np.sqrt(found.eigenvalues), np.sqrt(direct.eigenvalues), rtol=1e-8, atol=rounding**0.5 / 10
    )
    bound = found.residuals * (found.eigenvalues - found.shift) + 10.0 * rounding
    assert (np.abs(found.eigenvalues - direct.eigenvalues) <= bound).all()
    np.testing.assert_allclose(
        found.shapes.T @ (m @ found.shapes), np.eye(found.eigenvalues.size), atol=1e-9
    )
    quotients = np.sum(found.shapes * (k @ found.shapes), axis=0)
    np.testing.assert_allclose(quotients, found.eigenvalues, rtol=1e-8, atol=rounding)


@pytest.mark.parametrize("structure", STRUCTURES)
def test_modes_are_those_of_double_precision(
    structure: Structure, tmp_path: Path, factorised: list[bool]
) -> None:
    pair = structure()
    with factor_room(room(tmp_path, 1e12, single=True)):
        solver = ModeSolver(count=False)
        found = solver.solve(pair[0], pair[1], MODES)
    assert solver.held == " in single precision"
    assert found.way == "single precision"
    assert not found.counted
    assert set(factorised) == {False}
    agrees(found, pair)


@pytest.mark.parametrize("structure", STRUCTURES)
def test_later_models_are_solved_by_the_same_factors(
    structure: Structure, tmp_path: Path, factorised: list[bool]
) -> None:
    with factor_room(room(tmp_path, 1e12, single=True)):
        solver = ModeSolver(count=False)
        first = solver.solve(*structure(), n_modes=MODES)
        count, found_later = len(factorised), []
        for stiff in (1.05, 0.92):
            later = structure(stiff)
            found = solver.solve(later[0], later[1], MODES, first.shift, first.shapes, 12)
            assert found.way == "kept factors in single precision"
            assert not solver.has_own_factors
            assert len(factorised) == count
            found_later.append((found, later))
    for found, later in found_later:
        agrees(found, later)


@pytest.mark.parametrize("structure", STRUCTURES)
def test_the_memory_there_is_decides(
    structure: Structure, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pair = structure()
    monkeypatch.setattr(rooms, "_resident", lambda: 0)  # nothing else counts
    memory = Pardiso(sparse.csr_array(pair[0] + pair[1])).memory
    vectors = 8 * pair[0].shape[0] * similar_vectors(MODES)
    double = 8 * pair[0].shape[0] * (8 * MODES + 80) + memory.peak
    held = []
    for limit in (double, vectors + memory.single_peak, vectors + memory.single_peak - 1):
        with factor_room(room(tmp_path, limit)):
            solver = ModeSolver(count=False)
            found = solver.solve(pair[0], pair[1], MODES)
        held.append(solver.held)
        agrees(found, pair)
    assert held == ["", " in single precision", " in single precision on disk"]
    del solver
    gc.collect()
    assert not list(tmp_path.iterdir())


def test_who_asks_for_double_precision_or_a_count_gets_no_other(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, factorised: list[bool]
) -> None:
    pair = bracket()
    monkeypatch.setattr(rooms, "_resident", lambda: 0)
    least = 8 * pair[0].shape[0] * (8 * MODES + 80)
    least += 9 * Pardiso(sparse.csr_array(pair[0] + pair[1])).memory.peak // 10
    for single, count in ((False, False), (None, True), (True, True)):
        with factor_room(room(tmp_path, least if single is None else 1e12, single)):
            solver = ModeSolver(count=count)
            assert solver.solve(pair[0], pair[1], MODES).counted == count
        assert solver.held == (" on disk" if single is None else "")
    assert set(factorised) == {True}


def test_a_mechanism_without_mass_is_told(tmp_path: Path) -> None:
    k, m = square_bar()
    rest = sparse.diags_array(np.r_[0.0, np.ones(k.shape[0] - 1)])
    k, m = (upper_triangle(sparse.csr_array(rest @ a @ rest)) for a in (k, m))
    with factor_room(room(tmp_path, 1e12, single=True)):
        with pytest.raises(ModelError, match="singular together"):
            ModeSolver(count=False).solve(k, m, MODES)


def test_numbers_of_any_size_stay_in_the_range_of_single_precision(tmp_path: Path) -> None:
    k, m = bracket()
    with factor_room(room(tmp_path, 1e12, single=True)):
        small, large = (
            ModeSolver(count=False).solve(size * k, size * m, 4).eigenvalues
            for size in (1e-60, 1e60)
        )
    np.testing.assert_allclose(small, large, rtol=1e-9)


def test_modes_that_it_does_not_find_are_told_with_the_remedy(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(eigen, "SINGLE_BLOCKS", 1)
    with factor_room(room(tmp_path, 1e12, single=True)):
        with pytest.raises(SolverExhausted, match=r"residual is .*double precision"):
            ModeSolver(count=False).solve(*bracket(), n_modes=MODES)


def test_vectors_in_memory_are_as_many_as_the_forecast_counts() -> None:
    n, n_pairs, n_random = 20_000, 8, GUARD
    stiffness = np.linspace(1.0, 1e3, n) ** 2

    def nearly(block: Floats, out: Floats) -> None:
        np.divide(block, 1.01 * stiffness[:, None] + 0.2, out=out)

    def shifted(block: Floats, out: Floats) -> None:
        np.multiply(block, stiffness[:, None], out=out)

    start = np.random.default_rng(0).standard_normal((n, n_pairs))
    tracemalloc.start()
    try:
        pairs = block_davidson(nearly, shifted, np.copy, start, n_pairs, 1e-6, 200, n_random)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert pairs is not None
    assert pairs.solutions > 5 * (n_pairs + n_random)  # the basis was full, and began anew
    # Beside the vectors: small matrices of 36 by 36, and pieces of 4,096 rows of a block.
    assert peak <= 8 * (n * similar_vectors(n_pairs) + 4 * 4096 * 36 + 50 * 36**2)
