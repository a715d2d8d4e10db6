"""Derivatives from the model's matrices: Fox and Kapoor's, and Nelson's for shapes.

K, M, dK/dp and dM/dp are those of `matrix_source` at a set of values. Modes are those of the
matrices (the solver's have lost digits in print, and the unknowns that it keeps to itself), checked
against the solver's eigenvalues. Where derivatives of the matrices are differences of a pair, a
second pair twice as wide tells whether they can be believed.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from modetune.adapters.solver import ModalAnalysis
from modetune.core.algebra.eigen import solve_modes
from modetune.core.algebra.matrices import MatrixResult, symmetric
from modetune.core.algebra.pencil import shift_below
from modetune.core.correlation.clusters import rotation_onto
from modetune.core.errors import ModelError, ModesError
from modetune.core.modes import CLOSE, Floats, Integers, close_sets
from modetune.core.storage.keys import Json
from modetune.core.updating.parameter_matrices import ParameterMatrices
from modetune.core.updating.sensitivity import ModeDerivatives, fox_kapoor, nelson
from modetune.flows.jobs.job import Job
from modetune.flows.updating.evaluation import Point
from modetune.flows.updating.matrix_source import MatrixSource

#: Eigenvalues of the stored matrices and of the solver's own run agree to its seven digits.
EIGENVALUE_TOLERANCE = 1e-4
#: Derivatives from two pairs of matrices, one twice as wide, that differ more are not believed.
PAIR_TOLERANCE = 0.01
#: Raised by hand when the same matrices give other derivatives.
DERIVATIVES_VERSION = 3


class UnlikeMatrices(ModesError):
    """The stored matrices are not those of the modes (preload, parts that matrices do not hold)."""


@dataclass(frozen=True, slots=True)
class SemiAnalytic:
    """The method bound to a model's matrices and the modal analysis whose modes are derived."""

    source: MatrixSource
    with_shapes: bool
    modal: ModalAnalysis

    def derivatives(self, point: Point, columns: Sequence[int]) -> ModeDerivatives:
        """Derivatives of the paired modes with respect to these columns, in their order.

        They cost an eigensolution and a factorisation a mode, so the store keeps them. Raises
        UnlikeMatrices.
        """
        source, engine = self.source, self.source.engine
        asked: Json = {
            "derivatives": DERIVATIVES_VERSION,
            "matrices": source.key(point.theta, columns),
            "modal": engine.key(Job(source.parameters.values(point.theta), self.modal)),
            "columns": list(columns),
            "n_modes": point.modal.modes.n_modes,
            "pairs": point.pairing.computed.tolist(),
            "shapes": self.with_shapes,
            "turned": _turned(point),
        }
        return engine.derived(
            asked,
            lambda: self._computed(point, columns),
            ModeDerivatives,
            "sensitivities from matrices",
        )

    def _computed(self, point: Point, columns: Sequence[int]) -> ModeDerivatives:
        theta, source = self.source.written(point.theta), self.source
        try:
            model = source.matrices(point.theta, columns)
        except ModelError as error:
            raise UnlikeMatrices(str(error)) from error
        here = model.at(theta)
        stiffness, mass = here.stiffness, here.mass
        eigenvalues, shapes = self._modes(point, stiffness, mass)
        eigenvalues, shapes = _as_compared(here, point, eigenvalues, shapes)
        _refuse_others(point, eigenvalues)
        modes = point.pairing.computed + point.modal.n_rigid
        self._check_pairs(point, columns, model, eigenvalues[modes], shapes[:, modes])
        changes = [_change(model, theta, column) for column in columns]
        if not self.with_shapes:
            slopes = [fox_kapoor(eigenvalues[modes], shapes[:, modes], *item) for item in changes]
            return ModeDerivatives(
                np.stack(slopes, axis=1), np.zeros((0, modes.size, len(changes)))
            )
        elastic = point.modal.elastic
        rows, held = _sensor_rows(here, elastic.nodes, elastic.components)
        found = nelson(
            stiffness, mass, eigenvalues, shapes, changes, modes.tolist(), rows, 2.0 * CLOSE
        )
        full = np.zeros((elastic.n_dof, modes.size, len(changes)))
        full[~held] = found.mode_shapes
        return ModeDerivatives(found.eigenvalues, full)

    def _modes(
        self, point: Point, stiffness: sparse.csr_array, mass: sparse.csr_array
    ) -> tuple[Floats, Floats]:
        """Modes of the matrices, as many as the modal run has. Raises UnlikeMatrices."""
        elastic = point.modal.elastic
        try:
            return solve_modes(
                stiffness,
                mass,
                point.modal.modes.n_modes,
                shift=shift_below(float(elastic.eigenvalues[0])),
            )
        except ModelError as error:
            raise UnlikeMatrices(
                f"the stored matrices cannot be solved, as happens with very thin shells that are "
                f"expanded to solids ({error})"
            ) from error

    def _check_pairs(
        self,
        point: Point,
        columns: Sequence[int],
        model: ParameterMatrices,
        eigenvalues: Floats,
        shapes: Floats,
    ) -> None:
        """Raise UnlikeMatrices where the derivatives by two pairs of matrices are not the same."""
        columns = self.source.without_powers(columns)
        if not columns:
            return
        theta = self.source.written(point.theta)
        wide = self.source.matrices(point.theta, columns, wide=True)
        for column in columns:
            near, far = (
                fox_kapoor(eigenvalues, shapes, *_change(item, theta, column))
                for item in (model, wide)
            )
            apart = np.abs(near - far).max() / np.abs(near).max()
            if apart > PAIR_TOLERANCE:
                raise UnlikeMatrices(
                    f"the derivatives with respect to {self.source.parameters.names[column]} from "
                    f"two pairs of stored matrices differ by {100 * apart:.2g} %, as where shells "
                    "of another thickness meet; use `auto` or finite_difference"
                )


