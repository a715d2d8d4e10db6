"""Response functions of K(theta), M(theta) with modal damping, and their exact derivatives.

With a shift s > 0 the matrix A = K + s M is definite for free structures too. Modes are taken as

    M psi = tau A psi,   psi^T A psi = 1,   tau = 1 / (lambda + s),

so rigid ones (tau = 1 / s) and what has no mass (tau = 0) are modes like the rest. Those of the
band alone leave out what modes above it add. So they are joined by residual vectors A^-1 w and
A^-1 M A^-1 w of every sensor and force w: static flexibility and its first inertia term. The Ritz
modes of both together give the receptance, with zeta_r of each,

    H(w) = Psi g Psi^T,   1 / g_r = 1 - (w^2 + s) tau_r + i w d_r,
    d_r = 2 zeta_r u_r,   u_r = sqrt(tau_r - s tau_r^2).

This is a function of the pencil, whose derivative has divided differences in place of slopes
(Daleckii and Krein 1965). With a = Psi^T dA Psi, b = Psi^T dM Psi and y_j = g psi_j at a sensor,

    dH_jk = y_j^T [(w^2 + s) b - a - i w (e b + (d_r - e tau_r) a)] y_k,
    e_rs = (d_r - d_s) / (tau_r - tau_s),

entry by entry. Where modes of one damping ratio come together e has the limit
2 zeta (1 - s (tau_r + tau_s)) / (u_r + u_s), so repeated modes need no care of their own.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import linalg, sparse

from modetune.core.algebra.eigen import ModeSolver
from modetune.core.algebra.factorisation import factorise
from modetune.core.algebra.matrices import MatrixResult, projected, upper_product
from modetune.core.measurement.frf import Complexes
from modetune.core.modes import REPEATED, Floats, Integers, close_sets

#: Modes are taken up to so many times the highest frequency: a mode there adds to the flexibility
#: what its residual vectors have to (2 / 3)^4 of its amplitude and better.
REACH = 1.5
#: Shift over the square of the highest circular frequency: far below what residual vectors are of,
#: and far above the rounding of rigid modes.
SHIFT = 0.01
#: Part of a residual vector that is not rounding of those before it.
NEW = 1e-8
#: Modes whose eigenvalue is this part of the shift are rigid, and have no damping.
RIGID = 1e-5


@dataclass(frozen=True, slots=True)
class FrfModes:
    """Ritz modes of a model for response functions at some degrees of freedom.

    shapes: (n_equations, n_modes), psi; tau: (n_modes,), descending; seen: (n_dofs, n_modes), psi
    at the sensors and forces; damping: (n_modes,), ratios; shift: (rad/s)^2.
    """

    shapes: Floats
    tau: Floats
    seen: Floats
    damping: Floats
    shift: float

    @classmethod
    def of(
        cls, here: MatrixResult, dofs: sparse.csr_array, highest_hz: float, n_least: int
    ) -> FrfModes:
        """Without damping. dofs: (n_dofs, n_equations). Raises ModelError."""
        top = (2.0 * np.pi * highest_hz) ** 2
        shift = SHIFT * top
        shapes = _lowest(here, REACH**2 * top, n_least)
        shifted = here.stiffness + shift * here.mass
        factors = factorise(shifted)
        static = factors.solve(dofs.T.toarray())
        inertia = factors.solve(upper_product(here.upper_mass, static))
        basis = shapes / np.sqrt(np.sum(shapes * (shifted @ shapes), axis=0))
        for block in (static, inertia):
            basis = np.hstack([basis, _beside(basis, block, shifted)])
        # once more, so that rounding of the first pass is none of the second
        lower = linalg.cholesky(basis.T @ (shifted @ basis), lower=True)
        basis = linalg.solve_triangular(lower, basis.T, lower=True).T
        tau, turn = np.linalg.eigh(projected(here.upper_mass, basis))
        tau, psi = np.maximum(tau[::-1], 0.0), basis @ turn[:, ::-1]
        return cls(psi, tau, np.asarray(dofs @ psi), np.zeros(tau.size), shift)

    def damped(self, ratios: Floats) -> FrfModes:
        """With ratios (n_modes,) of the modes; of repeated ones their mean, of rigid ones none."""
        own = ratios.copy()
        own[1.0 - self.shift * self.tau < RIGID] = 0.0
        hz = np.sqrt(np.maximum(1.0 / np.maximum(self.tau, 1e-300) - self.shift, 0.0))
        for alike in close_sets(hz, REPEATED):
            own[alike] = own[alike].mean()
        return FrfModes(self.shapes, self.tau, self.seen, own, self.shift)

    @property
    def root(self) -> Floats:
        """u, (n_modes,)."""
        return np.asarray(np.sqrt(np.maximum(self.tau - self.shift * self.tau**2, 0.0)))

    def gained(self, omega: Floats, dof: int) -> Complexes:
        """y of a degree of freedom at circular frequencies, (n_lines, n_modes)."""
        w = omega[:, None]
        d = 2.0 * self.damping * self.root
        return np.asarray(self.seen[dof] / (1.0 - (w**2 + self.shift) * self.tau + 1j * w * d))

    def receptance(self, omega: Floats, output: int, force: int) -> Complexes:
        """H of a sensor and a force, rows of `seen`, (n_lines,), in the deck's units."""
        return np.asarray(self.gained(omega, output) @ self.seen[force])

    def change(
        self, upper_stiffness: sparse.csr_array, upper_mass: sparse.csr_array
    ) -> tuple[Floats, Floats, Floats]:
        """a, b, and what goes with i w, (n_modes, n_modes) each; of dK and dM."""
        b = projected(upper_mass, self.shapes)
        a = projected(upper_stiffness, self.shapes) + self.shift * b
        u, zeta, tau = self.root, self.damping, self.tau
        both = u[:, None] + u
        apart, ratios = tau[:, None] - tau, zeta[:, None] - zeta
        with np.errstate(divide="ignore", invalid="ignore"):
            e = (zeta[:, None] + zeta) * (1.0 - self.shift * (tau[:, None] + tau)) / both
            e = np.where(both > 0.0, e, 0.0)
            e = e + np.where((ratios != 0.0) & (apart != 0.0), ratios * both / apart, 0.0)
        return a, b, e * b + (2.0 * (zeta * u)[:, None] - e * tau[:, None]) * a

    def slope(
        self, omega: Floats, output: int, force: int, change: tuple[Floats, Floats, Floats]
    ) -> Complexes:
        """dH of a sensor and a force, (n_lines,)."""
        a, b, c = change
        left, right = self.gained(omega, output), self.gained(omega, force)
        stiff, mass, damp = (np.sum((left @ part) * right, axis=1) for part in (a, b, c))
        return np.asarray((omega**2 + self.shift) * mass - stiff - 1j * omega * damp)


def _lowest(here: MatrixResult, beyond: float, n_least: int) -> Floats:
    """Mode shapes up to the first eigenvalue beyond a bound, at least n_least where there are."""
    size = int(np.count_nonzero(here.upper_mass.diagonal()))
    n_modes = min(max(n_least, 8), size)
    solver = ModeSolver()
    while True:
        found = solver.solve(here.upper_stiffness, here.upper_mass, n_modes)
        if n_modes == size or found.eigenvalues[-1] > beyond:
            return np.asarray(found.shapes)
        n_modes = min(2 * n_modes, size)


def _beside(basis: Floats, block: Floats, shifted: sparse.csr_array) -> Floats:
    """What a block has beside a basis that is orthonormal to A, likewise orthonormal."""
    lengths = np.sqrt(np.sum(block * (shifted @ block), axis=0))
    own = block / np.where(lengths > 0.0, lengths, 1.0)
    for _ in range(2):
        own = own - basis @ (basis.T @ (shifted @ own))
    values, turn = np.linalg.eigh(own.T @ (shifted @ own))
    kept: Integers = np.flatnonzero(values > NEW**2 * own.shape[1] + 1e-13)
    return np.asarray(own @ turn[:, kept] / np.sqrt(values[kept]))
