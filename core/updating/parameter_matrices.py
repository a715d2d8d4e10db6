"""Stiffness and mass of a model for all values of its parameters.

A matrix of finite elements is a sum of parts, each of which goes with a power of one parameter:

    A(theta) = A_ref + sum over columns c and powers k of (theta_c^k - ref_c^k) A_ck.

Young's modulus, density, a spring or a point mass have power 1 alone, and two samples of A, the
reference and one more, give A_c1 = (A - A_ref) / (theta_c - ref_c) exactly. A shell's thickness t
has more of them. Expanded to a solid with an unknown at both faces, its Jacobian is proportional
to t, its strains across the thickness to 1/t: B^T D B t has t^-1, t^0 and t^1. Where shells meet
at an angle or with different thicknesses, the faces move with a rigid knot, through arms of
length t/2: T^T K T with T = T_0 + t T_1 has t^-1 up to t^3, the mass t^1 up to t^3. So -1, 1, 2
and 3 beside the constant are all the powers of an unwarped or warped, flat or joined shell with
full integration, and as many samples beside the reference fit them:

    A(v_i) - A_ref = sum_k (v_i^k - ref^k) A_k.

Samples at factors spread over 1/2 to 2 (0.55, 0.75, 1.4, 1.9) bring the text's 14 digits back to
10^-13 of sqrt(a_ii a_jj) everywhere between; within 20 % of the reference they lose two digits.

Each part keeps its values by position in the reference's entries, so all theta have one pattern
(a symbolic factorisation holds for all), at 12 bytes an entry. Parts of disjoint element groups
together are no larger than the reference.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy import sparse

from modetune.core.algebra.matrices import MatrixResult, places_in, projected, union, upper_product
from modetune.core.algebra.vector_room import put_in_file
from modetune.core.errors import ModelError
from modetune.core.modes import Floats, Integers

#: Beyond this condition a fit of powers has fewer than six of the text's fourteen digits left.
HOPELESS_FIT = 1e8
#: Entries added at once; these many stay in the processor's cache.
_ENTRIES_AT_ONCE = 1 << 17


def powers_moved(powers: tuple[int, ...], value: float, reference: float) -> Floats:
    """theta^k - ref^k for each power, (n_powers,)."""
    return np.array([value**power - reference**power for power in powers])


def powers_slopes(powers: tuple[int, ...], value: float, order: int = 1) -> Floats:
    """Derivatives of theta^k for each power, (n_powers,), of order 1 or 2."""
    if order == 2:
        return np.array([k * (k - 1) * value ** (k - 2) for k in powers])
    return np.array([k * value ** (k - 1) for k in powers])


@dataclass(frozen=True, slots=True)
class Powers:
    """What one parameter adds to a matrix: an upper triangle (n, n) for each power."""

    column: int
    powers: tuple[int, ...]
    uppers: tuple[sparse.csr_array, ...]


@dataclass(frozen=True, slots=True)
class ParameterMatrix:
    """What goes with the powers of one parameter, by position in the reference's entries.

    places: (n_entries,), ascending, positions in `data` of the reference's upper triangle.
    values: (n_powers, n_entries).
    """

    column: int
    powers: tuple[int, ...]
    places: Integers
    values: Floats

    def upper(self, base: sparse.csr_array, factors: Floats) -> sparse.csr_array:
        """Its powers times factors (n_powers,), an upper triangle with its own entries alone.

        base: the upper triangle in which it has its places.
        """
        pointers = np.searchsorted(self.places, base.indptr).astype(base.indptr.dtype)
        entries = (factors @ self.values, base.indices[self.places], pointers)
        return sparse.csr_array(entries, shape=base.shape)

    def on(self, base: sparse.csr_array, vectors: Floats) -> Floats:
        """Its powers on the space of these vectors (n, r), (n_powers, r, r)."""
        units = np.eye(len(self.powers))
        return np.stack([projected(self.upper(base, unit), vectors) for unit in units])


@dataclass(frozen=True, slots=True)
class ParameterMatrices:
    """A model's matrices for all parameter values.

    reference: (n_parameters,), relative values of the base. base: the matrices there, with an
    entry wherever some values have one. stiffness, mass: parts, any number to a parameter.
    """

    reference: Floats
    base: MatrixResult
    stiffness: tuple[ParameterMatrix, ...]
    mass: tuple[ParameterMatrix, ...]

    def at(self, theta: Floats) -> MatrixResult:
        """The matrices at these values (n_parameters,); all share one pattern, arrays included."""
        stiffness = self._at(self.base.upper_stiffness, self.stiffness, theta)
        return replace(self.base, upper_stiffness=stiffness, upper_mass=self.mass_at(theta))

    @property
    def n_bytes(self) -> int:
        """What their numbers take, without the pattern that matrices at all values share."""
        own = (self.base.upper_stiffness.data, self.base.upper_mass.data)
        parts = (
            array for part in (*self.stiffness, *self.mass) for array in (part.places, part.values)
        )
        return sum(array.nbytes for array in (*own, *parts))

    def in_files(self, folder: Path) -> ParameterMatrices:
        """The same with their numbers in files of a folder, which go with them.

        They are read from one end to the other for each set. Raises SolverExhausted where the disk
        is full.
        """

        def whole(upper: sparse.csr_array) -> sparse.csr_array:
            data = put_in_file(folder, upper.data)
            return sparse.csr_array((data, upper.indices, upper.indptr), shape=upper.shape)

        def each(parts: tuple[ParameterMatrix, ...]) -> tuple[ParameterMatrix, ...]:
            return tuple(
                replace(
                    part,
                    places=put_in_file(folder, part.places),
                    values=put_in_file(folder, part.values.T).T,
                )
                for part in parts
            )

        stiffness, mass = whole(self.base.upper_stiffness), whole(self.base.upper_mass)
        base = replace(self.base, upper_stiffness=stiffness, upper_mass=mass)
        return replace(self, base=base, stiffness=each(self.stiffness), mass=each(self.mass))

    def mass_at(self, theta: Floats) -> sparse.csr_array:
        """The mass' upper triangle alone."""
        return self._at(self.base.upper_mass, self.mass, theta)

    def on(self, vectors: Floats) -> ParameterMatrices:
        """On the space of these vectors (n_equations, r), whose numbers are its unknowns."""

        def small(matrix: Floats) -> sparse.csr_array:
            return sparse.csr_array(np.triu(matrix))

        numbers, wholes, parts = np.arange(vectors.shape[1]), [], []
        for upper, of in (
            (self.base.upper_stiffness, self.stiffness),
            (self.base.upper_mass, self.mass),
        ):
            wholes.append(small(projected(upper, vectors)))
            found = [(p, map(small, p.on(upper, vectors))) for p in of]
            parts.append([Powers(p.column, p.powers, tuple(uppers)) for p, uppers in found])
        few = MatrixResult(wholes[0], wholes[1], numbers, np.ones_like(numbers))
        return parameter_matrices(few, self.reference, *parts)

    def change(
        self, theta: Floats, column: int, order: int = 1
    ) -> tuple[sparse.csr_array, sparse.csr_array]:
        """Upper triangles of dK/dtheta_c and dM/dtheta_c at these values, exact; order 2 gives
        the second derivatives."""
        value = float(theta[column])
        stiffness, mass = (
            _sum_of_parts(upper, parts, column, value, order)
            for upper, parts in (
                (self.base.upper_stiffness, self.stiffness),
                (self.base.upper_mass, self.mass),
            )
        )
        return stiffness, mass

    def products(
        self, theta: Floats, column: int, block: Floats, order: int = 1
    ) -> tuple[Floats, Floats]:
        """The same times a block of vectors (n, k), (n, k) each."""
        stiffness, mass = self.change(theta, column, order)
        return upper_product(stiffness, block), upper_product(mass, block)

    def is_linear(self, column: int) -> bool:
        """Whether both matrices are linear in a parameter."""
        parts = (*self.stiffness, *self.mass)
        return all(part.powers == (1,) for part in parts if part.column == column)

    def _at(
        self, upper: sparse.csr_array, parts: tuple[ParameterMatrix, ...], theta: Floats
    ) -> sparse.csr_array:
        data = upper.data.copy()
        for part in parts:
            factors = powers_moved(
                part.powers, float(theta[part.column]), float(self.reference[part.column])
            )
            for values, factor in zip(part.values, factors.tolist(), strict=True):
                if factor != 0.0:
                    _add_scaled(data, part.places, values, factor)
        return sparse.csr_array((data, upper.indices, upper.indptr), shape=upper.shape)