def _refuse_others(point: Point, eigenvalues: Floats) -> None:
    """Raise UnlikeMatrices where eigenvalues (n_modes,) of the matrices are not the point's."""
    elastic, paired, n_rigid = point.modal.elastic, point.pairing.computed, point.modal.n_rigid
    apart = np.abs(eigenvalues[paired + n_rigid] / elastic.eigenvalues[paired] - 1.0)
    # Rigid modes, which should have none, show what the rounding of the matrices' text adds.
    rounding = np.abs(eigenvalues[:n_rigid]).max(initial=0.0)
    if (apart > EIGENVALUE_TOLERANCE + rounding / elastic.eigenvalues[paired]).any():
        raise UnlikeMatrices(
            f"the stored matrices have other eigenvalues than the modal run (they differ by "
            f"{apart.max():.2g}): the model has parts that matrices do not hold; use "
            "finite_difference"
        )


def _as_compared(
    here: MatrixResult, point: Point, eigenvalues: Floats, shapes: Floats
) -> tuple[Floats, Floats]:
    """Eigenvalues (n_modes,) and shapes (n, n_modes) of the matrices, signs and close modes as
    those of the point."""
    elastic, n_rigid = point.modal.elastic, point.modal.n_rigid
    rows, held = _sensor_rows(here, elastic.nodes, elastic.components)
    rotation = np.eye(eigenvalues.size)
    rotation[n_rigid:, n_rigid:] = rotation_onto(
        shapes[rows][:, n_rigid:],
        np.real(elastic.mode_shapes[~held]),
        np.sqrt(np.abs(eigenvalues[n_rigid:])),
    )
    return eigenvalues @ rotation**2, shapes @ rotation


def _turned(point: Point) -> str:
    """How close modes have been turned on to the test's, for keys; empty where none is close."""
    elastic = point.modal.elastic
    sets = [item for item in close_sets(elastic.frequencies_hz, CLOSE) if item.size > 1]
    if not any(np.isin(point.pairing.computed, item).any() for item in sets):
        return ""
    return hashlib.sha256(np.ascontiguousarray(elastic.mode_shapes).tobytes()).hexdigest()


def _change(
    model: ParameterMatrices, theta: Floats, column: int
) -> tuple[sparse.csr_array, sparse.csr_array]:
    """dK/dp and dM/dp, both triangles."""
    stiffness, mass = model.change(theta, column)
    return symmetric(stiffness), symmetric(mass)


def _sensor_rows(
    base: MatrixResult, nodes: Integers, components: Integers
) -> tuple[Integers, NDArray[np.bool_]]:
    """Equation of each sensor degree of freedom that has one, and which are held in place."""
    equation: dict[tuple[int, int], int] = {}
    names = zip(base.nodes.tolist(), base.components.tolist(), strict=True)
    for row, name in enumerate(names):
        equation.setdefault(name, row)
    wanted = zip(nodes.tolist(), components.tolist(), strict=True)
    rows = np.array([equation.get(dof, -1) for dof in wanted], dtype=np.int64)
    return rows[rows >= 0], rows < 0
