"""Derivatives of modes with respect to a model's parameters."""

from __future__ import annotations

from dataclasses import dataclass

from modetune.core.modes import Floats


@dataclass(frozen=True, slots=True)
class ModeDerivatives:
    """Derivatives of modes with respect to all parameters, relative values each.

    eigenvalues: (n_modes, n_parameters), (rad/s)^2.
    mode_shapes: (n_dof, n_modes, n_parameters), of mass-normalised shapes; n_dof is 0 where only
    frequencies were asked for. In an updating step the modes are those of the pairs, in order.
    """

    eigenvalues: Floats
    mode_shapes: Floats

    def column(self, place: int) -> ModeDerivatives:
        """The derivatives with respect to one parameter."""
        return ModeDerivatives(self.eigenvalues[:, [place]], self.mode_shapes[:, :, [place]])
