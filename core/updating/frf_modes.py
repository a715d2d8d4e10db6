"""Response functions of K(theta), M(theta) with damping, and their exact derivatives.

With a shift s > 0 the matrix A = K + s M is definite for free structures too. Modes are taken as

    M psi = tau A psi,   psi^T A psi = 1,   tau = 1 / (lambda + s),

so rigid ones (tau = 1 / s) and massless motions (tau = 0) are modes like all others. Those of the
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
2 zeta (1 - s (tau_r + tau_s)) / (u_r + u_s), so repeated modes need no special case.

Dampers and loss factors, C and H, join modes of their own numbers and others. There Z takes the
place of the diagonal 1 / g,

    y_j = Z^-1 psi_j,   Z = 1 / g + i w Psi^T C Psi + i Psi^T H Psi,

i w Psi^T dC Psi + i Psi^T dH Psi is added to the brackets, and A^-1 C phi, A^-1 H phi
of the modes of the band join the residual vectors: the motion from dampers beyond these modes.

Near a set the same Ritz vectors serve, together with the derivatives of its modes by each
parameter: a pencil of some hundred unknowns for all values of the parameters (`near`). Its H and
dH are exact at the set and err by the square of a change from it.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from scipy import linalg, sparse

from modetune.core.algebra.damped_modes import DampedSystem
from modetune.core.algebra.eigen import ModeSolver
from modetune.core.algebra.factorisation import factorise
from modetune.core.algebra.krylov import GUARD
from modetune.core.algebra.matrices import MatrixResult, projected, upper_product
from modetune.core.errors import ModesError
from modetune.core.measurement.response_functions import Complexes
from modetune.core.modes import REPEATED, Floats, Integers, close_sets
from modetune.core.updating.parameter_matrices import ParameterMatrices

#: Modes are taken up to this multiple of the highest frequency: residual vectors replace a mode
#: there with an error of at most (2 / 3)^4 of its amplitude.
REACH = 1.5
#: Shift over the square of the highest circular frequency: far below what residual vectors are of,
#: and far above the rounding of rigid modes.
SHIFT = 0.01
#: Equations up to which all modes of a model are taken.
SMALL = 400
#: Part of a residual vector that is not rounding of those before it.
NEW = 1e-8
#: Modes whose eigenvalue is this part of the shift are rigid, and have no damping.
RIGID = 1e-5


@dataclass(frozen=True, slots=True)
class FrfModes:
    """Ritz modes of a model for response functions at some degrees of freedom.

    shapes: (n_equations, n_modes), psi; tau: (n_modes,), descending; seen: (n_dofs, n_modes), psi
    at the sensors and forces; damping: (n_modes,), ratios; shift: (rad/s)^2. viscous, structural:
    (n_modes, n_modes), of dampers between them; (0, 0) without.
    """

    shapes: Floats
    tau: Floats
    seen: Floats
    damping: Floats
    shift: float
    viscous: Floats = field(default_factory=lambda: np.zeros((0, 0)))
    structural: Floats = field(default_factory=lambda: np.zeros((0, 0)))

    @classmethod
    def of(
        cls,
        here: MatrixResult,
        dofs: sparse.csr_array,
        highest_hz: float,
        n_least: int,
        like: FrfModes | None = None,
        system: DampedSystem | None = None,
    ) -> FrfModes:
        """Without ratios. dofs: (n_dofs, n_equations); n_least: modes to begin with; like: of a
        similar model; system: where dampers count. Of a small model these are all modes. Raises
        ModelError, ModesError."""
        top = (2.0 * np.pi * highest_hz) ** 2
        shift = SHIFT * top
        if here.nodes.size <= SMALL:
            stiffness, mass = here.stiffness.toarray(), here.mass.toarray()
            return cls.whole(stiffness, mass, dofs.toarray(), shift).among(system)
        shapes = _lowest(here, REACH**2 * top, n_least, like)
        shifted = here.stiffness + shift * here.mass
        factors = factorise(shifted)
        static = factors.solve(dofs.T.toarray())
        inertia = factors.solve(upper_product(here.upper_mass, static))
        basis = shapes / np.sqrt(np.sum(shapes * (shifted @ shapes), axis=0))
        damped = () if system is None else (system.viscous, system.structural)
        moved = [factors.solve(matrix @ basis) for matrix in damped if matrix.nnz]
        for block in (static, inertia, *moved):
            basis = np.hstack([basis, _beside(basis, block, shifted)])
        # once more, so that rounding of the first pass is none of the second
        found = cls.whole(
            projected(here.upper_stiffness, basis),
            projected(here.upper_mass, basis),
            np.asarray(dofs @ basis),
            shift,
        )
        return replace(found, shapes=basis @ found.shapes).among(system)

    @classmethod
    def whole(cls, stiffness: Floats, mass: Floats, dofs: Floats, shift: float) -> FrfModes:
        """All modes of a small pencil (r, r), without damping; dofs: (n_dofs, r).

        Raises ModesError where some motion has neither stiffness nor mass."""
        try:
            tau, psi = linalg.eigh(mass, stiffness + shift * mass)
        except linalg.LinAlgError as error:
            raise ModesError("a motion of the model has neither stiffness nor mass") from error
        tau, psi = np.maximum(tau[::-1], 0.0), psi[:, ::-1]
        return cls(psi, tau, dofs @ psi, np.zeros(tau.size), shift)

    def among(self, system: DampedSystem | None) -> FrfModes:
        """With the dampers of a system of the same equations."""
        if system is None:
            return self
        viscous, structural = (
            self.shapes.T @ (a @ self.shapes) for a in (system.viscous, system.structural)
        )
        return replace(self, viscous=viscous, structural=structural)

    def damped(self, ratios: Floats) -> FrfModes:
        """With ratios (n_modes,) of the modes; of repeated ones their mean, of rigid ones none."""
        own = ratios.copy()
        own[1.0 - self.shift * self.tau < RIGID] = 0.0
        hz = np.sqrt(np.maximum(1.0 / np.maximum(self.tau, 1e-300) - self.shift, 0.0))
        for alike in close_sets(hz, REPEATED):
            own[alike] = own[alike].mean()
        return replace(self, damping=own)

    @property
    def root(self) -> Floats:
        """u, (n_modes,)."""
        return np.asarray(np.sqrt(np.maximum(self.tau - self.shift * self.tau**2, 0.0)))

    def lines(self, omega: Floats, outputs: Integers | int, forces: Integers | int) -> FrfLines:
        """The functions of sensors and forces, rows of `seen`: one, or one a frequency (n_lines,).

        omega: (n_lines,), circular frequencies.
        """
        w = omega[:, None]
        damped = 1j * w * (2.0 * self.damping * self.root)
        inverse = 1.0 - (w**2 + self.shift) * self.tau + damped
        ends = [np.broadcast_to(dofs, omega.shape) for dofs in (outputs, forces)]
        if not self.viscous.size:
            left, right = (np.asarray(self.seen[dofs] / inverse) for dofs in ends)
            return FrfLines(self, omega, left, right, ends[1])
        found = [np.empty(inverse.shape, np.complex128) for _ in ends]
        for line in np.unique(omega):
            rows = np.flatnonzero(omega == line)
            z = np.diag(inverse[rows[0]]) + 1j * (line * self.viscous + self.structural)
            wanted, place = np.unique([dofs[rows] for dofs in ends], return_inverse=True)
            gained = np.linalg.solve(z, self.seen[wanted].T).T
            for own, places in zip(found, place.reshape(2, rows.size), strict=True):
                own[rows] = gained[places]
        return FrfLines(self, omega, found[0], found[1], ends[1])

    def change(
        self,
        upper_stiffness: sparse.csr_array,
        upper_mass: sparse.csr_array,
        damped: DampedSystem | None = None,
    ) -> tuple[Floats, ...]:
        """a, b, and what goes with i w, (n_modes, n_modes) each; of dK and dM. damped: dC and dH,
        where dampers count: then what goes with i is there as well."""
        b = projected(upper_mass, self.shapes)
        a = projected(upper_stiffness, self.shapes) + self.shift * b
        u, zeta, tau = self.root, self.damping, self.tau
        both = u[:, None] + u
        apart, ratios = tau[:, None] - tau, zeta[:, None] - zeta
        with np.errstate(divide="ignore", invalid="ignore"):
            e = (zeta[:, None] + zeta) * (1.0 - self.shift * (tau[:, None] + tau)) / both
            e = np.where(both > 0.0, e, 0.0)
            e = e + np.where((ratios != 0.0) & (apart != 0.0), ratios * both / apart, 0.0)
        by_rate = e * b + (2.0 * (zeta * u)[:, None] - e * tau[:, None]) * a
        if damped is None:
            return a, b, by_rate
        own = self.among(damped)
        return a, b, by_rate + own.viscous, own.structural


@dataclass(frozen=True, slots=True)
class FrfLines:
    """Response functions at frequencies, in the deck's units.

    omega: (n_lines,), circular. left, right: (n_lines, n_modes), y of each sensor and each force.
    forces: (n_lines,), rows of the modes' `seen`.
    """

    modes: FrfModes
    omega: Floats
    left: Complexes
    right: Complexes
    forces: Integers

    @property
    def receptance(self) -> Complexes:
        """H, (n_lines,)."""
        return np.asarray(np.sum(self.left * self.modes.seen[self.forces], axis=1))

    def slope(self, change: tuple[Floats, ...]) -> Complexes:
        """dH, (n_lines,); change: of `FrfModes.change`."""
        whole = np.hstack(change)  # real, at half the price of complex times real
        real, imaginary = self.left.real @ whole, self.left.imag @ whole
        n = len(change)
        stiff, mass, damp, *lost = (
            np.sum((u + 1j * v) * self.right, axis=1)
            for u, v in zip(np.split(real, n, 1), np.split(imaginary, n, 1), strict=True)
        )
        found = (self.omega**2 + self.modes.shift) * mass - stiff - 1j * self.omega * damp
        return np.asarray(found - 1j * lost[0] if lost else found)

    def slope_by_damping(self, ratios: Floats) -> Complexes:
        """The same where the modes' ratios change by these, (n_modes,), as `damped` takes them."""
        change = self.modes.root * self.modes.damped(ratios).damping
        return np.asarray(-2j * self.omega * ((self.left * self.right) @ change))


