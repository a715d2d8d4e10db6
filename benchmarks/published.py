"""Updating without modetune: a least-squares method around the solver.

`gauss_newton`: forward differences of 1 %, one parameter after another, and numpy's least squares.
`least_squares`: SciPy's trust-region method with the same differences.
`nl2sol`: that of Dakota (Dennis, Gay and Welsch 1981) with the same differences, as many in
parallel as there are cores. Dakota is linked into this process, which reads the deck once, and
evaluates all differences of a Jacobian together (`batch`).

All minimise the residual of problem.py. A run of CalculiX by itself has as many threads as are the
quickest, runs side by side have one; nothing is kept from one run for another; all end as soon as
the target is met.

    python -m benchmarks.published gauss_newton|least_squares|nl2sol FOLDER

prints one JSON object: converged, parameters.
"""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
from benchmarks.plain import PlainModel, cores
from benchmarks.problem import Agreement, Problem, read_problem
from scipy import optimize

from modetune.core.modes import Floats

#: Relative step of the finite differences.
STEP = 0.01
MAX_ITERATIONS = 20

#: How the model at parameter values agrees with the test.
Compare = Callable[[Floats], Agreement]
#: Dakota's description of a point, by name: `cv` are its continuous variables.
Variables = Mapping[str, Floats]


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


#: A study of Dakota. What NL2SOL takes for convergence is put below what the target needs.
STUDY = """\
environment
method
  nl2sol
    convergence_tolerance 1e-12
    x_conv_tol 1e-10
    max_iterations {iterations}
    max_function_evaluations 100000
  output silent
variables
  continuous_design {n_parameters}
    initial_point {initial}
    lower_bounds {lower}
    upper_bounds {upper}
interface
  python
    analysis_drivers 'evaluate'
  batch
  deactivate restart_file
responses
  calibration_terms {n_residuals}
  numerical_gradients
    method_source dakota
    interval_type forward
    fd_step_size {step}
  no_hessians
"""


def nl2sol(problem: Problem, compare: Compare, beside: Compare | None = None) -> Updated:
    """Dakota's NL2SOL.

    beside: like `compare`, for calls from several threads at once. Raises SystemExit if Dakota is
    not installed.
    """
    try:
        from dakota import environment
    except ImportError:
        sys.exit("Dakota is not installed: pip install 'modetune[bench]'")
    parameters = problem.parameter_set
    n_residuals = problem.agreement(problem.measured).residual.size
    study = STUDY.format(
        iterations=MAX_ITERATIONS,
        n_parameters=len(problem.parameters),
        initial=_row(parameters.initial),
        lower=_row(parameters.lower),
        upper=_row(parameters.upper),
        n_residuals=n_residuals,
        step=STEP,
    )
    last = parameters.initial
    met: list[Floats] = []

    def evaluate(sets: Variables | list[Variables]) -> object:
        """Dakota's answer to a set or several: their residuals."""
        nonlocal last
        single = not isinstance(sets, list)
        thetas = [np.array(each["cv"]) for each in (sets if isinstance(sets, list) else [sets])]
        last = thetas[0]
        called = compare if single or beside is None else beside
        waiting = {pool.submit(called, theta): theta for theta in thetas}
        for done in as_completed(waiting):
            if done.result().holds(problem.target):
                met.append(waiting[done])
                raise TargetMet(waiting[done])
        found = [{"fns": each.result().residual} for each in waiting]
        return found[0] if single else found

    pool = ThreadPoolExecutor(cores())
    try:
        environment.study(callbacks={"evaluate": evaluate}, input_string=study).execute()
    except (TargetMet, RuntimeError):  # the latter: Dakota's word for any error of a callback
        if not met:
            raise
    finally:
        pool.shutdown(wait=False, cancel_futures=True)
    return Updated(bool(met), tuple((met[0] if met else last).tolist()))


def _row(values: Floats) -> str:
    return " ".join(repr(float(value)) for value in values)


METHODS = {"gauss_newton": gauss_newton, "least_squares": least_squares, "nl2sol": nl2sol}


def main() -> None:
    """Update the problem in the folder that the command line names."""
    method, folder = sys.argv[1:]
    problem = read_problem(Path(folder))
    alone, beside = PlainModel(problem).agreement, PlainModel(replace(problem, threads=1)).agreement
    if method == "nl2sol":
        updated = nl2sol(problem, alone, beside)
    else:
        updated = METHODS[method](problem, alone)
    sys.stdout.write(json.dumps(asdict(updated)) + "\n")
    sys.stdout.flush()
    os._exit(0)  # runs in parallel end with their process


if __name__ == "__main__":
    main()
