"""A model that is matrices: K and M, named unknowns, and the parts that parameters scale.

With theta_j the relative value of part j, whose own stiffness and mass are K_j and M_j,

    K(theta) = K + sum_j (theta_j - 1) K_j,     M(theta) = M + sum_j (theta_j - 1) M_j

(thesis (2.5), (2.6)), linear in every parameter. The factor of a part may also be an expression of
parameters, f_j(theta) in place of theta_j: of a tube's radius r the mass has r^2 and the bending
stiffness r^4. In a spring-mass system each spring is a part
with a K_j and each mass one with an M_j.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy import sparse

from modetune.core.algebra.matrices import MatrixResult, upper_triangle
from modetune.core.errors import ModelError
from modetune.core.modes import Floats, Integers
from modetune.core.near_names import suggestion
from modetune.core.parameters import Parameter, Quantity
from modetune.core.updating.damping_model import Damper, DampingKind, DampingModel, Linear
from modetune.core.updating.parameter_matrices import ParameterMatrices, Powers, parameter_matrices
from modetune.core.updating.relation import Relation

#: What matrices a part may have, as models' files call them; modes know the first two.
MATRIX_KINDS = ("stiffness", "mass", "viscous", "structural")
DAMPING_KINDS: tuple[DampingKind, ...] = ("viscous", "structural")
#: Values of parts relative to the model's own; a part that is not named stays as it is.
Factors = Mapping[str, float]


@dataclass(frozen=True, slots=True)
class MatrixPart:
    """What one parameter may scale: its matrices of stiffness, mass and damping, (n, n), or none.

    quantity: how parameters call it; value: in the model's units, 1 for matrices.
    """

    quantity: Quantity
    value: float
    stiffness: sparse.csr_array | None
    mass: sparse.csr_array | None
    viscous: sparse.csr_array | None = None
    structural: sparse.csr_array | None = None

    @property
    def matrices(self) -> dict[str, sparse.csr_array]:
        """Those that it has, by the keys of models' files."""
        found = {kind: getattr(self, kind) for kind in MATRIX_KINDS}
        return {kind: matrix for kind, matrix in found.items() if matrix is not None}

    @property
    def damps_only(self) -> bool:
        """Whether modes do not depend on it."""
        return self.stiffness is None and self.mass is None


