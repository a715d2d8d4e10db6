"""Which matrix jobs show what every parameter does to the stiffness and mass matrices.

A parameter in which the matrices are polynomials needs as many models beside the base as it has
powers: one for Young's modulus, density or a spring, some for a thickness. Parameters whose
elements share no node touch different entries, so one job can move several of them at once, and so
can a modulus and a density, which move different matrices. The columns are coloured accordingly
(greedily, those with the most neighbours first: Welsh and Powell 1967), a job a colour and power:
ten moduli of a structure's parts take two or three jobs, not ten. Where the parameters' elements
are the whole model, the stiffness is the sum of their parts, and the largest colour is what the
others leave of it: one job less.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from modetune.adapters.solver import Footprint
from modetune.core.modes import Floats
from modetune.core.parameters import ParameterSet

#: Factor on a parameter in which the matrices are linear. It is exact anyhow, and as stored
#: matrices are text of some digits a far one is the most exact.
LINEAR_FACTORS = (2.0,)
#: Factors on others, spread like Chebyshev's points between 1/2 and 2.
FACTORS = (0.55, 0.75, 1.4, 1.9, 0.65, 1.65)


@dataclass(frozen=True, slots=True)
class Sample:
    """One model whose matrices are stored: parameter values, and which columns it moves."""

    theta: tuple[float, ...]
    columns: tuple[int, ...]

    @property
    def values(self) -> Floats:
        return np.array(self.theta)


@dataclass(frozen=True, slots=True)
class Plan:
    """The models beside the base; rest: columns whose parts are what the others leave of it."""

    samples: tuple[Sample, ...]
    rest: tuple[int, ...]


def plan(
    parameters: ParameterSet, footprints: Sequence[Footprint], elements: frozenset[int]
) -> Plan:
    """The jobs for these parameters, whose footprints stand in their order.

    elements: numbers of all elements of the model, point masses included.
    """
    colours = _colours(footprints)
    rest: list[int] = []
    if _whole(footprints, elements):
        rest = max(colours, key=len)
        colours.remove(rest)
    found = []
    for colour in colours:
        for number in range(max(len(footprints[column].powers) for column in colour)):
            moved = tuple(c for c in colour if number < len(footprints[c].powers))
            theta = parameters.initial
            for column in moved:
                theta[column] *= factors(footprints[column])[number]
            found.append(Sample(tuple(theta.tolist()), moved))
    return Plan(tuple(found), tuple(rest))


def _whole(footprints: Sequence[Footprint], elements: frozenset[int]) -> bool:
    """Whether the stiffness is the sum of parts proportional to the parameters, and they move
    nothing else."""
    proportional = all(
        item.stiffness and not item.mass and item.powers == (1,) for item in footprints
    )
    return proportional and elements == frozenset[int]().union(
        *(item.elements for item in footprints)
    )


def factors(footprint: Footprint) -> tuple[float, ...]:
    """The factors on a parameter at which its samples are taken."""
    return LINEAR_FACTORS if footprint.powers == (1,) else FACTORS[: len(footprint.powers)]


def collide(one: Footprint, other: Footprint) -> bool:
    """Whether two parameters may move the same entry of a matrix."""
    return same_matrix(one, other) and not one.nodes.isdisjoint(other.nodes)


def same_matrix(one: Footprint, other: Footprint) -> bool:
    """Whether two parameters move the same of the two matrices."""
    return (one.stiffness and other.stiffness) or (one.mass and other.mass)


def _colours(footprints: Sequence[Footprint]) -> list[list[int]]:
    """Columns in groups of which none collide, in ascending order."""
    n = len(footprints)
    beside = [
        {other for other in range(n)
         if other != column and collide(footprints[column], footprints[other])}
        for column in range(n)
    ]  # fmt: skip
    colours: list[list[int]] = []
    for column in sorted(range(n), key=lambda c: -len(beside[c])):
        free = (colour for colour in colours if beside[column].isdisjoint(colour))
        colour = next(free, None)
        if colour is None:
            colours.append([column])
        else:
            colour.append(column)
    return [sorted(colour) for colour in colours]
