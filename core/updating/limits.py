"""Limits that no step breaks: inequalities of responses in the least-squares problem of a step.

A residual's value z may have limits, l <= z <= u (those of the computed side, mirrored). The step
is that of the problem with every limit that its linear prediction would break made an equation,

    sqrt(w) (z - S d) = sqrt(w) b,

b a little inside the limit and w so large that the equation wins against all else. One more round
is taken for each limit that the new step would break. A limit that is broken already draws the step
back in the same way. Source: Nocedal and Wright 2006, 16.5 (active sets) and 17.1 (penalties).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from modetune.core.modes import Floats, Integers
from modetune.core.updating.estimation import Step, StepProblem, weights_root

#: Share of the other equations in one that stands for a limit: rounding and conditioning of the
#: least-squares problem keep their digits.
LOOSE = 1e-10
#: How far inside a limit a step ends, as a share of the change that it asks of the value: fields of
#: a deck may have six digits alone.
INSIDE = 1e-4
#: Rounds that steps which bend get beside those in which a limit is met.
BENDS = 4


def step_within(
    solve: Callable[[StepProblem], Step],
    problem: StepProblem,
    values: Floats,
    sensitivity: Floats,
    limits: Floats,
) -> tuple[Step, Integers]:
    """The step of a problem that keeps its linear prediction within limits, and the rows whose
    limits hold it.

    values: (n_residuals,), sensitivity: (n_residuals, n_parameters), of the items, where the
    problem's own rows may be mixed; limits: (n_residuals, 2).
    """
    step = solve(problem)
    held = np.flatnonzero(np.isfinite(limits).any(axis=1) & sensitivity.any(axis=1))
    ends: dict[int, float] = {}
    for _ in range(held.size + BENDS):
        there = values - sensitivity @ step.change
        broken = [row for row in held.tolist() if breach(there[[row]], limits[[row]])[0] > 0.0]
        if not broken:
            break
        for row in broken:
            low, high = limits[row].tolist()
            room = min(INSIDE * abs(there[row] - values[row]), 0.5 * (high - low))
            wanted = float(np.clip(there[row], low + room, high - room))
            # Steps of logarithms bend away from what their equation says.
            ends[row] = ends.get(row, there[row]) + wanted - there[row]
        step = solve(_with_equations(problem, values, sensitivity, ends))
    return step, np.array(sorted(ends), dtype=np.int64)


def breach(values: Floats, limits: Floats) -> Floats:
    """How far values (n,) are outside of their limits (n, 2), 0 within."""
    return np.asarray(np.maximum(0.0, np.maximum(limits[:, 0] - values, values - limits[:, 1])))


def _with_equations(
    problem: StepProblem, values: Floats, sensitivity: Floats, ends: dict[int, float]
) -> StepProblem:
    rows = list(ends)
    slopes = sensitivity[rows]
    scale = np.linalg.norm(slopes, axis=1)
    root = np.sqrt(problem.weights)[:, None] * problem.sensitivity
    others = np.vstack([root, weights_root(problem.parameter_weights)])
    weight = float(np.sum(others**2)) / LOOSE
    return replace(
        problem,
        sensitivity=np.vstack([problem.sensitivity, slopes / scale[:, None]]),
        residual=np.append(problem.residual, (values[rows] - list(ends.values())) / scale),
        weights=np.append(problem.weights, np.full(scale.size, weight)),
    )
