"""Decks with damping: all matrices at the deck's own values, and their roots by LAPACK."""

from __future__ import annotations

import threading
from pathlib import Path
from typing import Any

import numpy as np
from scipy import linalg, sparse

from modetune.adapters.process import run_process
from modetune.adapters.solver import MatrixAnalysis, Solver
from modetune.core.algebra.damped_modes import DampedSystem
from modetune.core.algebra.matrices import MatrixResult
from modetune.core.updating.damping_model import GroupStiffness
from modetune.core.updating.parameter_matrices import Powers, parameter_matrices


def matrices(solver: Solver, folder: Path, **values: float) -> MatrixResult:
    job = folder / f"job{len(list(folder.glob('job*')))}"
    job.mkdir(parents=True)
    solver.render(values, MatrixAnalysis()).write(job)
    ended = run_process(solver.program.command(1), job, 60.0, threading.Event())
    found = solver.read(values, MatrixAnalysis(), job, ended.return_code)
    assert isinstance(found, MatrixResult)
    return found


def damped_system(solver: Solver, folder: Path) -> tuple[DampedSystem, MatrixResult]:
    """A run for K and M, and one for each group with a loss factor."""
    assert solver.deck.undamped() == ""
    base, groups = matrices(solver, folder), solver.deck.losses()
    parts = []
    for column, item in enumerate(groups):
        twice = matrices(solver, folder, **{item.name: 2.0}).upper_stiffness
        parts.append(Powers(column, (1,), (sparse.csr_array(twice - base.upper_stiffness),)))
    own = parameter_matrices(base, np.ones(len(groups)), parts, [])
    stiffness = GroupStiffness(own, np.zeros(0))
    whole = parameter_matrices(base, np.zeros(0), [], [])
    return solver.deck.damping(base).system(whole, np.zeros(0), stiffness), base


def roots(system: DampedSystem, n_modes: int) -> Any:
    """The lowest roots above the real axis, of the whole state space."""
    k, m, c = system.complex_stiffness.toarray(), system.mass.toarray(), system.viscous.toarray()
    size = len(k)
    zero, one = np.zeros((size, size)), np.eye(size)
    found: Any = linalg.eigvals(np.block([[zero, one], [-k, -c]]), linalg.block_diag(one, m))
    kept = found[np.isfinite(found) & (found.imag > 1e-3 * np.abs(found))]
    return kept[np.argsort(np.abs(kept))][:n_modes]


def ratios(found: Any) -> Any:
    return -found.real / np.abs(found)


def measured(found: Any, order: Any = None) -> str:
    """A test of these roots: undamped frequencies (n_modes,) unless |s| is given."""
    hz = np.abs(found) / (2.0 * np.pi) if order is None else order
    return f"mode, {', '.join(str(n + 1) for n in range(len(found)))}\n" + "".join(
        f"{name}, {', '.join(f'{value:.12g}' for value in values)}\n"
        for name, values in (("frequency_hz", hz), ("damping_ratio", ratios(found)))
    )
