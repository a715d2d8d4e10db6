"""K - s M of one model after the other, all of one sparsity, from their upper triangles.

What depends on the sparsity alone is kept: the union of both patterns, the places of the entries
of K and M in it, the order of the unknowns for the factorisation, and which rows have mass.
Products with a triangle U are U x + U^T x - d x, column by column: faster than with the mirrored
matrix in blocks, and half its memory.

Many unknowns may have no mass (rotations, condensed nodes). The eigenvectors of

    A = (K - s M)^-1 M

follow from their rows with mass, phi = A phi / theta, so vectors are kept on these rows only and
M x is spread over all rows for a solution.

A negative shift s makes K - s M positive definite even where K is singular, as a free
structure's is. It should be of the size of the first elastic eigenvalue: much closer to zero it
drowns the elastic modes of a free structure in the rigid ones, much farther away the modes crowd
together seen from it. Where the caller does not know that eigenvalue it is estimated: with a
shift just far enough below zero to exceed rounding, by two steps from random vectors. Where these
find no rigid motion nothing can be drowned, and that shift does for all modes, its factors
with it.
"""

from __future__ import annotations

import math
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from modetune.core.algebra.factorisation import SymmetricFactors, symmetric_factors
from modetune.core.algebra.krylov import RitzPairs, block_krylov, unit_combinations, with_random
from modetune.core.algebra.matrices import places_in, same_pattern, union
from modetune.core.errors import ModelError
from modetune.core.modes import Floats, Integers

Places: TypeAlias = NDArray[np.int32] | NDArray[np.int64] | slice

#: Share of the largest eigenvalue above which a shift exceeds rounding.
LEAST_SHIFT = 1e-10
#: Eigenvalues of this many least shifts are not those of rigid motion.
STRAINED = 10.0
#: Shapes in the estimate of the first elastic eigenvalue: six rigid ones and some to spare.
BLOCK = 10
#: Eigenvalues are known to this share of the largest one, rigid ones for example.
ROUNDING = 1e-15
#: The shift below the spectrum, in first elastic eigenvalues.
SHIFT = -0.1
#: Solved columns that a factorisation is worth, by entries of the factors in a column: 0.4 to 0.75
#: were measured between 17,000 and 1,240,000 equations of shells and solids.
FACTORISED_COLUMNS = 0.5
_LOST = 1e-2  # of a known solution, relative: beyond this the matrix has no inverse to speak of
_WITHOUT_ENERGY = 1e-14  # relative to the energy of its single unknowns: rounding


def shifted_pattern(stiffness: sparse.csr_array, mass: sparse.csr_array) -> sparse.csr_array:
    """Where K - s M may have entries, those of the diagonal among them; of upper triangles."""
    diagonal = sparse.csr_array(sparse.eye_array(stiffness.shape[0]))
    return sparse.csr_array(union([stiffness, mass, diagonal]).astype(np.float64))


