"""Damping matrices for all parameter values, and the system with stiffness and mass.

Viscous C and structural H are sums of elements' own, each linear in a parameter or constant:

    C(theta) = sum_j (a_j + b_j theta_j) C_j,      H(theta) alike.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from scipy import sparse

from modetune.core.algebra.damped_modes import DampedSystem
from modetune.core.algebra.matrices import symmetric
from modetune.core.modes import Floats
from modetune.core.updating.parameter_matrices import ParameterMatrices

DampingKind = Literal["viscous", "structural"]


@dataclass(frozen=True, slots=True)
class Damper:
    """matrix: (n, n), both triangles, times constant + slope * theta of its column."""

    kind: DampingKind
    matrix: sparse.csr_array
    constant: float
    slope: float = 0.0
    column: int = -1


@dataclass(frozen=True, slots=True)
class DampingModel:
    """All that damps a model."""

    dampers: tuple[Damper, ...]

    def system(self, matrices: ParameterMatrices, theta: Floats) -> DampedSystem:
        """All matrices at a set (n_parameters,)."""
        here = matrices.at(theta)
        factors = [d.constant + (d.slope * float(theta[d.column]) if d.slope else 0.0)
                   for d in self.dampers]  # fmt: skip
        return self._with(here.stiffness, here.mass, factors)

    def change(self, matrices: ParameterMatrices, theta: Floats, column: int) -> DampedSystem:
        """Their derivatives with respect to a parameter."""
        stiffness, mass = map(symmetric, matrices.change(theta, column))
        return self._with(
            stiffness, mass, [d.slope if d.column == column else 0.0 for d in self.dampers]
        )

    def _with(
        self, stiffness: sparse.csr_array, mass: sparse.csr_array, factors: list[float]
    ) -> DampedSystem:
        sums = {"viscous": sparse.csr_array(mass.shape), "structural": sparse.csr_array(mass.shape)}
        for damper, factor in zip(self.dampers, factors, strict=True):
            if factor:
                sums[damper.kind] = sparse.csr_array(sums[damper.kind] + factor * damper.matrix)
        return DampedSystem(stiffness, mass, sums["viscous"], sums["structural"])
