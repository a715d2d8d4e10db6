"""The launcher in any size: time and memory of its first modes, and of a campaign.

    modes      CalculiX's matrices at the hidden moduli, reading them, and 13 modes, uncounted:
               factors in single precision; with --double in double precision after it, compared
    campaign   `modetune update` of the ten moduli by default settings, with these modes as its test

    python -m benchmarks.sizes 20000 1000000 5786376 --memory-gb 20 [--double] [--campaign]

No plain modal run is made: at a million degrees of freedom it takes CalculiX eight minutes. So
the last word of a campaign is that of CalculiX's matrices. The last line of the output is one JSON
object.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import sys
import tempfile
import time
from collections.abc import Mapping
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass, replace
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
from benchmarks.cost import calculix, watched
from benchmarks.plain import PlainModel
from benchmarks.problem import LAUNCHERS, Problem, set_up, write_problem
from benchmarks.ways import campaign, modetune, told

from modetune.configs.launcher.launcher import LEAST_DOF, MOST_DOF
from modetune.core.algebra.eigen import ModeSolver, SolvedModes
from modetune.core.algebra.factor_room import FactorRoom, factor_room, machine_memory
from modetune.core.algebra.matrices import MatrixResult
from modetune.core.algebra.mumps import FactorFiles
from modetune.core.errors import ModetuneError
from modetune.core.modes import ModeSet, mode_set

#: Modes that are found, as many as the thesis shows.
N_MODES = 13
#: Degrees of freedom along x, y and z at a sensor.
COMPONENTS = (1, 2, 3)


@dataclass(frozen=True, slots=True)
class Found:
    """Modes of one size, and what they took.

    job_s, job_bytes: of CalculiX's matrix job; read_s; solve_s, solve_cpu_s: from matrices to
    modes; peak_bytes: largest resident size of the process that solves. frequencies_hz: of all
    modes; residual: the largest. difference: of eigenvalues to those by factors in double
    precision, relative; None where these were not asked for.
    """

    n_equations: int
    job_s: float
    job_bytes: int
    read_s: float
    solve_s: float
    solve_cpu_s: float
    peak_bytes: int
    frequencies_hz: tuple[float, ...]
    residual: float
    difference: float | None


@dataclass(frozen=True, slots=True)
class Limits:
    """memory_bytes: of the process that solves, and of campaigns; double: whether to compare."""

    memory_bytes: int
    double: bool


def find(problem: Problem, limits: Limits) -> tuple[Found, ModeSet]:
    """The twin's modes; of those that are compared, shapes at the problem's sensors."""
    model = PlainModel(problem)
    matrices, job = model.matrices(np.array(problem.truth))
    with watched(os.getpid()) as peak:
        started, cpu = time.monotonic(), time.process_time()
        solved = solve(matrices, limits.memory_bytes, problem.folder, single=True)
        solve_s, solve_cpu_s = time.monotonic() - started, time.process_time() - cpu
    difference = None
    if limits.double:
        double = solve(matrices, limits.memory_bytes, problem.folder, single=False)
        difference = float(np.abs(solved.eigenvalues / double.eigenvalues - 1.0).max())
    frequencies = np.sqrt(solved.eigenvalues) / (2.0 * np.pi)
    found = Found(
        matrices.nodes.size,
        job.solver_s,
        job.peak_bytes,
        job.read_s,
        solve_s,
        solve_cpu_s,
        peak[0],
        tuple(frequencies.tolist()),
        float(solved.residuals.max()),
        difference,
    )
    nodes = np.repeat(np.array(problem.sensors, dtype=np.int64), len(COMPONENTS))
    components = np.tile(np.array(COMPONENTS), len(problem.sensors))
    observer = model.solver.deck.observation(matrices, nodes, components).matrix
    compared = slice(0, problem.n_modes)
    shapes = observer @ solved.shapes[:, compared]
    return found, mode_set(frequencies[compared], shapes, nodes, components)


def solve(matrices: MatrixResult, memory_bytes: int, folder: Path, single: bool) -> SolvedModes:
    """The first modes, with factors in single precision or double within so much memory."""

    def files() -> FactorFiles:
        own = Path(tempfile.mkdtemp(dir=folder, prefix="factors-"))
        return FactorFiles(own, lambda: shutil.rmtree(own, ignore_errors=True))

    room = FactorRoom(memory_bytes, shutil.disk_usage(folder).free, files, single=single)
    with factor_room(room):
        return ModeSolver(count=False).solve(matrices.upper_stiffness, matrices.upper_mass, N_MODES)


def update(problem: Problem, limits: Limits) -> Mapping[str, Any]:
    """What a campaign took, and how it ended."""
    folder = problem.folder / "update"
    folder.mkdir()
    words = ["update", *campaign(problem, folder)]
    words += ["--set", f"run.memory_gb={limits.memory_bytes / 1e9:g}"]
    ended = modetune(words, folder, folder / "home", "none")
    answer = told(ended, "modetune update")
    theta = np.array([item["updated"] for item in answer["parameters"]])
    return {
        **asdict(ended.cost),
        "status": answer["status"],
        "distance": float(problem.distance(theta).max()),
    }


def line(n_freedoms: int, found: Found) -> str:
    """A size's modes, to be read."""
    compared = "" if found.difference is None else f", {found.difference:.1e} from double precision"
    return (
        f"{n_freedoms:,} degrees of freedom, {found.n_equations:,} equations: matrices "
        f"{found.job_s:.0f} s and {found.job_bytes / 1e9:.1f} GB, read in {found.read_s:.0f} s; "
        f"{len(found.frequencies_hz)} modes {found.solve_s:.0f} s, {found.solve_cpu_s:.0f} s of "
        f"processor time, {found.peak_bytes / 1e9:.1f} GB; {found.frequencies_hz[0]:.4f} to "
        f"{found.frequencies_hz[-1]:.3f} Hz, residuals up to {found.residual:.1e}{compared}"
    )


