"""Approximate eigenpairs completed to modes of a model, and how far these may be off.

One solution with all shapes at once, phi = A phi / theta with A = (K - s M)^-1 M, gives their rows
without mass, and the residuals ||A phi - theta phi||_M / theta tell that there is a lambda within

    |lambda - lambda_found| <= residual (lambda_found - s).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import eigh
from scipy.linalg.blas import dgemm

from modetune.core.algebra.krylov import RitzPairs
from modetune.core.algebra.pencil import Pencil
from modetune.core.modes import Floats

#: Largest residual of a mode before the last solution, which leaves a few hundredths of it.
#: Eigenvalues have its square over the gap to modes that were not looked for.
TOLERANCE = 2e-5


@dataclass(frozen=True, slots=True)
class SolvedModes:
    """The lowest modes of a model.

    eigenvalues: (n_modes,) ascending, (rad/s)^2. shapes: (n, n_modes), mass-normalised.
    residuals: (n_modes,), largest error of an eigenvalue relative to its distance from the shift;
    those of the shapes before the last solution, which makes them better.
    shift: (rad/s)^2. way: how they were found. counted: whether inertia has shown that none below
    the last one is missing. solutions: right-hand sides solved.
    """

    eigenvalues: Floats
    shapes: Floats
    residuals: Floats
    shift: float
    way: str
    counted: bool
    solutions: int


def of_pairs(
    pencil: Pencil, pairs: RitzPairs, n_modes: int, way: str, counted: bool
) -> SolvedModes:
    """The first modes of approximate pairs; way, counted: as `SolvedModes` has them."""
    theta, vectors = pairs.inverted[:n_modes], pairs.vectors[:, :n_modes]
    if not isinstance(pencil.rows, slice):
        return completed(pencil, theta, vectors, way, pairs.solutions, counted)
    # Where all rows have mass the last solution is at hand: A x.
    inertia, images = pencil.inertia(vectors), pairs.images[:, :n_modes]
    values, shapes = _refined(pencil, inertia, images, images, pencil.inertia(images))
    residuals = pairs.residuals[:n_modes]
    return SolvedModes(values, shapes, residuals, _shift_of(pencil), way, counted, pairs.solutions)


def completed(
    pencil: Pencil,
    inverted: Floats,
    vectors: Floats,
    way: str,
    solutions: int,
    counted: bool = False,
) -> SolvedModes:
    """Shapes on all rows by one solution.

    inverted: theta (n_modes,); vectors: (n_with_mass, n_modes).
    """
    inertia = pencil.inertia(vectors)
    images = pencil.apply(inertia)
    own = images[pencil.rows]
    own_inertia = pencil.inertia(own)
    values, shapes = _refined(pencil, inertia, images, own, own_inertia)
    rest, rest_inertia = own - vectors * inverted, own_inertia - inertia * inverted
    squares = np.sum(rest * rest_inertia, axis=0) / np.sum(vectors * inertia, axis=0)
    residuals = np.sqrt(np.maximum(squares, 0.0)) / np.abs(inverted)
    solutions += inverted.size
    return SolvedModes(values, shapes, residuals, _shift_of(pencil), way, counted, solutions)


def _refined(
    pencil: Pencil, inertia: Floats, images: Floats, own: Floats, own_inertia: Floats
) -> tuple[Floats, Floats]:
    """Rayleigh-Ritz in the space of A x: eigenvalues, ascending, and mass-normalised shapes.

    inertia: b = M x; images: z = (K - s M)^-1 b on all rows; own, own_inertia: z and M z on the
    rows with mass. z^T (K - s M) z is z^T b: no product with K.
    """
    energy, mass = own.T @ inertia, own.T @ own_inertia
    lengths = np.sqrt(np.diag(mass))
    energy, mass = (0.5 * (a + a.T) / np.outer(lengths, lengths) for a in (energy, mass))
    above_shift, ritz = eigh(energy, mass)
    shapes = dgemm(1.0, images, np.asfortranarray(ritz / lengths[:, None]))
    return above_shift + _shift_of(pencil), shapes


def _shift_of(pencil: Pencil) -> float:
    assert pencil.shift is not None
    return pencil.shift
