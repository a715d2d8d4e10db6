"""The embedded solver as a process: closed forms, free structures, large models, failures."""

from __future__ import annotations

import sys
import threading
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pytest
from scipy import sparse

from modetune.adapters.matrices.matrix_files import write_matrix
from modetune.adapters.matrices.program import CLOSING_MARK, RESULT
from modetune.adapters.matrices.solver import matrices_solver
from modetune.adapters.process import run_process
from modetune.adapters.solver import Analysis, Command, MatrixAnalysis, ModalAnalysis, Solver
from modetune.core.algebra.matrices import MatrixResult
from modetune.core.errors import SolverCrashed, SolverRejected
from modetune.core.parameters import Parameter
from modetune.core.updating.job_results import ModalResult, Result

K, M, N = 50.0, 2e-3, 12


def chain_text(*, held: bool = True, n: int = N) -> str:
    """A chain of equal masses and springs, held at its first mass or free."""
    lines = ["masses:", *(f"  m{i}: {M}" for i in range(1, n + 1)), "springs:"]
    if held:
        lines.append(f"  k1: {{between: [ground, m1], stiffness: {K}}}")
    lines += [f"  k{i}: {{between: [m{i - 1}, m{i}], stiffness: {K}}}" for i in range(2, n + 1)]
    return "\n".join(lines) + "\n"


def chain_matrices(n: int, *, held: bool) -> tuple[sparse.csr_array, sparse.csr_array]:
    diagonal = np.full(n, 2.0 * K)
    diagonal[-1] = K
    diagonal[0] = 2.0 * K if held else K
    off = sparse.diags_array(np.full(n - 1, -K), offsets=1)
    stiffness = sparse.diags_array(diagonal) + off + off.T
    return sparse.csr_array(stiffness), sparse.csr_array(sparse.diags_array(np.full(n, M)))


def held_hz(mode: int, n: int = N) -> float:
    """Fixed-free chain of equal links: sqrt(k / m) / pi sin((2 j - 1) pi / (4 n + 2))."""
    return float((K / M) ** 0.5 / np.pi * np.sin((2 * mode - 1) * np.pi / (4 * n + 2)))


def free_hz(mode: int, n: int = N) -> float:
    """Free chain, rigid mode 0: sqrt(k / m) / pi sin(j pi / 2 n)."""
    return float((K / M) ** 0.5 / np.pi * np.sin(mode * np.pi / (2 * n)))


SPRINGS = Parameter(
    "k", "spring_stiffness", "elset", tuple(f"k{i}" for i in range(1, N + 1)), 0.1, 9.0, 0.1
)
MASSES = Parameter("m", "mass", "elset", tuple(f"m{i}" for i in range(1, N + 1)), 0.1, 9.0, 0.1)


@pytest.fixture
def held(tmp_path: Path) -> Solver:
    (tmp_path / "chain.yaml").write_text(chain_text())
    return matrices_solver(tmp_path / "chain.yaml", (SPRINGS, MASSES))


def run(solver: Solver, values: Mapping[str, float], analysis: Analysis, folder: Path) -> Result:
    job = folder / f"job{sum(1 for _ in folder.iterdir())}"
    job.mkdir()
    solver.render(values, analysis).write(job)
    finished = run_process(solver.program.command(1), job, 120.0, threading.Event())
    return solver.read(values, analysis, job, finished.return_code)


def run_modal(
    solver: Solver, values: Mapping[str, float], analysis: ModalAnalysis, folder: Path
) -> ModalResult:
    result = run(solver, values, analysis, folder)
    assert isinstance(result, ModalResult)
    return result


def test_a_held_chain_has_its_closed_form(held: Solver, tmp_path: Path) -> None:
    groups = (("k", SPRINGS.targets), ("root", ("k1",)))
    result = run_modal(held, {}, ModalAnalysis(5, (3, 12), groups), tmp_path)
    np.testing.assert_allclose(
        result.modes.frequencies_hz, [held_hz(mode) for mode in range(1, 6)], rtol=1e-12
    )
    assert result.n_rigid == 0
    assert result.mass == pytest.approx(N * M)
    assert result.modes.nodes.tolist() == [3, 12]
    np.testing.assert_allclose(result.energy_balance, 1.0, rtol=1e-12)
    np.testing.assert_allclose(result.strain_energies[0], result.total_strain_energy, rtol=1e-9)
    assert (result.strain_energies[1] < result.strain_energies[0]).all()


