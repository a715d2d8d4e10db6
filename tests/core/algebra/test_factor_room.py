"""Factors in memory or in files: the choice, equal modes of unlike structures, and refusals."""

from __future__ import annotations

import errno
import functools
import gc
import os
import resource
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
import pytest
from scipy import sparse

from modetune.core.algebra import factor_room as rooms
from modetune.core.algebra import mumps, pardiso
from modetune.core.algebra.eigen import ModeSolver
from modetune.core.algebra.factor_room import FactorRoom, factor_room, machine_memory
from modetune.core.algebra.factorisation import factorise
from modetune.core.algebra.matrices import upper_triangle
from modetune.core.algebra.mumps import FactorFiles
from modetune.core.algebra.vector_room import in_file
from modetune.core.errors import SolverExhausted
from modetune.core.modes import Floats

pytestmark = pytest.mark.skipif(
    not pardiso.is_available(), reason="PARDISO is installed on x86_64 only"
)
Pair = tuple[sparse.csr_array, sparse.csr_array]


def second_differences(n: int) -> sparse.csr_array:
    """A chain of n masses between springs, held at both ends."""
    return sparse.csr_array(
        sparse.diags_array([[-1.0] * (n - 1), [2.0] * n, [-1.0] * (n - 1)], offsets=[-1, 0, 1])
    )


def block() -> Pair:
    """A solid: 22 by 20 by 18 points with springs to their neighbours, held all round."""
    one = [second_differences(n) for n in (22, 20, 18)]
    unit = [sparse.eye_array(n) for n in (22, 20, 18)]
    whole = sparse.kron(sparse.kron(one[0], unit[1]), unit[2])
    whole = whole + sparse.kron(sparse.kron(unit[0], one[1]), unit[2])
    whole = whole + sparse.kron(sparse.kron(unit[0], unit[1]), one[2])
    return sparse.csr_array(whole), sparse.csr_array(sparse.eye_array(whole.shape[0]))


def plate() -> Pair:
    """A simply supported plate's bending by differences, 90 by 80 points."""
    one = [second_differences(n) for n in (90, 80)]
    laplacian = sparse.kron(one[0], sparse.eye_array(80)) + sparse.kron(
        sparse.eye_array(90), one[1]
    )
    return sparse.csr_array(laplacian @ laplacian), sparse.csr_array(sparse.eye_array(7200))


def frame() -> Pair:
    """A free tower of 16 by 16 by 20 joints; half of its unknowns, rotations, have no mass."""
    sizes = (16, 16, 20)
    joints = sparse.csr_array((5120, 5120))
    for along in range(3):
        parts = [sparse.csr_array(sparse.eye_array(n)) for n in sizes]
        chain = second_differences(sizes[along]).tolil()
        chain[0, 0] = chain[-1, -1] = 1.0  # free ends
        parts[along] = sparse.csr_array(chain)
        joints = sparse.csr_array(joints + sparse.kron(sparse.kron(parts[0], parts[1]), parts[2]))
    shared, turned = 0.1 * joints, sparse.csr_array(joints + sparse.eye_array(5120))
    stiffness = sparse.block_array([[joints + shared, shared], [shared, turned]])
    mass = sparse.block_diag([sparse.eye_array(5120), sparse.csr_array((5120, 5120))])
    return sparse.csr_array(stiffness), sparse.csr_array(mass)


def room(folder: Path, memory: int, disk: int = 10**9) -> FactorRoom:
    def files() -> FactorFiles:
        own = Path(tempfile.mkdtemp(dir=folder))
        return FactorFiles(own, functools.partial(shutil.rmtree, own, ignore_errors=True))

    return FactorRoom(memory, disk, files)


def taken_in_memory(pair: Pair, monkeypatch: pytest.MonkeyPatch) -> int:
    """What the factors of K - s M take, bytes; nothing else counts from now on."""
    monkeypatch.setattr(rooms, "_resident", lambda: 0)
    upper = upper_triangle(sparse.csr_array(pair[0] + pair[1]))
    return pardiso.Pardiso(upper).memory.peak


