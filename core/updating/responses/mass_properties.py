"""Mass, centre of gravity and inertia of the model, as targets and as limits.

With R the unit translations and rotations of the whole model at its equations, the mass of rigid
motion M_r = R^T M R contains all of them (`core/correlation/rigid_body`), whether the
structure is free or on springs. Its derivatives are R^T (dM/dtheta) R; those of the ten quantities
follow by a complex step, exact to rounding:

    dq = Im q(M_r + i h dM_r) / h.

Equations that a support constrains are in no stored matrix, so mass there is not counted. Values
are in the deck's units; inertia is the tensor about the centre of gravity in global axes, so
inertia_xy is minus the integral of x y dm.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import ClassVar, Literal, get_args

import numpy as np

from modetune.core.algebra.matrices import projected, upper_product
from modetune.core.correlation.rigid_body import rigid_body_of_mass
from modetune.core.errors import ModesError
from modetune.core.modes import Floats
from modetune.core.updating.responses.response import (
    MatricesAt,
    ModelState,
    Need,
    Residual,
    StateDerivatives,
    residual_of,
)
from modetune.core.updating.rigid_motions import Observe, RigidMotions, rigid_motions

MassQuantity = Literal[
    "mass", "centre_x", "centre_y", "centre_z", "inertia_xx", "inertia_yy", "inertia_zz",
    "inertia_xy", "inertia_yz", "inertia_zx",
]  # fmt: skip
MASS_QUANTITIES: tuple[MassQuantity, ...] = get_args(MassQuantity)
#: Masses in three directions differ by more where supports constrain a part of the structure.
ONE_MASS = 1e-6
#: A printed mass has at least four digits.
PRINTED = 1e-3
HELD = (
    "supports hold the remaining mass, which no stored matrix contains; free the structure (on "
    "soft springs, as in the test), or leave mass properties out"
)
#: Share of M_r in a complex step: its square vanishes next to one.
COMPLEX_STEP = 1e-30


@dataclass(frozen=True, slots=True)
class MassTarget:
    """A measured mass property: value, deviation, emphasis, and limits that no step exceeds."""

    value: float
    deviation: float
    weight: float = 1.0
    limits: tuple[float, float] = (-np.inf, np.inf)


@dataclass(frozen=True, slots=True)
class MassResponse:
    """Mass properties compared with their targets.

    within: deviations that e1 allows. observe: returns degrees of freedom in terms of the matrices'
    equations, where these are not those of the nodes.
    """

    targets: Mapping[MassQuantity, MassTarget]
    within: float = 2.0
    observe: Observe | None = None
    kind: ClassVar[str] = "mass_properties"
    needs: ClassVar[frozenset[Need]] = frozenset({"matrices"})
    #: The latest result, since values and derivatives are requested one after the other.
    _newest: list[tuple[MatricesAt, RigidMotions]] = field(
        default_factory=list, repr=False, compare=False
    )

    def residual(self, state: ModelState) -> Residual:
        matrices, rigid = self._rigid(state)
        rigid_mass = projected(matrices.model.mass_at(matrices.theta), rigid.shapes)
        here = self._of(rigid_mass)
        printed = np.nan if state.modal is None else state.modal.mass
        if abs(printed / rigid_mass.diagonal()[:3].max() - 1.0) > PRINTED:
            raise ModesError(
                f"mass properties: the solver prints a mass of {printed:.6g}, its matrices have "
                f"{rigid_mass.diagonal()[:3].max():.6g}: {HELD}"
            )
        asked = self.targets.values()
        measured = np.array([item.value for item in asked])
        limits = measured[:, None] - np.array([item.limits[::-1] for item in asked])
        return residual_of(
            self.kind,
            [name.replace("_", " ") for name in self.targets],
            None,
            measured - here,
            np.array([item.weight for item in asked]),
            np.array([item.deviation**2 for item in asked]),
            measured=measured,
            limits=limits,
        )

    def sensitivity(self, state: ModelState, derivatives: StateDerivatives) -> Floats:
        matrices, rigid = self._rigid(state)
        mass = matrices.model.mass_at(matrices.theta)
        here = projected(mass, rigid.shapes)
        momentum = upper_product(mass, rigid.shapes)
        slopes = np.zeros((len(self.targets), len(derivatives.columns)))
        for place, column in enumerate(derivatives.columns):
            moved, heavier = matrices.change(column)
            turned = rigid.change(moved).T @ momentum
            change = projected(heavier, rigid.shapes) + turned + turned.T
            stepped = self._of(here + 1j * COMPLEX_STEP * change)
            slopes[:, place] = stepped.imag / COMPLEX_STEP
        return slopes

    def agrees(self, part: Residual) -> bool:
        z = part.of_used(self.kind, part.values)
        deviations = np.sqrt(part.of_used(self.kind, part.noise))
        return bool((np.abs(z) <= self.within * deviations).all())

    def _rigid(self, state: ModelState) -> tuple[MatricesAt, RigidMotions]:
        given = state.matrices
        assert given is not None
        assert state.mesh is not None
        for known, motions in self._newest:
            if known.model is given.model and np.array_equal(known.theta, given.theta):
                return given, motions
        alone = set(self.targets) == {"mass"}
        try:
            found = rigid_motions(given.model.at(given.theta), state.mesh, alone, self.observe)
        except ModesError as error:
            raise ModesError(f"mass properties: {error}") from error
        self._newest[:] = [(given, found)]
        return given, found

    def _of(self, rigid_mass: Floats) -> Floats:
        """Return the targets' quantities, (n,), complex where the mass is. Raises ModesError."""
        masses = rigid_mass.diagonal()[:3]
        there = np.abs(masses) > 0.0
        if not there.any():
            raise ModesError("mass properties: the model has no mass that translations move")
        mass = masses[there].mean()
        if np.ptp(masses[there].real) > ONE_MASS * mass.real:
            text = ", ".join(f"{item:.6g}" for item in masses.real)
            raise ModesError(
                f"mass properties: the model's mass is {text} along x, y and z: {HELD}"
            )
        if set(self.targets) == {"mass"}:
            return np.array([mass])
        body = rigid_body_of_mass(rigid_mass)
        j = body.inertia
        found = dict(
            zip(
                MASS_QUANTITIES,
                (mass, *body.centre, j[0, 0], j[1, 1], j[2, 2], j[0, 1], j[1, 2], j[2, 0]),
                strict=True,
            )
        )
        return np.array([found[name] for name in self.targets])
