"""Results that contradict themselves, and those of another job, are refused by all readers."""

from __future__ import annotations

import shutil
import threading
from pathlib import Path

import numpy as np
import pytest

from modetune.adapters.calculix.solver import calculix_solver
from modetune.adapters.cross_checks import check_energies, check_mark, mark_of
from modetune.adapters.nastran.f06 import read_f06
from modetune.adapters.process import run_process
from modetune.adapters.solver import ModalAnalysis
from modetune.core.errors import NoResult, SolverCrashed
from modetune.core.parameters import Parameter
from tests.adapters.nastran.test_f06 import small

DATA = Path(__file__).parent / "data"
E = Parameter("E", "youngs_modulus", "material", ("AL",), 0.5, 2.0, 0.2)


def test_more_energy_than_the_eigenvalue_says_is_a_contradiction() -> None:
    eigenvalues = np.array([-1e-4, 0.0, 400.0, 9e4])
    check_energies(eigenvalues, 0.5 * np.maximum(eigenvalues, 0.0))
    check_energies(eigenvalues, np.array([1e-12, 0.0, 1e-3, np.nan]))  # hourglass modes, not told
    for wrong in ([0.0, 0.0, 0.0, 9e4], [0.0, 0.0, 40.0, 9e4]):
        with pytest.raises(ValueError, match=r"eigenvalue 3 is .* twice the strain energy .* 400"):
            check_energies(np.array(wrong), 0.5 * np.array([0.0, 0.0, 400.0, 9e4]))


def test_a_mark_names_a_job() -> None:
    text = b"*NSET, NSET=NODES\n1\n"
    marked = text.replace(b"NODES", b"NODES" + mark_of(text).encode())
    check_mark(marked.decode(), "for set NODES_JOB" + mark_of(text)[4:])
    check_mark("NODES", "NODES_JOB0123456789ABCDEF")  # a job without a mark
    with pytest.raises(ValueError, match="it is another job's"):
        check_mark(marked.decode(), "for set NODES_JOB0123456789ABCDEF and time")


def bar(folder: Path) -> Path:
    """The deck beside a job's folder: two bricks without supports."""
    path = folder.parent / "bar.inp"
    text = (DATA / "bar.inp").read_text()  # a job of modetune's
    path.write_text(text[: text.index("*NSET, NSET=MODETUNE_NODES")])
    return path


def solved(folder: Path, value: float) -> Path:
    folder.mkdir()
    solver = calculix_solver(bar(folder), (E,))
    nodes = tuple(sorted(solver.deck.summary.node_ids))
    solver.render({"E": value}, ModalAnalysis(8, nodes)).write(folder)
    ended = run_process(solver.program.command(1), folder, 120.0, threading.Event())
    solver.read({"E": value}, ModalAnalysis(8, nodes), folder, ended.return_code)
    return folder


def test_the_result_of_another_calculix_job_is_refused(tmp_path: Path) -> None:
    one, other = solved(tmp_path / "one", 1.0), solved(tmp_path / "other", 1.1)
    solver = calculix_solver(tmp_path / "bar.inp", (E,))
    analysis = ModalAnalysis(8, tuple(sorted(solver.deck.summary.node_ids)))
    shutil.copy(other / "job.dat", one / "job.dat")
    with pytest.raises(NoResult, match=r"the result names job .* another job's"):
        solver.read({"E": 1.0}, analysis, one, 0)
    (one / "job.inp").unlink()
    with pytest.raises(NoResult, match=r"job\.inp cannot be read"):
        solver.read({"E": 1.0}, analysis, one, 0)


def test_eigenvalues_that_all_their_columns_deny_are_found_by_their_energies(
    tmp_path: Path,
) -> None:
    folder = solved(tmp_path / "one", 1.0)
    dat = folder / "job.dat"
    lines = dat.read_text().splitlines()
    rows = [n for n, line in enumerate(lines) if line.split()[:1] == ["7"] and "E+" in line]
    lines[rows[0]] = "      7   0.0000000E+00   0.0000000E+00   0.0000000E+00   0.0000000E+00"
    dat.write_text("\n".join(lines) + "\n")
    solver = calculix_solver(tmp_path / "bar.inp", (E,))
    analysis = ModalAnalysis(8, tuple(sorted(solver.deck.summary.node_ids)))
    with pytest.raises(NoResult, match="eigenvalue 7 is 0, but twice the strain energy"):
        solver.read({"E": 1.0}, analysis, folder, 0)


def test_a_generalised_stiffness_that_contradicts_its_eigenvalue_is_refused(
    tmp_path: Path,
) -> None:
    path = tmp_path / "job.f06"
    path.write_text(small())
    assert read_f06(path).modes.eigenvalues.size
    lines = small().splitlines(keepends=True)
    row = next(n for n, line in enumerate(lines) if line.split()[:2] == ["1", "1"])
    last = lines[row].split()[-1]
    lines[row] = lines[row].replace(last, "9.999999E+09")
    path.write_text("".join(lines))
    with pytest.raises(SolverCrashed, match="a row of the eigenvalues is"):
        read_f06(path)
