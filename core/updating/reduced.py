"""A reduced model of a few dozen vectors that knows the modes for all parameter values.

The modes of K(theta), M(theta) are sought as phi = V x with a fixed basis V of modes at one or
more values and their derivatives there (Fox and Miura 1971; Balmes 1996). As K and M are sums of
parts (`core/updating/parameter_matrices`), so are the projected ones, and r x r matrices are all
that is left:

    K_r(theta) = V^T K_ref V + sum (theta_c^k - ref_c^k) V^T K_ck V,   K_r x = lambda M_r x.

By Rayleigh's principle errors of eigenvalues are the square of those of shapes. At the values
where the basis was made, modes and the eigenvalues' first derivatives are those of the full model,
as the modes are in the basis; the shapes' first derivatives are nearly so. Away from there the
shapes' error grows with the distance times what these lack, some 10^-3, and with its square, the
eigenvalues' with the square of that. It is solved as M_r x = mu (K_r - s M_r) x,
lambda = s + 1 / mu, as M_r is singular where a vector moves no mass. Derivatives within the
reduced space use all of its modes:

    d phi_i = sum_k x_k x_k^T (lambda_i dM - dK) phi_i / (1 - mu_k / mu_i)
              - 1/2 phi_i phi_i^T dM phi_i

with x_k^T (K_r - s M_r) x_k = 1, the terms of modes of the same cluster left out, as they move
nothing that is compared (`core/correlation/clusters`). How the basis comes to be:
`core/updating/reduced_basis`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import LinAlgError, eigh

from modetune.core.errors import ModesError
from modetune.core.modes import CLOSE, Floats, Integers, close_labels
from modetune.core.updating.parameter_matrices import powers_moved, powers_slopes
from modetune.core.updating.sensitivity import ModeDerivatives

#: Eigenvalues of the flexibility below this share of the largest are of vectors without mass.
LEAST_MASS = 1e-12


@dataclass(frozen=True, slots=True)
class ReducedPart:
    """What a parameter adds to a projected matrix: values (n_powers, r, r), a matrix a power."""

    column: int
    powers: tuple[int, ...]
    values: Floats

    def moved(self, value: float, reference: float) -> Floats:
        """What it adds at a parameter value beyond the reference, (r, r)."""
        factors = powers_moved(self.powers, value, reference)
        return np.asarray(factors @ self.values.reshape(factors.size, -1)).reshape(
            self.values.shape[1:]
        )

    def slope(self, value: float) -> Floats:
        """Its derivative at a parameter value, (r, r)."""
        return np.asarray(np.tensordot(powers_slopes(self.powers, value), self.values, axes=1))


@dataclass(frozen=True, slots=True)
class ReducedModel:
    """A model projected on a basis of r vectors.

    reference: (n_parameters,), relative values of the base. shift: (rad/s)^2, below all
    eigenvalues. base_stiffness, base_mass: (r, r) there. stiffness, mass: parts. rows:
    (n_rows, r), the basis at the wanted degrees of freedom.
    """

    reference: Floats
    shift: float
    base_stiffness: Floats
    base_mass: Floats
    stiffness: tuple[ReducedPart, ...]
    mass: tuple[ReducedPart, ...]
    rows: Floats

    def __post_init__(self) -> None:
        square = (self.rows.shape[1],) * 2
        whole = {self.base_stiffness.shape, self.base_mass.shape}
        if whole | {part.values.shape[1:] for part in (*self.stiffness, *self.mass)} != {square}:
            raise ModesError("the matrices of a reduced model do not fit its basis")

    @property
    def size(self) -> int:
        """Number of basis vectors, r."""
        return self.rows.shape[1]

    def at(self, theta: Floats) -> tuple[Floats, Floats]:
        """Projected stiffness and mass (r, r) at these values (n_parameters,)."""
        stiffness, mass = self.base_stiffness.copy(), self.base_mass.copy()
        for whole, parts in ((stiffness, self.stiffness), (mass, self.mass)):
            for part in parts:
                whole += part.moved(theta[part.column], self.reference[part.column])
        return stiffness, mass

    def modes(self, theta: Floats, n_modes: int) -> tuple[Floats, Floats]:
        """The lowest modes at these values (n_parameters,).

        Returns eigenvalues (n_modes,) ascending, (rad/s)^2, and mass-normalised shapes
        (n_rows, n_modes). Raises ModesError where the reduced model has no such modes.
        """
        eigenvalues, combined = self.combinations(theta, n_modes)
        return eigenvalues, self.rows @ combined

    def combinations(self, theta: Floats, n_modes: int) -> tuple[Floats, Floats]:
        """As `modes`, the shapes by what they have of each vector of the basis, (r, n_modes)."""
        return lowest(*self.at(theta), self.shift, n_modes)

    def derivatives(
        self, theta: Floats, modes: Integers, shapes: Floats | None = None
    ) -> ModeDerivatives:
        """Derivatives of modes with respect to all parameters, exact in the reduced space.

        theta: (n_parameters,); modes: positions of the wanted ones. shapes: (n_rows, n_wanted),
        those of which they shall be the derivatives, as another solver may have turned them the
        other way round, or close ones by any angle; those of `modes` by default.
        Raises ModesError where the reduced model has no such modes.
        """
        inverted, vectors = self._solved(theta)
        if int(modes.max(initial=-1)) >= self.size:
            raise ModesError(f"the reduced model of {self.size} vectors has no mode {modes.max()}")
        d_lam = np.zeros((modes.size, self.reference.size))
        d_phi = np.zeros((self.size, modes.size, self.reference.size))
        close = _close(inverted, modes, self.shift)
        if shapes is None:
            shapes = self.modes(theta, int(modes.max()) + 1)[1][:, modes]
        near = np.flatnonzero(close.any(axis=1))
        turn = np.zeros(close.shape)
        turn[near] = _turn(inverted[near], self.rows @ vectors[:, near], close[near], shapes)
        phi = (vectors / np.sqrt(np.abs(inverted))) @ turn
        eigenvalues = (self.shift + 1.0 / inverted) @ turn**2
        apart = 1.0 - inverted[:, None] * (eigenvalues - self.shift)
        dividing = np.where(close, 0.0, 1.0 / np.where(close, 1.0, apart))
        for column in range(self.reference.size):
            value = float(theta[column])
            stiffness, mass = (
                sum(
                    (part.slope(value) @ phi for part in parts if part.column == column),
                    np.zeros_like(phi),
                )
                for parts in (self.stiffness, self.mass)
            )
            d_lam[:, column] = np.sum(phi * (stiffness - eigenvalues * mass), axis=0)
            forces = vectors.T @ (eigenvalues * mass - stiffness)
            own = -0.5 * np.sum(phi * mass, axis=0) * phi
            d_phi[:, :, column] = vectors @ (forces * dividing) + own
        return ModeDerivatives(d_lam, np.tensordot(self.rows, d_phi, axes=1))

    def _solved(self, theta: Floats) -> tuple[Floats, Floats]:
        """mu (r,), descending, and vectors (r, r) with x^T (K - s M) x = 1."""
        return _inverted(*self.at(theta), self.shift, self.size)


def lowest(stiffness: Floats, mass: Floats, shift: float, n_modes: int) -> tuple[Floats, Floats]:
    """The lowest modes of small matrices (r, r), some vectors of which may be without mass.

    shift: (rad/s)^2, below all eigenvalues. Returns eigenvalues (n_modes,) ascending and
    mass-normalised shapes (r, n_modes). Raises ModesError where there are no such modes.
    """
    size = mass.shape[0]
    inverted, vectors = _inverted(stiffness, mass, shift, min(n_modes, size))
    with_mass = int(np.sum(inverted > LEAST_MASS * inverted[0]))
    if n_modes > with_mass:
        raise ModesError(
            f"{n_modes} modes were asked of a reduced model that has {with_mass}; "
            "make it of more modes"
        )
    return shift + 1.0 / inverted, vectors / np.sqrt(inverted)


def _inverted(stiffness: Floats, mass: Floats, shift: float, count: int) -> tuple[Floats, Floats]:
    """The largest mu (count,), descending, and vectors (r, count) with x^T (K - s M) x = 1."""
    size = mass.shape[0]
    some = None if count == size else (size - count, size - 1)
    try:
        inverted, vectors = eigh(mass, stiffness - shift * mass, subset_by_index=some)
    except (LinAlgError, ValueError) as error:
        raise ModesError(
            "a reduced model has an eigenvalue below its shift or no modes at all at some "
            "parameter values"
        ) from error
    return inverted[::-1], vectors[:, ::-1]


def _close(inverted: Floats, modes: Integers, shift: float) -> NDArray[np.bool_]:
    """Which modes are in the cluster of each wanted one, itself included, (r, n_wanted)."""
    known = inverted > LEAST_MASS * inverted[0]
    hz = np.sqrt(np.abs(shift + 1.0 / inverted[known]))
    labels = np.zeros(inverted.size, dtype=np.int64)
    labels[known] = close_labels(hz, CLOSE)
    found: NDArray[np.bool_] = (labels[:, None] == labels[modes]) & known[:, None] & known[modes]
    return found


def _turn(inverted: Floats, seen: Floats, close: NDArray[np.bool_], shapes: Floats) -> Floats:
    """What brings modes to the shapes given for the wanted ones, (r, n_wanted).

    Alone a mode can be turned the other way round; close ones by the rotation that fits best, of
    some of them too (orthogonal Procrustes: Schoenemann 1966). seen: (n_rows, r).
    """
    turn, alone = np.zeros(close.shape), np.flatnonzero(close.sum(axis=0) == 1)
    own = close[:, alone].argmax(axis=0)
    turn[own, alone] = np.where((seen[:, own] * shapes[:, alone]).sum(axis=0) < 0.0, -1.0, 1.0)
    for members in np.unique(np.delete(close, alone, axis=1), axis=1).T:
        wanted = np.flatnonzero((close.T == members).all(axis=1))
        basis = seen[:, members] / np.sqrt(inverted[members])
        left, _, right = np.linalg.svd(basis.T @ shapes[:, wanted], full_matrices=False)
        turn[np.ix_(members, wanted)] = left @ right
    return turn