def near(
    model: ParameterMatrices, theta: Floats, modes: FrfModes, highest_hz: float
) -> tuple[ParameterMatrices, Floats]:
    """A model of few unknowns for response functions next to a set, and its vectors (n, r).

    modes: of the set theta (n_parameters,). Raises ModelError.
    """
    here = model.at(theta)
    shifted = here.stiffness + modes.shift * here.mass
    beyond = (2.0 * np.pi * REACH * highest_hz) ** 2 + modes.shift
    own = np.flatnonzero(modes.tau * beyond >= 1.0)
    moved = []
    for column in range(theta.size):
        stiff, heavy = model.products(theta, column, modes.shapes[:, own])
        moved.append(stiff - heavy * (1.0 / modes.tau[own] - modes.shift))
    answers = factorise(shifted).solve(np.hstack(moved))
    vectors = np.hstack([modes.shapes, _beside(modes.shapes, answers, shifted)])

    return model.on(vectors), vectors


def _lowest(here: MatrixResult, beyond: float, n_least: int, like: FrfModes | None) -> Floats:
    """Mode shapes up to the first eigenvalue beyond a bound, at least n_least where there are."""
    size = int(np.count_nonzero(here.upper_mass.diagonal()))
    n_modes, solver = min(max(n_least, 8), size), ModeSolver()
    start = None if like is None else like.shapes[:, : n_modes + GUARD]
    while True:
        found = solver.solve(here.upper_stiffness, here.upper_mass, n_modes, start=start)
        if n_modes == size or found.eigenvalues[-1] > beyond:
            return np.asarray(found.shapes)
        n_modes = min(2 * n_modes, size)


def _beside(basis: Floats, block: Floats, shifted: sparse.csr_array) -> Floats:
    """Return the part of a block outside a basis orthonormal to A, likewise orthonormal."""
    lengths = np.sqrt(np.sum(block * (shifted @ block), axis=0))
    own = block / np.where(lengths > 0.0, lengths, 1.0)
    for _ in range(2):
        own = own - basis @ (basis.T @ (shifted @ own))
    values, turn = np.linalg.eigh(own.T @ (shifted @ own))
    kept: Integers = np.flatnonzero(values > NEW**2 * own.shape[1] + 1e-13)
    return np.asarray(own @ turn[:, kept] / np.sqrt(values[kept]))
