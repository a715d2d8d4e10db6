"""The seam of responses: what a response type gets of a model, and what it returns.

A response type is one file of this folder. From the state of a model it makes a Residual of one
block, measured minus computed, each entry with its variance and weight, and the derivatives of the
computed side. `stacked` joins the residuals of types and of cases.

An item has one name for people (a frequency, a shape, a mass); its entries are adjacent. Errors of
the entries are independent, unless the block has a `mixing` T: with the covariance C of its values,
T C T^T is diagonal. Variances and weights are those of T z, and

    z^T C^-1 z = (T z)^T diag(variances)^-1 (T z),

so code that weights rows takes them from `Residual.independent`. Values, derivatives and
predictions are those of the items.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal, Protocol

import numpy as np
from numpy.typing import NDArray
from scipy import linalg, sparse

from modetune.core.algebra.matrices import MatrixResult
from modetune.core.correlation.pairing import Pairing
from modetune.core.errors import CampaignError
from modetune.core.mesh import Mesh
from modetune.core.modes import Floats, Integers, MeasuredModes, ModeSet
from modetune.core.updating.damping_model import GroupStiffness
from modetune.core.updating.job_results import ModalResult
from modetune.core.updating.parameter_matrices import ParameterMatrices
from modetune.core.updating.sensitivity import ModeDerivatives
from modetune.core.updating.weighting import Weighting

#: What a response needs besides frequencies: shapes at the sensors and their derivatives; K, M and
#: their derivatives; in addition the stiffness of groups that have a loss factor.
Need = Literal["shapes", "matrices", "losses"]


@dataclass(frozen=True, slots=True)
class MatricesAt:
    """Stiffness and mass of a case at parameter values, and how they change there.

    theta: (n_parameters,), of the case's parameters. groups: of losses, where a response needs them
    and the model has them. around: (n_parameters,), a point that was solved in full, where values
    and their slopes need to be exact only there; else None.
    """

    model: ParameterMatrices
    theta: Floats
    groups: GroupStiffness | None = None
    around: Floats | None = None

    @property
    def here(self) -> MatrixResult:
        """K and M, computed at each access: keep them where they are needed twice."""
        return self.model.at(self.theta)

    def same(self, other: MatricesAt) -> bool:
        """Return whether both are of one model at the same values."""
        return self.model is other.model and np.array_equal(self.theta, other.theta)

    def change(self, column: int) -> tuple[sparse.csr_array, sparse.csr_array]:
        """Return upper triangles of dK/dtheta and dM/dtheta of a parameter, exact."""
        return self.model.change(self.theta, column)


@dataclass(frozen=True, slots=True)
class ModelState:
    """A model at parameter values and the test of its case, from which responses are computed.

    test, weighting: of the used modes. seen: the elastic modes at the test's sensors. pairing:
    positions in both. modal: all modes, also rigid ones, at the requested nodes. matrices, mesh:
    where a response of the case needs matrices, else None.
    """

    test: MeasuredModes
    weighting: Weighting
    seen: ModeSet
    pairing: Pairing
    modal: ModalResult | None = None
    matrices: MatricesAt | None = None
    mesh: Mesh | None = None

    @property
    def numbers(self) -> list[int]:
        """The test's numbers of the pairs."""
        return [self.test.numbers[place] for place in self.pairing.measured.tolist()]


@dataclass(frozen=True, slots=True)
class StateDerivatives:
    """Derivatives with respect to the parameters at `columns` (positions among those of the case).

    modes: of the paired modes, in the order of the pairs, at the rows of `seen` (no rows where no
    response needs shapes). whole: the same at the rows of `modal`, where shapes are needed.
    """

    modes: ModeDerivatives
    columns: tuple[int, ...]
    whole: ModeDerivatives | None = None


@dataclass(frozen=True, slots=True)
class Block:
    """The items of the rows of one response type in one case.

    names: of the items, for people. sizes: (n_items,), numbers of their entries. scaled: whether an
    item loses one entry to its scale. measured: (n,), in the response's own unit, for reports
    (values are then measured minus computed), else empty. mixing: (n, n), see the module's head;
    (0, 0) where errors are independent. limits: (n, 2), least and largest values that a step may
    lead to; (0, 2) without.
    """

    kind: str
    names: tuple[str, ...]
    sizes: Integers
    scaled: bool = False
    measured: Floats = field(default_factory=lambda: np.zeros(0))
    mixing: Floats = field(default_factory=lambda: np.zeros((0, 0)))
    limits: Floats = field(default_factory=lambda: np.zeros((0, 2)))

    @property
    def size(self) -> int:
        """Rows of the block."""
        return int(self.sizes.sum())