@dataclass(frozen=True)
class MatrixModel:
    """Stiffness and mass (n, n), what each unknown is called (n,), and the parts by name."""

    name: str
    stiffness: sparse.csr_array
    mass: sparse.csr_array
    nodes: Integers
    components: Integers
    parts: Mapping[str, MatrixPart]

    def part(self, name: str) -> MatrixPart:
        """Return a part by its name. Raises ModelError with the nearest names."""
        if name not in self.parts:
            raise ModelError(f"the model has no part {name}{suggestion(name, self.parts)}")
        return self.parts[name]

    def targets(self, parameter: Parameter) -> list[MatrixPart]:
        """Return the parts of a parameter.

        Raises ModelError with the first reason why it has none.
        """
        found = []
        for name in () if parameter.quantity == "variable" else parameter.targets:
            part = self.part(name)
            if part.quantity != parameter.quantity:
                raise ModelError(
                    f"part {name} has a {part.quantity}, which {parameter.quantity} cannot scale"
                )
            found.append(part)
        return found

    @cached_property
    def by_parts(self) -> ParameterMatrices:
        """K and M for all relative values of the parts, in their order."""
        stiffness, mass = (
            [
                Powers(column, (1,), (upper_triangle(matrix),))
                for column, matrix in enumerate(matrices)
                if matrix is not None
            ]
            for matrices in (
                [part.stiffness for part in self.parts.values()],
                [part.mass for part in self.parts.values()],
            )
        )
        base = MatrixResult.of_full(self.stiffness, self.mass, self.nodes, self.components)
        return parameter_matrices(base, np.ones(len(self.parts)), stiffness, mass)

    def matrices(
        self, parameters: tuple[Parameter, ...], dependents: tuple[Parameter, ...] = ()
    ) -> ParameterMatrices:
        """Return K and M for all values of these parameters; dependents: expressions of them."""
        names = list(self.parts)
        here, there = (
            {name: f for p in parameters for name, f in self.factors(p, value).items()}
            for value in (1.0, 2.0)
        )
        slopes = {names.index(name): there[name] - here[name] for name in here}
        moved = any(factor != 1.0 for factor in here.values())
        columns = {
            names.index(target): column
            for column, parameter in enumerate(parameters)
            for target in self.factors(parameter, 1.0)
        }
        related = {
            names.index(name): relation
            for name, relation in self.relations(parameters, dependents).items()
        }
        stiffness, mass = (
            tuple(
                replace(part, column=-1, relation=related[part.column])
                if part.column in related
                else replace(
                    part, column=columns[part.column], values=part.values * slopes[part.column]
                )
                for part in parts
                if part.column in columns or part.column in related
            )
            for parts in (self.by_parts.stiffness, self.by_parts.mass)
        )
        base = self.assembled(here) if moved else self.by_parts.base
        return ParameterMatrices(np.ones(len(parameters)), base, stiffness, mass)

    def relations(
        self, parameters: tuple[Parameter, ...], dependents: tuple[Parameter, ...]
    ) -> dict[str, Relation]:
        """Return the factors of the parts that expressions scale, by part."""
        found = {}
        for item in dependents:
            ends = self.factors(item, 1.0)
            for name, start in self.factors(item, 0.0).items():
                slope = ends[name] - start
                found[name] = Relation.of(item.expression, parameters, start, slope)
        return found

    def damping(
        self, parameters: tuple[Parameter, ...], dependents: tuple[Parameter, ...] = ()
    ) -> DampingModel:
        """Return the damping of the model for all values of these parameters."""
        related = self.relations(parameters, dependents)
        here, there = (
            {name: (f, column) for column, p in enumerate(parameters)
             for name, f in self.factors(p, value).items()}
            for value in (0.0, 1.0)
        )  # fmt: skip
        found = []
        for name, part in self.parts.items():
            (constant, column), (end, _) = here.get(name, (1.0, -1)), there.get(name, (1.0, -1))
            number = related.get(name) or Linear(constant, end - constant, column)
            found += [
                Damper(kind, matrix, (number,))
                for kind in DAMPING_KINDS
                if (matrix := getattr(part, kind)) is not None
            ]
        return DampingModel(tuple(found))

    def factors(self, parameter: Parameter, value: float) -> dict[str, float]:
        """Return factors on the parts of a parameter at its value."""
        shown, plain = parameter.shown(value), parameter.values == "relative"
        return {
            name: shown if plain else parameter.number(part.value, value) / part.value
            for name in parameter.targets
            if (part := self.parts.get(name)) is not None and parameter.quantity != "variable"
        }

    def assembled(self, factors: Factors) -> MatrixResult:
        """Return K and M with these parts scaled."""
        return self.by_parts.at(np.array([factors.get(name, 1.0) for name in self.parts]))

    def group_stiffness(self, names: tuple[str, ...], factors: Factors) -> sparse.csr_array:
        """Return the scaled stiffness of several parts together."""
        total = sparse.csr_array(self.stiffness.shape)
        for name in names:
            stiffness = self.part(name).stiffness
            if stiffness is not None:
                total = sparse.csr_array(total + factors.get(name, 1.0) * stiffness)
        return total

    def total_mass(self, mass: sparse.csr_array) -> float:
        """r^T M r for unit motion r along the first translation that unknowns have, else NaN."""
        translations = self.components[self.components <= 3]
        if translations.size == 0:
            return float("nan")
        motion = (self.components == translations.min()).astype(np.float64)
        return float(motion @ (mass @ motion))

    @cached_property
    def digest(self) -> str:
        """SHA-256 of everything in the model that can change numbers."""
        digest = hashlib.sha256()
        for name, numbers in (("nodes", self.nodes), ("components", self.components)):
            _feed(digest, name, numbers.astype("<i8"))
        _feed_matrix(digest, "stiffness", self.stiffness)
        _feed_matrix(digest, "mass", self.mass)
        for name in sorted(self.parts):
            for kind in MATRIX_KINDS[:2]:
                if kind in self.parts[name].matrices:
                    _feed_matrix(digest, f"{name}/{kind}", self.parts[name].matrices[kind])
        return digest.hexdigest()


def _feed_matrix(digest: hashlib._Hash, name: str, matrix: sparse.csr_array) -> None:
    _feed(digest, f"{name}/indptr", matrix.indptr.astype("<i8"))
    _feed(digest, f"{name}/indices", matrix.indices.astype("<i8"))
    _feed(digest, f"{name}/data", matrix.data.astype("<f8"))


def _feed(digest: hashlib._Hash, name: str, numbers: Floats | Integers) -> None:
    digest.update(f"{name}:{numbers.size};".encode())
    digest.update(numbers.tobytes())
