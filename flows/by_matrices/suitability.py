"""Whether a model's modes can be found from its stored matrices at all."""

from __future__ import annotations

from itertools import combinations

from modetune.adapters.solver import Footprint, Solver
from modetune.core.parameters import Parameter
from modetune.flows.by_matrices.plan import same_matrix
from modetune.flows.schema import Method


def unsuitable(solver: Solver, parameters: tuple[Parameter, ...], method: Method) -> str | None:
    """Why modes cannot be found from stored matrices, None where they can."""
    if not solver.capabilities.matrix_modes:
        return f"{solver.name} does not hand its matrices out"
    if not solver.model.matrix_shapes:
        return "the motion of this model's nodes does not follow from its matrices"
    if method not in ("auto", "semi_analytic"):
        return f"sensitivities are asked for by {method}"
    found: list[tuple[Parameter, Footprint]] = []
    for parameter in parameters:
        footprint = solver.footprint(parameter)
        if footprint is None:
            return f"the matrices are no polynomials in {parameter.name}"
        found.append((parameter, footprint))
    for (one, print_one), (other, print_other) in combinations(found, 2):
        shared = not print_one.elements.isdisjoint(print_other.elements)
        if shared and same_matrix(print_one, print_other):
            return f"{one.name} and {other.name} scale the same elements together"
    return None
