"""One modal solution: CalculiX by itself, and from its matrices by modetune's own solver.

    native   CalculiX's modal job, with one thread or all cores, and reading it
    first    its matrix job, reading it, the factorisation and a block Krylov space
    later    other parameter values: matrices by their parts, another factorisation, and a block
             Krylov space from the modes before; of large models the factors that are there
             (`kept` says of how many of these solutions, and how many columns were solved)

and how much of two cores finite differences get that run side by side: the wall time of jobs with
one thread one after another, over twice that of the same jobs two at a time.

    python -m benchmarks.eigen [--case garteur] [--sizes coarse medium fine large] [--threads 2]

The last line of the output is one JSON object.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import sys
import tempfile
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import nullcontext
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from statistics import median

import numpy as np
from benchmarks.cost import calculix, watched
from benchmarks.plain import PlainModel, quickest
from benchmarks.problem import CASES, Problem, set_up

from modetune.core.algebra.eigen import ModeSolver, SolvedModes
from modetune.core.algebra.factor_room import FactorRoom, factor_room, machine_memory
from modetune.core.algebra.matrices import MatrixResult
from modetune.core.algebra.mumps import FactorFiles
from modetune.core.algebra.pencil import shift_below
from modetune.core.errors import ModetuneError
from modetune.core.modes import Floats
from modetune.core.updating.parameter_matrices import (
    ParameterMatrices,
    Powers,
    differences,
    parameter_matrices,
)

#: Ways from the deck's moduli to the hidden ones, in steps as updating takes them.
STEPS = (0.6, 0.9, 1.0)
#: Jobs with one thread, side by side in pairs; not at sizes where they take too long.
N_JOBS = 4
LARGEST_PARALLEL = 100_000


@dataclass(frozen=True, slots=True)
class Solution:
    """Wall times in s of one modal solution, and memory, at one size.

    native_s: CalculiX, with its reading; native_bytes: its memory. job_s, read_s, solve_s: of the
    first solution from matrices. later_s: median of the later ones, later_cpu_s: of their processor
    time; kept: how many of them factorised nothing; later_columns: solved in all. own_bytes:
    largest resident size of this process and its matrix jobs. difference: largest of the elastic
    frequencies, relative, first against native. efficiency: of two jobs side by side, None where
    it was not measured.
    """

    size: str
    n_equations: int
    n_modes: int
    native_s: float
    native_bytes: int
    job_s: float
    read_s: float
    solve_s: float
    later_s: float
    later_cpu_s: float
    kept: int
    later_columns: int
    own_bytes: int
    difference: float
    efficiency: float | None

    @property
    def first_s(self) -> float:
        return self.job_s + self.read_s + self.solve_s


@dataclass(frozen=True, slots=True)
class Later:
    """A later solution, its wall and its processor time."""

    wall_s: float
    cpu_s: float
    solved: SolvedModes


def measure(problem: Problem) -> Solution:
    """All of it on a problem's model."""
    model = PlainModel(problem)
    start = problem.parameter_set.initial
    modes, native = model.modes(start)
    with watched(os.getpid()) as peak:
        base, job = model.matrices(start)
        solver, started = ModeSolver(count=False), time.monotonic()
        # A campaign knows about where the first elastic mode is: from its test.
        shift = shift_below((2.0 * np.pi * float(modes.frequencies_hz[0])) ** 2)
        first = solver.solve(base.upper_stiffness, base.upper_mass, model.n_modes, shift)
        solve_s = time.monotonic() - started
        laters = later(model, base, solver, first)
    elastic = np.sqrt(first.eigenvalues[problem.n_rigid :]) / (2.0 * np.pi)
    alike = native.n_equations <= LARGEST_PARALLEL
    return Solution(
        problem.size,
        native.n_equations,
        model.n_modes,
        native.wall_s,
        native.peak_bytes,
        job.solver_s,
        job.read_s,
        solve_s,
        median(item.wall_s for item in laters),
        median(item.cpu_s for item in laters),
        sum(item.solved.way.startswith("kept factors") for item in laters),
        sum(item.solved.solutions for item in laters),
        peak[0],
        float(np.abs(elastic / modes.frequencies_hz - 1.0).max()),
        efficiency(problem) if alike else None,
    )


