"""A reduced model that holds over a range of values, and by how much it may be off anywhere in it.

A reduced model made at one set (`reduced_basis`) loses its modes with the distance from it. Where
many sets are asked for, it grows until it holds all over their range (greedy reduced basis:
Prud'homme et al. 2002): of sets spread over the range the one where it is worst is solved in full,
and its modes join the basis, until the full solution there says that nothing is missing any more.

Where it is worst is told by residuals. What a reduced mode leaves of its equation, r = K phi -
lambda M phi, moves the structure by about w = (K_0 - s M_0)^-1 r, which is what the shape lacks.
Its length is estimated by what random loads g with the variance of the masses have of it: as
g^T w = z^T r with z = (K_0 - s M_0)^-1 g, a few vectors z that are projected beside the basis once
tell it at any set from small matrices (probabilistic estimates: Smetana, Zahm and Patera 2019).
Eigenvalues err by the square of what shapes lack, times a factor that the full solution at the
worst set gives.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property, partial

import numpy as np
from scipy import sparse

from modetune.core.algebra.eigen import ModeSolver, SolvedModes
from modetune.core.algebra.krylov import GUARD, with_random
from modetune.core.algebra.matrices import upper_product
from modetune.core.algebra.pencil import shift_below
from modetune.core.errors import ModesError
from modetune.core.modes import Floats, Integers
from modetune.core.updating.parameter_matrices import ParameterMatrices
from modetune.core.updating.reduced import ReducedModel, ReducedPart, lowest
from modetune.core.updating.reduced_basis import projected_model, widened_model, with_directions

#: Random loads: the estimate of a length is good to a quarter.
LOADS = 24
#: Sets at which the worst is looked for, and full solutions at most.
LOOKED_AT, SOLUTIONS = 48, 24
#: Numbers of all basis vectors at most, and vectors, whatever the model's size.
NUMBERS, LEAST_ROOM, MOST_ROOM = 120_000_000, 150, 400
#: What shapes lack is never told below this.
LEAST = 1e-12


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
    tell: hears of full solutions, how many so far and what frequencies were off by at the last;
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
    """The model on the first so many vectors of its basis."""
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
