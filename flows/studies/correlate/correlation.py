"""Two mode sets side by side, whatever they are of: tests, models, or one of each.

Motion is compared along the directions of one side's sensors that the other side's span
(`core/measurement/common_motion`), whatever components are called. Modes are paired one-to-one by
MAC; pairs below the limit of pairing (core.pairing.LOST_MAC) are none. Without shapes on one side,
modes are paired in the order of frequency, and frequencies are all that is compared.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from modetune.core.algebra.factorisation import Matrix
from modetune.core.brief import brief
from modetune.core.correlation.correlation import (
    Shapes,
    comac,
    cross_orthogonality,
    ecomac,
    modal_scale_factor,
)
from modetune.core.correlation.pairing import LOST_MAC, mac_or_zero, pair_by_order, pair_by_shape
from modetune.core.errors import CampaignError
from modetune.core.measurement.common_motion import (
    SAME,
    CommonMotion,
    common_motion,
    directions_of,
    turn_between,
)
from modetune.core.measurement.measurement import TestGeometry
from modetune.core.modes import Floats, Integers, ModeSet, common_dofs, dof_name
from modetune.core.near_names import listed

SideKind = Literal["test", "model", "record"]
Dof = tuple[int, int]


@dataclass(frozen=True, slots=True)
class Side:
    """One of two mode sets.

    label: what it is called in tables; numbers: of its modes, (n_modes,); geometry: with the
    directions of its sensors, along the axes where there is none.
    """

    label: str
    kind: SideKind
    numbers: tuple[int, ...]
    modes: ModeSet
    geometry: TestGeometry | None = None


@dataclass(frozen=True, slots=True)
class CorrelatedPair:
    """A mode of the first side and its partner.

    first, second: positions in both sides, from 0. difference: of frequency, relative to the
    first. mac: NaN without shapes. scale: the factor that brings the first shape to the second's
    size (modal scale factor), NaN without shapes.
    """

    first: int
    second: int
    difference: float
    mac: float
    scale: float


@dataclass(frozen=True, slots=True)
class Orthogonality:
    """Shapes in the metric of kinetic energy, signs their own; method: of the reduced mass.

    dofs: (n,), where; cross: (n_first, n_second); first, second: each side with itself.
    """

    method: Literal["guyan", "serep"]
    dofs: tuple[Dof, ...]
    cross: Shapes
    first: Shapes
    second: Shapes


@dataclass(frozen=True, slots=True, repr=False)
class Correlation:
    """Two sides and how alike they are.

    dofs: (n_common,), node and component; shapes: of both sides there, (n_common, n_modes) each;
    only_first, only_second: degrees of freedom that one side has. notes: what is to be known.
    mac: (n_first, n_second); auto_first, auto_second: MAC of each side with itself, at its own
    degrees of freedom; empty without shapes. comac, ecomac: (n_common,), over the pairs; empty
    where there is no pair with shapes.
    """

    first: Side
    second: Side
    dofs: tuple[Dof, ...]
    only_first: tuple[Dof, ...]
    only_second: tuple[Dof, ...]
    pairs: tuple[CorrelatedPair, ...]
    mac: Floats
    auto_first: Floats
    auto_second: Floats
    comac: Floats
    ecomac: Floats
    shapes: tuple[Shapes, Shapes]
    orthogonality: Orthogonality | None = None
    notes: tuple[str, ...] = ()

    __repr__ = brief

    @property
    def alone_first(self) -> tuple[int, ...]:
        """Numbers of modes of the first side that have no partner."""
        paired = {pair.first for pair in self.pairs}
        return tuple(n for place, n in enumerate(self.first.numbers) if place not in paired)

    @property
    def alone_second(self) -> tuple[int, ...]:
        paired = {pair.second for pair in self.pairs}
        return tuple(n for place, n in enumerate(self.second.numbers) if place not in paired)

    def worst(self, count: int) -> list[tuple[Dof, float, float]]:
        """Degrees of freedom that agree least, with COMAC and eCOMAC.

        Half of them by either: COMAC is blind to a sensor mounted upside down.
        """
        by_comac, by_ecomac = np.argsort(self.comac), np.argsort(-self.ecomac)
        mixed = np.stack([by_comac, by_ecomac], axis=1).ravel()
        places = list(dict.fromkeys(mixed.tolist()))[:count]
        return [(self.dofs[n], float(self.comac[n]), float(self.ecomac[n])) for n in places]


def correlate(first: Side, second: Side) -> Correlation:
    """Compare two sides. Raises CampaignError where both have shapes, but at no common place."""
    with_shapes = bool(first.modes.n_dof and second.modes.n_dof)
    common, notes = _common(first, second)
    if with_shapes and not common.dofs:
        theirs = (listed(map(dof_name, _others(side.modes)), 3) for side in (first, second))
        raise CampaignError(
            f"{first.label} and {second.label} have no common degree of freedom: the first has "
            f"{', the second '.join(theirs)}; sensors of another numbering "
            "are laid over a model by `test.sensors` of a campaign"
        )
    a, b = common.of(first.modes, second.modes)
    table = mac_or_zero(a, b) if with_shapes else np.zeros((0, 0))
    pairs = _pairs(first.modes, second.modes, table, a, b)
    shaped = with_shapes and bool(pairs)
    left = a[:, [pair.first for pair in pairs]]
    right = b[:, [pair.second for pair in pairs]]
    return Correlation(
        first=first,
        second=second,
        dofs=common.dofs,
        only_first=_others(first.modes, common.used_first),
        only_second=_others(second.modes, common.used_second),
        pairs=pairs,
        mac=table,
        auto_first=_auto(first.modes),
        auto_second=_auto(second.modes),
        comac=comac(left, right) if shaped else np.zeros(0),
        ecomac=ecomac(left, right) if shaped else np.zeros(0),
        shapes=(a, b),
        notes=notes if with_shapes else (),
    )


def _common(first: Side, second: Side) -> tuple[CommonMotion, tuple[str, ...]]:
    """What both sides see, and what is to be known of their directions."""
    here, there = (directions_of(side.modes, side.geometry) for side in (first, second))
    notes = list[str]()
    if first.geometry is not None and second.geometry is not None:
        rotation, text = turn_between(first.geometry, second.geometry)
        there = there @ rotation.T
        notes += [f"{second.label} against {first.label}: {text}"] if text else []
    for side, other, seen in ((first, second, there), (second, first, here)):
        along = np.eye(3)[(other.modes.components - 1) % 3]
        turned = (np.abs(seen - along) > SAME).any()
        if side.geometry is None and other.geometry is not None and turned:
            notes.append(
                f"{side.label} has no sensor directions; its components are taken along the "
                f"axes of {other.label}"
            )
    found = common_motion(first.modes, second.modes, here, there)
    by_name = common_dofs(first.modes, second.modes)
    alike = [
        np.array_equal(seen.indices, rows) and (seen.data == 1.0).all()
        for seen, rows in zip((found.first, found.second), by_name, strict=True)
    ]
    if not all(alike):
        notes.append(
            "sensors look along different directions: motion is compared where one side's span "
            "those of the other"
        )
    return found, tuple(notes)


def orthogonality(
    found: Correlation, method: Literal["guyan", "serep"], dofs: tuple[Dof, ...], mass: Matrix
) -> Orthogonality:
    """Both sides in the metric of a mass matrix at these common degrees of freedom, (n, n).

    Raises ModesError where a shape carries no mass.
    """
    rows = [found.dofs.index(dof) for dof in dofs]
    a, b = (shapes[rows] for shapes in found.shapes)
    return Orthogonality(
        method,
        dofs,
        cross_orthogonality(a, b, mass),
        cross_orthogonality(a, a, mass),
        cross_orthogonality(b, b, mass),
    )


def _pairs(
    first: ModeSet, second: ModeSet, table: Floats, a: Shapes, b: Shapes
) -> tuple[CorrelatedPair, ...]:
    """Pairs in the order of the first side; the side with fewer modes is given partners."""
    swapped = first.n_modes > second.n_modes
    fewer, more = (second, first) if swapped else (first, second)
    if table.size:
        found = pair_by_shape(fewer, more, lost_mac=-1.0)
    else:
        found = pair_by_order(fewer, more)
    columns = (found.computed, found.measured) if swapped else (found.measured, found.computed)
    pairs = []
    for row, column in sorted(zip(*(index.tolist() for index in columns), strict=True)):
        value = float(table[row, column]) if table.size else float("nan")
        if value < LOST_MAC:
            continue
        scale = modal_scale_factor(a[:, row], b[:, column]) if table.size else float("nan")
        difference = float(second.frequencies_hz[column] / first.frequencies_hz[row] - 1.0)
        pairs.append(CorrelatedPair(row, column, difference, value, scale))
    return tuple(pairs)


def _auto(modes: ModeSet) -> Floats:
    return mac_or_zero(modes.mode_shapes, modes.mode_shapes) if modes.n_dof else np.zeros((0, 0))


def _others(modes: ModeSet, used: Integers | tuple[()] = ()) -> tuple[Dof, ...]:
    """The degrees of freedom whose rows are not among those used."""
    rows = np.setdiff1d(np.arange(modes.n_dof, dtype=np.int64), used)
    return tuple(zip(modes.nodes[rows].tolist(), modes.components[rows].tolist(), strict=True))