class Pencil:
    """One model's K and M, and the factors of K - s M at one shift s.

    stiffness, mass: upper triangles, (n, n). rows: (n_with_mass,), or all as a slice. shift: where
    it is factorised, (rad/s)^2. below: eigenvalues below the shift (Sylvester's law of inertia:
    as many as K - s M has negative ones); -1 where a pivot was as good as zero. kept_shift: where
    the factors at hand are, if they are an earlier model's.
    """

    def __init__(
        self,
        stiffness: sparse.csr_array,
        mass: sparse.csr_array,
        columns: int = 0,
        similar: int | None = None,
    ) -> None:
        """Order the unknowns; nothing is factorised yet.

        stiffness, mass: (n, n), upper triangles, sorted, kept and not copied; columns: vectors
        (n,) that will be in memory with the factors; similar: with those of a similar matrix, None
        if `exact` ones are needed. Raises ModelError where they are not a model,
        SolverExhausted where memory does not suffice.
        """
        _check(stiffness, mass)
        self.n = int(stiffness.shape[0])
        self.shift: float | None = None
        self.kept_shift: float | None = None
        self.below = -1
        self._invertible: bool | None = None
        pattern = shifted_pattern(stiffness, mass)
        self._n_entries = int(pattern.nnz)
        self._stiffness_places = _places(pattern, stiffness)
        self._mass_places = _places(pattern, mass)
        self._take(stiffness, mass)
        self._factors: SymmetricFactors = symmetric_factors(pattern, columns, similar)

    def update(self, stiffness: sparse.csr_array, mass: sparse.csr_array) -> bool:
        """Take the next model; false, and nothing done, where its sparsity is another."""
        if not (same_pattern(stiffness, self.stiffness) and same_pattern(mass, self.mass)):
            return False
        _check(stiffness, mass)
        self._take(stiffness, mass)
        return True

    @property
    def held(self) -> str:
        """How the factors are held, where that is not in double precision in memory."""
        return self._factors.held

    @property
    def exact(self) -> bool:
        """Whether the inverse is that of the matrix, and not of one that is similar."""
        return self._factors.exact

    def factorise(self, shift: float) -> None:
        """Factorise K - shift M. Raises ModelError where it is exactly singular."""
        self.shift = self.kept_shift = self._invertible = None
        self._factors.refactor(self._values(shift))  # which has the only reference to them
        self.shift = self.kept_shift = shift
        self.below = -1 if self._factors.lifted_pivots else self._factors.negative_pivots

    def _values(self, shift: float) -> Floats:
        values = np.zeros(self._n_entries)
        values[self._stiffness_places] = self.stiffness.data
        values[self._mass_places] -= shift * self.mass.data
        return values

    def inverse(self, block: Floats, out: Floats | None = None) -> Floats:
        """(K - s M)^-1 block, (n,) or (n, n_columns), at the last shift; out: where to put it."""
        return self._factors.solve(block, out)

    def room_for(self, n_rows: int, n_columns: int) -> Floats:
        """Room for vectors where the factors are, (n_rows, n_columns), in Fortran order."""
        return self._factors.room_for(n_rows, n_columns)

    @property
    def factorisation_columns(self) -> float:
        """How many solved columns take about as long as a factorisation.

        Factors with c entries a column take c operations an entry to be made and 4 to be used;
        that is done at some eighth of the speed, as memory lets it.
        """
        return FACTORISED_COLUMNS * self._factors.factor_entries / self.n

    def apply(self, inertia: Floats) -> Floats:
        """(K - s M)^-1 f on all rows, (n, n_columns), of forces f on the rows with mass."""
        return self.inverse(self.spread(inertia))

    def apply_inside(self, inertia: Floats, out: Floats) -> None:
        """As apply, on the rows with mass only, (n_with_mass, n_columns), put into out."""
        if isinstance(self.rows, slice):
            self.inverse(inertia, out)
        else:
            out[...] = self.apply(inertia)[self.rows]

    def spread(self, block: Floats) -> Floats:
        """A block on the rows with mass, on all rows, with zeros elsewhere."""
        if isinstance(self.rows, slice):
            return block
        whole = np.zeros((self.n, *block.shape[1:]), order="F")
        whole[self.rows] = block
        return whole

    def stiff(self, block: Floats) -> Floats:
        """K block, (n, n_columns)."""
        return triangle_product(self.stiffness, block)

    def shifted(self, block: Floats, shift: float, out: Floats) -> None:
        """(K - s M) block at any shift s, (n, n_columns), put into out, column by column."""
        triangle_product(self.stiffness, block, out=out)
        diagonal = self.mass.diagonal()
        for x, forces in zip(block.T, out.T, strict=True):
            forces -= shift * triangle_product(self.mass, x, diagonal)

    def inertia(self, block: Floats, out: Floats | None = None) -> Floats:
        """M block, on the rows with mass; out: where to put it, in Fortran order."""
        return triangle_product(self._inner_mass, block, self._inner_diagonal, out)

    def largest_eigenvalue(self) -> float:
        """A number of the size of the largest eigenvalue: the stiffest unknown by itself."""
        inertia = self.mass.diagonal()
        moving = inertia > 0.0
        largest = float(np.max(np.abs(self.stiffness.diagonal()[moving]) / inertia[moving]))
        return largest if largest > 0.0 else 1.0

    def is_invertible(self) -> bool:
        """Whether the factors give a known solution back, in the scale of each unknown.

        In single precision: whether nothing that forces at random move most is without energy.
        """
        if self._invertible is None:
            self._invertible = self._gives_back()
        return self._invertible

    def _gives_back(self) -> bool:
        known = np.random.default_rng(1).standard_normal(self.n)
        shift = 0.0 if self.shift is None else self.shift
        diagonal = np.abs(self.stiffness.diagonal()) + abs(shift) * self.mass.diagonal()
        if not diagonal.all():
            return False
        known /= np.sqrt(diagonal)
        if not self.exact:
            random = with_random(np.zeros((self.n, 0)), BLOCK)
            moved = self.inverse(random * np.sqrt(diagonal)[:, None])
            forces = self.stiff(moved) - shift * triangle_product(self.mass, moved)
            factor = unit_combinations(moved.T @ (diagonal[:, None] * moved), 0.0)
            energies = np.linalg.eigvalsh(factor.T @ (moved.T @ forces) @ factor)
            return bool(energies[0] > _WITHOUT_ENERGY)
        forces = triangle_product(self.stiffness, known)
        forces -= shift * triangle_product(self.mass, known)
        lost = (self.inverse(forces) - known) * np.sqrt(diagonal)
        return bool(np.linalg.norm(lost) <= _LOST * np.sqrt(self.n))

    def _take(self, stiffness: sparse.csr_array, mass: sparse.csr_array) -> None:
        self.stiffness, self.mass = stiffness, mass
        self.shift, self.below = None, -1
        self.rows, self._inner_mass = _with_mass(mass)
        self._inner_diagonal = self._inner_mass.diagonal()
        self.n_with_mass = int(self._inner_mass.shape[0])


