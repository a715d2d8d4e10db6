"""Sets of modes, measured or computed, and the degrees of freedom they share."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from modetune.core.brief import brief
from modetune.core.errors import ModesError

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]
Normalisation = Literal["mass", "max", "unknown"]

#: Relative distance of eigenvalues that seven printed digits, which solvers give, cannot tell: such
#: modes are repeated.
REPEATED = 5e-7
#: Relative distance of frequencies below which modes turn within their common space: a change of
#: one of them by 0.4 % of its stiffness, which any step makes, mixes their shapes wholly.
CLOSE = 0.002
COMPONENTS = ("x", "y", "z", "rx", "ry", "rz")


@dataclass(frozen=True, slots=True, repr=False)
class ModeSet:
    """Natural frequencies and mode shapes at named degrees of freedom.

    frequencies_hz: (n_modes,), as given, not sorted.
    mode_shapes: (n_dof, n_modes), real or complex; n_dof may be 0 where no shape was measured.
    nodes, components: (n_dof,), node number and component 1..6 (x, y, z, rx, ry, rz).
    damping_ratios: (n_modes,), fraction of critical; empty where unknown.
    Raises ModesError where shapes do not fit together or a value is not finite.
    """

    frequencies_hz: Floats
    mode_shapes: NDArray[np.float64] | NDArray[np.complex128]
    nodes: Integers
    components: Integers
    damping_ratios: Floats
    normalisation: Normalisation = "unknown"

    __repr__ = brief

    def __post_init__(self) -> None:
        n_modes, n_dof = self.frequencies_hz.size, self.nodes.size
        if self.mode_shapes.shape != (n_dof, n_modes) or self.components.shape != (n_dof,):
            raise ModesError(
                f"mode shapes of shape {self.mode_shapes.shape} do not fit {n_dof} degrees of "
                f"freedom and {n_modes} frequencies"
            )
        if self.damping_ratios.size not in (0, n_modes):
            raise ModesError(f"{self.damping_ratios.size} damping ratios for {n_modes} modes")
        if not (np.isfinite(self.frequencies_hz).all() and np.isfinite(self.mode_shapes).all()):
            raise ModesError("a frequency or a mode shape is not a finite number")
        if n_dof and (self.components.min() < 1 or self.components.max() > 6):
            raise ModesError("components are numbered 1 to 6 (x, y, z, rx, ry, rz)")

    @property
    def n_modes(self) -> int:
        return self.frequencies_hz.size

    @property
    def n_dof(self) -> int:
        return self.nodes.size

    @property
    def eigenvalues(self) -> Floats:
        """(2 pi f)^2 of each mode, (n_modes,), in (rad/s)^2."""
        return (2.0 * np.pi * self.frequencies_hz) ** 2

    def select(self, modes: ArrayLike) -> ModeSet:
        """The modes at these positions, in this order."""
        index = np.asarray(modes, dtype=np.int64)
        return replace(
            self,
            frequencies_hz=self.frequencies_hz[index],
            mode_shapes=self.mode_shapes[:, index],
            damping_ratios=self.damping_ratios[index] if self.damping_ratios.size else np.zeros(0),
        )

    def rows(self, rows: ArrayLike) -> ModeSet:
        """The same modes at these rows of the shapes only."""
        index = np.asarray(rows, dtype=np.int64)
        return replace(
            self,
            mode_shapes=self.mode_shapes[index],
            nodes=self.nodes[index],
            components=self.components[index],
        )


def mode_set(
    frequencies_hz: ArrayLike,
    mode_shapes: ArrayLike | None = None,
    nodes: ArrayLike = (),
    components: ArrayLike = (),
    damping_ratios: ArrayLike = (),
    normalisation: Normalisation = "unknown",
) -> ModeSet:
    """Build a ModeSet from anything array-like; without mode_shapes, frequencies only."""
    frequencies = np.atleast_1d(np.asarray(frequencies_hz, dtype=np.float64))
    node_ids = np.atleast_1d(np.asarray(nodes, dtype=np.int64))
    shapes = np.zeros((node_ids.size, frequencies.size)) if mode_shapes is None else mode_shapes
    shapes = np.asarray(shapes)
    numbers: NDArray[np.float64] | NDArray[np.complex128] = (
        shapes.astype(np.complex128) if np.iscomplexobj(shapes) else shapes.astype(np.float64)
    )
    return ModeSet(
        frequencies_hz=frequencies,
        mode_shapes=numbers,
        nodes=node_ids,
        components=np.atleast_1d(np.asarray(components, dtype=np.int64)),
        damping_ratios=np.atleast_1d(np.asarray(damping_ratios, dtype=np.float64)),
        normalisation=normalisation,
    )


def mode_name(number: int, configuration: str = "") -> str:
    """A measured mode as people call it; configuration: whose test it is of, where several are."""
    return f"mode {number} of {configuration}" if configuration else f"mode {number}"


def dof_name(dof: tuple[int, int]) -> str:
    """Node and component as test files name them: 12.z."""
    return f"{dof[0]}.{COMPONENTS[dof[1] - 1]}"


def common_dofs(first: ModeSet, second: ModeSet) -> tuple[Integers, Integers]:
    """Rows of both sets that stand for the same node and component, in first's order."""
    wanted, there = (7 * modes.nodes + modes.components for modes in (first, second))
    known, places = places_of(wanted, there)
    return np.flatnonzero(known), places[known]


