"""Static displacements and elongations under loads, and their derivatives, from K(theta).

With W_i the row that takes displacements of equations to a measured value (a displacement; of a
gauge of two nodes, the difference along its direction over its length) and f the forces,

    K u = f,        y_i = W_i u,        dy_i/dtheta_c = -a_i^T (dK/dtheta_c) u,     K a_i = W_i^T,

so one factorisation serves all values and all parameters. A force at a degree of freedom that is
itself a sum over equations (shells expanded to solids, dependent nodes) does its work on them in
the same shares: f = W^T F.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from modetune.core.algebra.factorisation import factorise
from modetune.core.algebra.matrices import MatrixResult, upper_product
from modetune.core.errors import ModelError
from modetune.core.modes import Floats, Integers, dof_name
from modetune.core.updating.observation import Observation
from modetune.core.updating.parameter_matrices import ParameterMatrices


@dataclass(frozen=True, slots=True)
class LoadCase:
    """Forces and moments at nodes, each in its node's own axes, those of shapes there.

    nodes, components (1 to 6), values: (n_forces,), in the deck's units. places: file and line of
    each.
    """

    nodes: Integers
    components: Integers
    values: Floats
    places: tuple[str, ...]

    @classmethod
    def of_forces(cls, forces: list[tuple[int, int, float, str]]) -> LoadCase:
        """Of node, component, value and place each."""
        nodes, components, values, places = zip(*forces, strict=True)
        return cls(np.array(nodes), np.array(components), np.array(values, dtype=float), places)


@dataclass(frozen=True, slots=True)
class Reading:
    """A measured value: a sum over degrees of freedom of displacements, each times a factor.

    name: what people call it; load: position of its load case; nodes, components, factors:
    (n_terms,); value, deviation, tolerance: in its own unit.
    """

    name: str
    load: int
    nodes: Integers
    components: Integers
    factors: Floats
    value: float
    deviation: float
    tolerance: float
    weight: float = 1.0


@dataclass(frozen=True, slots=True)
class StaticModel:
    """What is loaded and what is measured, in terms of the equations of a model's matrices.

    forces: (n_equations, n_loads); rows: (n_readings, n_equations), CSR; loads: (n_readings,), the
    load case of each reading.
    """

    forces: Floats
    rows: sparse.csr_array
    loads: Integers

    @classmethod
    def of(
        cls,
        base: MatrixResult,
        observe: Callable[[MatrixResult, Integers, Integers], Observation],
        loads: Sequence[LoadCase],
        readings: Sequence[Reading],
    ) -> StaticModel:
        """Of matrices with these equations. observe: degrees of freedom in terms of them.

        Raises ModelError for what is held in place, or is not a sum over equations.
        """
        forces, sums = [], []
        for load in loads:
            seen = observe(base, load.nodes, load.components)
            _check(seen, load.nodes, load.components, load.places, seen.held)
            forces.append(seen.matrix.T @ load.values)
        for item in readings:
            seen = observe(base, item.nodes, item.components)
            said = [item.name] * item.nodes.size
            _check(seen, item.nodes, item.components, said, seen.held & bool(seen.held.all()))
            sums.append(item.factors @ seen.matrix)
        return cls(
            np.column_stack(forces),
            sparse.csr_array(np.vstack(sums)),
            np.array([item.load for item in readings]),
        )

    def values(self, matrices: ParameterMatrices, theta: Floats) -> tuple[Floats, Floats]:
        """The readings (n_readings,) at a set and their derivatives (n_readings, n_parameters).

        Raises ModelError where the stiffness is singular, as a free structure's is.
        """
        try:
            factors = factorise(matrices.at(theta).stiffness)
        except ModelError as error:
            raise ModelError(f"static displacements: {error}") from error
        moved = factors.solve(self.forces)
        adjoint = factors.solve(self.rows.T.toarray())
        slopes = np.zeros((self.loads.size, theta.size))
        for column in range(theta.size):
            upper, _ = matrices.change(theta, column)
            changed = upper_product(upper, moved)[:, self.loads]
            slopes[:, column] = -np.sum(adjoint * changed, axis=0)
        return (self.rows @ moved)[np.arange(self.loads.size), self.loads], slopes


def _check(
    seen: Observation,
    nodes: Integers,
    components: Integers,
    said: Sequence[str],
    held: NDArray[np.bool_],
) -> None:
    """Raise ModelError for the first that is unknown, or held in place. said: what each is of."""
    for wrong, why in (
        (seen.unknown, "does not follow from the matrices' unknowns"),
        (held, "is held in place, so nothing moves there"),
    ):
        for place in np.flatnonzero(wrong)[:1].tolist():
            dof = dof_name((int(nodes[place]), int(components[place])))
            raise ModelError(f"{said[place]}: {dof} {why}")