def shift_below(eigenvalue: float) -> float:
    """A shift below the spectrum, about a tenth of a first elastic eigenvalue, (rad/s)^2.

    The same for all that are nearly alike, so that modes do not hang on digits of where it is from.
    """
    return SHIFT * 2.0 ** round(math.log2(abs(eigenvalue) or 1.0))


def estimate_shift(pencil: Pencil) -> float:
    """A shift below the spectrum, (rad/s)^2: a tenth of about the first elastic eigenvalue.

    Where nothing moves rigidly it is next to zero, and the pencil is factorised there already.
    Raises ModelError where the matrices are singular together. Source: Bathe 2014, 11.6 (subspace
    iteration), 11.2.3 (shifts for free structures).
    """
    least = -LEAST_SHIFT * pencil.largest_eigenvalue()
    least = factorise_below(pencil, least)
    if not pencil.is_invertible():
        raise singular_together(pencil)
    start = with_random(np.zeros((pencil.n_with_mass, 0)), min(BLOCK, pencil.n_with_mass))
    pairs = largest_pairs(pencil, start, BLOCK, 0.0, 2)
    eigenvalues = 1.0 / np.maximum(pairs.inverted, 1e-300) + least
    if eigenvalues[0] > -least:  # nothing moves rigidly, and the first mode is as far away or more
        return least
    elastic = eigenvalues[eigenvalues > -STRAINED * least]  # single parts may move rigidly
    first = float(elastic[0] if elastic.size else abs(eigenvalues[-1]))
    return min(SHIFT * first, least)


def largest_pairs(
    pencil: Pencil,
    start: Floats,
    n_pairs: int,
    tolerance: float,
    n_blocks: int,
    *,
    least_inverted: float = 0.0,
) -> RitzPairs:
    """block_krylov of a factorised pencil; start: (n_with_mass, n_start), written over."""
    return block_krylov(
        pencil.apply_inside,
        pencil.inertia,
        start,
        n_pairs,
        tolerance,
        n_blocks,
        least_inverted=least_inverted,
        room_for=pencil.room_for,
    )