def test_values_scale_stiffness_and_mass(held: Solver, tmp_path: Path) -> None:
    values = {"k": 2.0, "m": 0.5}
    groups = (("k", SPRINGS.targets),)
    result = run_modal(held, values, ModalAnalysis(2, (1,), groups), tmp_path)
    np.testing.assert_allclose(
        result.modes.frequencies_hz, [2.0 * held_hz(1), 2.0 * held_hz(2)], rtol=1e-12
    )
    assert result.mass == pytest.approx(0.5 * N * M)
    np.testing.assert_allclose(result.strain_energies[0], result.total_strain_energy, rtol=1e-9)
    matrices = run(held, values, MatrixAnalysis(), tmp_path)
    assert isinstance(matrices, MatrixResult)
    expected = chain_matrices(N, held=True)
    np.testing.assert_allclose(matrices.stiffness.toarray(), 2.0 * expected[0].toarray())
    np.testing.assert_allclose(matrices.mass.toarray(), 0.5 * expected[1].toarray())


def test_an_updated_model_runs_to_the_same_modes(held: Solver, tmp_path: Path) -> None:
    values, analysis = {"k": 1.2345, "m": 0.87}, ModalAnalysis(3, (1,))
    expected = run_modal(held, values, analysis, tmp_path)
    again = matrices_solver(held.deck.write_updated(values, tmp_path / "updated"), ())
    found = run_modal(again, {}, analysis, tmp_path)
    np.testing.assert_allclose(found.eigenvalues, expected.eigenvalues, rtol=1e-12)


def test_a_free_chain_has_one_rigid_mode_and_its_closed_form(tmp_path: Path) -> None:
    (tmp_path / "chain.yaml").write_text(chain_text(held=False))
    solver = matrices_solver(tmp_path / "chain.yaml", ())
    result = run_modal(solver, {}, ModalAnalysis(30, (1,)), tmp_path)
    assert result.n_rigid == 1
    assert result.modes.n_modes == N  # no more than there are, though more were asked for
    np.testing.assert_allclose(
        result.elastic.frequencies_hz, [free_hz(mode) for mode in range(1, N)], rtol=1e-10
    )


