"""The matrix jobs that determine the effect of every parameter on stiffness and mass.

A parameter in which the matrices are a sum of powers needs as many models, in addition to the base,
as it has powers: one for Young's modulus, density or a spring, several for a thickness. Parameters
whose elements share no node change different entries, so one job can change several of them; so can
a modulus and a density, which change different matrices. The columns are coloured accordingly
(greedily, those with the most neighbours first: Welsh and Powell 1967), with one job per colour and
power: ten moduli of a structure's parts take two or three jobs, not ten. If the parameters'
elements are the whole model, the stiffness is the sum of their parts. The largest colour is then
the remainder after all others, which saves a job.

If the matrices are not a sum of powers of a parameter (Poisson's ratio), or two parameters scale
the same quantity together, the plan is for one point. A parameter without powers then takes two
pairs of models close to the point: one at 1 + s and 1 / (1 + s), and one twice as wide.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations

import numpy as np

from modetune.adapters.solver import AffectedElements, Solver
from modetune.core.modes import Floats
from modetune.core.parameters import Parameter
from modetune.flows.campaign.schema import Method
from modetune.flows.campaign.solvers import untested_capabilities

#: Factor on a parameter in which the matrices are linear. Any factor is exact, and a large one is
#: most accurate, as stored matrices are text with few digits.
LINEAR_FACTORS = (2.0,)
#: Factors on other parameters, spread like Chebyshev points between 1/2 and 2.
FACTORS = (0.55, 0.75, 1.4, 1.9, 0.65, 1.65)


@dataclass(frozen=True, slots=True)
class Sampling:
    """How one parameter is sampled.

    affected: elements that it changes, None if unknown. powers: of its value, empty if the matrices
    are not a sum of powers. factors: on the parameter, one model each.
    """

    affected: AffectedElements | None
    powers: tuple[int, ...]
    factors: tuple[float, ...]


@dataclass(frozen=True, slots=True)
class Sample:
    """A model whose matrices are stored: parameter values, and the columns that it changes."""

    theta: tuple[float, ...]
    columns: tuple[int, ...]

    @property
    def values(self) -> Floats:
        return np.array(self.theta)


@dataclass(frozen=True, slots=True)
class MatrixPlan:
    """The models whose matrices are stored.

    base: parameter values of the reference model. rest: columns whose parts are the remainder of
    the base after all others.
    """

    base: tuple[float, ...]
    samples: tuple[Sample, ...]
    rest: tuple[int, ...]


def sampling(solver: Solver, parameter: Parameter, step: float) -> Sampling:
    """Return how to sample a parameter of a solver's model; step: relative, of the pairs."""
    affected = solver.deck.affected_elements(parameter)
    if affected is None and not solver.deck.is_linear(parameter):
        pairs = [factor for s in (step, 2.0 * step) for factor in (1.0 + s, 1.0 / (1.0 + s))]
        return Sampling(None, (), tuple(pairs))
    powers = (1,) if affected is None else affected.powers
    factors = LINEAR_FACTORS if powers == (1,) else FACTORS[: len(powers)]
    related = affected is not None and affected.related
    if powers == (1,) and (related or not parameter.proportional):
        # Beyond its bounds a value may be impossible for a model.
        ends = (parameter.upper / parameter.initial, parameter.lower / parameter.initial)
        factors = (max(ends, key=lambda factor: abs(factor - 1.0)),)
    if affected is not None and not (affected.stiffness or affected.mass):
        factors = ()  # affects damping only
    return Sampling(affected, powers, factors)


def plan(theta: Floats, samplings: dict[int, Sampling], elements: frozenset[int]) -> MatrixPlan:
    """Return the jobs at and around these values (n_parameters,), for these columns.

    elements: numbers of all elements of the model, point masses included.
    """
    colours = _colours(samplings)
    rest: list[int] = []
    if len(samplings) == theta.size and _whole(samplings, elements):
        rest = max(colours, key=len)
        colours.remove(rest)
    found = []
    for colour in colours:
        for number in range(max(len(samplings[column].factors) for column in colour)):
            moved = tuple(c for c in colour if number < len(samplings[c].factors))
            values = theta.copy()
            for column in moved:
                values[column] *= samplings[column].factors[number]
            found.append(Sample(tuple(values.tolist()), moved))
    return MatrixPlan(tuple(theta.tolist()), tuple(found), tuple(rest))