def factorise_below(pencil: Pencil, shift: float) -> float:
    """Factorise at the shift, or at a lower one where there are eigenvalues below it.

    shift: (rad/s)^2, negative. Returns the shift taken. Raises ModelError where stiffness and
    mass are singular together, or there are eigenvalues below any shift.
    """
    lowest = -1e3 * pencil.largest_eigenvalue()
    if pencil.shift != shift:
        pencil.factorise(shift)
    while pencil.below > 0:
        if shift < lowest:
            raise ModelError(
                f"there are {pencil.below} eigenvalues below any that the stiffness could have: "
                "the mass matrix has negative eigenvalues, or an unknown without mass has "
                "negative stiffness"
            )
        shift *= 4.0
        pencil.factorise(shift)
    if pencil.below < 0:
        raise singular_together(pencil)
    return shift


def count_below(pencil: Pencil, eigenvalue: float, margin: float) -> tuple[float, int]:
    """Return a number near an eigenvalue, and how many eigenvalues are below that number.

    margin: distance from it, (rad/s)^2, negative for below; somewhat larger if a pivot happens to
    be nearly zero there. The count is -1 if this happens at each number tried. Leaves the
    pencil factorised there.
    """
    beside = eigenvalue
    for share in (1.0, 3.0, 10.0):
        beside = eigenvalue + share * margin
        pencil.factorise(beside)
        if pencil.below >= 0:
            break
    pencil.kept_shift = None  # among the eigenvalues: of no use for a model like it
    return beside, pencil.below


def singular_together(pencil: Pencil) -> ModelError:
    """The error to raise where K - s M has no inverse at any s."""
    return ModelError(
        f"stiffness and mass of {pencil.n} unknowns are singular together: an unknown has neither, "
        "or a mechanism without mass moves freely"
    )


def triangle_product(
    upper: sparse.csr_array,
    block: Floats,
    diagonal: Floats | None = None,
    out: Floats | None = None,
) -> Floats:
    """The symmetric matrix with this upper triangle times a block, in Fortran order.

    upper: (n, n); block: (n,) or (n, n_columns); diagonal: (n,) of upper, where it is at hand;
    out: where to put it, of the shape of block.
    """
    lower = upper.T
    diagonal = upper.diagonal() if diagonal is None else diagonal
    out = np.empty(block.shape, order="F") if out is None else out
    columns, into = (a[:, None] if a.ndim == 1 else a for a in (block, out))
    for place in range(columns.shape[1]):
        x = np.ascontiguousarray(columns[:, place])
        y = upper @ x
        y += lower @ x
        y -= diagonal * x
        into[:, place] = y
    return out


def _with_mass(mass: sparse.csr_array) -> tuple[Integers | slice, sparse.csr_array]:
    # A row of M with a zero on its diagonal is a zero row, or M were not a mass matrix.
    inertia = mass.diagonal()
    moving = inertia != 0.0
    if (inertia < 0.0).any():
        raise ModelError(
            f"the mass matrix is negative at row {int(np.argmin(inertia))} (from 0): it is not a "
            "mass matrix"
        )
    if moving.all():
        return slice(None), mass
    if not moving.any():
        raise ModelError("the mass matrix is zero: there is nothing that moves")
    rows = np.flatnonzero(moving)
    inner = sparse.csr_array(mass[rows][:, rows])
    inner.sort_indices()
    if np.count_nonzero(inner.data) != np.count_nonzero(mass.data):
        raise ModelError("the mass matrix has negative eigenvalues: it is not a mass matrix")
    return rows, inner


def _places(pattern: sparse.csr_array, part: sparse.csr_array) -> Places:
    return slice(None) if same_pattern(pattern, part) else places_in(pattern, part)


def _check(stiffness: sparse.csr_array, mass: sparse.csr_array) -> None:
    if stiffness.shape != mass.shape or stiffness.shape[0] != stiffness.shape[1]:
        raise ModelError(f"stiffness is {stiffness.shape}, mass is {mass.shape}: not one model")
    for name, matrix in (("stiffness", stiffness), ("mass", mass)):
        if not matrix.has_canonical_format or not _is_upper(matrix):
            raise ModelError(f"the {name} matrix is not an upper triangle with sorted rows")
        if not np.isfinite(matrix.data).all():
            raise ModelError(f"the {name} matrix holds values that are not finite")


def _is_upper(matrix: sparse.csr_array) -> bool:
    filled = np.flatnonzero(np.diff(matrix.indptr))
    return bool((matrix.indices[matrix.indptr[filled]] >= filled).all())
