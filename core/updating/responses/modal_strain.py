"""Strains of modes at gauges: z = (e_m - alpha e_c) / rms(e_m) of each pair and gauge.

A gauge is a row w of factors on displacements, so e_c = w phi and its derivative is w dphi. The
scale of a mode is arbitrary: alpha is the modal scale factor by a reference r, r_m ~ alpha r_c,

    alpha = r_m^T r_c / r_c^T r_c,
    d alpha = (r_m^T d r_c - 2 alpha r_c^T d r_c) / r_c^T r_c,

where the reference is the displacement shape at the common sensors, if strains were measured in its
scale, or else the strains themselves, which then lose one value to the scale.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Literal

import numpy as np

from modetune.core.errors import ModesError
from modetune.core.modes import Floats, Integers, common_dofs
from modetune.core.updating.responses.response import (
    ModelState,
    Need,
    Residual,
    StateDerivatives,
    residual_of,
)

StrainScale = Literal["shapes", "own"]


@dataclass(frozen=True, slots=True)
class Gauge:
    """A strain as a sum over degrees of freedom; nodes, components, factors: (n_terms,)."""

    name: str
    nodes: Integers
    components: Integers
    factors: Floats


@dataclass(frozen=True, slots=True)
class ModalStrain:
    """Strains of modes at gauges.

    measured: by the number of the test's mode, (n_gauges,). deviation, tolerance: relative to the
    root mean square of the mode's strains.
    """

    gauges: tuple[Gauge, ...]
    measured: dict[int, Floats]
    scale: StrainScale
    weight: float
    deviation: float
    tolerance: float
    kind: ClassVar[str] = "modal_strain"
    needs: ClassVar[frozenset[Need]] = frozenset({"shapes"})

    def residual(self, state: ModelState) -> Residual:
        scaled, _, sizes = self._compared(state)
        measured = self._measured(state) / sizes
        names = [f"strains of mode {number}" for number in self._numbers(state)]
        counts = np.full(sizes.size, len(self.gauges))
        if self.scale == "shapes":  # each is an item
            numbers, counts = self._numbers(state), np.ones(measured.size, dtype=np.int64)
            names = [f"strain {gauge.name} of mode {n}" for n in numbers for gauge in self.gauges]
        return residual_of(
            self.kind,
            names,
            counts,
            (measured - scaled / sizes).T.ravel(),
            np.full(measured.size, self.weight),
            np.full(measured.size, self.deviation**2),
            scaled=self.scale == "own",
            measured=measured.T.ravel(),
        )

    def sensitivity(self, state: ModelState, derivatives: StateDerivatives) -> Floats:
        assert derivatives.whole is not None
        assert state.modal is not None
        pairs = self._pairs(state)
        changes = derivatives.whole.mode_shapes
        changed = np.tensordot(self._rows(state), changes, axes=1)[:, pairs]
        strains = self._rows(state) @ state.modal.elastic.mode_shapes.real
        strains = strains[:, state.pairing.computed[pairs]]
        reference, computed = self._reference(state)
        slopes = changed
        if self.scale == "shapes":
            _, sensors = common_dofs(state.test.modes, state.seen)
            slopes = derivatives.modes.mode_shapes[sensors][:, pairs]
        _, alpha, sizes = self._compared(state)
        towards = reference - 2.0 * alpha * computed
        d_alpha = np.einsum("sm,smp->mp", towards, slopes) / np.sum(computed**2, axis=0)[:, None]
        found = alpha[:, None] * changed + strains[:, :, None] * d_alpha
        found = found / sizes[:, None]
        return np.asarray(found.transpose(1, 0, 2).reshape(-1, changes.shape[2]))

    def agrees(self, part: Residual) -> bool:
        return bool((np.abs(part.of_used(self.kind, part.values)) <= self.tolerance).all())

    def _pairs(self, state: ModelState) -> Integers:
        """Return the positions of the pairs with measured strains."""
        return np.flatnonzero([number in self.measured for number in state.numbers])

    def _numbers(self, state: ModelState) -> list[int]:
        return [number for number in state.numbers if number in self.measured]

    def _measured(self, state: ModelState) -> Floats:
        """(n_gauges, n_pairs)."""
        found = [self.measured[number] for number in self._numbers(state)]
        return np.array(found).reshape(-1, len(self.gauges)).T

    def _rows(self, state: ModelState) -> Floats:
        """Return the gauges' factors on rows of the modes, (n_gauges, n_dof). Raises ModesError."""
        assert state.modal is not None
        modes = state.modal.modes
        dofs = zip(modes.nodes.tolist(), modes.components.tolist(), strict=True)
        place = {dof: row for row, dof in enumerate(dofs)}
        rows = np.zeros((len(self.gauges), modes.n_dof))
        for row, gauge in zip(rows, self.gauges, strict=True):
            own = zip(gauge.nodes.tolist(), gauge.components.tolist(), strict=True)
            for dof, factor in zip(own, gauge.factors.tolist(), strict=True):
                if factor and dof not in place:
                    raise ModesError(f"gauge {gauge.name}: modes have no result at node {dof[0]}")
                if factor:
                    row[place[dof]] += factor
        return rows

    def _reference(self, state: ModelState) -> tuple[Floats, Floats]:
        """Return the reference of the scale, measured and computed, (n, n_pairs) each."""
        pairs, pairing = self._pairs(state), state.pairing
        if self.scale == "shapes":
            ours, theirs = common_dofs(state.test.modes, state.seen)
            measured = np.real(state.test.modes.mode_shapes[ours])[:, pairing.measured[pairs]]
            return measured, np.real(state.seen.mode_shapes[theirs])[:, pairing.computed[pairs]]
        assert state.modal is not None
        computed = self._rows(state) @ state.modal.elastic.mode_shapes.real
        return self._measured(state), computed[:, pairing.computed[pairs]]

    def _compared(self, state: ModelState) -> tuple[Floats, Floats, Floats]:
        """Return computed strains in the test's scale (n_gauges, n_pairs), the scale factors, and
        the root mean squares of the measured strains (n_pairs,). Raises ModesError."""
        assert state.modal is not None
        reference, computed = self._reference(state)
        sizes = np.sqrt(np.mean(self._measured(state) ** 2, axis=0))
        squares = np.sum(computed**2, axis=0)
        if not (squares > 0.0).all():
            raise ModesError("a mode moves none of the references that scale its strains")
        alpha = np.sum(reference * computed, axis=0) / squares
        strains = self._rows(state) @ state.modal.elastic.mode_shapes.real
        return strains[:, state.pairing.computed[self._pairs(state)]] * alpha, alpha, sizes
