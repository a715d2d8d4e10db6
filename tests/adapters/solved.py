"""Small Nastran decks solved by MYSTRAN and by CalculiX's translation."""

from __future__ import annotations

import os
import shutil
import threading
from collections.abc import Callable
from pathlib import Path

import pytest

from modetune.adapters.nastran.dialect import MYSTRAN
from modetune.adapters.nastran.solver import mystran_solver
from modetune.adapters.process import run_process
from modetune.adapters.solver import ModalAnalysis, Solver
from modetune.adapters.translation.solver import translated_solver
from modetune.core.parameters import Parameter
from modetune.core.updating.job_results import ModalResult

Binder = Callable[[Path, tuple[Parameter, ...]], Solver]

needs_ccx = pytest.mark.skipif(shutil.which("ccx") is None, reason="CalculiX (ccx) is not here")
needs_mystran = pytest.mark.skipif(
    shutil.which(os.environ.get(MYSTRAN.variable, MYSTRAN.program)) is None,
    reason=f"no {MYSTRAN.program} here; {MYSTRAN.variable} names one",
)
#: Each test with it runs once a solver.
on_both = pytest.mark.parametrize(
    "binder",
    [
        pytest.param(mystran_solver, marks=needs_mystran, id="mystran"),
        pytest.param(translated_solver, marks=needs_ccx, id="calculix"),
    ],
)
HEAD = "SOL 103\nCEND\nMETHOD = 1\nBEGIN BULK\nEIGRL,1,,,6\n"


def solved(
    text: str, folder: Path, binder: Binder, n_modes: int = 6, nodes: tuple[int, ...] = ()
) -> ModalResult:
    """Modes of a deck; text: all of it, or bulk data alone."""
    path = folder / "model.bdf"
    path.write_text(text if "BEGIN BULK" in text else HEAD + text)
    solver = binder(path, ())
    shown = nodes or tuple(sorted(solver.deck.summary.node_ids))[:1]
    job = folder / f"job{len(list(folder.iterdir()))}"
    return result_of(solver, ModalAnalysis(n_modes, shown), job)


def result_of(solver: Solver, analysis: ModalAnalysis, job: Path) -> ModalResult:
    """Modes of a bound deck; job: a new folder for its run."""
    job.mkdir()
    solver.render({}, analysis).write(job)
    finished = run_process(solver.program.command(1), job, 60.0, threading.Event())
    result = solver.read({}, analysis, job, finished.return_code)
    assert isinstance(result, ModalResult)
    return result
