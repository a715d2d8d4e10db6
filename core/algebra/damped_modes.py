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

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import linalg, sparse
from scipy.sparse.linalg import splu

from modetune.core.errors import ModesError
from modetune.core.modes import Floats, Integers

Complexes = NDArray[np.complex128]
#: Relative change of s that ends the iteration, 100 times the rounding of a sum of squares.
SETTLED = 1e-13
MOST_STEPS = 12
BESIDE = 1.0 + 1e-9
#: Least squared cosine (in M) of a damped mode with the real one that it grew from.
STILL_ITSELF = 0.5


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


def damped_modes(system: DampedSystem, shapes: Floats, wanted: Integers) -> DampedModes:
    """The damped modes that real ones become.

    shapes: (n, n_modes), mass-normalised, those of the undamped system; wanted: positions.
    Raises ModesError where a mode is overdamped, or is no longer told from others.
    """
    roots, vectors = _on_real_modes(system, shapes)
    found = [_of_mode(system, shapes, roots, vectors, int(mode)) for mode in wanted]
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
    above = roots.imag > 0.0
    return roots[above], vectors[:size, above]


def _of_mode(
    system: DampedSystem, shapes: Floats, roots: Complexes, vectors: Complexes, mode: int
) -> tuple[complex, Complexes]:
    """The root and the vector (n,) of one mode, on all equations."""
    lost = f"mode {mode + 1} of the model is overdamped, or damping mixes it with others wholly"
    shares = np.abs(vectors[mode]) ** 2 / (np.abs(vectors) ** 2).sum(axis=0)
    if not shares.size or shares.max() < STILL_ITSELF:
        raise ModesError(lost)
    place = int(np.argmax(shares))
    root, x = complex(roots[place]), shapes @ vectors[:, place]
    stiff = system.complex_stiffness
    for step in range(MOST_STEPS):
        x = x / np.sqrt(x @ (system.mass @ x))
        terms = [1.0, x @ (system.viscous @ x), x @ (stiff @ x)]
        before, root = root, complex(min(np.roots(terms), key=lambda s: abs(s - root)))
        # On the real modes' space the first root is its own already, whatever lies outside.
        if step and abs(root - before) <= SETTLED * abs(root):
            if root.imag <= 0.0:
                raise ModesError(lost)
            return root, x
        near = root * BESIDE  # at the root itself a pivot may be zero
        pencil = sparse.csc_array(stiff + near * system.viscous + near**2 * system.mass)
        y = splu(pencil).solve(np.asarray(2.0 * root * (system.mass @ x) + system.viscous @ x))
        x = y / np.abs(y).max()
    raise ModesError(f"{lost}: its iteration did not settle")