@dataclass(frozen=True, slots=True)
class Residual:
    """Measured minus computed.

    values: (n_residuals,), block by block; blocks of one type are adjacent, frequencies first and
    shapes next. weights: (n_residuals,), emphasis over variance. variances: (n_residuals,), with
    the error of the linear model. noise: variances of the measurement.
    """

    values: Floats
    weights: Floats
    variances: Floats
    noise: Floats
    blocks: tuple[Block, ...]

    @property
    def misfit(self) -> float:
        """The weighted sum of squares that updating minimises (thesis (40))."""
        values = self.independent(self.values)
        return float(values @ (self.weights * values))

    @property
    def potential(self) -> Floats:
        """Weights (n_residuals,) whose sum of squares has the stationary points of updating.

        The variance n of a measurement grows by that of the linear model to n (1 + r^2), with r
        proportional to the squared length of its item, so weights change with the parameters. Steps
        hold them and so minimise the sum of z^2 / n * atan(r) / r, whose derivative by z is 2 z / n
        / (1 + r^2). Values of it at distant points compare, those of `misfit` do not.
        """
        r = np.sqrt(np.maximum(self.variances / self.noise - 1.0, 0.0))
        near = r < 1e-4
        ratio = np.where(near, 1.0, np.arctan(r) / np.where(near, 1.0, r))
        return np.asarray(self.weights * self.variances / self.noise * ratio)

    @property
    def n_independent(self) -> int:
        """Number of used values; a scaled item has one fewer than its entries."""
        used = self.weights > 0.0
        owners = self.owners(scaled=True)
        return int(used.sum()) - int(np.unique(owners[used & (owners >= 0)]).size)

    @property
    def labels(self) -> tuple[str, ...]:
        """The name of each row's item, (n_residuals,)."""
        return tuple(
            name
            for block in self.blocks
            for name, size in zip(block.names, block.sizes.tolist(), strict=True)
            for _ in range(size)
        )

    def owners(self, scaled: bool = False) -> Integers:
        """Return the position of each row's item among all items, (n_residuals,).

        scaled: -1 for rows of items without a scale.
        """
        sizes = np.concatenate([block.sizes for block in self.blocks] or [np.zeros(0, np.int64)])
        owners = np.repeat(np.arange(sizes.size), sizes)
        if scaled:
            owners[~np.repeat([b.scaled for b in self.blocks], [b.size for b in self.blocks])] = -1
        return owners

    def rows(self, kind: str) -> slice:
        """Return the rows of a type; an empty slice at the end where there are none."""
        start = 0
        for block in self.blocks:
            if block.kind == kind:
                return slice(start, start + sum(b.size for b in self.blocks if b.kind == kind))
            start += block.size
        return slice(start, start)

    @property
    def block_rows(self) -> list[slice]:
        """The rows of each block."""
        ends = np.cumsum([block.size for block in self.blocks]).tolist()
        return [slice(end - block.size, end) for end, block in zip(ends, self.blocks, strict=True)]

    def has(self, kind: str) -> bool:
        """Return whether there are rows of a type."""
        rows = self.rows(kind)
        return bool(rows.stop > rows.start)

    def of_used(self, kind: str, values: Floats) -> Floats:
        """Return the values (n_rows_of_kind,) of a type in rows with a weight."""
        return values[self.weights[self.rows(kind)] > 0.0]

    @property
    def limits(self) -> Floats:
        """Least and largest value of each row that a step may lead to, (n_residuals, 2)."""
        free = np.array([-np.inf, np.inf])
        return np.concatenate(
            [np.zeros((0, 2))]
            + [b.limits if b.limits.size else np.tile(free, (b.size, 1)) for b in self.blocks]
        )

    def independent(self, rows: Floats) -> Floats:
        """Return values (n_residuals,) or derivatives (n_residuals, k) in combinations with
        independent errors, to which variances and weights belong."""
        return self._mixed(rows, np.matmul)

    def of_items(self, rows: Floats) -> Floats:
        """Return the argument of `independent` from its result."""
        return self._mixed(rows, np.linalg.solve)

    def _mixed(self, rows: Floats, turn: Callable[[Floats, Floats], Floats]) -> Floats:
        if not any(block.mixing.size for block in self.blocks):
            return rows
        ends = np.cumsum([block.size for block in self.blocks])
        return np.concatenate(
            [
                turn(block.mixing, own) if block.mixing.size else own
                for block, own in zip(self.blocks, np.split(rows, ends[:-1]), strict=True)
            ]
        )


