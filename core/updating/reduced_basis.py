"""The basis of a reduced model: modes at a parameter set, and what they become beside it.

The vectors Z answer forces F on no known mode, (K - s M) Z = F (`derivative_vectors`), so
no product with K is needed to make V = [Phi, Z W] orthonormal with respect to K - s M, by W from
the eigenvectors of

    Z^T (K - s M) Z = Z^T F,   and   V^T K V = diag(lambda - s, 1) + s V^T M V.

Vectors that hardly move (NEGLIGIBLE) and directions that the scaled others hardly have (RANK) are
left out. In this product unknowns without mass are not an obstacle, and nothing is lost to the
cancellation in K x of smooth x.

Where the inverse at hand is that of a similar matrix, its answers are about the ones wanted. They
and an older basis are then taken as directions beside the modes, and K and M projected on them.

An older basis is kept, as far as it is not in the new one already and there is room; what is
least outside it goes first. It answers no known forces, so its directions are taken with respect
to M + e diag(K), e so small that only vectors that move (nearly) no mass feel it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import sparse

from modetune.core.algebra.matrices import ROWS_AT_ONCE, projected, upper_product
from modetune.core.modes import Floats, Integers
from modetune.core.updating.derivative_vectors import (
    NEGLIGIBLE,
    Answers,
    Inverse,
    KnownModes,
    derivative_answers,
)
from modetune.core.updating.parameter_matrices import ParameterMatrices, ParameterMatrix
from modetune.core.updating.reduced import ReducedModel, ReducedPart

#: A positive definite matrix times a block of vectors (n, k).
Weight = Callable[[Floats], Floats]

#: Most vectors of a basis.
MOST_VECTORS = 150
#: The reduced model's own shift in first elastic eigenvalues, where its maker's is nearer to zero.
LEAST_SHIFT = -1e-3
#: Squared length below which a direction of the scaled vectors is not a direction of its own.
RANK = 1e-8
#: Squared length below which what an old basis has outside the new one is left out.
OLD_RANK = 1e-8
#: Vectors that are weighted at once: a product has three of the size of what it is made of.
COLUMNS_AT_ONCE = 8


def reduce(
    affine: ParameterMatrices,
    theta: Floats,
    eigenvalues: Floats,
    shapes: Floats,
    inverse: Inverse,
    used: Integers,
    n_rigid: int,
    observer: sparse.csr_array,
    previous: Floats | None = None,
    most: int = MOST_VECTORS,
    exact: bool = True,
) -> tuple[ReducedModel, Floats]:
    """A reduced model around a parameter set, and its basis (n, r).

    theta: (n_parameters,); eigenvalues (n_modes,), shapes (n, n_modes): the lowest modes there,
    rigid ones included, mass-normalised; inverse: by the factorisation that they were found with;
    used: positions of the modes whose derivatives are wanted; n_rigid: how many of the first are
    rigid; observer: (n_rows, n), takes shapes to the wanted degrees of freedom; previous: an older
    basis (n, r_old); exact: whether the inverse is that of this set, and not of one that is near.
    Raises ModesError where no mode strains the structure. Eigenvalues' derivatives are exact,
    those of shapes good to some 10^-3 with an exact inverse, else to what the two sets are apart.
    """
    mass = affine.mass_at(theta)
    modes = KnownModes.of(eigenvalues, shapes, used, mass, n_rigid)
    answers = derivative_answers(affine, theta, modes, mass, inverse)
    shift, more = answers.shift, [] if previous is None else [previous]
    own_shift = min(shift, LEAST_SHIFT * float(eigenvalues[modes.first]))
    if exact:
        basis = _basis(modes, answers, most - eigenvalues.size)
    else:
        basis, more = shapes, [answers.vectors, *more]
    del modes, answers  # as large as the basis itself
    widened = basis
    if more and basis.shape[1] < most:
        metric = _Metric.of(affine.at(theta).upper_stiffness, mass)
        widened = with_directions(metric.weighted, basis, more, most - basis.shape[1])
    del more
    if not exact:
        return projected_model(affine, widened, own_shift, observer), widened
    stiffness_parts = _reduced_parts(affine.base.upper_stiffness, affine.stiffness, widened)
    mass_parts = _reduced_parts(affine.base.upper_mass, affine.mass, widened)
    inertia = projected(mass, widened)
    if widened.shape[1] > basis.shape[1]:
        stiffness = projected(affine.base.upper_stiffness, widened)
    else:
        stiffness = shift * inertia
        energies = np.ones(basis.shape[1])
        energies[: eigenvalues.size] = eigenvalues - shift
        stiffness[np.diag_indices_from(stiffness)] += energies
        stiffness -= _moved(stiffness_parts, theta, affine.reference, basis.shape[1])
    model = ReducedModel(
        reference=affine.reference,
        shift=own_shift,
        base_stiffness=stiffness,
        base_mass=inertia - _moved(mass_parts, theta, affine.reference, widened.shape[1]),
        stiffness=stiffness_parts,
        mass=mass_parts,
        rows=np.asarray(observer @ widened),
    )
    return model, widened


def unreduced(affine: ParameterMatrices, shift: float, observer: sparse.csr_array) -> ReducedModel:
    """A small model as it is, every unknown a vector of its own: exact for all parameter values.

    shift: (rad/s)^2, below zero; observer: (n_rows, n).
    """
    return projected_model(affine, np.eye(observer.shape[1]), shift, observer)


def projected_model(
    affine: ParameterMatrices, basis: Floats, shift: float, observer: sparse.csr_array
) -> ReducedModel:
    """A model on any basis (n, r). shift: (rad/s)^2, below zero; observer: (n_rows, n)."""
    return ReducedModel(
        reference=affine.reference,
        shift=shift,
        base_stiffness=projected(affine.base.upper_stiffness, basis),
        base_mass=projected(affine.base.upper_mass, basis),
        stiffness=_reduced_parts(affine.base.upper_stiffness, affine.stiffness, basis),
        mass=_reduced_parts(affine.base.upper_mass, affine.mass, basis),
        rows=np.asarray(observer @ basis),
    )


def _basis(modes: KnownModes, answers: Answers, room: int) -> Floats:
    """The known modes and what answers have outside them, (n, r) in C order, the strongest first.

    room: how many directions it takes beside the modes.
    """
    known = modes.eigenvalues.size
    gram = answers.vectors.T @ answers.forces
    gram = 0.5 * (gram + gram.T)
    moves = np.flatnonzero(gram.diagonal() > NEGLIGIBLE * modes.eigenvalues[modes.first])
    scale = 1.0 / np.sqrt(gram.diagonal()[moves])
    squares, turned = np.linalg.eigh(scale[:, None] * gram[np.ix_(moves, moves)] * scale)
    kept = np.flatnonzero(squares > RANK)[::-1][: max(room, 0)]
    # With columns of zeros for the modes the product is made in its place.
    mixing = np.zeros((gram.shape[0], known + kept.size))
    mixing[moves, known:] = scale[:, None] * turned[:, kept] / np.sqrt(squares[kept])
    found = np.empty((modes.shapes.shape[0], mixing.shape[1]))
    np.matmul(answers.vectors, mixing, out=found)
    found[:, :known] = modes.shapes
    return found


@dataclass(frozen=True, slots=True)
class _Metric:
    """The product of vectors M + e diag(K)."""

    mass: sparse.csr_array
    diagonal: Floats

    @classmethod
    def of(cls, upper_stiffness: sparse.csr_array, upper_mass: sparse.csr_array) -> _Metric:
        stiffness, inertia = upper_stiffness.diagonal(), upper_mass.diagonal()
        moving = inertia > 0.0
        largest = float(np.max(stiffness[moving] / inertia[moving], initial=0.0))
        scale = 1e-3 / largest if largest > 0.0 else 1.0
        return cls(upper_mass, np.abs(stiffness) * scale)

    def weighted(self, block: Floats) -> Floats:
        found = upper_product(self.mass, block)
        found += self.diagonal[:, None] * block
        return found


def widened_model(
    affine: ParameterMatrices,
    model: ReducedModel,
    known: Sequence[Floats],
    new: Floats,
    observer: sparse.csr_array,
) -> ReducedModel:
    """A projected model with more vectors (n, k) behind those it is made of.

    known: these, side by side (n, r), which are not projected again.
    """

    def bordered(square: Floats, upper: sparse.csr_array) -> Floats:
        forces = upper_product(upper, new)
        beside, corner = np.vstack([block.T @ forces for block in known]), new.T @ forces
        return np.block([[square, beside], [beside.T, 0.5 * (corner + corner.T)]])

    def parts(
        given: tuple[ReducedPart, ...], own: tuple[ParameterMatrix, ...], upper: sparse.csr_array
    ) -> tuple[ReducedPart, ...]:
        return tuple(
            replace(
                part,
                values=np.stack(
                    [
                        bordered(square, matrix.upper(upper, unit))
                        for square, unit in zip(part.values, np.eye(len(part.powers)), strict=True)
                    ]
                ),
            )
            for part, matrix in zip(given, own, strict=True)
        )

    stiffness, mass = affine.base.upper_stiffness, affine.base.upper_mass
    return replace(
        model,
        base_stiffness=bordered(model.base_stiffness, stiffness),
        base_mass=bordered(model.base_mass, mass),
        stiffness=parts(model.stiffness, affine.stiffness, stiffness),
        mass=parts(model.mass, affine.mass, mass),
        rows=np.hstack([model.rows, observer @ new]),
    )


def with_directions(
    weight: Weight,
    basis: Floats,
    blocks: Sequence[Floats],
    room: int,
    inner: Floats | None = None,
) -> Floats:
    """A basis with the directions that blocks have outside it, the strongest first.

    weight: for the product of vectors; basis: (n, r); blocks: (n, k) each; room: how many of their
    directions the basis takes; inner: (r, r), products of the basis with itself, where they are
    known. Vectors are weighted a few at once, and rows of the blocks combined a few at once:
    beside what is given and what is found hardly anything is in memory.
    """
    if inner is None:
        inner = _products(weight, [basis], basis)
    known = [basis, *blocks]
    products = np.hstack([_products(weight, known, block) for block in blocks])
    seen, gram = products[: basis.shape[1]], products[basis.shape[1] :]
    moves = np.flatnonzero(gram.diagonal() > 0.0)
    scale = 1.0 / np.sqrt(gram.diagonal()[moves])
    gram = scale[:, None] * gram[np.ix_(moves, moves)] * scale
    seen = seen[:, moves] * scale
    inside = np.linalg.solve(inner, seen)
    squares, turned = np.linalg.eigh(gram - seen.T @ inside)
    kept = np.flatnonzero(squares > OLD_RANK)[::-1][: max(room, 0)]
    turned = turned[:, kept] / np.sqrt(squares[kept])
    mixing = np.zeros((products.shape[0], kept.size))
    mixing[: basis.shape[1]] = -inside @ turned
    mixing[basis.shape[1] + moves] = scale[:, None] * turned
    ends = np.cumsum([block.shape[1] for block in known])
    pairs = list(zip(known, np.split(mixing, ends[:-1]), strict=True))
    found = np.empty((basis.shape[0], basis.shape[1] + kept.size))
    for start in range(0, found.shape[0], ROWS_AT_ONCE):
        rows = slice(start, start + ROWS_AT_ONCE)
        found[rows, : basis.shape[1]] = basis[rows]
        found[rows, basis.shape[1] :] = sum(block[rows] @ own for block, own in pairs)
    return found


def _products(weight: Weight, known: Sequence[Floats], block: Floats) -> Floats:
    """Products of vectors, side by side in (n, r) each, with those of a block (n, k): (r, k)."""
    pieces = []
    for start in range(0, block.shape[1], COLUMNS_AT_ONCE):
        own = weight(block[:, start : start + COLUMNS_AT_ONCE])
        pieces.append(np.vstack([vectors.T @ own for vectors in known]))
    return np.hstack(pieces)


def _reduced_parts(
    upper: sparse.csr_array, parts: tuple[ParameterMatrix, ...], basis: Floats
) -> tuple[ReducedPart, ...]:
    return tuple(ReducedPart(p.column, p.powers, p.on(upper, basis)) for p in parts)


def _moved(parts: tuple[ReducedPart, ...], theta: Floats, reference: Floats, size: int) -> Floats:
    """What parts add at these values beyond the reference, (r, r)."""
    found = np.zeros((size, size))
    for part in parts:
        found += part.moved(float(theta[part.column]), float(reference[part.column]))
    return found