def places_of(wanted: Integers, there: Integers) -> tuple[NDArray[np.bool_], Integers]:
    """Whether each number, of any shape, is among others (n,), and its last position there."""
    if not there.size:
        return np.zeros(wanted.shape, np.bool_), np.zeros_like(wanted)
    order = np.argsort(there, kind="stable")
    last = np.searchsorted(there, wanted, side="right", sorter=order) - 1
    places = order[np.maximum(last, 0)]
    return there[places] == wanted, places


def close_labels(frequencies_hz: Floats, width: float | Floats) -> Integers:
    """The number of the set of close modes that each one is in, (n_modes,); one that is close to
    none is alone.

    width: relative distance of neighbours in frequency up to which they are close, of all or
    (n_modes,), the larger one of both. Sets are in the order of frequency.
    """
    order = np.argsort(frequencies_hz, kind="stable")
    ascending = frequencies_hz[order]
    if np.ndim(width):
        widths = np.broadcast_to(width, order.shape)[order]
        width = np.maximum(widths[1:], widths[:-1])
    apart = ascending[1:] - ascending[:-1] > width * np.abs(ascending[1:])
    labels = np.zeros(order.size, dtype=np.int64)
    labels[order[1:]] = np.cumsum(apart)
    return labels


def close_sets(frequencies_hz: Floats, width: float | Floats) -> list[Integers]:
    """Positions of each set of close modes, ascending, by `close_labels`."""
    labels = close_labels(frequencies_hz, width)
    order = np.argsort(labels, kind="stable")
    ends = np.append(np.flatnonzero(np.diff(labels[order])) + 1, order.size).tolist()
    return [order[first:end] for first, end in pairwise([0, *ends]) if end > first]


@dataclass(frozen=True, slots=True)
class MeasuredModes:
    """The modes of a test with the numbers the test gave them.

    numbers: (n_modes,), as in the test file; modes: the mode set, sensors without shapes left out.
    """

    numbers: tuple[int, ...]
    modes: ModeSet

    @property
    def has_shapes(self) -> bool:
        return self.modes.n_dof > 0

    def use(self, numbers: tuple[int, ...]) -> MeasuredModes:
        """The modes of these numbers, in this order. Raises ModesError for an unknown one."""
        missing = [number for number in numbers if number not in self.numbers]
        if missing:
            raise ModesError(f"the test has no mode {missing[0]}")
        return MeasuredModes(
            numbers, self.modes.select([self.numbers.index(number) for number in numbers])
        )