def parameter_matrices(
    base: MatrixResult, reference: Floats, stiffness: Iterable[Powers], mass: Iterable[Powers]
) -> ParameterMatrices:
    """The matrices for all values from those at the reference and what each parameter adds.

    reference: (n_parameters,), relative values of the base.
    """
    upper_stiffness, stiffness_parts = _placed(base.upper_stiffness, tuple(stiffness))
    upper_mass, mass_parts = _placed(base.upper_mass, tuple(mass))
    whole = replace(base, upper_stiffness=upper_stiffness, upper_mass=upper_mass)
    return ParameterMatrices(reference, whole, stiffness_parts, mass_parts)


def fit_powers(
    differences: Sequence[sparse.csr_array],
    values: Sequence[float],
    reference: float,
    powers: tuple[int, ...],
) -> tuple[sparse.csr_array, ...]:
    """The upper triangle (n, n) that goes with each power of a parameter.

    differences: upper triangles, (n, n), of samples at these values of the parameter less the
    base at the reference value; as many as powers, none of which is 0. Raises ModelError where
    the values do not tell the powers apart.
    """
    if not len(differences) == len(values) == len(powers):
        raise ModelError(f"{len(powers)} powers are fitted to {len(differences)} matrices")
    system = np.array([[value**k - reference**k for k in powers] for value in values])
    condition = float(np.linalg.cond(system))
    if not condition < HOPELESS_FIT:
        raise ModelError(
            f"matrices at the relative values {', '.join(f'{value:g}' for value in values)} do "
            f"not tell the powers {', '.join(map(str, powers))} apart (condition {condition:.1e})"
        )
    pattern = union(differences)
    samples = np.zeros((len(values), pattern.nnz))
    for row, difference in zip(samples, differences, strict=True):
        row[places_in(pattern, difference)] = difference.data
    fitted = np.linalg.solve(system, samples)
    shape = pattern.shape
    return tuple(
        sparse.csr_array((data, pattern.indices, pattern.indptr), shape=shape) for data in fitted
    )


