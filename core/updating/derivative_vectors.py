"""Modes near a parameter set: vectors that span their derivatives.

They are the answers of a shifted Nelson's equation, whose factors are those of the eigensolution:

    (K - s M) z = f,   f = (dK - lambda dM) phi   less M X X^T f

for each used mode and parameter, X the known modes. The derivative solves the same with lambda
for s: of an unknown mode z has (lambda - lambda_k) / (s - lambda_k) times what the derivative has,
so they are alike where modes some way above the used ones are known too, and what the space of
all z has of a derivative is better than that (a few 10^-3 and less of its length are wrong).

Where a matrix is not linear in a parameter p (thickness), second derivatives are vectors too:

    f'' = 2 (dK - lambda dM - d lambda M) d phi + (d2K - lambda d2M - 2 d lambda dM) phi,

signs and factors of z and f mattering to no space. Forces that can move nothing are not solved
for: of a part dK of the stiffness, as dK K^-1 dK <= dK, the answer's energy is at most
phi^T dK phi.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy import sparse

from modetune.core.algebra.matrices import touched_product, upper_product
from modetune.core.errors import ModesError
from modetune.core.modes import Floats, Integers
from modetune.core.updating.parameter_matrices import ParameterMatrices

#: (K - s M)^-1 times a block of vectors (n, k), at the values of the modes.
Inverse = Callable[[Floats], Floats]

#: Share of a mode's energy, for a change by one, below which its forces count as none: the shape
#: changes by less than the root of it.
NEGLIGIBLE = 1e-6
#: Relative distance of eigenvalues below which what two modes take of each other is left out of
#: second derivatives.
CLOSE = 1e-3
#: Hundreds of force columns are mixed at random into this number: the responses to the mixtures
#: span the strongest directions of all responses (Halko, Martinsson and Tropp 2011).
MOST_FORCES = 600
#: Rows of forces that are changed at once, so that they stay in the cache.
ROWS_AT_ONCE = 16384


@dataclass(frozen=True, slots=True)
class KnownModes:
    """Known modes with M X, and which of them are used.

    eigenvalues: (n_modes,); shapes, weighted: X and M X, (n, n_modes); used: positions; first:
    that of the lowest mode that is elastic.
    """

    eigenvalues: Floats
    shapes: Floats
    weighted: Floats
    used: Integers
    first: int

    @classmethod
    def of(
        cls, eigenvalues: Floats, shapes: Floats, used: Integers, mass: sparse.csr_array, first: int
    ) -> KnownModes:
        """Raises ModesError where no mode strains the structure."""
        if first >= eigenvalues.size:
            raise ModesError("a reduced model needs modes that strain the structure")
        weighted = upper_product(mass, shapes)
        return cls(eigenvalues, shapes, weighted, np.asarray(used), first)


@dataclass(frozen=True, slots=True)
class Answers:
    """Forces on no known mode, and what they move: (K - s M) vectors = forces, (n, k) each."""

    forces: Floats
    vectors: Floats
    shift: float


def derivative_answers(
    affine: ParameterMatrices,
    theta: Floats,
    modes: KnownModes,
    mass: sparse.csr_array,
    inverse: Inverse,
) -> Answers:
    """Return vectors that span the derivatives of the modes outside them, and their forces.

    theta: (n_parameters,); mass: (n, n), the upper triangle there. With a thickness those of
    rigid modes come too, as the faces' arms of a rotation change, and second derivatives.
    """
    columns = affine.columns
    curved = [column for column in columns if not affine.is_linear(column)]
    of_curved = np.union1d(np.arange(modes.first), modes.used)
    wanted = [(column, of_curved if column in curved else modes.used) for column in columns]
    room = sum(of.size for _, of in wanted)
    mixed = room > MOST_FORCES and not curved
    forces = np.zeros((modes.shapes.shape[0], min(room, MOST_FORCES) + 1), order="F")
    places: dict[int, slice] = {}
    end, random = 0, np.random.default_rng(0)
    for column, of in wanted:
        kept, parts = _forces(affine, theta, column, modes, of)
        places[column] = slice(end, end + kept.size)
        into, mixing = forces[:, places[column]], np.eye(kept.size)
        if mixed:
            into, mixing = forces[:, :MOST_FORCES], random.standard_normal((kept.size, MOST_FORCES))
            mixing /= np.sqrt(modes.eigenvalues[of[kept], None])
        for rows, own in parts:
            into[rows] += own @ mixing
        end = MOST_FORCES if mixed else end + kept.size
    acting = _leave_outside(modes, forces[:, :end])
    # The last column shows the shift s of the given inverse: M phi moves phi / (lambda - s).
    forces[:, end] = modes.weighted[:, modes.first]
    vectors = np.asarray(inverse(forces[:, : end + 1]))
    gap = 1.0 / float(forces[:, end] @ vectors[:, end])
    shift = float(modes.eigenvalues[modes.first]) - gap
    forces, vectors = forces[:, :end], vectors[:, :end]
    if not curved:
        return Answers(forces, vectors, shift)
    second = [
        _second_forces(
            affine,
            theta,
            column,
            modes,
            of_curved,
            acting[:, places[column]],
            vectors[:, places[column]],
            mass,
        )
        for column in curved
    ]
    more = np.asfortranarray(np.hstack(second))
    _leave_outside(modes, more)
    return Answers(np.hstack([forces, more]), np.hstack([vectors, inverse(more)]), shift)


def _leave_outside(modes: KnownModes, forces: Floats) -> Floats:
    """Take off forces (n, k), in their place, what acts on the known modes: X^T f is returned."""
    acting = modes.shapes.T @ forces
    for start in range(0, forces.shape[0], ROWS_AT_ONCE):
        rows = slice(start, start + ROWS_AT_ONCE)
        forces[rows] -= modes.weighted[rows] @ acting
    return np.asarray(acting)


def _forces(
    affine: ParameterMatrices, theta: Floats, column: int, modes: KnownModes, of: Integers
) -> tuple[Integers, list[tuple[Integers, Floats]]]:
    """Forces (dK - lambda dM) phi of these modes: positions of those that move anything, with a
    parameter that is not linear all, and rows with the values there, (n_own, n_kept)."""
    phi = np.ascontiguousarray(modes.shapes[:, of])
    eigenvalues = modes.eigenvalues[of]
    products = [
        (touched_product(change, phi), factors)
        for change, factors in zip(
            affine.change(theta, column), (np.ones(of.size), -eigenvalues), strict=True
        )
        if change.nnz
    ]
    kept = np.arange(of.size)
    if affine.is_linear(column):
        energy = np.zeros(of.size)
        for (own, rows), factors in products:
            energy += np.abs(factors * np.einsum("ij,ij->j", phi[rows], own))
        kept = np.flatnonzero(energy > NEGLIGIBLE * eigenvalues)
    return kept, [(rows, own[:, kept] * factors[kept]) for (own, rows), factors in products]


def _second_forces(
    affine: ParameterMatrices,
    theta: Floats,
    column: int,
    modes: KnownModes,
    of: Integers,
    acting: Floats,
    outside: Floats,
    mass: sparse.csr_array,
) -> Floats:
    """Forces of the second derivatives of modes with respect to one parameter, (n, n_of).

    acting: X^T (dK - lambda dM) phi, (n_modes, n_of); outside: the responses to its remainder.
    """
    lam, phi = modes.eigenvalues[of], modes.shapes[:, of]
    slopes = acting[of, np.arange(of.size)]
    gaps = lam - modes.eigenvalues[:, None]
    apart = np.abs(gaps) > CLOSE * np.abs(lam)
    change = modes.shapes @ (acting / np.where(apart, gaps, np.inf)) - outside
    stiffness, moved = affine.products(theta, column, change)
    force = stiffness - lam * moved
    inertia = affine.products(theta, column, phi)[1]
    force -= slopes * (inertia - upper_product(mass, outside))
    stiffness, moved = affine.products(theta, column, phi, order=2)
    return np.asarray(2.0 * force + stiffness - lam * moved)