def test_a_chain_has_as_many_modes_as_its_masses_allow(tmp_path: Path) -> None:
    # Every other mass is zero, so springs in pairs of K / 2 join the rest.
    stiffness, _ = chain_matrices(N, held=True)
    mass = sparse.diags_array(np.tile([0.0, M], N // 2))
    write_matrix(tmp_path, "K.npz", stiffness)
    write_matrix(tmp_path, "M.npz", sparse.csr_array(mass))
    (tmp_path / "model.yaml").write_text("stiffness: K.npz\nmass: M.npz\n")
    result = run_modal(
        matrices_solver(tmp_path / "model.yaml", ()), {}, ModalAnalysis(N, (2,)), tmp_path
    )
    wanted = [held_hz(mode, N // 2) * np.sqrt(0.5) for mode in range(1, N // 2 + 1)]
    np.testing.assert_allclose(result.modes.frequencies_hz, wanted, rtol=1e-9)


@pytest.mark.parametrize("is_held", [True, False])
def test_a_chain_of_a_hundred_thousand_unknowns_has_its_closed_form(
    is_held: bool, tmp_path: Path
) -> None:
    # The hardest spectrum for a shift: the first eigenvalue is 10^-10 of the last.
    n = 100_000
    stiffness, mass = chain_matrices(n, held=is_held)
    write_matrix(tmp_path, "K.npz", stiffness)
    write_matrix(tmp_path, "M.npz", mass)
    (tmp_path / "model.yaml").write_text("stiffness: K.npz\nmass: M.npz\n")
    solver = matrices_solver(tmp_path / "model.yaml", ())
    result = run_modal(solver, {}, ModalAnalysis(8, (1, n)), tmp_path)
    closed_form, first = (held_hz, 1) if is_held else (free_hz, 1)
    assert result.n_rigid == (0 if is_held else 1)
    elastic = result.elastic.frequencies_hz
    expected = [closed_form(mode, n) for mode in range(first, first + elastic.size)]
    # Eigenvalues are good to rounding of the largest: 10^-16 of 10^10 times the first.
    np.testing.assert_allclose(elastic, expected, rtol=1e-5)


@pytest.mark.parametrize(
    ("stiffness", "mass", "expected"),
    [
        (np.diag([1.0, -1.0]), np.eye(2), "negative eigenvalue"),
        (np.eye(2), np.diag([1.0, -1.0]), "no modes|no mass"),
        (np.eye(2), np.zeros((2, 2)), "nothing that moves"),
        (np.diag([1.0, 0.0]), np.diag([1.0, 0.0]), "neither"),
    ],
)
def test_matrices_that_are_no_structure_are_rejected_with_the_reason(
    stiffness: np.ndarray[tuple[int, int], np.dtype[np.float64]],
    mass: np.ndarray[tuple[int, int], np.dtype[np.float64]],
    expected: str,
    tmp_path: Path,
) -> None:
    write_matrix(tmp_path, "K.npz", sparse.csr_array(stiffness))
    write_matrix(tmp_path, "M.npz", sparse.csr_array(mass))
    (tmp_path / "model.yaml").write_text("stiffness: K.npz\nmass: M.npz\n")
    solver = matrices_solver(tmp_path / "model.yaml", ())
    with pytest.raises(SolverRejected, match=expected):
        run(solver, {}, ModalAnalysis(2, (1, 2)), tmp_path)


def finished_job(solver: Solver, folder: Path) -> tuple[ModalAnalysis, Path]:
    analysis, job = ModalAnalysis(2, (1,)), folder / "job"
    job.mkdir()
    solver.render({}, analysis).write(job)
    run_process(solver.program.command(1), job, 60.0, threading.Event())
    assert solver.read({}, analysis, job, 0)
    return analysis, job


def test_a_clean_exit_without_the_closing_mark_is_no_result(held: Solver, tmp_path: Path) -> None:
    analysis, job = finished_job(held, tmp_path)
    log = job / "solver.log"
    log.write_text(log.read_text().replace(CLOSING_MARK, ""))
    with pytest.raises(SolverCrashed, match="without its closing line"):
        held.read({}, analysis, job, 0)


def test_a_cut_or_missing_result_is_no_result(held: Solver, tmp_path: Path) -> None:
    analysis, job = finished_job(held, tmp_path)
    whole = (job / RESULT).read_bytes()
    damaged = bytearray(whole)
    damaged[whole.index(b"NUMPY") + 130] ^= 1  # in the numbers: the archive's checksum tells
    for content in (whole[: len(whole) // 2], b"", bytes(damaged)):
        (job / RESULT).write_bytes(content)
        with pytest.raises(SolverCrashed, match="missing, cut or damaged"):
            held.read({}, analysis, job, 0)
    (job / RESULT).unlink()
    with pytest.raises(SolverCrashed, match="missing, cut or damaged"):
        held.read({}, analysis, job, 0)


def test_a_result_of_another_job_is_refused(held: Solver, tmp_path: Path) -> None:
    _, job = finished_job(held, tmp_path)
    with pytest.raises(SolverCrashed, match="is not a result of this job"):
        held.read({}, ModalAnalysis(2, (1, 2)), job, 0)


def test_a_job_without_its_files_crashes_and_shows_its_log(held: Solver, tmp_path: Path) -> None:
    analysis, job = ModalAnalysis(2, (1,)), tmp_path / "job"
    job.mkdir()
    held.render({}, analysis).write(job)
    (job / "mass.npz").unlink()
    finished = run_process(held.program.command(1), job, 60.0, threading.Event())
    with pytest.raises(SolverCrashed, match=r"mass\.npz"):
        held.read({}, analysis, job, finished.return_code)


def test_modules_in_a_job_folder_are_not_imported(held: Solver, tmp_path: Path) -> None:
    job = tmp_path / "job"
    job.mkdir()
    (job / "numpy.py").write_text("raise SystemExit('imported from the job folder')")
    analysis = ModalAnalysis(2, (1,))
    held.render({}, analysis).write(job)
    finished = run_process(held.program.command(1), job, 60.0, threading.Event())
    assert held.read({}, analysis, job, finished.return_code)
    assert held.program.command(1) == Command(
        (sys.executable, "-P", "-m", "modetune.adapters.matrices"),
        tuple((n, "1") for n in ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS")),
    )
