"""Updating as published scripts do it: a loop around the solver, one run after another.

`gauss_newton`: forward differences of 1 %, one parameter after another, and numpy's least squares.
`least_squares`: SciPy's trust-region method with the same differences. Both minimise the residual
of agreement.py. Each run of CalculiX has as many threads as are the quickest; nothing is kept from
one run for another; both end as soon as the target is met.

    python -m benchmarks.published gauss_newton|least_squares FOLDER

prints one JSON object: converged, parameters.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from benchmarks.agreement import Agreement
from benchmarks.plain import PlainModel
from benchmarks.problem import Problem, read_problem
from scipy import optimize

from modetune.core.modes import Floats

#: Relative step of the finite differences.
STEP = 0.01
MAX_ITERATIONS = 20

#: How the model at parameter values agrees with the test.
Compare = Callable[[Floats], Agreement]


@dataclass(frozen=True, slots=True)
class Updated:
    """How a script ended. parameters: relative values."""

    converged: bool
    parameters: tuple[float, ...]


class TargetMet(Exception):
    """Ends SciPy's method at the first run that meets the target."""

    def __init__(self, theta: Floats) -> None:
        super().__init__("the target is met")
        self.theta = theta


def gauss_newton(problem: Problem, compare: Compare) -> Updated:
    """Full steps of the linear least squares problem, cut at the bounds."""
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


def least_squares(problem: Problem, compare: Compare) -> Updated:
    """SciPy's trust-region reflective method (Branch, Coleman and Li 1999)."""
    parameters = problem.parameter_set

    def residual(theta: Floats) -> Floats:
        found = compare(theta)
        if found.holds(problem.target):
            raise TargetMet(theta.copy())
        return found.residual

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
        )
    except TargetMet as met:
        return Updated(True, tuple(met.theta.tolist()))
    return Updated(False, tuple(np.asarray(ended.x).tolist()))


METHODS = {"gauss_newton": gauss_newton, "least_squares": least_squares}


def main() -> None:
    """Update the problem in the folder that the command line names."""
    method, folder = sys.argv[1:]
    problem = read_problem(Path(folder))
    updated = METHODS[method](problem, PlainModel(problem).agreement)
    sys.stdout.write(json.dumps(asdict(updated)) + "\n")


if __name__ == "__main__":
    main()
