"""What a solver run gives (modes, or matrices), and what is derived from matrices at a cost."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy import sparse

from modetune.core.errors import ModesError
from modetune.core.modes import Floats, Integers, ModeSet, count_rigid_modes


@dataclass(frozen=True, slots=True)
class ModalResult:
    """The modes of one model state, rigid ones included, in the solver's order.

    eigenvalues: (n_modes,), (rad/s)^2, ascending, with the rounding of rigid modes as it came.
    modes: mass-normalised, at the requested nodes.
    groups: names of the element groups whose strain energies are known.
    strain_energies: (n_groups, n_modes) of the mass-normalised modes; total_strain_energy:
    (n_modes,) of the whole model. Both in the deck's units of (rad/s)^2 for unit modal mass.
    mass: total mass in the deck's unit, NaN where the solver does not tell.
    """

    eigenvalues: Floats
    modes: ModeSet
    groups: tuple[str, ...]
    strain_energies: Floats
    total_strain_energy: Floats
    mass: float

    def __post_init__(self) -> None:
        n_modes = self.modes.n_modes
        if self.eigenvalues.shape != (n_modes,):
            raise ModesError(f"{self.eigenvalues.size} eigenvalues for {n_modes} modes")
        if not np.isfinite(self.eigenvalues).all():
            raise ModesError("an eigenvalue is not a finite number")
        if self.strain_energies.shape != (len(self.groups), n_modes):
            raise ModesError("the strain energies do not fit their groups and modes")

    def at(self, nodes: tuple[int, ...]) -> ModalResult:
        """The same modes with shapes at these nodes only."""
        rows = np.flatnonzero(np.isin(self.modes.nodes, np.array(nodes, dtype=np.int64)))
        return self if rows.size == self.modes.n_dof else replace(self, modes=self.modes.rows(rows))

    @property
    def n_rigid(self) -> int:
        return count_rigid_modes(self.eigenvalues)

    @property
    def elastic(self) -> ModeSet:
        """The modes that strain the structure, in ascending order."""
        return self.modes.select(np.arange(self.n_rigid, self.modes.n_modes))

    def elastic_energies(self, group: str) -> Floats:
        """Strain energy of one group in each elastic mode, (n_elastic,)."""
        return self.strain_energies[self.groups.index(group), self.n_rigid :]

    @property
    def energy_balance(self) -> Floats:
        """2 U / lambda of each elastic mode: 1 where the energies are complete (n_elastic,)."""
        elastic = slice(self.n_rigid, None)
        return 2.0 * self.total_strain_energy[elastic] / self.eigenvalues[elastic]


@dataclass(frozen=True, slots=True)
class MatrixResult:
    """Stiffness and mass of one model state on the solver's own equations.

    stiffness, mass: (n, n), symmetric, both triangles, CSR, in the deck's units.
    nodes, components: (n,), what each equation is called; a name may stand more than once where
    the solver has unknowns of its own (incompatible modes, expanded shells).
    """

    stiffness: sparse.csr_array
    mass: sparse.csr_array
    nodes: Integers
    components: Integers


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


Result = ModalResult | MatrixResult | ModeDerivatives


def finite(result: Result) -> Result:
    """A result as it is, all of its numbers finite. Raises ModesError.

    Strain energies and mass may be NaN, where the solver does not tell them.
    """
    if isinstance(result, MatrixResult):
        whole = np.isfinite(result.stiffness.data).all() and np.isfinite(result.mass.data).all()
    else:
        modes = result.modes if isinstance(result, ModalResult) else result
        shapes = np.isfinite(modes.mode_shapes).all()
        whole = shapes and np.isfinite(result.eigenvalues).all()
    if not whole:
        raise ModesError("the result holds values that are not finite numbers")
    return result
