"""Damping matrices for all parameter values, and the system with stiffness and mass.

Viscous C is a sum of dampers, each a matrix times a product of numbers that are constant, linear in
a parameter, or given by an expression of parameters. Structural H is such a sum, and of loss
factors g times the stiffness of groups of elements, and of all:

    C(theta) = sum_j c_j(theta) C_j,    H(theta) = sum_j h_j(theta) H_j + sum_g g(theta) K_g(theta)
                                                  + G K(theta).

Parameters move the stiffness K_g of a group as well. With K_g and the parts A_ck of K (as in
`parameter_matrices`) known at theta_0, those that scale all of the group, and maybe more, and those
whose elements all are in it, are

    K_g(theta) = K_g prod_c (theta_c / theta_0c) + sum_ck (theta_c^k - theta_0c^k) A_ck,

which is exact as long as no two of them scale the same elements; where they do, theta_0 is the set
itself, and value and first derivatives are exact there.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import prod
from typing import Literal

import numpy as np
from scipy import sparse

from modetune.core.algebra.damped_modes import DampedSystem
from modetune.core.algebra.matrices import symmetric
from modetune.core.modes import Floats
from modetune.core.updating.parameter_matrices import ParameterMatrices, powers_moved, powers_slopes
from modetune.core.updating.relation import Relation

DampingKind = Literal["viscous", "structural"]


@dataclass(frozen=True, slots=True)
class Linear:
    """A number of a model: constant + slope * theta of its column."""

    constant: float
    slope: float = 0.0
    column: int = -1

    def at(self, theta: Floats) -> float:
        return self.constant + (self.slope * float(theta[self.column]) if self.slope else 0.0)

    def change(self, theta: Floats, column: int) -> float:
        """Its derivative with respect to a column, the same for all theta."""
        return self.slope if column == self.column else 0.0


@dataclass(frozen=True, slots=True)
class Damper:
    """matrix: (n, n), both triangles, times a product of numbers."""

    kind: DampingKind
    matrix: sparse.csr_array
    numbers: tuple[Linear | Relation, ...]

    def at(self, theta: Floats) -> float:
        return prod(number.at(theta) for number in self.numbers)

    def change(self, theta: Floats, column: int) -> float:
        return sum(
            number.change(theta, column)
            * prod(o.at(theta) for o in self.numbers if o is not number)
            for number in self.numbers
        )


@dataclass(frozen=True, slots=True)
class Loss:
    """A loss factor of the stiffness of a group of elements.

    group: its column in the groups' matrices; scaled: parameters that scale all of it; within:
    those whose elements all are in it.
    """

    factor: Linear
    group: int
    scaled: tuple[int, ...] = ()
    within: tuple[int, ...] = ()


@dataclass(frozen=True, slots=True)
class GroupStiffness:
    """Stiffness of groups of elements, one proportional to each column; at: (n_parameters,), the
    set theta_0 of the model's own parameters where it is so."""

    matrices: ParameterMatrices
    at: Floats

    def on(self, vectors: Floats) -> GroupStiffness:
        """On the space of these vectors (n_equations, r)."""
        return replace(self, matrices=self.matrices.on(vectors))

    def of(
        self, loss: Loss, model: ParameterMatrices, theta: Floats, column: int | None = None
    ) -> sparse.csr_array:
        """K_g at a set, or its derivative with respect to a column, both triangles."""
        scale = prod(float(theta[c] / self.at[c]) for c in loss.scaled)
        if column is not None:
            scale = scale / float(theta[column]) if column in loss.scaled else 0.0
        parts = [(self.matrices, p, np.array([scale])) for p in self.matrices.stiffness
                 if p.column == loss.group and scale]  # fmt: skip
        for part in model.stiffness:
            if part.column in loss.within and column in (None, part.column):
                here = float(theta[part.column])
                if column is None:
                    factors = powers_moved(part.powers, here, float(self.at[part.column]))
                else:
                    factors = powers_slopes(part.powers, here)
                parts.append((model, part, factors))
        total = sparse.csr_array(model.base.upper_stiffness.shape)
        for source, part, factors in parts:
            total = total + part.upper(source.base.upper_stiffness, factors)
        return symmetric(sparse.csr_array(total))


@dataclass(frozen=True, slots=True)
class DampingModel:
    """All that damps a model; uniform: the loss factor G of all its stiffness."""

    dampers: tuple[Damper, ...]
    losses: tuple[Loss, ...] = ()
    uniform: float = 0.0

    def on(self, vectors: Floats) -> DampingModel:
        """On the space of these vectors (n_equations, r)."""
        return replace(
            self,
            dampers=tuple(
                replace(d, matrix=sparse.csr_array(vectors.T @ (d.matrix @ vectors)))
                for d in self.dampers
            ),
        )

    def system(
        self, matrices: ParameterMatrices, theta: Floats, groups: GroupStiffness | None = None
    ) -> DampedSystem:
        """All matrices at a set (n_parameters,); groups: where there are losses."""
        here = matrices.at(theta)
        terms = [(d.kind, d.at(theta), d.matrix) for d in self.dampers]
        for loss in self.losses:
            assert groups is not None
            terms.append(("structural", loss.factor.at(theta), groups.of(loss, matrices, theta)))
        return self._with(here.stiffness, here.mass, terms)

    def change(
        self,
        matrices: ParameterMatrices,
        theta: Floats,
        column: int,
        groups: GroupStiffness | None = None,
    ) -> DampedSystem:
        """Their derivatives with respect to a parameter."""
        stiffness, mass = map(symmetric, matrices.change(theta, column))
        terms = [(d.kind, d.change(theta, column), d.matrix) for d in self.dampers]
        for loss in self.losses:
            assert groups is not None
            slope, value = loss.factor.change(theta, column), loss.factor.at(theta)
            if slope:
                terms.append(("structural", slope, groups.of(loss, matrices, theta)))
            if value and column in (*loss.scaled, *loss.within):
                moved = groups.of(loss, matrices, theta, column)
                terms.append(("structural", value, moved))
        return self._with(stiffness, mass, terms)

    def _with(
        self,
        stiffness: sparse.csr_array,
        mass: sparse.csr_array,
        terms: Sequence[tuple[DampingKind, float, sparse.csr_array]],
    ) -> DampedSystem:
        nothing = sparse.csr_array(mass.shape)
        sums = {"viscous": nothing, "structural": sparse.csr_array(self.uniform * stiffness)}
        for kind, factor, matrix in terms:
            if factor:
                sums[kind] = sparse.csr_array(sums[kind] + factor * matrix)
        return DampedSystem(stiffness, mass, sums["viscous"], sums["structural"])
