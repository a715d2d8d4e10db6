"""Modes from stiffness and mass matrices by shift-invert.

K phi = lambda M phi is solved for the eigenvalues next to a shift s below the spectrum, where
K - s M is positive definite even for a free structure with its singular K:

    A phi = theta phi,   A = (K - s M)^-1 M,   theta = 1 / (lambda - s).

**Search.** A block Krylov space (block Lanczos that keeps all vectors, `core/algebra/krylov`)
starts from a few random vectors for the first model, and from the shapes of an earlier model for
models with the same sparsity and nearly the same modes. ARPACK, which takes one vector after the
other, misses one of a square bar's pairs of bending modes for 9 of 40 numbers of modes. A solution
with six right-hand sides costs little more than with one, so ARPACK's fewer vectors take half as
long again and more.

**Completion.** One more solution with all shapes at once, phi = A phi / theta, gives the rows
without mass. The residuals ||A phi - theta phi||_M / theta bound the error: there is a lambda with

    |lambda - lambda_found| <= residual (lambda_found - s).

**Counting.** No method finds a mode that its start vectors do not contain. So eigenvalues are
counted: K - c M has as many negative pivots as there are eigenvalues below c (Sylvester), which
costs one more factorisation. With start shapes, c is just above the Rayleigh quotient of the last
one (which no eigenvalue of its number exceeds); the solver finds all modes below c or raises an
error. With random vectors, c is just below the last eigenvalue found. Of equal eigenvalues (bending
of square and round sections, parts that occur twice) a space contains as many directions as it has
start vectors, and others only through rounding. Where the count shows that some are missing,
another space, from the shapes found and random vectors, continues to c just above the last
eigenvalue found until it contains all of them.

**Similar factors.** A factorisation of 10^6 equations takes as long as hundreds of solved columns.
The factors of an earlier, similar model serve as well (`block_davidson`): products use the new K
and M, the inverse is the old one, and the residuals satisfy the same bound. Where residuals fall
so slowly over the first blocks that a factorisation is faster, the solver factorises and continues
from the shapes it has. Without a count, random vectors stay in the block to the end and turn
towards the lowest modes that the others lack, and a mode among the lowest has to converge like the
rest. A count needs one factorisation, just below the last eigenvalue. Factors in single precision
(`core/algebra/factor_room`) are also those of a similar matrix, some 6e-8 of K away, and take half
the memory.

**Small models.** LAPACK solves small models, and models that have mass at few unknowns only. Where
M is singular (unknowns without mass, whose eigenvalues are infinite) the problem is inverted:
M phi = mu (K - s M) phi, mu = 1 / (lambda - s).

Rounding limits every method: lambda is known to about 10^-16 of the largest eigenvalue, as the
computed eigenvalues of rigid modes show. `core/algebra/pencil` finds the shift.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy import sparse
from scipy.linalg import LinAlgError, eigh
from scipy.linalg.blas import dgemm

from modetune.core.algebra.krylov import (
    DAVIDSON,
    GUARD,
    RitzPairs,
    block_davidson,
    unit_combinations,
    with_random,
)
from modetune.core.algebra.matrices import upper_triangle
from modetune.core.algebra.pencil import (
    LEAST_SHIFT,
    ROUNDING,
    STRAINED,
    Pencil,
    count_below,
    estimate_shift,
    factorise_below,
    largest_pairs,
    singular_together,
    triangle_product,
)
from modetune.core.errors import ModelError, SolverExhausted, TooManyModes
from modetune.core.modes import Floats

logger = logging.getLogger(__name__)

#: Largest residual of a mode before the last solution, which leaves a few hundredths of it.
#: Eigenvalues have its square over the gap to modes that were not looked for.
TOLERANCE = 2e-5
#: Models up to this many unknowns are solved whole.
DENSE = 300
#: Blocks of a Krylov space, the start shapes being the first, before the start counts as bad.
BLOCKS = 5
#: Random start vectors where nothing is known: a solution with a few costs little more than with
#: one, and as many equal eigenvalues are seen at once.
COLUMNS = 6
#: Vectors of such a space for a mode, and beyond, before it counts as in vain; half is common.
VECTORS, MORE_VECTORS = 8, 80
#: Krylov spaces, each from the best of the one before, for modes that the first did not hold.
ROUNDS = 4
#: Largest residual from random vectors, whose modes hold some of any other; a block more.
RANDOM_TOLERANCE = 2e-6
#: Of the unknowns that give modes.
WITH_MASS = " that have mass"
#: The way of modes that an earlier model's factors led to.
KEPT = "kept factors"
#: Distance of eigenvalues, relative to that from the shift, below which they count as equal.
_SAME = 1e-6
#: Blocks with an earlier model's factors: fewer are too few to try, more never came to an end.
LEAST_BLOCKS, MOST_BLOCKS = 3, 8
#: The same with factors in single precision, for which there are no others.
SINGLE_BLOCKS = 30
#: Solved columns that a column of such a block costs, with its products and its part of the basis,
#: and that a mode costs with exact factors (three blocks, the later ones smaller).
BLOCK_COLUMN, KRYLOV_MODE = 2.5, 4.5


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

    def first(self, n_modes: int) -> SolvedModes:
        """Return the lowest of these modes; arrays are not copied."""
        values, residuals = self.eigenvalues[:n_modes], self.residuals[:n_modes]
        shapes = self.shapes[:, :n_modes]
        return replace(self, eigenvalues=values, shapes=shapes, residuals=residuals)


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


def solve_whole(pencil: Pencil, n_modes: int) -> tuple[Floats, Floats]:
    """Modes of a small model by LAPACK.

    Returns eigenvalues (n_modes,), ascending, (rad/s)^2, and mass-normalised shapes (n, n_modes).
    Raises ModelError where the matrices allow no solution.
    """
    k, m = _mirrored(pencil.stiffness), _mirrored(pencil.mass)
    try:
        values, vectors = eigh(k, m)
    except LinAlgError:  # M is not positive definite
        return _solve_inverted(k, m, n_modes, 1e-3 * pencil.largest_eigenvalue())
    return values[:n_modes], vectors[:, :n_modes]


def solve_condensed(pencil: Pencil, n_modes: int) -> tuple[Floats, Floats]:
    """Modes of a model with few unknowns that have mass, from its flexibility at these.

    pencil: factorised below the spectrum. Returns theta = 1 / (lambda - s), (n_modes,),
    descending, and shapes (n_with_mass, n_modes). Raises ModelError where there are fewer modes.
    """
    flexibility = pencil.apply(np.eye(pencil.n_with_mass, order="F"))[pencil.rows]
    inertia = pencil.inertia(np.eye(pencil.n_with_mass))
    # M G M x = theta M x, with all eigenvalues of M above zero.
    squares, turned = eigh(inertia)
    own = squares > 1e-14 * squares[-1]
    root = turned[:, own] * np.sqrt(squares[own])
    inverted, vectors = eigh(root.T @ flexibility @ root)
    inverted, vectors = inverted[::-1][:n_modes], vectors[:, ::-1][:, :n_modes]
    if inverted.size < n_modes:
        raise TooManyModes(n_modes, int(own.sum()), WITH_MASS)
    shapes = turned[:, own] @ (vectors / np.sqrt(squares[own])[:, None])
    return inverted, shapes


def _mirrored(upper: sparse.csr_array) -> Floats:
    above = upper.toarray()
    return np.asarray(above + np.triu(above, 1).T)


def _solve_inverted(k: Floats, m: Floats, n_modes: int, below: float) -> tuple[Floats, Floats]:
    """Modes of a model with unknowns that have no mass, by mu = 1 / (lambda + below)."""
    try:
        inverted, vectors = eigh(m, k + below * m)
    except LinAlgError as error:
        raise ModelError(
            "the mass and stiffness matrices allow no modes: an unknown has neither, or one of "
            "the matrices has negative eigenvalues"
        ) from error
    inverted, vectors = inverted[::-1], vectors[:, ::-1]
    with_mass = int(np.sum(inverted > 1e-12 * inverted[0]))
    if inverted[-1] < -1e-9 * inverted[0]:
        raise ModelError("the mass matrix has negative eigenvalues: it is not a mass matrix")
    if n_modes > with_mass:
        raise TooManyModes(n_modes, with_mass, WITH_MASS)
    kept = inverted[:n_modes]
    return 1.0 / kept - below, vectors[:, :n_modes] / np.sqrt(kept)


def most_vectors(n_modes: int) -> int:
    """Vectors of a space from nothing, each twice (M times it); half of them is common."""
    return VECTORS * n_modes + MORE_VECTORS


class ModeSolver:
    """Modes of one model after the other; what depends on their sparsity alone is kept.

    One solver holds the matrices of the last model and the factors of one shifted matrix, its own
    or an earlier model's (`has_own_factors`). It is for one thread.
    """

    def __init__(self, *, count: bool = True) -> None:
        """count: whether to prove by inertia that no mode is missing, which takes one more
        factorisation; the default of each solution."""
        self._count = count
        self._pencil: Pencil | None = None
        self._shift: float | None = None

    def solve(
        self,
        stiffness: sparse.csr_array,
        mass: sparse.csr_array,
        n_modes: int,
        shift: float | None = None,
        start: Floats | None = None,
        kept_blocks: int = 0,
        count: bool | None = None,
    ) -> SolvedModes:
        """The lowest modes of a model, rigid ones included.

        stiffness, mass: (n, n), upper triangles, sorted, kept and not copied; they may be another
        model's, with another sparsity, than before. shift: (rad/s)^2, negative, of the size of
        the first elastic eigenvalue or somewhat smaller; where it is None the last one is kept if
        there is a start, else it is estimated; it is lowered below negative eigenvalues.
        start: (n, n_start), shapes of a similar model, at least n_modes of them and better some
        more. With count, modes are complete or an error is raised; without it, a mode of which the
        start shapes hold nothing is not found: for whoever looks at the modes again by other means.
        kept_blocks: blocks of vectors that the factors of the model before may be tried with
        (`blocks_that_pay`); count: of this solution.
        Raises ModelError where the matrices allow no solution, SolverExhausted where memory does
        not suffice.
        """
        size = int(stiffness.shape[0])
        if not 0 < n_modes <= size:
            raise TooManyModes(n_modes, size)
        count = self._count if count is None else count
        pencil = self._pencil_of(stiffness, mass, n_modes, count)
        if size <= DENSE or n_modes > size // 2:
            return self._whole(pencil, n_modes, shift)
        if n_modes > pencil.n_with_mass:
            raise TooManyModes(n_modes, pencil.n_with_mass, WITH_MASS)
        if shift is None:
            kept = None if start is None else self._shift
            shift = estimate_shift(pencil) if kept is None else kept
        if pencil.n_with_mass <= DENSE or n_modes > pencil.n_with_mass // 2:
            self._shift = factorise_below(pencil, shift)
            inverted, shapes = solve_condensed(pencil, n_modes)
            return completed(pencil, inverted, shapes, "condensed", pencil.n_with_mass, True)
        if start is not None and (start.shape[0] != size or start.shape[1] < n_modes):
            start = None
        if start is not None and kept_blocks and pencil.kept_shift is not None:
            solved, start = self._from_kept(pencil, n_modes, start, kept_blocks, count)
            if solved is not None:
                return solved
        if not pencil.exact:
            self._shift = factorise_below(pencil, shift)
            return modes_in_single_precision(pencil, n_modes, self._shift, start)
        if start is not None:
            near = self._from_start(pencil, n_modes, shift, np.asfortranarray(start), count)
            if near is not None:
                return near
        return self._from_random(pencil, n_modes, shift, count)

    def solve_available(
        self, stiffness: sparse.csr_array, mass: sparse.csr_array, n_modes: int, *search: Any
    ) -> SolvedModes:
        """Return the modes of `solve`, or all modes of a model that has fewer, and log that.

        search: the other arguments of `solve`.
        """
        try:
            return self.solve(stiffness, mass, n_modes, *search)
        except TooManyModes as error:
            logger.info("%s: all %d are used", error, error.available)
            return self.solve(stiffness, mass, error.available)

    def counted(
        self, stiffness: sparse.csr_array, mass: sparse.csr_array, solved: SolvedModes
    ) -> SolvedModes | None:
        """Return a model's modes as counted, by one factorisation; None if modes are missing.

        stiffness, mass: as in `solve`. Raises SolverExhausted if memory does not suffice.
        """
        if solved.counted:
            return solved
        pencil = self._pencil_of(stiffness, mass, solved.eigenvalues.size, count=True)
        self._shift = solved.shift
        _, found, there = _below_last(pencil, solved)
        return replace(solved, counted=True) if there == found else None

    def _pencil_of(
        self, stiffness: sparse.csr_array, mass: sparse.csr_array, n_modes: int, count: bool
    ) -> Pencil:
        """Return the pencil of these matrices, with the order of unknowns and factors at hand."""
        usable = self._pencil is not None and (self._pencil.exact or not count)
        if self._pencil is None or not usable or not self._pencil.update(stiffness, mass):
            self._pencil = None  # its memory is free before the next one takes any
            similar = None if count else similar_vectors(n_modes)
            self._pencil = Pencil(stiffness, mass, most_vectors(n_modes), similar)
            self._shift = None
        return self._pencil

    def factorise(
        self,
        stiffness: sparse.csr_array,
        mass: sparse.csr_array,
        shift: float,
        n_modes: int | None = None,
    ) -> None:
        """Factorise a model for a similar one. Arguments as `solve`, with the shift it returned.

        n_modes: that will be looked for with them, for which memory has to be left."""
        if self._pencil is None or not self._pencil.update(stiffness, mass):
            self._pencil = None
            similar = None if self._count else similar_vectors(n_modes or 0)
            columns = 0 if n_modes is None else most_vectors(n_modes)
            self._pencil = Pencil(stiffness, mass, columns, similar)
        self._shift = factorise_below(self._pencil, shift)

    def blocks_that_pay(self, n_modes: int) -> int:
        """How many blocks with the factors at hand cost no more than new ones; 0 if too few.

        By numbers of entries, not by a clock: the same in each run.
        """
        if self._pencil is None or self._pencil.kept_shift is None:
            return 0
        return blocks_worth(self._pencil.factorisation_columns, n_modes)

    @property
    def has_own_factors(self) -> bool:
        """Whether the factors at hand are the last model's, or will be when they are asked for."""
        return self._shift is not None

    @property
    def inverts_exactly(self) -> bool:
        """Whether `inverse` is that of the last model: by its own factors, in double precision."""
        return self.has_own_factors and self._pencil is not None and self._pencil.exact

    def inverse(self, block: Floats) -> Floats:
        """(K - s M)^-1 block of the last model, (n,) or (n, n_columns), s as in its `SolvedModes`.

        Of a similar matrix where it was solved by an earlier model's factors, or by factors in
        single precision.
        """
        if self._pencil is None or (self._shift is None and self._pencil.kept_shift is None):
            raise ModelError("no model has been solved yet: there is nothing to invert")
        if self._shift is not None and self._pencil.shift != self._shift:
            self._shift = factorise_below(self._pencil, self._shift)
        return self._pencil.inverse(block)

    @property
    def held(self) -> str:
        """How the factors are held, where that is not in double precision in memory."""
        return "" if self._pencil is None else self._pencil.held

    def _from_kept(
        self, pencil: Pencil, n_modes: int, start: Floats, blocks: int, count: bool
    ) -> tuple[SolvedModes | None, Floats]:
        """By the factors at hand, an earlier model's; None and better shapes where they will not
        do."""
        assert pencil.kept_shift is not None
        self._shift, shift = None, pencil.kept_shift
        pairs = pairs_by_similar(pencil, n_modes, shift, start, blocks)
        if pairs is not None and pairs.converged:
            solved = similar_modes(pairs, n_modes, shift, f"{KEPT}{pencil.held}")
            if not count:
                return solved, start
            self._shift = shift
            _, found, there = _below_last(pencil, solved)
            if there == found:
                return replace(solved, counted=True), start
        logger.info("the model is too far from the factorised one: factorising again")
        return None, start if pairs is None else pairs.vectors

    def _from_start(
        self, pencil: Pencil, n_modes: int, shift: float, start: Floats, count: bool
    ) -> SolvedModes | None:
        """None where the start shapes are not good enough."""
        shapes, wanted, above, guard = start[pencil.rows], n_modes, np.inf, 0
        if count:
            quotients, shapes = _rayleigh_ritz(pencil, start)
            if quotients.size < n_modes:
                return None
            last = float(quotients[n_modes - 1])
            above, wanted = count_below(pencil, last, _margin(pencil, last, shift))
            # No eigenvalue is above the quotient of its number: as many as these there are, more
            # if the start lacks some.
            lacking = wanted - int(np.sum(quotients < above))
            if not 0 <= lacking <= GUARD:
                return None
            guard = lacking + GUARD if lacking else 0
        self._shift = factorise_below(pencil, shift)
        pairs = largest_pairs(
            pencil,
            with_random(shapes, guard),
            wanted,
            TOLERANCE,
            BLOCKS,
            least_inverted=1.0 / (above - self._shift),
        )
        if not pairs.converged:
            return None
        return of_pairs(pencil, pairs, n_modes, "start", count)

    def _from_random(self, pencil: Pencil, n_modes: int, shift: float, count: bool) -> SolvedModes:
        self._shift = factorise_below(pencil, shift)
        if not pencil.is_invertible():
            raise singular_together(pencil)
        pairs = _random_pairs(pencil, n_modes)
        solved = of_pairs(pencil, pairs, n_modes, "random", False)
        if not count:
            return solved
        below, found, there = _below_last(pencil, solved)
        if there == found:
            return replace(solved, counted=True)
        whole = self._with_missing(pencil, solved)
        if whole is None:
            raise ModelError(
                f"{n_modes} modes were looked for, but of the eigenvalues below {below:.6e} "
                f"(rad/s)^2 {found} were found and {max(there, 0)} counted; ask for some more "
                "modes, or look at the mass matrix: it may have negative eigenvalues"
            )
        return whole

    def _with_missing(self, pencil: Pencil, found: SolvedModes) -> SolvedModes | None:
        """Modes found and those between them that the count says are there; None in vain."""
        n_modes, shift = found.eigenvalues.size, found.shift
        # Those found are not below the eigenvalues of their numbers: here are n_modes or more,
        # all that are equal to the last one among them.
        last = float(found.eigenvalues[-1])
        above, wanted = count_below(pencil, last, _margin(pencil, last, shift))
        if wanted < n_modes:
            return None
        self._shift = factorise_below(pencil, shift)
        shapes, solutions = found.shapes[pencil.rows], found.solutions
        for turn in range(ROUNDS):
            start = with_random(shapes, wanted - shapes.shape[1] + GUARD, turn)
            pairs = largest_pairs(
                pencil,
                start,
                wanted,
                RANDOM_TOLERANCE,
                3 * BLOCKS,
                least_inverted=1.0 / (above - self._shift),
            )
            solutions += pairs.solutions
            if pairs.converged:
                pairs = replace(pairs, solutions=solutions)
                return of_pairs(pencil, pairs, n_modes, "random, again", True)
            shapes = pairs.images
        return None

    def _whole(self, pencil: Pencil, n_modes: int, shift: float | None) -> SolvedModes:
        values, vectors = solve_whole(pencil, n_modes)
        least = LEAST_SHIFT * pencil.largest_eigenvalue()
        strained = values[values > STRAINED * least]
        first = float(strained[0]) if strained.size else 0.0
        least = min(-0.1 * first, -least)
        below = least if shift is None else shift
        self._shift = below if values[0] > below else 2.0 * float(values[0])
        return SolvedModes(values, vectors, np.zeros(n_modes), self._shift, "whole", True, 0)


