"""Modes from stiffness and mass matrices by shift-invert.

K phi = lambda M phi is solved for the eigenvalues next to a shift s below the spectrum, where
K - s M is positive definite even for a free structure with its singular K:

    A phi = theta phi,   A = (K - s M)^-1 M,   theta = 1 / (lambda - s).

They are found in a block Krylov space (block Lanczos with all vectors kept,
core/algebra/krylov): of the first model from a few random vectors, of models with the same sparsity
and nearly the same modes from those. ARPACK, which takes one vector after the other, is not a match
for the first either: of a square bar's pairs of bending modes it lacks one for 9 of 40 numbers of
modes, and a solution with six right-hand sides costs little more than with one, so that its fewer
vectors take half as long again and more. Pairs become modes in core/algebra/solved_modes.

No way sees what its start vectors lack. So eigenvalues are counted: K - c M has as many negative
pivots as there are eigenvalues below c (Sylvester), at the cost of one more factorisation. From
start shapes c is just above the Rayleigh quotient of the last one (which no eigenvalue of its
number exceeds); as many modes as there are below c are found, or it is said that they are not.
From random vectors c is just below the last eigenvalue found. Of equal eigenvalues (bending of
square and round sections, parts that occur twice) a space sees as many directions as it has start
vectors, and others only as rounding brings them in: where the count says that some are missing,
another one from the shapes found and random vectors goes on to c just above the last one found,
until it holds as many as there are.

Factors of a similar matrix, of an earlier model or in single precision, do as well:
core/algebra/similar_factors.

Rounding sets a limit to all ways: lambda is known to about 10^-16 of the largest eigenvalue, as
the computed eigenvalues of rigid modes show. Small models are solved whole by LAPACK
(core/algebra/dense_modes). How the shift is found: core/algebra/pencil.
"""

from __future__ import annotations

import logging
from dataclasses import replace

import numpy as np
from scipy import sparse
from scipy.linalg import eigh
from scipy.linalg.blas import dgemm

from modetune.core.algebra.dense_modes import solve_condensed, solve_whole
from modetune.core.algebra.krylov import GUARD, RitzPairs, unit_combinations, with_random
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
)
from modetune.core.algebra.similar_factors import (
    blocks_worth,
    modes_in_single_precision,
    pairs_by_similar,
    similar_modes,
    similar_vectors,
)
from modetune.core.algebra.solved_modes import TOLERANCE, SolvedModes, completed, of_pairs
from modetune.core.errors import ModelError
from modetune.core.modes import Floats

logger = logging.getLogger(__name__)

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
#: The way of modes that an earlier model's factors led to.
KEPT = "kept factors"
#: Eigenvalues this close, relative to their distance from the shift, are not told apart.
_SAME = 1e-6


def most_vectors(n_modes: int) -> int:
    """Vectors of a space from nothing, each twice (M times it); half of them is common."""
    return VECTORS * n_modes + MORE_VECTORS


class ModeSolver:
    """Modes of one model after the other; what depends on their sparsity alone is kept.

    One solver holds the matrices of the last model and the factors of one shifted matrix, its own
    or an earlier model's (`has_own_factors`). It is for one thread.
    """

    def __init__(self, *, count: bool = True) -> None:
        """count: whether to prove by inertia that no mode is missing; one factorisation more.
        What a solution is not told otherwise."""
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
            raise ModelError(f"{n_modes} modes were asked of a model with {size} unknowns")
        count = self._count if count is None else count
        own = self._pencil is not None and (self._pencil.exact or not count)
        if self._pencil is None or not own or not self._pencil.update(stiffness, mass):
            self._pencil = None  # its memory is free before the next one takes any
            similar = None if count else similar_vectors(n_modes)
            self._pencil = Pencil(stiffness, mass, most_vectors(n_modes), similar)
            self._shift = None
        pencil = self._pencil
        if size <= DENSE or n_modes > size // 2:
            return self._whole(pencil, n_modes, shift)
        if n_modes > pencil.n_with_mass:
            raise ModelError(
                f"{n_modes} modes were asked of a model with {pencil.n_with_mass} unknowns that "
                "have mass"
            )
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

    def factorise(
        self,
        stiffness: sparse.csr_array,
        mass: sparse.csr_array,
        shift: float,
        n_modes: int | None = None,
    ) -> None:
        """Only the factors of a model, for one that is like it. As `solve`, shift as it told.

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
        logger.info("the model is too far from the one factorised: factorised anew")
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
