"""Runs of CalculiX on a problem's model, with nothing around them.

The deck is written and the results are read by modetune's adapter; each run has its own
folder, which is deleted, and nothing is stored.
"""

from __future__ import annotations

import os
import re
import shutil
import tempfile
import threading
import time
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np
from benchmarks.problem import Agreement, Problem

from modetune.adapters.calculix.solver import calculix_solver
from modetune.adapters.nastran.solver import mystran_solver
from modetune.adapters.process import LOG, run_process
from modetune.adapters.solver import (
    Analysis,
    MatrixAnalysis,
    ModalAnalysis,
    Rendered,
    Solver,
)
from modetune.core.algebra.matrices import MatrixResult
from modetune.core.modes import Floats, ModeSet
from modetune.core.updating.job_results import ModalResult, Result

#: Additional requested modes if modes are paired by shape and may change places.
SPARE_MODES = 2
TIMEOUT_S = 36_000.0
SOLVERS = {"calculix": calculix_solver, "mystran": mystran_solver}
EQUATIONS = re.compile(r"number of equations\s+(\d+)")


def cores() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0))


@dataclass(frozen=True, slots=True)
class JobCost:
    """solver_s, read_s: wall times of CalculiX and of reading what it left. peak_bytes: its memory.
    n_equations: as printed, 0 if CalculiX does not print it."""

    solver_s: float
    read_s: float
    peak_bytes: int
    n_equations: int

    @property
    def wall_s(self) -> float:
        return self.solver_s + self.read_s


@dataclass(frozen=True)
class PlainModel:
    """The model of a problem, as a script would run it."""

    problem: Problem

    @cached_property
    def solver(self) -> Solver:
        made = SOLVERS[self.problem.solver]
        return made(self.problem.deck, self.problem.parameters)

    @property
    def n_modes(self) -> int:
        """Modes asked of the solver, rigid ones included."""
        spare = SPARE_MODES if self.problem.sensors else 0
        return self.problem.n_rigid + self.problem.n_modes + spare

    def modes(self, theta: Floats) -> tuple[ModeSet, JobCost]:
        """The elastic modes at these parameter values, (n_parameters,), at the problem's sensors.

        Raises SolverError, as the others do.
        """
        sensors = self.problem.sensors
        result, cost = self._run(theta, self.modal)
        assert isinstance(result, ModalResult)
        modes = result.modes.select(range(self.problem.n_rigid, self.n_modes))
        return modes if sensors else modes.rows([]), cost

    @property
    def modal(self) -> ModalAnalysis:
        """The request of a modal run."""
        sensors = self.problem.sensors or (min(self.solver.deck.summary.node_ids),)
        return ModalAnalysis(self.n_modes, sensors)

    def render(self, theta: Floats) -> Rendered:
        """A modal run's input files."""
        return self.solver.render(self.problem.parameter_set.values(theta), self.modal)

    def matrices(self, theta: Floats) -> tuple[MatrixResult, JobCost]:
        """The assembled stiffness and mass at these values."""
        result, cost = self._run(theta, MatrixAnalysis())
        assert isinstance(result, MatrixResult)
        return result, cost

    def agreement(self, theta: Floats) -> Agreement:
        """How the model at these values agrees with the test."""
        return self.problem.agreement(self.modes(theta)[0])

    def _run(self, theta: Floats, analysis: Analysis) -> tuple[Result, JobCost]:
        values, solver = self.problem.parameter_set.values(theta), self.solver
        folder = Path(tempfile.mkdtemp(dir=self.problem.folder, prefix="plain-"))
        try:
            solver.render(values, analysis).write(folder)
            command = solver.program.command(self.problem.threads)
            finished = run_process(command, folder, TIMEOUT_S, threading.Event())
            started = time.monotonic()
            result = solver.read(values, analysis, folder, finished.return_code)
            read_s = time.monotonic() - started
            told = EQUATIONS.search((folder / LOG).read_text(errors="replace"))
        finally:
            shutil.rmtree(folder)
        n_equations = int(told[1]) if told else 0
        return result, JobCost(finished.wall_s, read_s, finished.peak_memory_bytes, n_equations)


def quickest(problem: Problem) -> tuple[Problem, ModeSet]:
    """The problem with one thread or all cores, whichever is quicker, and the twin's modes.

    CalculiX gains little by threads on most models, and loses much by them where another process
    requires a core now and then: its threads wait for each other at full speed.
    """
    counts = {1, cores()} if problem.solver == "calculix" else {1}  # MYSTRAN has one
    tried = [replace(problem, threads=count) for count in sorted(counts)]
    runs = [PlainModel(each).modes(np.array(problem.truth)) for each in tried]
    best = min(range(len(tried)), key=lambda place: runs[place][1].wall_s)
    return tried[best], runs[best][0]
