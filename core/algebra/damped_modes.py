"""Damped modes: the quadratic eigenvalue problem, from the real modes on.

    (K + i H + s C + s^2 M) x = T(s) x = 0,   w = |s|,   zeta = -Re(s) / |s|,

H structural, C viscous damping; modes come in the half plane Im(s) > 0 (there i H dissipates). On
the space of the real modes Phi, with s x as a second unknown (state space),

    [ 0               I          ] [ q ]     [ q ]
    [ -Phi^T(K+iH)Phi -Phi^T C Phi ] [s q] = s [s q],

is a small problem that LAPACK solves whole. What the modes left out add is brought in one by one:
inverse iteration T(s) y = T'(s) x on all equations, s being the root of the quadratic

    s^2 x^T M x + s x^T C x + x^T (K + i H) x = 0

next to the last one; T is symmetric, so the error of s is the square of that of x. A mode costs a
factorisation of a complex matrix a step, one or two of them where damping is light.

Derivatives need no other vector, since left and right ones are one:

    ds = -x^T (dK + i dH + s dC + s^2 dM) x / x^T (2 s M + C) x.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import linalg, sparse
from scipy.sparse.csgraph import connected_components
from scipy.sparse.linalg import splu

from modetune.core.assignment import least_cost
from modetune.core.errors import ModesError
from modetune.core.modes import Floats, Integers

logger = logging.getLogger(__name__)

Complexes = NDArray[np.complex128]
#: Relative change of s that ends the iteration, 100 times the rounding of a sum of squares; and how
#: many times the rounding of x^T K x, whose terms are far above the sum where parts are stiff.
SETTLED, ROUNDED = 1e-13, 4.0 * float(np.finfo(np.float64).eps)
MOST_STEPS = 12
BESIDE = 1.0 + 1e-9
#: Least squared cosine (in M) of a damped mode with the real one that it grew from, and the least
#: one of a real mode that a mixture is made of.
STILL_ITSELF, TAKES_PART = 0.7, 0.1
#: Relative difference of repeated roots, some digits above the square root of the rounding, which
#: is what a defective pair is off by.
ALIKE = 1e-7
#: Im(s) / |s| of a root that oscillates: its damping ratio is below 1 by half the square of this.
OVERDAMPED = 1e-3


@dataclass(frozen=True, slots=True)
class DampedSystem:
    """Matrices (n, n) with both triangles, symmetric: stiffness, mass, viscous and structural
    damping."""

    stiffness: sparse.csr_array
    mass: sparse.csr_array
    viscous: sparse.csr_array
    structural: sparse.csr_array

    @property
    def complex_stiffness(self) -> sparse.csr_array:
        """K + i H."""
        return sparse.csr_array(self.stiffness + 1j * self.structural)

    def slope(self, s: complex, x: Complexes, change: DampedSystem) -> complex:
        """ds with respect to what changes the matrices so; x: (n,), the mode of s."""
        stiff = np.asarray(change.complex_stiffness @ x)
        forces = stiff + s * (change.viscous @ x) + s**2 * (change.mass @ x)
        inertia = np.asarray(2.0 * s * (self.mass @ x) + self.viscous @ x)
        return complex(-np.sum(x * forces) / np.sum(x * inertia))


@dataclass(frozen=True, slots=True)
class DampedModes:
    """roots: (n_modes,), s in rad/s; shapes: (n, n_modes), x^T M x = 1."""

    roots: Complexes
    shapes: Complexes

    @property
    def damping_ratios(self) -> Floats:
        """(n_modes,), fraction of critical."""
        return np.asarray(-self.roots.real / np.abs(self.roots))


def ratio_slope(s: complex, change: complex) -> float:
    """The change of the damping ratio with that of its root."""
    size = abs(s)
    return -change.real / size + s.real * (s.conjugate() * change).real / size**3


def damped_modes(
    system: DampedSystem, shapes: Floats, wanted: Integers, like: Complexes | None = None
) -> DampedModes:
    """The damped modes that real ones become.

    shapes: (n, n_modes), mass-normalised, those of the undamped system; wanted: positions. like:
    (n_wanted,), roots s of a test, which separate modes that damping mixes. Raises
    ModesError where a mode is overdamped, or mixed without a test.
    """
    roots, vectors = _on_real_modes(system, shapes)
    chosen = _chosen(roots, vectors, wanted, like)
    found = []
    for mode, place in zip(wanted.tolist(), chosen, strict=True):
        # Of repeated roots any vector is one, also such that x^T M x = 0; a real shape is none.
        alike = np.abs(roots - roots[place]) <= ALIKE * np.abs(roots[place])
        start = shapes[:, mode] if alike.sum() > 1 else shapes @ vectors[:, place]
        found.append(_of_mode(system, complex(roots[place]), start.astype(np.complex128), mode))
    return DampedModes(
        np.array([root for root, _ in found]), np.column_stack([shape for _, shape in found])
    )


def _on_real_modes(system: DampedSystem, shapes: Floats) -> tuple[Complexes, Complexes]:
    """Roots with Im(s) > 0 and vectors on the real modes, by LAPACK."""
    size = shapes.shape[1]
    whole = np.zeros((2 * size, 2 * size), dtype=np.complex128)
    whole[:size, size:] = np.eye(size)
    whole[size:, :size] = -shapes.T @ (system.complex_stiffness @ shapes)
    whole[size:, size:] = -shapes.T @ (system.viscous @ shapes)
    roots, vectors = linalg.eig(whole)
    # An overdamped mode has two real roots, of which structural damping makes small angles.
    above = roots.imag > np.abs(roots) * OVERDAMPED
    return roots[above], vectors[:size, above]


def _chosen(
    roots: Complexes, vectors: Complexes, wanted: Integers, like: Complexes | None
) -> list[int]:
    """The place of the root of each wanted mode.

    Real modes of which damping makes mixtures are one set, and so are their roots.
    """
    shares = np.abs(vectors) ** 2 / (np.abs(vectors) ** 2).sum(axis=0)
    mixed = shares.max(axis=0) < STILL_ITSELF
    joined = (shares[:, mixed] >= TAKES_PART).astype(np.float64)
    _, labels = connected_components(joined @ joined.T, directed=False)
    chosen = [-1] * wanted.size
    for label in dict.fromkeys(labels[wanted].tolist()):
        members = np.flatnonzero(labels == label)
        own = np.flatnonzero(shares[members].sum(axis=0) >= 0.5)
        asked = np.flatnonzero(labels[wanted] == label)
        names = " and ".join(str(mode + 1) for mode in members.tolist())
        if own.size < members.size:
            raise ModesError(
                f"mode {names} of the model is overdamped: it no longer oscillates, so that it "
                "has no damping ratio below 1"
            )
        if members.size == 1:
            chosen[asked[0]] = int(own[np.argmax(shares[members[0], own])])
            continue
        if like is None:
            raise ModesError(f"damping mixes modes {names} of the model wholly")
        logger.info(
            "damping mixes modes %s of the model: those of the test go with the damped ones whose "
            "frequencies and ratios are nearest", names,
        )  # fmt: skip
        apart = np.abs(roots[own] / like[asked, None] - 1.0) ** 2
        for row, column in zip(*least_cost(apart), strict=True):
            chosen[asked[row]] = int(own[column])
    return chosen


def _of_mode(
    system: DampedSystem, root: complex, x: Complexes, mode: int
) -> tuple[complex, Complexes]:
    """The root and the vector (n,) of one mode on all equations, from near ones."""
    stiff, sizes = system.complex_stiffness, abs(system.stiffness)
    for step in range(MOST_STEPS):
        x = x / np.sqrt(np.sum(x * np.asarray(system.mass @ x)))
        terms = [1.0, *(np.sum(x * np.asarray(part @ x)) for part in (system.viscous, stiff))]
        before, root = root, complex(min(np.roots(terms), key=lambda s: abs(s - root)))
        # On the real modes' space the first root is its own already, whatever lies outside.
        apart = abs(root - before) / abs(root)
        size = float(np.sum(np.abs(x) * np.asarray(sizes @ np.abs(x)))) / abs(root) ** 2
        if step and apart <= SETTLED + ROUNDED * size:
            return root, x
        near = root * BESIDE  # at the root itself a pivot may be zero
        pencil = sparse.csc_array(stiff + near * system.viscous + near**2 * system.mass)
        y = splu(pencil).solve(np.asarray(2.0 * root * (system.mass @ x) + system.viscous @ x))
        x = y / np.abs(y).max()
    raise ModesError(
        f"the iteration for damped mode {mode + 1} of the model did not settle: it is next to "
        "being overdamped"
    )
