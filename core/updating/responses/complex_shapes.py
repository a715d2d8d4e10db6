"""Complex shapes at the sensors: how far each pair's damped shape is from the measured one.

Both are of unit length; the measured one, u, is turned by the phase that makes its real part
largest, the model's, v, by the one that makes u^H v real and positive. With z = u u^H v - v the
squared length of z is 1 - MAC, whatever scale and phase either had. v' = (I - v v^H) dx / |x| with
the turn -i v Im(u^H v') / u^H v is the derivative of v; dx is that of the damped mode, from

    [ T(s)     T'(s) x ] [ dx ]     [ dT x + ds T'(s) x ]
    [ (T'x)^T     0    ] [  0 ] = - [         0         ].

Real parts have the information of shapes made real; imaginary parts come from non-proportional
damping. Each has the variance s^2 / n for n entries, and in addition that of the linear model's
error, as for real shapes (`responses/shapes`).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import splu

from modetune.core.algebra.damped_modes import Complexes
from modetune.core.algebra.matrices import MatrixResult
from modetune.core.correlation.complexity import turned
from modetune.core.errors import ModesError
from modetune.core.modes import Floats
from modetune.core.updating.damped_pairs import DampedPairs, SolvedPairs
from modetune.core.updating.responses.response import (
    ModelState,
    Need,
    Residual,
    StateDerivatives,
    residual_of,
)


@dataclass(frozen=True, slots=True)
class ComplexShapes:
    """Complex shapes of a test.

    shapes: (n_sensors, n_modes), of the test's modes. observe: returns the sensors in terms of the
    matrices' equations, (n_sensors, n_equations). weights: by the number of the mode. mac: the
    minimum that e1 allows.
    """

    shapes: Complexes
    observe: Callable[[MatrixResult], sparse.csr_array]
    weights: Mapping[int, float]
    deviation: float
    mac: float
    pairs: DampedPairs
    kind: ClassVar[str] = "complex_shapes"
    needs: ClassVar[frozenset[Need]] = frozenset({"matrices", "losses"})

    def residual(self, state: ModelState) -> Residual:
        measured = state.pairing.measured
        away = np.array([u * np.vdot(u, v) - v for u, v, _ in self._units(state)])
        n = self.shapes.shape[0]
        far = (np.abs(away) ** 2).sum(axis=1) ** 2
        return residual_of(
            self.kind,
            [f"complex shape of mode {number}" for number in state.numbers],
            np.full(measured.size, 2 * n),
            np.hstack([away.real, away.imag]).ravel(),
            np.repeat([self.weights[number] for number in state.numbers], 2 * n),
            np.full(measured.size * 2 * n, self.deviation**2 / n),
            unknown=np.repeat(far / n, 2 * n),
            scaled=True,
        )

    def sensitivity(self, state: ModelState, derivatives: StateDerivatives) -> Floats:
        assert state.matrices is not None
        observe = self.observe(state.matrices.here)
        solved, columns = self.pairs.of(state), list(derivatives.columns)
        rows = []
        for row, (u, v, factor) in enumerate(self._units(state)):
            change = factor * np.asarray(observe @ _shape_slopes(solved, row, columns))
            change = change - np.outer(v, v.conj() @ change)
            turn = np.imag(u.conj() @ change) / np.vdot(u, v).real
            change = change - 1j * np.outer(v, turn)
            change = change - np.outer(u, u.conj() @ change)
            rows.append(np.vstack([change.real, change.imag]))
        return np.vstack(rows)

    def agrees(self, part: Residual) -> bool:
        split = np.split(part.values, np.cumsum(part.blocks[0].sizes)[:-1])
        weights = np.split(part.weights, np.cumsum(part.blocks[0].sizes)[:-1])
        pairs = zip(split, weights, strict=True)
        return all(1.0 - float(z @ z) >= self.mac for z, w in pairs if w.any())

    def _units(self, state: ModelState) -> list[tuple[Complexes, Complexes, complex]]:
        """Return u, v and the factor on the model's shape for each pair. Raises ModesError."""
        assert state.matrices is not None
        computed = self.observe(state.matrices.here) @ self.pairs.of(state).modes.shapes
        found = []
        for u, x in zip(self.shapes[:, state.pairing.measured].T, computed.T, strict=True):
            unit = u / np.linalg.norm(u)
            unit = turned(unit[:, None])[:, 0]
            length, onto = float(np.linalg.norm(x)), complex(np.vdot(unit, x))
            if not abs(onto) > 1e-12 * length:
                raise ModesError("a damped mode of the model does not move at the sensors as one "
                                 "of the test does")  # fmt: skip
            factor = onto.conjugate() / abs(onto) / length
            found.append((unit, factor * x, factor))
        return found


def _shape_slopes(solved: SolvedPairs, row: int, columns: list[int]) -> Complexes:
    """Return dx of a damped mode, (n, n_columns), without a part along the mode."""
    system, s, x = solved.system, solved.modes.roots[row], solved.modes.shapes[:, row]
    beside = np.asarray(2.0 * s * (system.mass @ x) + system.viscous @ x)
    whole = system.complex_stiffness + s * system.viscous + s**2 * system.mass
    sides = np.zeros((x.size + 1, len(columns)), dtype=np.complex128)
    for place, column in enumerate(columns):
        change = solved.changes[column]
        moved = np.asarray(change.complex_stiffness @ x)
        moved = moved + s * (change.viscous @ x) + s**2 * (change.mass @ x)
        sides[:-1, place] = -moved - solved.slopes[row, column] * beside
    border = sparse.csc_array(beside[:, None])
    scale = float(np.abs(whole.diagonal()).max()) / float(np.abs(beside).max())
    bordered = sparse.block_array([[whole, scale * border], [scale * border.T, None]])
    return np.asarray(splu(sparse.csc_array(bordered)).solve(sides)[:-1])
