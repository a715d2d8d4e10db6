"""Reduced models: a few dozen vectors that give modes and derivatives for all parameter values.

The modes of K(theta), M(theta) are sought as phi = V x with a fixed basis V of modes at one or
more points and their derivatives there (Fox and Miura 1971; Balmes 1996). As K and M are sums of
parts (`core/updating/parameter_matrices`), so are the projected ones, and only r x r matrices
remain:

    K_r(theta) = V^T K_ref V + sum (theta_c^k - ref_c^k) V^T K_ck V,   K_r x = lambda M_r x.

**Modes and derivatives.** By Rayleigh's principle errors of eigenvalues are the square of those of
shapes. At the points where the basis was made, modes and first derivatives of eigenvalues are those
of the full model, as the modes are in the basis; first derivatives of shapes are nearly so. Away
from there the error of shapes grows with the distance times what these lack, some 10^-3, and with
its square; that of eigenvalues with the square of that. The problem is solved as
M_r x = mu (K_r - s M_r) x, lambda = s + 1 / mu, as M_r is singular where a vector moves no mass.
Derivatives within the reduced space use all of its modes:

    d phi_i = sum_k x_k x_k^T (lambda_i dM - dK) phi_i / (1 - mu_k / mu_i)
              - 1/2 phi_i phi_i^T dM phi_i

with x_k^T (K_r - s M_r) x_k = 1. Terms of modes of the same cluster are left out, as they move
nothing that is compared (`core/correlation/clusters`).

**Basis around one point.** The vectors Z respond to forces F that act on no known mode,
(K - s M) Z = F (`core/updating/derivative_vectors`), so no product with K is needed to make
V = [Phi, Z W] orthonormal with respect to K - s M, by W from the eigenvectors of

    Z^T (K - s M) Z = Z^T F,   and   V^T K V = diag(lambda - s, 1) + s V^T M V.

Vectors that hardly move (NEGLIGIBLE) and directions that the scaled others hardly have (RANK) are
left out. In this product unknowns without mass are not an obstacle, and nothing is lost to the
cancellation in K x of smooth x. Where the available inverse is that of a similar matrix, its
answers are approximate. They and an older basis then become directions in addition to the modes,
and K and M are projected on all of them. An older basis is kept as far as it is not in the new one
already and there is room; what is least outside it goes first. It does not respond to known forces,
so its directions are taken with respect to M + e diag(K), with e so small that only vectors that
move (nearly) no mass feel it.

**Basis over a range.** A model made at one point loses its modes with the distance from it. Where
many points are needed, the basis grows until it is valid all over their range (greedy reduced
basis: Prud'homme et al. 2002): of points spread over the range the worst one is solved in full, and
its modes join the basis, until the full solution there shows that nothing is missing.

**Error at a point.** What a reduced mode leaves of its equation, r = K phi - lambda M phi, moves
the structure by about w = (K_0 - s M_0)^-1 r, which is what the shape lacks. Its length is
estimated from its products with random loads g that have the variance of the masses: as
g^T w = z^T r with z = (K_0 - s M_0)^-1 g, a few vectors z, projected once together with the basis,
give it at any point from small matrices (probabilistic estimates: Smetana, Zahm and Patera 2019).
Eigenvalues err by the square of what shapes lack, times a factor that the full solution at the
worst point gives.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.linalg import LinAlgError, eigh

from modetune.core.algebra.eigen import ModeSolver, SolvedModes
from modetune.core.algebra.krylov import GUARD, with_random
from modetune.core.algebra.matrices import ROWS_AT_ONCE, projected, touched_product, upper_product
from modetune.core.algebra.pencil import shift_below
from modetune.core.errors import ModesError
from modetune.core.modes import CLOSE, Floats, Integers, close_labels
from modetune.core.updating.derivative_vectors import (
    NEGLIGIBLE,
    Answers,
    Inverse,
    KnownModes,
    derivative_answers,
)
from modetune.core.updating.parameter_matrices import (
    ParameterMatrices,
    ParameterMatrix,
    columns_of,
    dense_matrices,
    factors_moved,
    factors_slopes,
)
from modetune.core.updating.relation import Relation
from modetune.core.updating.sensitivity import ModeDerivatives

#: Eigenvalues of the flexibility below this share of the largest are of vectors without mass.
LEAST_MASS = 1e-12
#: A positive definite matrix times a block of vectors (n, k).
Weight = Callable[[Floats], Floats]

#: Most vectors of a basis.
MOST_VECTORS = 150
#: The reduced model's own shift in first elastic eigenvalues, where its maker's is nearer to zero.
LEAST_SHIFT = -1e-3
#: Squared length below which a direction of the scaled vectors depends on the others.
RANK = 1e-8
#: Squared length below which what an old basis has outside the new one is left out.
OLD_RANK = 1e-8
#: Vectors that are weighted at once: a product has three of the size of what it is made of.
COLUMNS_AT_ONCE = 8
#: Random loads: the estimate of a length is good to a quarter.
LOADS = 24
#: Sets at which the worst is looked for, and full solutions at most.
LOOKED_AT, SOLUTIONS = 48, 24
#: Numbers of all basis vectors at most, and vectors, whatever the model's size.
NUMBERS, LEAST_ROOM, MOST_ROOM = 120_000_000, 150, 400
#: Least stated error of shapes.
LEAST = 1e-12


@dataclass(frozen=True, slots=True)
class ReducedPart:
    """What a parameter adds to a projected matrix: values (n_powers, r, r), a matrix a power."""

    column: int
    powers: tuple[int, ...]
    values: Floats
    relation: Relation | None = None

    def moved(self, theta: Floats, reference: Floats) -> Floats:
        """What it adds at parameter values beyond the reference, (r, r)."""
        return self._sum(factors_moved(self, theta, reference))

    def slope(self, theta: Floats, column: int) -> Floats:
        """Its derivative with respect to a column at parameter values, (r, r)."""
        return self._sum(factors_slopes(self, theta, column))

    def _sum(self, factors: Floats) -> Floats:
        """Its matrices, each with its factor (n_powers,); `tensordot` takes five times as long."""
        size = self.values.shape[1:]
        return np.asarray(factors @ self.values.reshape(factors.size, -1)).reshape(size)


#: Up to this size all modes of a reduced model take less time than some of them.
SOLVED_WHOLE = 100
#: The newest solution: modes and derivatives at a point are wanted one after the other.
_latest: tuple[ReducedModel, bytes, tuple[Floats, Floats]] | None = None


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
                whole += part.moved(theta, self.reference)
        return stiffness, mass

    def matrices(self) -> ParameterMatrices:
        """The model as matrices of r equations."""
        stiffness, mass = ([(part, part.values) for part in parts]
                           for parts in (self.stiffness, self.mass))  # fmt: skip
        own = (self.base_stiffness, stiffness), (self.base_mass, mass)
        return dense_matrices(self.reference, *own)

    def modes(self, theta: Floats, n_modes: int) -> tuple[Floats, Floats]:
        """The lowest modes at these values (n_parameters,).

        Returns eigenvalues (n_modes,) ascending, (rad/s)^2, and mass-normalised shapes
        (n_rows, n_modes). Raises ModesError where the reduced model has no such modes.
        """
        eigenvalues, combined = self.combinations(theta, n_modes)
        return eigenvalues, self.rows @ combined

    def combinations(self, theta: Floats, n_modes: int) -> tuple[Floats, Floats]:
        """As `modes`, the shapes by what they have of each vector of the basis, (r, n_modes)."""
        if self.size > SOLVED_WHOLE:
            return lowest(*self.at(theta), self.shift, n_modes)
        return _with_mass(*self._solved(theta), self.shift, n_modes)

    def derivatives(
        self, theta: Floats, modes: Integers, shapes: Floats | None = None, of_shapes: bool = True
    ) -> ModeDerivatives:
        """Derivatives of modes with respect to all parameters, exact in the reduced space.

        theta: (n_parameters,); modes: positions of the wanted ones. shapes: (n_rows, n_wanted),
        those of which they shall be the derivatives, as another solver may have turned them the
        other way round, or close ones by any angle; those of `modes` by default. of_shapes: whether
        derivatives of shapes are wanted, else they have no rows.
        Raises ModesError where the reduced model has no such modes.
        """
        inverted, vectors = self._solved(theta)
        if int(modes.max(initial=-1)) >= self.size:
            raise ModesError(f"the reduced model of {self.size} vectors has no mode {modes.max()}")
        close = _close(inverted, modes, self.shift)
        near = np.flatnonzero(close.any(axis=1))
        turn = np.where(close, 1.0, 0.0)
        if of_shapes or (close.sum(axis=0) > 1).any():  # a mode's sign changes no eigenvalue
            if shapes is None:
                shapes = self.modes(theta, int(modes.max()) + 1)[1][:, modes]
            turn[near] = _turn(inverted[near], self.rows @ vectors[:, near], close[near], shapes)
        # Vectors without mass, which have no eigenvalue, are in no mode.
        phi = (vectors[:, near] / np.sqrt(np.abs(inverted[near]))) @ turn[near]
        eigenvalues = (self.shift + 1.0 / inverted[near]) @ turn[near] ** 2
        stiffness, mass = (
            self._changes(parts, theta, phi) for parts in (self.stiffness, self.mass)
        )
        change = stiffness - eigenvalues * mass
        d_lam = np.sum(phi * change, axis=1)
        if not of_shapes:
            return ModeDerivatives(d_lam.T, np.zeros((0, modes.size, theta.size)))
        apart = 1.0 - inverted[:, None] * (eigenvalues - self.shift)
        dividing = np.where(close, 0.0, 1.0 / np.where(close, 1.0, apart))
        own = -0.5 * np.sum(phi * mass, axis=1)[:, None, :] * phi
        d_phi = own - vectors @ (vectors.T @ change * dividing)
        return ModeDerivatives(d_lam.T, np.moveaxis(self.rows @ d_phi, 0, -1))

    def _changes(self, parts: Sequence[ReducedPart], theta: Floats, phi: Floats) -> Floats:
        """Derivatives of a matrix by each parameter times vectors (r, n), (n_parameters, r, n)."""
        found = np.zeros((self.reference.size, *phi.shape))
        for part in parts:
            for column in columns_of(part):
                found[column] += part.slope(theta, column) @ phi
        return found

    def _solved(self, theta: Floats) -> tuple[Floats, Floats]:
        """mu (r,), descending, and vectors (r, r) with x^T (K - s M) x = 1."""
        global _latest
        at, latest = theta.tobytes(), _latest
        if latest is None or latest[0] is not self or latest[1] != at:
            latest = _latest = self, at, _inverted(*self.at(theta), self.shift, self.size)
        return latest[2]


def lowest(stiffness: Floats, mass: Floats, shift: float, n_modes: int) -> tuple[Floats, Floats]:
    """The lowest modes of small matrices (r, r), some vectors of which may be without mass.

    shift: (rad/s)^2, below all eigenvalues. Returns eigenvalues (n_modes,) ascending and
    mass-normalised shapes (r, n_modes). Raises ModesError where there are no such modes.
    """
    count = min(n_modes, mass.shape[0])
    return _with_mass(*_inverted(stiffness, mass, shift, count), shift, n_modes)


def _with_mass(
    inverted: Floats, vectors: Floats, shift: float, n_modes: int
) -> tuple[Floats, Floats]:
    """The lowest modes of those that `_inverted` found, as `lowest` returns them."""
    with_mass = int(np.sum(inverted > LEAST_MASS * inverted[0]))
    inverted, vectors = inverted[:n_modes], vectors[:, :n_modes]
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
    if not alone.size and not close.any():
        return turn
    own = close[:, alone].argmax(axis=0)
    turn[own, alone] = np.where((seen[:, own] * shapes[:, alone]).sum(axis=0) < 0.0, -1.0, 1.0)
    together = np.delete(close, alone, axis=1).T
    for members in {row.tobytes(): row for row in together}.values():
        wanted = np.flatnonzero((close.T == members).all(axis=1))
        basis = seen[:, members] / np.sqrt(inverted[members])
        left, _, right = np.linalg.svd(basis.T @ shapes[:, wanted], full_matrices=False)
        turn[np.ix_(members, wanted)] = left @ right
    return turn


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
    """Return a small model unreduced, one vector per unknown: exact for all parameter values.

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

    room: number of directions in addition to the modes.
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
        forces, rows = touched_product(upper, new)
        own = slice(None) if rows.size == new.shape[0] else rows  # a group's part has few rows
        beside = np.vstack([block[own].T @ forces for block in known])
        corner = new[own].T @ forces
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
    known. Vectors are weighted and rows of the blocks combined a few at a time, so that memory
    holds little more than the input and the result.
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
    return tuple(ReducedPart(p.column, p.powers, p.on(upper, basis), p.relation) for p in parts)


