"""Static displacements and elongations under loads, and their derivatives, from K(theta).

With W_i the row that takes displacements of equations to a measured value (a displacement; of a
gauge of two nodes, the difference along its direction over its length) and f the forces,

    K u = f,        y_i = W_i u,        dy_i/dtheta_c = -a_i^T (dK/dtheta_c) u,     K a_i = W_i^T,

so one factorisation serves all values and all parameters. A force at a degree of freedom that is
itself a sum over equations (shells expanded to solids, dependent nodes) does its work on them in
the same shares: f = W^T F. Where masses are at nodes, an acceleration g of the whole model loads it
by f = M R g, with R its unit translations; where they are spread over elements, what supports hold
of M is in no stored matrix, and such forces are the deck's own. Either way f follows parameters of
the mass, and df/dtheta_c is added to the right side of the derivative.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from modetune.core.algebra.factorisation import factorise
from modetune.core.algebra.matrices import MatrixResult, upper_product
from modetune.core.errors import ModelError
from modetune.core.mesh import Mesh
from modetune.core.modes import Floats, Integers, dof_name
from modetune.core.updating.observation import Observation
from modetune.core.updating.parameter_matrices import ParameterMatrices
from modetune.core.updating.rigid_motions import Observe, rigid_motions

#: Node, component, value, and file and line.
Force = tuple[int, int, float, str]


@dataclass(frozen=True, slots=True)
class LoadCase:
    """Forces and moments at nodes, each in its node's own axes, those of shapes there.

    nodes, components (1 to 6), values: (n_forces,), in the deck's units. places: file and line of
    each. n_spread: how many of them, the last ones, are parts of a load that is spread, of which
    supports carry theirs; by_mass: whether these follow the mass. acceleration: (3,), of all the
    model's mass, along basic axes.
    """

    nodes: Integers
    components: Integers
    values: Floats
    places: tuple[str, ...]
    n_spread: int = 0
    by_mass: bool = False
    acceleration: Floats = field(default_factory=lambda: np.zeros(3))

    @classmethod
    def of_forces(
        cls,
        forces: Sequence[Force],
        spread: Sequence[Force] = (),
        by_mass: bool = False,
        acceleration: Floats | None = None,
    ) -> LoadCase:
        """Of node, component, value and place each."""
        whole = [*forces, *spread]
        return cls(
            np.array([item[0] for item in whole], dtype=np.int64),
            np.array([item[1] for item in whole], dtype=np.int64),
            np.array([item[2] for item in whole], dtype=np.float64),
            tuple(item[3] for item in whole),
            len(spread),
            by_mass,
            np.zeros(3) if acceleration is None else acceleration,
        )

    def on_equations(self, base: MatrixResult, observe: Observe) -> Floats:
        """(n_equations,) without those of an acceleration. Raises ModelError for a force at what
        is held in place, or is not a sum over equations."""
        seen = observe(base, self.nodes, self.components)
        held = seen.held.copy()
        held[held.size - self.n_spread :] = False
        _check(seen, self.nodes, self.components, self.places, held)
        return np.asarray(seen.matrix.T @ self.values)


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

    forces, accelerations: (n_equations, n_loads); rows: (n_readings, n_equations), CSR; loads:
    (n_readings,), the load case of each reading.
    """

    forces: Floats
    accelerations: Floats
    rows: sparse.csr_array
    loads: Integers

    @classmethod
    def of(
        cls,
        base: MatrixResult,
        observe: Observe,
        loads: Sequence[LoadCase],
        readings: Sequence[Reading],
        mesh: Mesh | None = None,
    ) -> StaticModel:
        """Of matrices with these equations. observe: degrees of freedom in terms of them; mesh:
        needed by accelerations.

        Raises ModelError for what is held in place, or is not a sum over equations.
        """
        forces, sums = [load.on_equations(base, observe) for load in loads], []
        for item in readings:
            seen = observe(base, item.nodes, item.components)
            text = [item.name] * item.nodes.size
            _check(seen, item.nodes, item.components, text, seen.held & bool(seen.held.all()))
            sums.append(item.factors @ seen.matrix)
        given = np.column_stack([load.acceleration for load in loads])
        accelerations = np.zeros((base.nodes.size, len(loads)))
        if given.any() and mesh is not None:
            accelerations = rigid_motions(base, mesh, translations=True).shapes[:, :3] @ given
        return cls(
            np.column_stack(forces),
            accelerations,
            sparse.csr_array(np.vstack(sums)),
            np.array([item.load for item in readings]),
        )

    def values(
        self,
        matrices: ParameterMatrices,
        theta: Floats,
        changes: Mapping[int, Floats] | None = None,
    ) -> tuple[Floats, Floats]:
        """The readings (n_readings,) at a set and their derivatives (n_readings, n_parameters).

        changes: derivatives of `forces` by column. Raises ModelError where the stiffness is
        singular, as a free structure's is.
        """
        here = matrices.at(theta)
        try:
            factors = factorise(here.stiffness)
        except ModelError as error:
            raise ModelError(f"static displacements: {error}") from error
        moved = factors.solve(self.forces + upper_product(here.upper_mass, self.accelerations))
        adjoint = factors.solve(self.rows.T.toarray())
        slopes = np.zeros((self.loads.size, theta.size))
        for column in range(theta.size):
            stiffness, mass = matrices.change(theta, column)
            change = upper_product(mass, self.accelerations) - upper_product(stiffness, moved)
            if changes and column in changes:
                change = change + changes[column]
            slopes[:, column] = np.sum(adjoint * change[:, self.loads], axis=0)
        return (self.rows @ moved)[np.arange(self.loads.size), self.loads], slopes


def _check(
    seen: Observation,
    nodes: Integers,
    components: Integers,
    said: Sequence[str],
    held: NDArray[np.bool_],
) -> None:
    """Raise ModelError for the first that is unknown or constrained. said: what each is of."""
    for wrong, why in (
        (seen.unknown, "does not follow from the matrices' unknowns"),
        (held, "is held in place, so nothing moves there"),
    ):
        for place in np.flatnonzero(wrong)[:1].tolist():
            dof = dof_name((int(nodes[place]), int(components[place])))
            raise ModelError(f"{said[place]}: {dof} {why}")
