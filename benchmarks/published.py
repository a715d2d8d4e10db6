"""Updating without modetune: a least-squares method around the solver.

`gauss_newton`: forward differences of 1 %, one parameter after another, and numpy's least squares.
`least_squares`: SciPy's trust-region method, with the same differences, as many in parallel
as there are cores. Dakota's NL2SOL has its own program (`dakota.py`).

All minimise the residual of problem.py. A run of CalculiX by itself has as many threads as are the
quickest, runs side by side have one; nothing is kept from one run for another; all end as soon as
the target is met.

    python -m benchmarks.published gauss_newton|least_squares FOLDER

prints one JSON object: converged, parameters.
"""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TypeVar

import numpy as np
from benchmarks.plain import PlainModel, cores
from benchmarks.problem import Agreement, Problem, read_problem
from scipy import optimize

from modetune.core.modes import Floats

#: Relative step of the finite differences.
STEP = 0.01
MAX_ITERATIONS = 20

X = TypeVar("X")
Y = TypeVar("Y")

#: How the model at parameter values agrees with the test.
Compare = Callable[[Floats], Agreement]


@dataclass(frozen=True, slots=True)
class Updated:
    """How a script ended. parameters: relative values."""

    converged: bool
    parameters: tuple[float, ...]


class TargetMet(Exception):
    """Ends a method of others at the first run that meets the target."""

    def __init__(self, theta: Floats) -> None:
        super().__init__("the target is met")
        self.theta = theta


def gauss_newton(problem: Problem, compare: Compare, beside: Compare) -> Updated:
    """Full steps of the linear least squares problem, cut at the bounds; one run after another."""
    parameters = problem.parameter_set
    theta = parameters.initial
    for iteration in range(MAX_ITERATIONS + 1):
        now = compare(theta)
        if now.holds(problem.target):
            return Updated(True, tuple(theta.tolist()))
        if iteration == MAX_ITERATIONS:
            break
        columns = []
        for place in range(theta.size):
            moved = theta.copy()
            moved[place] *= 1.0 + STEP
            change = compare(moved).residual - now.residual
            columns.append(change / (moved[place] - theta[place]))
        step = np.linalg.lstsq(np.stack(columns, axis=1), -now.residual, rcond=None)[0]
        theta = np.clip(theta + step, parameters.lower, parameters.upper)
    return Updated(False, tuple(theta.tolist()))


def least_squares(problem: Problem, compare: Compare, beside: Compare) -> Updated:
    """SciPy's trust-region reflective method (Branch, Coleman and Li 1999)."""
    parameters, running = problem.parameter_set, compare

    def residual(theta: Floats) -> Floats:
        found = running(theta)
        if found.holds(problem.target):
            raise TargetMet(theta.copy())
        return found.residual

    def side_by_side(function: Callable[[X], Y], points: Iterable[X], /) -> Iterable[Y]:
        nonlocal running
        running = beside
        found = list(pool.map(function, points))
        running = compare
        return found

    pool = ThreadPoolExecutor(cores())
    try:
        ended = optimize.least_squares(
            residual,
            parameters.initial,
            jac="2-point",
            diff_step=[STEP] * len(parameters),
            bounds=(parameters.lower, parameters.upper),
            x_scale=1.0,
            method="trf",
            max_nfev=MAX_ITERATIONS,
            workers=side_by_side,
        )
    except TargetMet as met:
        return Updated(True, tuple(met.theta.tolist()))
    finally:
        pool.shutdown(wait=False, cancel_futures=True)
    return Updated(False, tuple(np.asarray(ended.x).tolist()))


METHODS = {"gauss_newton": gauss_newton, "least_squares": least_squares}


def main() -> None:
    """Update the problem in the folder that the command line names."""
    method, folder = sys.argv[1:]
    problem = read_problem(Path(folder))
    alone, beside = PlainModel(problem).agreement, PlainModel(replace(problem, threads=1)).agreement
    updated = METHODS[method](problem, alone, beside)
    sys.stdout.write(json.dumps(asdict(updated)) + "\n")
    sys.stdout.flush()
    os._exit(0)  # runs in parallel end with their process


if __name__ == "__main__":
    main()