def main(arguments: list[str] | None = None) -> None:
    """Measure the requested sizes."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("freedoms", nargs="+", type=int, help="degrees of freedom, six a node")
    parser.add_argument("--memory-gb", type=float, default=machine_memory() / 1e9)
    parser.add_argument("--double", action="store_true", help="compare with double precision")
    parser.add_argument("--campaign", action="store_true", help="update the ten moduli too")
    chosen = parser.parse_args(arguments)
    if wrong := [n for n in chosen.freedoms if not LEAST_DOF <= n <= MOST_DOF]:
        parser.error(f"the launcher is made with {LEAST_DOF} to {MOST_DOF}, not {wrong[0]}")
    limits, results = Limits(int(chosen.memory_gb * 1e9), chosen.double), []
    calculix()
    with tempfile.TemporaryDirectory(prefix="modetune-bench-") as name:
        for n_freedoms in chosen.freedoms:
            LAUNCHERS[str(n_freedoms)] = n_freedoms
            problem = set_up("launcher", str(n_freedoms), 1e-4, Path(name) / str(n_freedoms))
            # In a separate process, so that the campaign gets its memory.
            with ProcessPoolExecutor(1, get_context("spawn")) as pool:
                found, twin = pool.submit(find, problem, limits).result()
            sys.stdout.write(line(n_freedoms, found) + "\n")
            sys.stdout.flush()
            results.append({"freedoms": n_freedoms, **asdict(found)})
            if chosen.campaign:
                problem = replace(problem, measured=twin)
                write_problem(problem)
                results[-1]["campaign"] = ended = update(problem, limits)
                sys.stdout.write(f"  campaign: {json.dumps(ended)}\n")
                sys.stdout.flush()
            shutil.rmtree(problem.folder)
    sys.stdout.write(json.dumps(results) + "\n")


if __name__ == "__main__":
    try:
        main()
    except ModetuneError as error:
        sys.exit(str(error))