def _moved(parts: tuple[ReducedPart, ...], theta: Floats, reference: Floats, size: int) -> Floats:
    """What parts add at these values beyond the reference, (r, r)."""
    found = np.zeros((size, size))
    for part in parts:
        found += part.moved(theta, reference)
    return found


@dataclass(frozen=True)
class ReducedRange:
    """A reduced model for a range of values.

    whole: of the basis and the answers to random loads, the first `size` vectors the basis;
    n_rigid: modes that are rigid. solved: (n_solved, n_parameters), where the full model was solved
    to see how far it is off, and errors: (n_solved,), of frequencies there, relative, before the
    modes found there joined it. factor: of the squared estimate of what shapes lack.
    """

    whole: ReducedModel
    size: int
    n_rigid: int
    solved: Floats
    errors: Floats
    factor: float

    @cached_property
    def model(self) -> ReducedModel:
        """The reduced model itself."""
        return leading(self.whole, self.size)

    def modes(self, theta: Floats, n_modes: int) -> tuple[Floats, Floats, float]:
        """Eigenvalues (n_modes,), shapes (n_rows, n_modes), and what frequencies may be off by,
        relative. Raises ModesError where the reduced model has no such modes."""
        found = lacking_modes(self.whole, self.size, theta, n_modes, self.n_rigid)
        eigenvalues, combined, lacking = found
        return eigenvalues, self.model.rows @ combined, self.factor * lacking**2


