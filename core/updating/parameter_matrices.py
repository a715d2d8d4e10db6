"""Stiffness and mass of a model for all values of its parameters.

A matrix of finite elements is a sum of parts, each proportional to a power of one parameter:

    A(theta) = A_ref + sum over columns c and powers k of (theta_c^k - ref_c^k) A_ck.

**Powers.** Young's modulus, density, a spring or a point mass have power 1 only, and two samples of
A, the reference and one more, give A_c1 = (A - A_ref) / (theta_c - ref_c) exactly. A shell's
thickness t has more of them. Expanded to a solid with an unknown at both faces, its Jacobian is
proportional to t, its strains across the thickness to 1/t: B^T D B t has t^-1, t^0 and t^1. Where
shells meet at an angle or with different thicknesses, the faces move with a rigid knot, through
arms of length t/2: T^T K T with T = T_0 + t T_1 has t^-1 up to t^3, the mass t^1 up to t^3. So -1,
1, 2 and 3 in addition to the constant are all the powers of an unwarped or warped, flat or joined
shell with full integration, and as many samples in addition to the reference fit them:

    A(v_i) - A_ref = sum_k (v_i^k - ref^k) A_k.

Samples at factors spread over 1/2 to 2 (0.55, 0.75, 1.4, 1.9) reproduce the text's 14 digits to
10^-13 of sqrt(a_ii a_jj) everywhere between; within 20 % of the reference they lose two digits.
A model of matrices may also have parts whose factor an expression of parameters gives (a tube's
radius r: mass with r^2, bending with r^4). Such a part is whole at the reference and adds
f(theta) - 1 of itself; its derivatives are those of the expression.

Each part keeps its values by position in the reference's entries, so all theta have one pattern
(one symbolic factorisation serves all), at 12 bytes an entry. Parts of disjoint element groups
together are no larger than the reference.

**Several parameters in one sample.** One matrix job may move several parameters at once whose
element groups share no node. Its difference to the base is then block diagonal over the groups: the
connected components of the difference's pattern, each of which belongs to the group that has one of
its nodes. Equations that are not a deck node's (incompatible modes of C3D8I, rotations of knots)
are reached through those that are.

**Rounding.** Stored matrices are text of 14 digits of sums over elements, so entries of the same
number may differ by rounding. An entry a_ij printed so is off by half a unit of its last digit, at
most 0.5 10^-13 |a_ij|; a sum of m terms is off by m eps / 2 times the sum of their sizes, and
threads may take the terms in another order. Element matrices are positive semi-definite, hence

    |k_ij| <= sqrt(k_ii k_jj) for each element, and sum |k_ij| <= sqrt(a_ii a_jj) (Cauchy, Schwarz):

both are at most ROUNDING sqrt(a_ii a_jj), however small the sum itself is. What follows from
several matrices has the rounding of all of them, sum_s ROUNDING sqrt(a_ii^s a_jj^s), and by Cauchy
and Schwarz again that is at most ROUNDING sqrt(d_i d_j) with d the sum of their diagonals. Below
this nothing is a change: also not in a remainder, where entries that were too small to be seen as a
parameter's are left over (on a mesh with dust of 10^-13 in its coordinates, where exact zeros of
the ideal one are 10^-13 of the diagonal). A true change is above it unless a group is some 10^12
times softer than what it is joined to, where the text has lost it.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.csgraph import connected_components

from modetune.core.algebra.matrices import (
    ROWS_AT_ONCE,
    MatrixResult,
    places_in,
    projected,
    union,
    upper_product,
)
from modetune.core.algebra.vector_room import put_in_file
from modetune.core.errors import ModelError
from modetune.core.modes import Floats, Integers
from modetune.core.updating.relation import Relation

#: Beyond this condition a fit of powers has fewer than six of the text's fourteen digits left.
HOPELESS_FIT = 1e8
#: Entries added at once; these many stay in the processor's cache.
_ENTRIES_AT_ONCE = 1 << 17
#: Terms that are summed to one entry: 24 tetrahedra of 4 integration points, 8 bricks of 27.
TERMS = 256
#: Largest rounding of a stored entry in sqrt(a_ii a_jj): its 14 digits, and that of its sum.
ROUNDING = 0.5e-13 + 0.5 * TERMS * float(np.finfo(np.float64).eps)


def powers_moved(powers: tuple[int, ...], value: float, reference: float) -> Floats:
    """theta^k - ref^k for each power, (n_powers,)."""
    return np.array([value**power - reference**power for power in powers])


def powers_slopes(powers: tuple[int, ...], value: float, order: int = 1) -> Floats:
    """Derivatives of theta^k for each power, (n_powers,), of order 1 or 2."""
    if order == 2:
        return np.array([k * (k - 1) * value ** (k - 2) for k in powers])
    return np.array([k * value ** (k - 1) for k in powers])


class ParameterPart(Protocol):
    """A part of a matrix: powers of one parameter, or one factor that a relation gives."""

    @property
    def column(self) -> int: ...

    @property
    def powers(self) -> tuple[int, ...]: ...

    @property
    def relation(self) -> Relation | None: ...


def columns_of(part: ParameterPart) -> tuple[int, ...]:
    """Return the parameters that a part depends on."""
    return (part.column,) if part.relation is None else part.relation.columns


def factors_moved(part: ParameterPart, theta: Floats, reference: Floats) -> Floats:
    """Return what a part's matrices are multiplied by beyond the reference, (n_powers,).

    theta, reference: (n_parameters,). Raises ModelError where an expression has no value.
    """
    if part.relation is not None:
        return np.array([part.relation.at(theta) - 1.0])
    here, there = float(theta[part.column]), float(reference[part.column])
    return powers_moved(part.powers, here, there)


def factors_slopes(part: ParameterPart, theta: Floats, column: int, order: int = 1) -> Floats:
    """Return the derivatives of these factors with respect to a column, of order 1 or 2."""
    if part.relation is not None:
        return np.array([part.relation.change(theta, column, order)])
    return powers_slopes(part.powers, float(theta[column]), order)


@dataclass(frozen=True, slots=True)
class Powers:
    """What one parameter, or a relation, adds to a matrix: an upper triangle (n, n) a power."""

    column: int
    powers: tuple[int, ...]
    uppers: tuple[sparse.csr_array, ...]
    relation: Relation | None = None


@dataclass(frozen=True, slots=True)
class ParameterMatrix:
    """What goes with the powers of one parameter, by position in the reference's entries.

    relation: gives the only factor instead, which is 1 at the reference; column is then -1.

    places: (n_entries,), ascending, positions in `data` of the reference's upper triangle.
    values: (n_powers, n_entries).
    """

    column: int
    powers: tuple[int, ...]
    places: Integers
    values: Floats
    relation: Relation | None = None

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
        stiffness, mass = (
            (projected(upper, vectors), [(part, part.on(upper, vectors)) for part in parts])
            for upper, parts in (
                (self.base.upper_stiffness, self.stiffness),
                (self.base.upper_mass, self.mass),
            )
        )
        return dense_matrices(self.reference, stiffness, mass)

    def change(
        self, theta: Floats, column: int, order: int = 1
    ) -> tuple[sparse.csr_array, sparse.csr_array]:
        """Upper triangles of dK/dtheta_c and dM/dtheta_c at these values, exact; order 2 gives
        the second derivatives."""
        stiffness, mass = (
            _sum_of_parts(upper, parts, theta, column, order)
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
        """Whether both matrices are linear in a parameter, as far as powers show it."""
        parts = (*self.stiffness, *self.mass)
        return all(
            part.powers == (1,) and part.relation is None
            for part in parts
            if column in columns_of(part)
        )

    @property
    def columns(self) -> tuple[int, ...]:
        """The parameters that the matrices depend on, ascending."""
        found = {column for part in (*self.stiffness, *self.mass) for column in columns_of(part)}
        return tuple(sorted(found))

    def _at(
        self, upper: sparse.csr_array, parts: tuple[ParameterMatrix, ...], theta: Floats
    ) -> sparse.csr_array:
        data = upper.data.copy()
        for part in parts:
            factors = factors_moved(part, theta, self.reference)
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


def dense_matrices(
    reference: Floats,
    stiffness: tuple[Floats, Iterable[tuple[ParameterPart, Floats]]],
    mass: tuple[Floats, Iterable[tuple[ParameterPart, Floats]]],
) -> ParameterMatrices:
    """The matrices of a small model, whose unknowns have numbers from 0.

    stiffness, mass: (r, r) at the reference (n_parameters,), and the values (n_powers, r, r) of
    each part.
    """

    def upper(matrix: Floats) -> sparse.csr_array:
        return sparse.csr_array(np.triu(matrix))

    numbers = np.arange(stiffness[0].shape[0])
    base = MatrixResult(upper(stiffness[0]), upper(mass[0]), numbers, np.ones_like(numbers))
    parts = (
        [Powers(part.column, part.powers, tuple(map(upper, values)), part.relation)
         for part, values in own]
        for _, own in (stiffness, mass)
    )  # fmt: skip
    return parameter_matrices(base, reference, *parts)


def fit_powers(
    differences: Sequence[sparse.csr_array],
    values: Sequence[float],
    reference: float,
    powers: tuple[int, ...],
) -> tuple[sparse.csr_array, ...]:
    """The upper triangle (n, n) that goes with each power of a parameter.

    differences: upper triangles, (n, n), of samples at these values of the parameter less the
    base at the reference value; as many as powers, none of which is 0. Raises ModelError where
    the values do not separate the powers.
    """
    if not len(differences) == len(values) == len(powers):
        raise ModelError(f"{len(powers)} powers are fitted to {len(differences)} matrices")
    system = np.array([[value**k - reference**k for k in powers] for value in values])
    condition = float(np.linalg.cond(system))
    if not condition < HOPELESS_FIT:
        raise ModelError(
            f"matrices at the relative values {', '.join(f'{value:g}' for value in values)} do "
            f"not separate the powers {', '.join(map(str, powers))} (condition {condition:.1e})"
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
    theta: Floats,
    column: int,
    order: int,
) -> sparse.csr_array:
    """A derivative of a matrix with respect to a column, an upper triangle."""
    own = [
        part.upper(upper, factors_slopes(part, theta, column, order))
        for part in parts
        if column in columns_of(part)
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
    places = places_in(upper, pattern)
    return ParameterMatrix(part.column, part.powers, places, values, part.relation)


def differences(
    base: MatrixResult, other: MatrixResult
) -> tuple[sparse.csr_array, sparse.csr_array]:
    """Upper triangles of what another state's stiffness and mass have beyond the base's.

    Differences that may be rounding are left out.

    Raises ModelError where the two are not on the same equations.
    """
    if not (
        np.array_equal(base.nodes, other.nodes)
        and np.array_equal(base.components, other.components)
    ):
        raise ModelError(
            f"the stored matrices of two states of the model have other equations "
            f"({base.nodes.size} and {other.nodes.size}), as where shells of equal thickness "
            "become unequal; start where they are unequal"
        )
    stiffness, mass = (
        _without_rounding(new - old, np.abs(new.diagonal()) + np.abs(old.diagonal()))
        for old, new in (
            (base.upper_stiffness, other.upper_stiffness),
            (base.upper_mass, other.upper_mass),
        )
    )
    return stiffness, mass


def remainder(
    upper: sparse.csr_array, taken: Iterable[tuple[float, sparse.csr_array]]
) -> sparse.csr_array:
    """What is left of an upper triangle (n, n) without parts of it, no rounding.

    taken: factors and matrices; factor times matrix is what a parameter has of the triangle, found
    as its change where the parameter is twice as large.
    """
    # A copy: entries are taken out in place below, of the triangle itself where nothing is taken.
    left, diagonal = upper.copy(), upper.diagonal()
    sizes = np.abs(diagonal)
    for factor, matrix in taken:
        part = factor * matrix
        left, own = left - part, part.diagonal()
        # The two matrices of that change, diagonal and diagonal + own.
        sizes += np.where(own != 0.0, 2.0 * np.abs(diagonal) + np.abs(own), 0.0)
    return _without_rounding(left, sizes)


def _without_rounding(found: sparse.csr_array, sizes: Floats) -> sparse.csr_array:
    """A difference without entries that are only rounding.

    sizes: (n,), of the matrices that it was made of the sum of their diagonals.
    """
    found = sparse.csr_array(found)
    root = np.sqrt(sizes)
    for first in range(0, root.size, ROWS_AT_ONCE):
        starts = found.indptr[first : first + ROWS_AT_ONCE + 1]
        piece = slice(starts[0], starts[-1])
        allowed = np.repeat(ROUNDING * root[first : first + ROWS_AT_ONCE], np.diff(starts))
        allowed *= root[found.indices[piece]]
        data = found.data[piece]
        data[np.abs(data) <= allowed] = 0.0
    found.eliminate_zeros()
    found.sort_indices()
    return found


def separate(
    difference: sparse.csr_array,
    nodes: Integers,
    node_groups: Sequence[frozenset[int]],
    whole: sparse.csr_array | None = None,
) -> list[sparse.csr_array]:
    """The parts of a difference that belong to groups of elements, upper triangles (n, n) each.

    difference: upper triangle, (n, n), without rounding; nodes: (n,), the node that each equation
    is named after; node_groups: the nodes of each group; whole: upper triangle (n, n) of the model,
    by which equations inside elements are joined to their nodes where the difference does not join
    them (of a rectangular shell's thickness it has only their diagonal). Raises ModelError where
    groups share a node, or a part of the difference touches none or several of them.
    """
    owner = _owners(nodes, node_groups)
    _, component = connected_components(difference, directed=False)
    changed = np.diff(difference.indptr) > 0
    changed[difference.indices] = True
    lowest = np.full(nodes.size, len(node_groups))
    highest = np.full(nodes.size, -1)
    named = changed & (owner >= 0)
    np.minimum.at(lowest, component[named], owner[named])
    np.maximum.at(highest, component[named], owner[named])
    if whole is not None:
        lost = np.flatnonzero(changed & (highest[component] < 0))
        beside = _beside(whole, lost, owner)
        np.minimum.at(lowest, component[lost], np.where(beside < 0, len(node_groups), beside))
        np.maximum.at(highest, component[lost], beside)
    wrong = np.flatnonzero(changed & (lowest != highest)[component])
    if wrong.size:
        where = f"node {nodes[wrong[0]]}"
        raise ModelError(
            f"the stored matrices changed at {where}, which is not joined to the elements of any "
            "moved parameter"
            if highest[component[wrong[0]]] < 0
            else f"the stored matrices changed at {where} by two parameters whose elements should "
            "share no node"
        )
    owners = np.where(changed, highest[component], -1)
    return [_rows(difference, owners == place) for place in range(len(node_groups))]


def with_tied(nodes: Iterable[int], ties: Iterable[tuple[set[int], set[int]]]) -> set[int]:
    """These nodes and all that ties lead to from them; ties: nodes, and those they depend on."""
    leads: dict[int, set[int]] = {}
    for dependent, others in ties:
        for node in dependent:
            leads.setdefault(node, set()).update(others)
    reached, new = set(nodes), set(nodes)
    while new:
        new = set[int]().union(*(leads.get(node, ()) for node in new)) - reached
        reached |= new
    return reached


def _beside(whole: sparse.csr_array, rows: Integers, owner: Integers) -> Integers:
    """The group of the nodes that each of these rows is coupled with, (n_rows,); -1 where none.

    An equation inside an element is coupled with that element's nodes alone, and two groups share
    no node.
    """
    found = np.full(rows.size, -1)
    for part in (whole[rows], sparse.csr_array(sparse.csc_array(whole)[:, rows].T)):
        here = np.repeat(np.arange(rows.size), np.diff(part.indptr))
        np.maximum.at(found, here, owner[part.indices])
    return found


def _owners(nodes: Integers, node_groups: Sequence[frozenset[int]]) -> Integers:
    """The group that has each equation's node, (n,); -1 where none has."""
    owner = np.full(nodes.size, -1)
    for place, group in enumerate(node_groups):
        inside = np.isin(nodes, np.fromiter(group, np.int64, len(group)))
        shared = np.flatnonzero(inside & (owner >= 0))
        if shared.size:
            raise ModelError(
                f"parameters {owner[shared[0]]} and {place} of one matrix job share node "
                f"{nodes[shared[0]]}: their changes cannot be separated"
            )
        owner[inside] = place
    return owner


def _rows(upper: sparse.csr_array, kept: NDArray[np.bool_]) -> sparse.csr_array:
    """The matrix with these rows only, the others empty."""
    counts = np.diff(upper.indptr)
    entries = np.repeat(kept, counts)
    pointers = np.concatenate([[0], np.cumsum(np.where(kept, counts, 0))])
    data, indices = upper.data[entries], upper.indices[entries]
    pointers = pointers.astype(upper.indptr.dtype)
    return sparse.csr_array((data, indices, pointers), shape=upper.shape)