def later(
    model: PlainModel, base: MatrixResult, solver: ModeSolver, before: SolvedModes
) -> list[Later]:
    """Each solution on the way to the hidden moduli; their matrices are linear in it."""
    affine = towards(base, model.matrices(np.array(model.problem.truth))[0])
    found = []
    for step in STEPS:
        started, cpu = time.monotonic(), time.process_time()
        matrices = affine.at(np.array([step]))
        before = solver.solve(
            matrices.upper_stiffness,
            matrices.upper_mass,
            model.n_modes,
            before.shift,
            before.shapes,
            solver.blocks_that_pay(model.n_modes),
        )
        found.append(Later(time.monotonic() - started, time.process_time() - cpu, before))
    return found


def towards(base: MatrixResult, other: MatrixResult) -> ParameterMatrices:
    """The matrices between two states, 0 and 1 the value of their one parameter."""
    stiffness, mass = differences(base, other)
    return parameter_matrices(
        base,
        np.zeros(1),
        [Powers(0, (1,), (stiffness,))],
        [Powers(0, (1,), (mass,))],
    )


def efficiency(problem: Problem) -> float:
    """Share of two cores that finite differences with one thread each use side by side."""
    model = PlainModel(replace(problem, threads=1))
    thetas = [problem.parameter_set.initial * (1.0 + 0.01 * k) for k in range(N_JOBS)]
    return one_by_one(model, thetas) / (2.0 * in_pairs(model, thetas))


def one_by_one(model: PlainModel, thetas: Sequence[Floats]) -> float:
    started = time.monotonic()
    for theta in thetas:
        model.modes(theta)
    return time.monotonic() - started


def in_pairs(model: PlainModel, thetas: Sequence[Floats]) -> float:
    started = time.monotonic()
    with ThreadPoolExecutor(2) as pool:
        list(pool.map(model.modes, thetas))
    return time.monotonic() - started


def table(solutions: Sequence[Solution]) -> str:
    """A line a size; seconds, and how much faster than native."""
    lines = [
        f"{'one modal solution':18}{'equations':>11}{'native s':>9}{'job':>8}{'read':>7}"
        f"{'solve':>7}{'first s':>8}{'':>7}{'later s':>8}{'':>7}{'GB native':>11}{'own':>6}"
        f"{'differ':>9}{'2 cores':>9}{'later cpu':>10}{'kept':>6}{'columns':>8}"
    ]
    for item in solutions:
        share = "-" if item.efficiency is None else f"{item.efficiency:.0%}"
        lines.append(
            f"{item.size:18}{item.n_equations:11,}{item.native_s:9.2f}{item.job_s:8.2f}"
            f"{item.read_s:7.2f}{item.solve_s:7.2f}{item.first_s:8.2f}"
            f"{f'x{item.native_s / item.first_s:.1f}':>7}{item.later_s:8.2f}"
            f"{f'x{item.native_s / item.later_s:.1f}':>7}{item.native_bytes / 1e9:11.2f}"
            f"{item.own_bytes / 1e9:6.2f}{item.difference:9.1e}{share:>9}"
            f"{item.later_cpu_s:10.2f}{item.kept:>4}/{len(STEPS)}{item.later_columns:8}"
        )
    return "\n".join(lines)


def main() -> None:
    """Measure the sizes asked for."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--case", choices=sorted(CASES), default="garteur")
    parser.add_argument("--sizes", nargs="+", default=["coarse", "medium"])
    parser.add_argument("--mixed", action="store_true", help="factors in single precision")
    parser.add_argument("--threads", type=int, help="of CalculiX; else the quickest is tried out")
    chosen = parser.parse_args()
    known = CASES[chosen.case][0]
    if unknown := sorted(set(chosen.sizes) - set(known)):
        parser.error(f"{chosen.case} has the sizes {', '.join(known)}, not {', '.join(unknown)}")
    calculix()
    with tempfile.TemporaryDirectory(prefix="modetune-bench-") as name:
        problems = (set_up(chosen.case, size, 1.0, Path(name) / size) for size in chosen.sizes)

        def files() -> FactorFiles:
            return FactorFiles(Path(tempfile.mkdtemp(dir=name)), lambda: None)

        room = FactorRoom(machine_memory(), shutil.disk_usage(name).free, files, single=True)
        with factor_room(room) if chosen.mixed else nullcontext():
            solutions = [
                measure(
                    replace(item, threads=chosen.threads) if chosen.threads else quickest(item)[0]
                )
                for item in problems
            ]
    sys.stdout.write(table(solutions) + "\n" + json.dumps([asdict(s) for s in solutions]) + "\n")


if __name__ == "__main__":
    try:
        main()
    except ModetuneError as error:
        sys.exit(str(error))