@pytest.mark.parametrize("structure", [block, plate, frame])
def test_modes_with_factors_in_files_are_those_with_factors_in_memory(
    structure: type, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    stiffness, mass = (upper_triangle(a) for a in structure())
    inside = ModeSolver().solve(stiffness, mass, 8)
    least = taken_in_memory((stiffness, mass), monkeypatch)
    vectors = 8 * stiffness.shape[0] * (8 * 8 + 80)
    mapped = []

    def spied(folder: Path, n_rows: int, n_columns: int) -> Floats:
        found = in_file(folder, n_rows, n_columns)
        mapped.append(found.nbytes)
        return found

    monkeypatch.setattr(mumps, "in_file", spied)
    # A quarter of the vectors is worked on in memory; the factors themselves leave it.
    with factor_room(room(tmp_path, vectors // 4 + least * 9 // 10)):
        solver = ModeSolver()
        outside = solver.solve(stiffness, mass, 8)
        assert solver.held == " on disk"
        assert sum(mapped) > vectors // 2
        assert any(tmp_path.rglob("factors_mumps*"))
    largest = float(np.max(stiffness.diagonal()))  # rounding is of the largest eigenvalue
    np.testing.assert_allclose(
        outside.eigenvalues, inside.eigenvalues, rtol=1e-9, atol=1e-14 * largest
    )
    del solver
    gc.collect()
    assert not list(tmp_path.iterdir())


def test_vectors_in_a_file_are_in_one_without_a_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    vectors = in_file(tmp_path, 1000, 7)
    assert vectors.shape == (1000, 7)
    assert vectors.flags.f_contiguous
    vectors[:, 3] = 5.0
    assert vectors.sum() == 5000.0
    assert not list(tmp_path.iterdir())

    def full(*_: int) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "posix_fallocate", full)
    with pytest.raises(SolverExhausted, match=r"7 vectors of 1000 .*GB: No space left"):
        in_file(tmp_path, 1000, 7)
    assert not list(tmp_path.iterdir())


def test_factors_stay_in_memory_where_they_fit(tmp_path: Path) -> None:
    stiffness, mass = (upper_triangle(a) for a in block())
    with factor_room(room(tmp_path, 10**12)):
        solver = ModeSolver()
        solver.solve(stiffness, mass, 4)
    assert not solver.held
    assert not list(tmp_path.iterdir())


def test_other_factorisations_go_to_files_too(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    stiffness = block()[0]
    least = taken_in_memory((stiffness, stiffness), monkeypatch)
    with factor_room(room(tmp_path, least * 9 // 10)):
        factors = factorise(stiffness)
        assert any(tmp_path.rglob("factors_mumps*"))
    np.testing.assert_allclose(stiffness @ factors.solve(np.ones(factors.n)), 1.0, rtol=1e-10)


@pytest.mark.parametrize(
    ("share", "disk", "said"),
    [
        (0.01, 10**9, "with factors on disk too"),
        (0.9, 10**6, r"more than the 0.001 GB of the limit of disk"),
    ],
)
def test_what_does_not_fit_at_all_is_refused_with_a_remedy(
    share: float, disk: int, said: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    stiffness = block()[0]
    memory = int(share * taken_in_memory((stiffness, stiffness), monkeypatch))
    with factor_room(room(tmp_path, memory, disk)), pytest.raises(SolverExhausted, match=said):
        factorise(stiffness)
    gc.collect()
    assert not list(tmp_path.iterdir())


FULL = """
import resource, sys
from pathlib import Path
from tests.core.algebra import test_factor_room as t
from modetune.core.algebra import factor_room as rooms
from modetune.core.errors import SolverExhausted
rooms._resident = lambda: 0
stiffness = t.block()[0]
resource.setrlimit(resource.RLIMIT_FSIZE, (200_000, 200_000))
memory = int(0.9 * rooms.Pardiso(t.upper_triangle(stiffness)).memory.peak)
try:
    with t.factor_room(t.room(Path(sys.argv[1]), memory)):
        t.factorise(stiffness)
except SolverExhausted as error:
    print(error)
"""


def test_a_disk_that_fills_up_on_the_way_is_told_in_a_sentence(tmp_path: Path) -> None:
    """A limit on the size of files refuses a write as a full disk does.

    In one of some twenty-five processes MUMPS then waits for ever for its own thread that writes.
    """
    root = Path(__file__).parents[3]
    for attempt in ("first", "second", "third"):
        try:
            done = subprocess.run(
                [sys.executable, "-c", FULL, str(tmp_path)],
                cwd=root, capture_output=True, text=True, check=False, timeout=60.0,
            )  # fmt: skip
            break
        except subprocess.TimeoutExpired:
            assert attempt != "third"
            for part in tmp_path.iterdir():
                shutil.rmtree(part)
    assert done.returncode == 0, done.stderr
    assert "the files of the factors cannot be" in done.stdout
    assert str(tmp_path) in done.stdout
    assert "free some" in done.stdout
    assert not list(tmp_path.iterdir())


def test_memory_is_the_least_of_machine_and_containers(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    inner = tmp_path / "slice" / "job"
    inner.mkdir(parents=True)
    (inner / "memory.max").write_text("max\n")
    (tmp_path / "slice" / "memory.max").write_text("2000000000\n")
    told = tmp_path / "cgroup"
    told.write_text("0::/slice/job\n")
    groups = list(rooms._control_groups(told, tmp_path))
    assert groups == [tmp_path / "slice" / "job", tmp_path / "slice", tmp_path]
    monkeypatch.setattr(rooms, "_control_groups", lambda *_: iter(groups))
    assert machine_memory() == 1_800_000_000
    monkeypatch.setenv(rooms.MEMORY_VARIABLE, "5000")
    assert machine_memory() == 5000


def test_this_machine_has_no_more_memory_than_the_system_says() -> None:
    told = int(Path("/proc/meminfo").read_text().split()[1]) * 1024
    assert resource.getpagesize() < machine_memory() < told
