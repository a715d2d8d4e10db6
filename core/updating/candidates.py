"""Changes that a model may lack: masses, springs and absorbers, exact in a reduced model.

A change adds matrices of low rank, a sum of a b b^T: a spring of stiffness a between two points has
for b the difference of their displacements, a point mass one vector for each direction. A reduced
model answers exactly to forces F that act where its basis contains the static response

    Z = (K - s M)^-1 F,

so the vectors Z of all places are projected once, together with the basis of modes and of their
derivatives (static attachment vectors: Craig 1981), and the model of one change is the part of the
projected matrices that belongs to the basis and its own few Z. A stiffness from zero to infinity
is in its space.

An absorber has an unknown of its own: its mass m there, and its spring k between the place and it.

A support or a rigid link that yields is released in the matrices before the constraint. With T q
the motion of the constrained model and r that of its released freedoms relative to it, the vectors

    u = r - T (K - s M)^-1 T^T (K_free - s M_free) r

for a few patterns r join the others, and the change is a spring of any stiffness k against r; the
model has the constraint where it is infinite. Springs answer the forces f of the constraint with
r = (k + S)^-1 f, S the stiffness of the rest at the released freedoms, so that patterns come from
the first blocks of a Krylov space of S: reactions of the modes, rigid motions of the group, and S
times these, several times.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Literal

import numpy as np
from scipy import sparse
from scipy.linalg import solve_triangular

from modetune.core.algebra.matrices import MatrixResult, upper_product
from modetune.core.errors import ModesError
from modetune.core.modes import Floats, Integers
from modetune.core.updating.parameter_matrices import ParameterMatrices
from modetune.core.updating.reduced_basis import (
    RANK,
    ReducedModel,
    ReducedPart,
    of_vectors,
    widened_model,
)

#: Vectors whose responses are computed at a time.
AT_ONCE = 64
NONE: Integers = np.zeros(0, dtype=np.int64)


@dataclass(frozen=True, slots=True)
class Term:
    """An amplitude times a sum of b b^T.

    amplitude: its position among those of the change. loads: positions of loads of an
    `AttachedModel`; vectors: (k, n_loads), the b in terms of these. own: (k, n_own), in terms of
    the unknowns that the change brings.
    """

    matrix: Literal["stiffness", "mass"]
    amplitude: int
    loads: tuple[int, ...]
    vectors: Floats
    own: Floats = field(default_factory=lambda: np.zeros((0, 0)))


@dataclass(frozen=True, slots=True)
class DampedModel(ReducedModel):
    """dampers: viscous and structural matrix, (r, r) each, at all values; none without."""

    dampers: tuple[Floats, ...] = ()

    @classmethod
    def of(cls, model: ReducedModel, dampers: tuple[Floats, ...]) -> DampedModel:
        own = {item.name: getattr(model, item.name) for item in fields(ReducedModel)}
        return cls(**own, dampers=dampers)

    def chosen(self, places: Integers) -> DampedModel:
        """Return the model on these of its vectors, (n_places,)."""
        own = tuple(matrix[np.ix_(places, places)] for matrix in self.dampers)
        return DampedModel.of(of_vectors(self, places), own)

    def mapped(self, square: Callable[[Floats], Floats], rows: Floats) -> DampedModel:
        """Return the model with each matrix (r, r) changed by a function, and with other rows."""

        def parts(given: tuple[ReducedPart, ...]) -> tuple[ReducedPart, ...]:
            return tuple(
                replace(part, values=np.stack([square(values) for values in part.values]))
                for part in given
            )

        return replace(
            self,
            base_stiffness=square(self.base_stiffness),
            base_mass=square(self.base_mass),
            stiffness=parts(self.stiffness),
            mass=parts(self.mass),
            rows=rows,
            dampers=tuple(map(square, self.dampers)),
        )

    def turned(self, turn: Floats) -> DampedModel:
        """Return the model on combinations (r, r_new) of its vectors."""
        return self.mapped(lambda values: turn.T @ values @ turn, self.rows @ turn)

    def scaled(self, scale: Floats) -> DampedModel:
        """Return the model with each vector multiplied by its scale, (r,)."""
        return self.mapped(lambda values: scale[:, None] * values * scale, self.rows * scale)

    def padded(self, n_own: int) -> DampedModel:
        """Return the model with unknowns of their own behind it, so far without any matrix."""
        if not n_own:
            return self
        rows = np.pad(self.rows, ((0, 0), (0, n_own)))
        return self.mapped(lambda values: np.pad(values, ((0, n_own), (0, n_own))), rows)


@dataclass(frozen=True, slots=True)
class AttachedModel:
    """A reduced model with the static responses to loads at the places of all changes.

    whole: on the basis, `size` vectors, and then the response to each load. at: (n_loads, n_all),
    the displacement of each load's place in these vectors. kept: loads whose responses the model
    of every change contains.
    """

    whole: DampedModel
    size: int
    at: Floats
    kept: Integers

    def flexibility(self, loads: Sequence[int], weights: Floats) -> float:
        """Return the static displacement along b under the force b.

        loads, weights: b, as one row of `Term.vectors`.
        """
        places = np.array(loads, dtype=np.int64)
        block = self.at[np.ix_(places, self.size + places)]
        return float(weights @ block @ weights)

    def changed(self, terms: Sequence[Term], n_amplitudes: int = 0) -> DampedModel:
        """Return the model with a change, whose amplitudes follow the parameters and start at 0.

        n_amplitudes: of the change, at least those of its terms.
        """
        loads = np.array([n for term in terms for n in term.loads], dtype=np.int64)
        used = np.unique(np.append(self.kept, loads))
        places = np.concatenate([np.arange(self.size), self.size + used])
        model = self.whole.chosen(places)
        turn = _independent(model.base_stiffness - model.shift * model.base_mass, self.size)
        model, at = model.turned(turn), self.at[:, places] @ turn
        n_own = max((term.own.shape[1] for term in terms), default=0)
        model = model.padded(n_own)
        n_before = model.reference.size
        n_amplitudes = max([n_amplitudes, *(1 + term.amplitude for term in terms)])
        added: dict[str, list[ReducedPart]] = {"stiffness": [], "mass": []}
        for term in terms:
            rows = np.zeros((term.vectors.shape[0], model.size))
            rows[:, : at.shape[1]] = term.vectors @ at[list(term.loads)]
            if term.own.size:
                rows[:, at.shape[1] :] = term.own
            value = (rows.T @ rows)[None]
            added[term.matrix].append(ReducedPart(n_before + term.amplitude, (1,), value))
        return replace(
            model,
            reference=np.concatenate([model.reference, np.zeros(n_amplitudes)]),
            stiffness=(*model.stiffness, *added["stiffness"]),
            mass=(*model.mass, *added["mass"]),
        )


@dataclass(frozen=True, slots=True)
class Released:
    """The same model without its supports and rigid links, and motions that these suppress.

    matrices: of its own equations, n_free. tie: (n_free, n), the constrained model's motion of
    them; a row is empty where a support holds it. observer: (n_rows, n_free). loads: (n_free,
    n_loads). patterns: (n_free, n_patterns), motions relative to the tie, each group's own
    orthonormal. dampers: as of `attached_model`, (n_free, n_free) each.
    """

    matrices: ParameterMatrices
    tie: sparse.csr_array
    observer: sparse.csr_array
    loads: sparse.csr_array
    patterns: sparse.csr_array
    dampers: tuple[sparse.csr_array, ...] = ()

    def lifted(self, theta: Floats, shift: float, inverse: Callable[[Floats], Floats]) -> Floats:
        """Return the static motion (n_free, n_patterns) with each pattern.

        inverse: (K - s M)^-1 of the constrained model, s the shift.
        """
        here, own = self.matrices.at(theta), self.patterns.toarray()
        return static_motion(here, self.tie, own, shift, inverse)


def static_motion(
    free: MatrixResult,
    tie: sparse.csr_array,
    own: Floats,
    shift: float,
    inverse: Callable[[Floats], Floats],
) -> Floats:
    """Return the static motion (n_free, n) of a released model with some of its freedoms' own.

    own: (n_free, n), relative to the tie; inverse: (K - s M)^-1 of the constrained model.
    """
    forces = dynamic_forces(free, own, shift)
    return np.asarray(own - tie @ inverse(np.asfortranarray(tie.T @ forces)))


def dynamic_forces(matrices: MatrixResult, motion: Floats, shift: float) -> Floats:
    """Return (K - s M) times a motion, (n, k)."""
    forces = upper_product(matrices.upper_stiffness, motion)
    forces -= shift * upper_product(matrices.upper_mass, motion)
    return forces


def attached_model(
    affine: ParameterMatrices,
    model: ReducedModel,
    basis: Floats,
    observer: sparse.csr_array,
    inverse: Callable[[Floats], Floats],
    loads: sparse.csr_array,
    released: Released | None = None,
    at: tuple[Floats, float] | None = None,
    kept: Integers = NONE,
    dampers: tuple[sparse.csr_array, ...] = (),
) -> AttachedModel:
    """Return a reduced model with the responses to loads.

    model, basis (n, r): as of `reduced_basis.reduce`, made with `inverse`, (K - s M)^-1 of a block
    (n, k). observer: (n_rows, n). loads: (n, n_loads). released: motions without supports and
    links, which are further loads behind these; at: the values (n_columns,) and s of the inverse.
    kept: as of `AttachedModel`. dampers: viscous and structural, (n, n) each, none without.
    """
    responses = np.zeros(loads.shape)
    for first in range(0, loads.shape[1], AT_ONCE):
        some = slice(first, first + AT_ONCE)
        responses[:, some] = inverse(np.asfortranarray(loads[:, some].toarray()))
    if released is not None and at is not None:
        affine, observer, loads = released.matrices, released.observer, released.loads
        dampers = released.dampers
        lifted = released.lifted(*at, inverse)
        responses = np.hstack([released.tie @ responses, lifted])
        basis = released.tie @ basis
    # Responses of unit length are safe to project; those of unit load give flexibilities.
    lengths = np.linalg.norm(responses, axis=0)
    responses /= np.where(lengths > 0.0, lengths, 1.0)
    scale = np.concatenate([np.ones(basis.shape[1]), lengths])
    wide = widened_model(affine, model, (basis,), responses, observer)
    every = np.hstack([basis, responses]) if dampers else basis
    projected_dampers = tuple(every.T @ (matrix @ every) for matrix in dampers)
    whole = DampedModel.of(wide, projected_dampers).scaled(scale)
    moved = np.hstack([loads.T @ basis, loads.T @ responses]) * scale
    n_patterns = responses.shape[1] - loads.shape[1]
    own = np.eye(n_patterns, moved.shape[1], moved.shape[1] - n_patterns)
    return _orthonormal(AttachedModel(whole, basis.shape[1], np.vstack([moved, own]), kept))


def _orthonormal(loaded: AttachedModel) -> AttachedModel:
    """Return the model with a basis that is orthonormal with respect to K - s M."""
    whole, size = loaded.whole, loaded.size
    energy = whole.base_stiffness - whole.shift * whole.base_mass
    try:
        lower = np.linalg.cholesky(energy[:size, :size])
    except np.linalg.LinAlgError as error:
        raise ModesError("the basis of a reduced model depends on itself") from error
    turn = np.eye(whole.size)
    turn[:size, :size] = solve_triangular(lower, np.eye(size), lower=True).T
    return replace(loaded, whole=whole.turned(turn), at=loaded.at @ turn)


def _independent(energy: Floats, size: int) -> Floats:
    """Return combinations of vectors without those that the first `size` already span, (r, r_new).

    energy: (r, r), products of the vectors with respect to K - s M; the first are orthonormal.
    """
    new = np.arange(size, energy.shape[0])
    inside = energy[:size, new]
    outside = energy[np.ix_(new, new)] - inside.T @ inside
    lengths = energy[new, new]
    scale = 1.0 / np.sqrt(np.where(lengths > 0.0, lengths, np.inf))
    squares, turned = np.linalg.eigh(scale[:, None] * outside * scale)
    kept = squares > RANK
    mixing = scale[:, None] * turned[:, kept] / np.sqrt(squares[kept])
    turn = np.zeros((energy.shape[0], size + mixing.shape[1]))
    turn[:size, :size] = np.eye(size)
    turn[:size, size:] = -inside @ mixing
    turn[size:, size:] = mixing
    return turn


def spread_nodes(coordinates: Floats, first: Integers, n: int) -> Integers:
    """Return rows of points spread evenly, (n_chosen,), ascending: the first ones and, up to n in
    all, at each step the point that is farthest from those chosen.

    coordinates: (n_points, 3); first: rows.
    """
    if coordinates.shape[0] <= n:
        return np.arange(coordinates.shape[0])
    chosen = np.unique(first)[:n].tolist()
    if not chosen:
        middle = coordinates.mean(axis=0)
        chosen = [int(np.argmin(np.linalg.norm(coordinates - middle, axis=1)))]
    distances = np.full(coordinates.shape[0], np.inf)
    for row in chosen:
        distances = np.minimum(distances, np.linalg.norm(coordinates - coordinates[row], axis=1))
    while len(chosen) < n and distances.max() > 0.0:
        row = int(np.argmax(distances))
        chosen.append(row)
        distances = np.minimum(distances, np.linalg.norm(coordinates - coordinates[row], axis=1))
    return np.array(sorted(chosen), dtype=np.int64)