def scale_together(one: tuple[Parameter, Sampling], other: tuple[Parameter, Sampling]) -> bool:
    """Return whether two parameters scale the same part of a matrix, by their product."""
    (first, here), (second, there) = one, other
    alike = (first.quantity, first.by, first.item) == (second.quantity, second.by, second.item)
    targets = {target.upper() for target in first.targets}
    if alike and not targets.isdisjoint(target.upper() for target in second.targets):
        return True
    if here.affected is None or there.affected is None:
        return False
    if not _same_matrix(here.affected, there.affected):
        return False
    if here.affected.related or there.affected.related:
        return not here.affected.elements.isdisjoint(there.affected.elements)
    # Moduli of two materials in one laminate are a sum.
    summed = first.quantity == second.quantity and here.powers == there.powers == (1,)
    return not summed and not here.affected.elements.isdisjoint(there.affected.elements)


def unsuitable(solver: Solver, parameters: tuple[Parameter, ...], method: Method) -> str | None:
    """Return why modes cannot be computed from stored matrices; None if they can."""
    if not solver.offers.matrix_modes:
        why = untested_capabilities(solver) if solver.program.capabilities.matrix_modes else ""
        return why or f"{solver.program.name} does not export matrices"
    if not solver.deck.summary.matrix_shapes:
        return "the motion of this model's nodes does not follow from its matrices"
    if method not in ("auto", "semi_analytic"):
        return f"sensitivity.method is {method}"
    found: list[tuple[Parameter, Sampling]] = []
    for parameter in parameters:
        sampled = sampling(solver, parameter, 0.0)
        if sampled.affected is None:
            why = solver.deck.preload()
            text = f"the stiffness is not a polynomial in {parameter.name}"
            return f"{text} ({why})" if why else text
        found.append((parameter, sampled))
    for one, other in combinations(found, 2):
        if scale_together(one, other):
            return f"{one[0].name} and {other[0].name} scale the same elements together"
    return None


def _whole(samplings: dict[int, Sampling], elements: frozenset[int]) -> bool:
    """Return whether the stiffness is a sum of parts proportional to the parameters, which change
    nothing else."""
    parts = [
        item.affected.elements
        for item in samplings.values()
        if item.affected is not None and item.affected.proportional
    ]
    disjoint = sum(map(len, parts)) == len(elements)
    return disjoint and len(parts) == len(samplings) and elements == frozenset().union(*parts)


def _same_matrix(one: AffectedElements, other: AffectedElements) -> bool:
    """Return whether two parameters change the same one of the two matrices."""
    return (one.stiffness and other.stiffness) or (one.mass and other.mass)


def _collide(one: AffectedElements | None, other: AffectedElements | None) -> bool:
    """Return whether two parameters may change the same entry of a matrix."""
    if one is None or other is None:
        return True
    return _same_matrix(one, other) and not one.nodes.isdisjoint(other.nodes)


def _colours(samplings: dict[int, Sampling]) -> list[list[int]]:
    """Return columns in groups without collisions, in ascending order."""
    beside = {
        column: {
            other
            for other, there in samplings.items()
            if other != column and _collide(here.affected, there.affected)
        }
        for column, here in samplings.items()
    }
    colours: list[list[int]] = []
    for column in sorted(samplings, key=lambda c: -len(beside[c])):
        free = (colour for colour in colours if beside[column].isdisjoint(colour))
        colour = next(free, None)
        if colour is None:
            colours.append([column])
        else:
            colour.append(column)
    return [sorted(colour) for colour in colours]
