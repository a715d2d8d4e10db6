"""What modes become beside a parameter set: their derivatives outside the modes that are known.

They solve Nelson's equation (K - lambda M) z = f with f = (lambda dM - dK) phi less
M X X^T (lambda dM - dK) phi, X the known modes. With (K - s M)^-1 at hand from the eigensolution
no further factorisation is needed:

    (I - (lambda - s) T) z = y,   T = (K - s M)^-1 M,   y = (K - s M)^-1 f.

T is symmetric in the product of M, so only the unknowns that have mass are needed until the end,
where z = y + (lambda - s) T z gives the others. Where more modes are known than used, (lambda - s)
T is small on the rest, and the iteration converges (Zhang and Zerva 1996); faster than column by
column does Galerkin's method in the space of all of them: each step adds the residuals of the
columns that are not good enough yet to it, at the cost of one solution each.

Where K and M are not linear in a parameter p (thickness), second derivatives are vectors too:

    (K - lambda M) z'' = 2 (d lambda M + lambda dM - dK) d phi
                         + (2 d lambda dM + lambda d2M - d2K) phi   less what acts on X.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy import sparse

from modetune.core.affine import AffineMatrices
from modetune.core.errors import ModesError
from modetune.core.matrices import symmetric, touched
from modetune.core.modes import Floats, Integers, count_rigid_modes

#: (K - s M)^-1 times a block of vectors (n, k), at the values of the modes.
Inverse = Callable[[Floats], Floats]

#: Relative residual of derivatives, in the norm of M, at which they are good enough: with one step
#: more at the end their error is a thousand times smaller.
TOLERANCE = 1e-4
#: Length, in M, of a derivative with respect to a relative value that counts as none: what the
#: rounding of K x leaves of a rigid mode.
NEGLIGIBLE = 1e-7
#: Steps towards it at most. Only a mode with a near neighbour that is not known takes more.
MOST_STEPS = 8
#: Least share of a mode's own stiffness that counts as left where such a neighbour is there.
LEAST_GAP = 1e-3
#: Relative distance of eigenvalues below which what two modes take of each other is left out of
#: second derivatives.
CLOSE = 1e-3
#: Columns solved for together, a bound on memory.
COLUMNS_AT_ONCE = 64
#: Squared length below which a direction of the scaled vectors is not added to the space in a
#: step: so the space is orthonormal to 10^-6, and what it lacks is added in the next step.
STEP_RANK = 1e-10


@dataclass(frozen=True, slots=True)
class Mass:
    """A mass matrix without the unknowns that have none, which may be most.

    full: (n_moving, n_moving), both triangles; moving: (n_moving,), their equations.
    """

    full: sparse.csr_array
    moving: Integers

    @classmethod
    def of(cls, upper: sparse.csr_array) -> Mass:
        """From an upper triangle (n, n), which may hold zeros."""
        weighty = upper.copy()
        weighty.eliminate_zeros()
        inside, moving = touched(weighty)
        return cls(symmetric(inside), moving)

    def times(self, block: Floats) -> Floats:
        """M x of a block of vectors (n, k)."""
        found = np.zeros(block.shape)
        found[self.moving] = self.full @ np.ascontiguousarray(block[self.moving])
        return found


@dataclass(frozen=True, slots=True)
class KnownModes:
    """Known modes with M X, the shift that their inverse has, and the first elastic eigenvalue.

    eigenvalues: (n_modes,); shapes, weighted: X and M X, (n, n_modes).
    """

    eigenvalues: Floats
    shapes: Floats
    weighted: Floats
    shift: float
    first: float

    @classmethod
    def of(cls, eigenvalues: Floats, shapes: Floats, mass: Mass, inverse: Inverse) -> KnownModes:
        """Raises ModesError where no mode strains the structure."""
        first = count_rigid_modes(eigenvalues)
        if first >= eigenvalues.size:
            raise ModesError("a reduced model needs modes that strain the structure")
        weighted = mass.times(shapes)
        # (K - s M)^-1 M phi = phi / (lambda - s) tells the shift of whoever gave the inverse.
        answer = inverse(weighted[:, [first]])[:, 0]
        shift = float(eigenvalues[first]) - 1.0 / float(weighted[:, first] @ answer)
        return cls(eigenvalues, shapes, weighted, shift, float(eigenvalues[first]))


def derivative_vectors(
    affine: AffineMatrices, theta: Floats, modes: KnownModes, used: Integers, mass: Mass,
    inverse: Inverse,
) -> Floats:  # fmt: skip
    """Derivatives of modes with respect to all parameters outside the known modes, (n, k).

    theta: (n_parameters,); used: positions of the modes. With a thickness those of rigid modes
    come too, as the faces' arms of a rotation change, and second derivatives.
    """
    columns = sorted({part.column for part in (*affine.stiffness, *affine.mass)})
    linear = [column for column in columns if affine.is_linear(column)]
    forces = [_forces(affine, theta, column, modes, used) for column in linear]
    found = [_outside(modes, used, forces, mass, inverse)]
    curved = [column for column in columns if column not in linear]
    used = np.union1d(np.flatnonzero(modes.eigenvalues < modes.first), used)
    forces = [_forces(affine, theta, column, modes, used) for column in curved]
    found.append(_outside(modes, used, forces, mass, inverse))
    second = [
        _second_forces(affine, theta, column, modes, used, part, mass)
        for column, part in zip(curved, np.hsplit(found[1], len(curved)) if curved else (),
                                strict=True)
    ]  # fmt: skip
    return np.hstack([*found, _outside(modes, used, second, mass, inverse)])


def _forces(
    affine: AffineMatrices, theta: Floats, column: int, modes: KnownModes, used: Integers
) -> Floats:
    """(lambda dM - dK) phi of used modes, (n, n_used)."""
    stiffness, inertia = affine.products(theta, column, modes.shapes[:, used])
    return np.asarray(modes.eigenvalues[used] * inertia - stiffness)


def _second_forces(
    affine: AffineMatrices, theta: Floats, column: int, modes: KnownModes, used: Integers,
    outside: Floats, mass: Mass,
) -> Floats:  # fmt: skip
    """Forces of the second derivatives of used modes with respect to one parameter, (n, n_used).

    outside: (n, n_used), their first derivatives outside the known modes.
    """
    lam, phi = modes.eigenvalues[used], modes.shapes[:, used]
    stiffness, inertia = affine.products(theta, column, modes.shapes)
    own = lam * inertia[:, used] - stiffness[:, used]
    slopes = -np.sum(phi * own, axis=0)
    gaps = lam - modes.eigenvalues[:, None]
    apart = np.abs(gaps) > CLOSE * np.abs(lam)
    inside = -(modes.shapes.T @ own) / np.where(apart, gaps, np.inf)
    force = lam * (inertia @ inside) - stiffness @ inside
    stiffness, moved = affine.products(theta, column, outside)
    force += lam * moved - stiffness + slopes * (mass.times(outside) + inertia[:, used])
    stiffness, moved = affine.products(theta, column, phi, order=2)
    return np.asarray(2.0 * force + lam * moved - stiffness)


def _outside(
    modes: KnownModes, used: Integers, forces: list[Floats], mass: Mass, inverse: Inverse
) -> Floats:
    """(K - lambda M)^-1 f outside the known modes of forces (n, n_used) each, side by side."""
    found = np.empty((modes.shapes.shape[0], len(forces) * used.size), order="F")
    at_once = max(1, COLUMNS_AT_ONCE // used.size)
    for start in range(0, len(forces), at_once):
        group = forces[start : start + at_once]
        block = np.empty((found.shape[0], len(group) * used.size), order="F")
        np.concatenate(group, axis=1, out=block)
        block -= modes.weighted @ (modes.shapes.T @ block)
        solved = _nelson_solved(
            modes, np.tile(modes.eigenvalues[used], len(group)), block, mass, inverse
        )
        found[:, start * used.size : start * used.size + block.shape[1]] = solved
    return found


def _nelson_solved(
    modes: KnownModes, eigenvalues: Floats, forces: Floats, mass: Mass, inverse: Inverse
) -> Floats:
    """(K - lambda M)^-1 f for forces (n, k) that act on no known mode, a lambda each."""
    start = inverse(forces)
    known = modes.shapes[mass.moving]
    weighted = modes.weighted[mass.moving]
    first = np.ascontiguousarray(start[mass.moving])
    first -= known @ (weighted.T @ first)
    weight = mass.full @ first
    goals = np.maximum(TOLERANCE * _lengths(first, weight), NEGLIGIBLE)
    factors = eigenvalues - modes.shift
    space = _Space.empty(forces.shape[0], mass.moving.size)
    coefficients, left = np.zeros((0, goals.size)), _lengths(first, weight) > goals
    residual, heavy = first, weight
    for _ in range(MOST_STEPS):
        if not left.any():
            break
        space = space.wider(residual[:, left], heavy[:, left], mass, inverse)
        small = space.vectors.T @ space.heavy_images
        values, turned = np.linalg.eigh(0.5 * (small + small.T))
        # I - (lambda - s) T is positive where all modes below lambda are known.
        dividing = 1.0 / np.maximum(1.0 - np.outer(values, factors), LEAST_GAP)
        coefficients = turned @ (dividing * (turned.T @ (space.heavy.T @ first)))
        scaled = factors * coefficients
        residual = first - space.vectors @ coefficients + space.images[mass.moving] @ scaled
        heavy = weight - space.heavy @ coefficients + space.heavy_images @ scaled
        left = _lengths(residual, heavy) > goals
    start += space.images @ (factors * coefficients)
    start -= modes.shapes @ (modes.weighted.T @ start)
    return np.asarray(start)


def _lengths(block: Floats, weighted: Floats) -> Floats:
    return np.asarray(np.sqrt(np.maximum(np.einsum("ij,ij->j", block, weighted), 0.0)))


@dataclass(frozen=True, slots=True)
class _Space:
    """An M-orthonormal space and what T makes of it.

    vectors: Q, (n_moving, k), on the unknowns that have mass; heavy: M Q; images: T Q, (n, k), on
    all; heavy_images: M T Q, (n_moving, k).
    """

    vectors: Floats
    heavy: Floats
    images: Floats
    heavy_images: Floats

    @classmethod
    def empty(cls, size: int, moving: int) -> _Space:
        none = np.zeros((moving, 0))
        return cls(none, none, np.zeros((size, 0), order="F"), none)

    def wider(self, block: Floats, heavy: Floats, mass: Mass, inverse: Inverse) -> _Space:
        """The space with the directions of a block (n_moving, j), M times it given, it lacks."""
        inside = self.heavy.T @ block
        block, heavy = block - self.vectors @ inside, heavy - self.heavy @ inside
        gram = block.T @ heavy
        scale = 1.0 / np.sqrt(np.maximum(gram.diagonal(), np.finfo(np.float64).tiny))
        squares, turned = np.linalg.eigh(scale[:, None] * gram * scale)
        kept = squares > STEP_RANK
        turned = scale[:, None] * turned[:, kept] / np.sqrt(squares[kept])
        block, heavy = block @ turned, heavy @ turned
        forces = np.zeros((self.images.shape[0], block.shape[1]), order="F")
        forces[mass.moving] = heavy
        images = inverse(forces)
        return _Space(
            np.hstack([self.vectors, block]),
            np.hstack([self.heavy, heavy]),
            np.hstack([self.images, images]),
            np.hstack([self.heavy_images, mass.full @ images[mass.moving]]),
        )