class Response(Protocol):
    """A response type in one case, with its deviations and weights."""

    @property
    def kind(self) -> str:
        """Its key in the campaign and in records."""
        ...

    @property
    def needs(self) -> frozenset[Need]: ...

    def residual(self, state: ModelState) -> Residual:
        """Return measured minus computed, one block (`residual_of`). Raises ModesError."""
        ...

    def sensitivity(self, state: ModelState, derivatives: StateDerivatives) -> Floats:
        """Return derivatives of the computed side, (n_residuals, n_columns)."""
        ...

    def agrees(self, part: Residual) -> bool:
        """Return whether e1 holds for its block, whose values may be predicted ones."""
        ...


def residual_of(
    kind: str,
    names: Sequence[str],
    sizes: Integers | None,
    values: Floats,
    emphasis: Floats,
    noise: Floats,
    unknown: Floats | None = None,
    scaled: bool = False,
    measured: Floats | None = None,
    limits: Floats | None = None,
) -> Residual:
    """Return a residual of one block.

    names: (n_items,). sizes: (n_items,), one entry per item where None. emphasis: (n,), 0 leaves an
    entry out. noise: (n,), variances of the measurement, or (n, n), its covariance. unknown: (n,),
    variances of the linear model's error. limits: (n, 2), of the values. Raises CampaignError for a
    covariance that is not positive definite.
    """
    mixing = np.zeros((0, 0))
    if noise.ndim == 2:
        mixing, noise = decorrelation(noise, emphasis > 0.0)
    variances = noise if unknown is None else noise + unknown
    block = Block(
        kind,
        tuple(names),
        np.ones(len(names), dtype=np.int64) if sizes is None else sizes,
        scaled,
        np.zeros(0) if measured is None else measured,
        mixing,
        np.zeros((0, 2)) if limits is None else limits,
    )
    return Residual(values, emphasis / variances, variances, noise, (block,))


def decorrelation(covariance: Floats, used: NDArray[np.bool_]) -> tuple[Floats, Floats]:
    """Return T (n, n) and the variances (n,) of T z, where z has this covariance (n, n).

    C = L D L^T with L of unit diagonal, T = L^-1: each entry less its regression on earlier ones.
    used: (n,); entries that are left out have no effect on the others. Raises CampaignError.
    """
    kept = np.where(np.outer(used, used) | np.eye(used.size, dtype=bool), covariance, 0.0)
    try:
        lower = linalg.cholesky(kept, lower=True)
    except linalg.LinAlgError:
        raise CampaignError("a covariance of measured values is not positive definite") from None
    root = lower.diagonal()
    mixing = linalg.solve_triangular(lower / root, np.eye(root.size), lower=True)
    return np.asarray(mixing), np.asarray(root**2)


def stacked(parts: Sequence[Sequence[Residual]]) -> Residual:
    """Return the residual of several cases; parts: by case and type, one block each."""
    chosen = [parts[case][place] for case, place in _order(parts)]

    def together(name: str) -> Floats:
        return np.concatenate([np.zeros(0), *(getattr(part, name) for part in chosen)])

    return Residual(
        together("values"),
        together("weights"),
        together("variances"),
        together("noise"),
        tuple(block for part in chosen for block in part.blocks),
    )


def stacked_rows(parts: Sequence[Residual]) -> list[Integers]:
    """Return the rows of each case's residual in the stacked one."""
    split = [block_parts(part) for part in parts]
    found: list[list[Integers]] = [[np.zeros(0, np.int64)] * len(own) for own in split]
    start = 0
    for case, place in _order(split):
        size = split[case][place].values.size
        found[case][place] = np.arange(start, start + size)
        start += size
    return [np.concatenate([np.zeros(0, np.int64), *own]) for own in found]


def block_parts(found: Residual) -> list[Residual]:
    """Return the residual of each block."""
    parts: list[Residual] = []
    start = 0
    for block in found.blocks:
        own = slice(start, start + block.size)
        arrays = found.values[own], found.weights[own], found.variances[own], found.noise[own]
        parts.append(Residual(*arrays, (block,)))
        start += block.size
    return parts


def _order(parts: Sequence[Sequence[Residual]]) -> list[tuple[int, int]]:
    """Return case and place of each part, ordered by type, then by case."""
    kinds = dict.fromkeys(block.kind for own in parts for part in own for block in part.blocks)
    return [
        (case, place)
        for kind in kinds
        for case, own in enumerate(parts)
        for place, part in enumerate(own)
        if part.blocks[0].kind == kind
    ]


def with_values(part: Residual, values: Floats) -> Residual:
    """Return a residual with other values, such as predicted ones."""
    return replace(part, values=values)