def _sum_of_parts(
    upper: sparse.csr_array,
    parts: tuple[ParameterMatrix, ...],
    column: int,
    value: float,
    order: int,
) -> sparse.csr_array:
    """A derivative of a matrix with respect to a column, an upper triangle."""
    own = [
        part.upper(upper, powers_slopes(part.powers, value, order))
        for part in parts
        if part.column == column
    ]
    if not own:
        return sparse.csr_array(upper.shape)
    return sparse.csr_array(sum(own[1:], own[0]))


def _add_scaled(data: Floats, places: Integers, values: Floats, factor: float) -> None:
    """data[places] += factor * values, in pieces that stay in the cache."""
    for start in range(0, places.size, _ENTRIES_AT_ONCE):
        piece = slice(start, start + _ENTRIES_AT_ONCE)
        data[places[piece]] += factor * values[piece]


def _placed(
    upper: sparse.csr_array, parts: tuple[Powers, ...]
) -> tuple[sparse.csr_array, tuple[ParameterMatrix, ...]]:
    """The base with an entry wherever a part has one, and the parts by position in it."""
    uppers = [item for part in parts for item in part.uppers]
    if any(item.shape != upper.shape for item in uppers):
        raise ModelError(f"a part's matrix does not have the base's {upper.shape[0]} equations")
    upper.prune()  # a solver's zeros that were dropped leave room behind the entries
    if not all(places_in(upper, item).size == item.nnz for item in uppers):
        pattern = union([upper, *uppers])
        data = np.zeros(pattern.nnz)
        data[places_in(pattern, upper)] = upper.data
        upper = sparse.csr_array((data, pattern.indices, pattern.indptr), shape=upper.shape)
    kept = (part for part in parts if any(item.nnz for item in part.uppers))
    return upper, tuple(_part(upper, part) for part in kept)


def _part(upper: sparse.csr_array, part: Powers) -> ParameterMatrix:
    first = part.uppers[0]
    alike = all(item.indices is first.indices for item in part.uppers)
    pattern = first if alike else union(part.uppers)
    values = np.zeros((len(part.powers), pattern.nnz))
    for row, item in zip(values, part.uppers, strict=True):
        row[slice(None) if alike else places_in(pattern, item)] = item.data
    return ParameterMatrix(part.column, part.powers, places_in(upper, pattern), values)