def solve_modes(
    stiffness: sparse.csr_array, mass: sparse.csr_array, n_modes: int, shift: float | None = None
) -> tuple[Floats, Floats]:
    """The lowest modes, rigid ones included.

    stiffness, mass: (n, n), symmetric, both triangles; shift: (rad/s)^2, negative, of the size of
    the first elastic eigenvalue or somewhat smaller; estimated where it is None. Returns
    eigenvalues (n_modes,) ascending and mass-normalised shapes (n, n_modes). Raises ModelError
    where the matrices allow no solution. For large models and several of them: `ModeSolver`.
    """
    upper = [upper_triangle(sparse.csr_array(a).astype(np.float64)) for a in (stiffness, mass)]
    solved = ModeSolver().solve(upper[0], upper[1], n_modes, shift)
    return solved.eigenvalues, solved.shapes


def available_modes(
    stiffness: sparse.csr_array, mass: sparse.csr_array, n_modes: int
) -> tuple[Floats, Floats]:
    """Return the modes of `solve_modes`, or all modes of a model that has fewer."""
    try:
        return solve_modes(stiffness, mass, n_modes)
    except TooManyModes as error:
        return solve_modes(stiffness, mass, error.available)


def _random_pairs(pencil: Pencil, n_modes: int) -> RitzPairs:
    """The modes that Krylov spaces from random vectors hold. Raises ModelError if in vain."""
    columns = min(COLUMNS, pencil.n_with_mass)
    blocks = -(-most_vectors(n_modes) // columns)
    shapes, solutions = np.zeros((pencil.n_with_mass, 0)), 0
    for turn in range(ROUNDS):
        start = with_random(shapes, columns, turn)
        pairs = largest_pairs(pencil, start, n_modes, RANDOM_TOLERANCE, blocks)
        solutions += pairs.solutions
        if pairs.converged:
            return replace(pairs, solutions=solutions)
        shapes = pairs.images
    raise ModelError(
        f"{n_modes} modes were not found in {solutions} vectors: the largest residual of the "
        f"{pairs.inverted.size} at hand is {float(np.max(pairs.residuals, initial=0.0)):.1e}"
    )


def _margin(pencil: Pencil, eigenvalue: float, shift: float) -> float:
    """How far from an eigenvalue to count, so that neither it nor its equals are cut by chance."""
    return max(_SAME * abs(eigenvalue - shift), ROUNDING * pencil.largest_eigenvalue())


def _below_last(pencil: Pencil, solved: SolvedModes) -> tuple[float, int, int]:
    """A number just below the last eigenvalue, how many are below it of those found, and of all."""
    last = float(solved.eigenvalues[-1])
    below, there = count_below(pencil, last, -_margin(pencil, last, solved.shift))
    return below, int(np.sum(solved.eigenvalues < below)), there


def _rayleigh_ritz(pencil: Pencil, start: Floats) -> tuple[Floats, Floats]:
    """Rayleigh quotients (n_found,) ascending in the space of start, and shapes on mass rows."""
    own = start[pencil.rows]
    factor = unit_combinations(own.T @ pencil.inertia(own), 0.0)
    quotients, ritz = eigh(factor.T @ (start.T @ pencil.stiff(start)) @ factor)
    return quotients, dgemm(1.0, own, np.asfortranarray(factor @ ritz))


def similar_vectors(n_modes: int) -> int:
    """Return the number of vectors in memory with the factors of a similar matrix."""
    return DAVIDSON * (n_modes + GUARD)


def blocks_worth(factorisation_columns: float, n_modes: int) -> int:
    """How many blocks with an earlier model's factors cost no more than new ones; 0 if too few.

    factorisation_columns: solved columns that take as long as a factorisation.
    """
    columns = factorisation_columns + KRYLOV_MODE * n_modes
    blocks = int(columns / (BLOCK_COLUMN * (n_modes + GUARD)))
    return min(blocks, MOST_BLOCKS) if blocks >= LEAST_BLOCKS else 0


def pairs_by_similar(
    pencil: Pencil, n_modes: int, shift: float, start: Floats, blocks: int
) -> RitzPairs | None:
    """By the factors at hand, from start (n, n_start) and random vectors; as `block_davidson`."""

    def mass(block: Floats) -> Floats:
        return triangle_product(pencil.mass, block)

    def shifted(block: Floats, out: Floats) -> None:
        pencil.shifted(block, shift, out)

    n_random = max(n_modes - start.shape[1], 0) + GUARD
    return block_davidson(
        pencil.inverse, shifted, mass, start, n_modes, TOLERANCE, blocks, n_random, pencil.room_for
    )


def similar_modes(pairs: RitzPairs, n_modes: int, shift: float, way: str) -> SolvedModes:
    """The first modes of such pairs."""
    values, shapes = 1.0 / pairs.inverted[:n_modes] + shift, pairs.vectors[:, :n_modes]
    residuals = pairs.residuals[:n_modes]
    return SolvedModes(values, shapes, residuals, shift, way, False, pairs.solutions)


def modes_in_single_precision(
    pencil: Pencil, n_modes: int, shift: float, start: Floats | None
) -> SolvedModes:
    """By this model's factors in single precision, made at the shift; start: (n, n_start).

    Raises ModelError where K and M are singular together, SolverExhausted where it is in vain.
    """
    if not pencil.is_invertible():
        raise singular_together(pencil)
    shapes = np.zeros((pencil.n, 0)) if start is None else start
    pairs = pairs_by_similar(pencil, n_modes, shift, shapes, SINGLE_BLOCKS)
    if pairs is None or not pairs.converged:
        largest = np.inf if pairs is None else float(pairs.residuals[:n_modes].max())
        raise SolverExhausted(
            f"{n_modes} modes of {pencil.n} equations were not found with factors in single "
            f"precision: the largest residual is {largest:.1e}; take factors in double "
            "precision, which need up to twice the memory, or take that of the disk"
        )
    solved = similar_modes(pairs, n_modes, shift, "single precision")
    bounds = solved.residuals * np.abs(1.0 - shift / solved.eigenvalues)
    logger.info(
        "%d modes of %d equations with factors in single precision: residuals at most %.1e, "
        "eigenvalues within %.1e, relative, and a mode that random vectors lack is not counted",
        n_modes,
        pencil.n,
        float(solved.residuals.max()),
        float(bounds[solved.eigenvalues > -shift].max(initial=0.0)),
    )
    return solved
