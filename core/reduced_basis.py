"""The basis of a reduced model: modes at a parameter set, and what they become beside it.

The vectors (`core/derivative_vectors.py`) are made orthonormal with respect to M + e diag(K), e
so small that only vectors that move (nearly) no mass feel it: unknowns without mass are no
obstacle, and nothing is lost to the cancellation in K x of smooth x. Directions that the scaled
vectors hardly have, RANK, are left out. A basis made at other values is kept, as far as it is not
in the new one already and there is room; what is least outside it goes first.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import sparse

from modetune.core.affine import AffineMatrices, Part
from modetune.core.derivative_vectors import Inverse, KnownModes, Mass, derivative_vectors
from modetune.core.matrices import MatrixResult, projected
from modetune.core.modes import Floats, Integers
from modetune.core.reduced import ReducedModel, ReducedPart

#: Most vectors of a basis.
MOST_VECTORS = 150
#: The reduced model's own shift in first elastic eigenvalues, where its maker's is nearer to zero.
LEAST_SHIFT = -1e-3
#: Squared length below which a direction of the scaled vectors is no direction of its own.
RANK = 1e-13
#: Squared length below which what an old basis has outside the new one is left out.
OLD_RANK = 1e-8


def reduce(
    affine: AffineMatrices,
    theta: Floats,
    eigenvalues: Floats,
    shapes: Floats,
    inverse: Inverse,
    used: Integers,
    observer: sparse.csr_array,
    previous: Floats | None = None,
    most: int = MOST_VECTORS,
) -> tuple[ReducedModel, Floats]:
    """A reduced model around a parameter set, and its basis (n, r).

    theta: (n_parameters,); eigenvalues (n_modes,), shapes (n, n_modes): the lowest modes there,
    rigid ones included, mass-normalised; inverse: by the factorisation that they were found with;
    used: positions of the modes whose derivatives are wanted; observer: (n_rows, n), takes shapes
    to the wanted degrees of freedom; previous: an older basis (n, r_old). Raises ModesError where
    no mode strains the structure.
    """
    here = affine.at(theta)
    mass = Mass.of(here.upper_mass)
    modes = KnownModes.of(eigenvalues, shapes, mass, inverse)
    beside = derivative_vectors(affine, theta, modes, used, mass, inverse)
    metric = _Metric.of(here, mass)
    basis = _with_directions(metric, shapes, beside, RANK, most - shapes.shape[1])
    if previous is not None and basis.shape[1] < most:
        basis = _with_directions(metric, basis, previous, OLD_RANK, most - basis.shape[1])
    model = ReducedModel(
        reference=affine.reference,
        shift=min(modes.shift, LEAST_SHIFT * modes.first),
        base_stiffness=projected(affine.base.upper_stiffness, basis),
        base_mass=projected(affine.base.upper_mass, basis),
        stiffness=_reduced_parts(affine.base.upper_stiffness, affine.stiffness, basis),
        mass=_reduced_parts(affine.base.upper_mass, affine.mass, basis),
        rows=np.asarray(observer @ basis),
    )
    return model, basis


@dataclass(frozen=True, slots=True)
class _Metric:
    """The product of vectors in which the basis is orthonormal: M + e diag(K)."""

    mass: Mass
    diagonal: Floats

    @classmethod
    def of(cls, here: MatrixResult, mass: Mass) -> _Metric:
        stiffness, inertia = here.upper_stiffness.diagonal(), here.upper_mass.diagonal()
        moving = inertia > 0.0
        largest = float(np.max(stiffness[moving] / inertia[moving], initial=0.0))
        return cls(mass, np.abs(stiffness) * (1e-3 / largest if largest > 0.0 else 1.0))

    def weighted(self, block: Floats) -> Floats:
        found = self.mass.times(block)
        found += self.diagonal[:, None] * block
        return found


def _with_directions(
    metric: _Metric, basis: Floats, block: Floats, least: float, room: int
) -> Floats:
    """A basis with the directions that a block has outside it, orthonormal, the strongest first.

    basis: (n, r); block: (n, k); least: squared length of a direction that counts, those of the
    block's vectors being 1; room: how many of them the basis takes.
    """
    weighted, own = metric.weighted(basis), metric.weighted(block)
    gram = block.T @ own
    moves = np.flatnonzero(gram.diagonal() > 0.0)
    scale = 1.0 / np.sqrt(gram.diagonal()[moves])
    gram = scale[:, None] * gram[np.ix_(moves, moves)] * scale
    seen = (weighted.T @ block[:, moves]) * scale
    inside = np.linalg.solve(basis.T @ weighted, seen)
    squares, turned = np.linalg.eigh(gram - seen.T @ inside)
    kept = np.flatnonzero(squares > least)[::-1][: max(room, 0)]
    turned = turned[:, kept] / np.sqrt(squares[kept])
    found = np.empty((basis.shape[0], basis.shape[1] + kept.size), order="F")
    found[:, : basis.shape[1]] = basis
    found[:, basis.shape[1] :] = block[:, moves] @ (scale[:, None] * turned)
    found[:, basis.shape[1] :] -= basis @ (inside @ turned)
    return found


def _reduced_parts(
    upper: sparse.csr_array, parts: tuple[Part, ...], basis: Floats
) -> tuple[ReducedPart, ...]:
    return tuple(
        ReducedPart(part.column, part.powers, np.stack([
            projected(part.upper(upper, unit), basis) for unit in np.eye(len(part.powers))
        ]))
        for part in parts
    )  # fmt: skip