@dataclass(frozen=True, slots=True)
class RangeUse:
    """How sets were evaluated by reduced models for a range, and how far these may be off.

    vectors: of the largest; solutions: full ones that all are made of. asked, error: of
    frequencies, relative: what was asked, and what the last full solution was off by before it
    joined. estimate: the largest over the sets; in_full: sets at which it was too large, so that
    they were solved in full. solver, apart, where: who confirmed, within what, at which values.
    """

    sets: int
    vectors: int
    solutions: int
    asked: float
    error: float
    estimate: float
    in_full: int
    solver: str
    apart: float
    where: str

    @property
    def sentence(self) -> str:
        """The same for people."""
        full = f"; {self.in_full} of them solved in full" if self.in_full else ""
        return (
            f"{self.sets} sets by a reduced model of {self.vectors} vectors, made of "
            f"{self.solutions} full solutions: error {self.error:.1e} at the last, asked "
            f"{self.asked:.0e}, at most {self.estimate:.1e} by estimate at the sets{full}; "
            f"confirmed by {self.solver} where it was worst, at {self.where}: frequencies within "
            f"{self.apart:.1e}"
        )


def reduce_over(
    affine: ParameterMatrices,
    thetas: Floats,
    begin: tuple[ReducedModel, Floats],
    n_modes: int,
    n_rigid: int,
    observer: sparse.csr_array,
    accuracy: float,
    tell: Callable[[int, float], None] = lambda solutions, error: None,
    keep: Callable[[Floats, Callable[[], SolvedModes]], SolvedModes] = lambda at, solve: solve(),
    solver: ModeSolver | None = None,
) -> ReducedRange:
    """A reduced model whose frequencies are as good as `accuracy`, relative, at all these sets.

    thetas: (n_sets, n_parameters), as of `range_sets`; begin: a reduced model around one set, and
    its basis (n, r); n_modes: the lowest ones wanted, rigid ones included; observer: (n_rows, n);
    tell: called with the number of full solutions and the frequency error of the last one;
    keep: gives the full solution at a set, by solving or from before; solver: one that need not
    count, as others confirm the worst set, and may have ordered the model's unknowns already.
    Sets that leave parts loose are passed over. Where the number of full solutions runs out the
    last of `errors` is above the accuracy. Raises ModelError where the matrices allow no solution,
    ModesError where the model has no such modes.
    """
    model, basis = begin
    base = affine.base
    solver = solver or ModeSolver(count=False)
    solver.factorise(base.upper_stiffness, base.upper_mass, model.shift)
    answers = _answers_to_loads(solver, base.upper_mass)

    def energy(block: Floats) -> Floats:
        """(K_0 - s M_0) times a block: what a direction lacks of it, eigenvalues lack."""
        inertia = model.shift * upper_product(base.upper_mass, block)
        return upper_product(base.upper_stiffness, block) - inertia

    room = int(np.clip(NUMBERS // basis.shape[0], LEAST_ROOM, MOST_ROOM))
    solved: list[Floats] = []
    errors: list[float] = []
    grown = projected_model(affine, np.hstack([answers, basis]), model.shift, observer)
    while True:
        whole = of_vectors(grown, np.roll(np.arange(grown.size), -LOADS))
        at, (eigenvalues, combined, lacking) = _worst(
            whole, basis.shape[1], thetas, n_modes, n_rigid
        )
        here = affine.at(at)
        first = float(eigenvalues[min(n_rigid, n_modes - 1)])
        matrices = here.upper_stiffness, here.upper_mass
        start = with_random(basis @ combined, GUARD)
        blocks = solver.blocks_that_pay(n_modes)
        solve = partial(solver.solve, *matrices, n_modes, shift_below(first), start, blocks)
        found = keep(at, solve)
        apart = np.sqrt(eigenvalues[n_rigid:] / found.eigenvalues[n_rigid:]) - 1.0
        solved.append(at)
        errors.append(float(np.max(np.abs(apart), initial=0.0)))
        tell(1 + len(solved), errors[-1])
        widened = basis
        if errors[-1] > accuracy and len(solved) < min(SOLUTIONS, len(thetas)):
            shapes = found.shapes[:, n_rigid:]
            own = leading(whole, basis.shape[1])
            inner = own.base_stiffness - model.shift * own.base_mass
            widened = with_directions(energy, basis, [shapes], room - basis.shape[1], inner)
        if widened.shape[1] == basis.shape[1]:  # good enough, or nothing can be added
            factor = errors[-1] / max(lacking, LEAST) ** 2
            seen = np.array(solved), np.array(errors)
            return ReducedRange(whole, basis.shape[1], n_rigid, *seen, factor)
        new = widened[:, basis.shape[1] :]
        grown = widened_model(affine, grown, (answers, basis), new, observer)
        basis = widened


def leading(whole: ReducedModel, size: int) -> ReducedModel:
    """Return the model on the first `size` vectors of its basis."""
    return of_vectors(whole, np.arange(size))


def of_vectors(whole: ReducedModel, places: Integers) -> ReducedModel:
    """The model on these vectors of its basis, (n_places,), in their order."""

    def parts(given: tuple[ReducedPart, ...]) -> tuple[ReducedPart, ...]:
        return tuple(
            replace(part, values=part.values[:, places[:, None], places]) for part in given
        )

    return replace(
        whole,
        base_stiffness=whole.base_stiffness[np.ix_(places, places)],
        base_mass=whole.base_mass[np.ix_(places, places)],
        stiffness=parts(whole.stiffness),
        mass=parts(whole.mass),
        rows=np.ascontiguousarray(whole.rows[:, places]),
    )


def lacking_modes(
    whole: ReducedModel, size: int, theta: Floats, n_modes: int, n_rigid: int
) -> tuple[Floats, Floats, float]:
    """The lowest modes on the first `size` vectors of a basis, and about what they lack.

    Returns eigenvalues (n_modes,), what shapes have of the basis (size, n_modes), and of the
    elastic shapes, of mass 1, the most that one lacks, by what their residuals do to the other
    vectors, answers to random loads. Raises ModesError where there are no such modes.
    """
    stiffness, mass = whole.at(theta)
    own = slice(None, size)
    eigenvalues, combined = lowest(stiffness[own, own], mass[own, own], whole.shift, n_modes)
    left = stiffness[size:, own] @ combined - (mass[size:, own] @ combined) * eigenvalues
    lacking = np.linalg.norm(left[:, n_rigid:], axis=0)
    return eigenvalues, combined, float(np.max(lacking, initial=0.0))


def _answers_to_loads(solver: ModeSolver, mass: sparse.csr_array) -> Floats:
    """What a model's structure does under random loads of its masses' variance, (n, LOADS)."""
    deviations = np.sqrt(np.maximum(mass.diagonal(), 0.0) / LOADS)
    random = np.random.default_rng(0).standard_normal((deviations.size, LOADS))
    return np.asarray(solver.inverse(np.asfortranarray(deviations[:, None] * random)))


def range_sets(lower: Floats, upper: Floats) -> Floats:
    """Sets (n_sets, n_parameters) at which the worst is looked for between these values.

    Half of them are corners, where reduced models are worst, the others a Latin hypercube inside;
    the same whenever they are asked for.
    """
    random, half = np.random.default_rng(0), LOOKED_AT // 2
    corners = random.integers(0, 2, (half, lower.size))
    strata = np.stack([random.permutation(half) for _ in range(lower.size)], axis=1)
    unit = np.vstack([np.unique(corners, axis=0), (strata + 0.5) / half])
    return np.asarray(lower + unit * (upper - lower))


def _worst(
    whole: ReducedModel, size: int, thetas: Floats, n_modes: int, n_rigid: int
) -> tuple[Floats, tuple[Floats, Floats, float]]:
    """The set whose modes on the first `size` vectors lack most, and `lacking_modes` there."""
    found, error = [], None
    for at in thetas:
        try:
            found.append((at, lacking_modes(whole, size, at, n_modes, n_rigid)))
        except ModesError as problem:
            error = problem
    strained = [item for item in found if (item[1][0][n_rigid:] > 0.0).all()]
    if not strained:
        raise error or ModesError("a reduced model has no elastic modes at any set of its range")
    return max(strained, key=lambda item: item[1][2])
