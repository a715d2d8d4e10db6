"""Modes of a whole structure from one sector of it, by nodal diameters.

For a nodal diameter n of N sectors ccx solves for complex shapes phi of one sector, of which sector
s moves as phi exp(2 pi i n s / N). It does so in twice the real unknowns, Re phi and Im phi, so
that each eigenvalue comes twice, with phi and i phi in some phase; its shapes are orthonormal
there, Re(phi_q^H M phi_r) = delta_qr. Re(phi exp(2 pi i n s / N)) is a standing wave of the whole
structure. Summed over all sectors, two of them have the product N/2 Re(phi_q^H M phi_r) where
0 < n < N/2, so that

    sqrt(2/N) Re(phi_r)

are mass-normalised modes of the whole, one for each of the eigenvalues that ccx gives, and no other
modes are there. For n = 0 and n = N/2 the sector has real modes Psi, (n_dof, m) of an m-fold
eigenvalue, and ccx gives 2 m shapes phi_r = Psi c_r, for which [Re c_r, Im c_r] are the rows of an
orthogonal matrix. So P = [Re phi_r] has P P^T = Psi Psi^T, the first m terms of its singular value
decomposition are Psi turned, and mass-normalised modes of the whole are

    sqrt(1/N) U_m S_m.

Strain energies of the whole are those of the sector's complex shapes, which ccx prints for the real
and the imaginary part. Shapes are given in the sector that the deck has.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from modetune.adapters.calculix.structure import CalculixStructure
from modetune.core.errors import ModelError
from modetune.core.modes import Floats, Integers
from modetune.core.updating.job_results import ModalResult

SELECT = "*SELECT CYCLIC SYMMETRY MODES"
#: Eigenvalues are printed with seven digits, and ARPACK finds equal ones to about these.
ALIKE = 1e-5
#: Rows beyond those that are wanted, so that no double eigenvalue is cut.
BEYOND = 4


@dataclass(frozen=True, slots=True)
class CyclicSymmetry:
    """The number of sectors, and the first and last wanted nodal diameter."""

    sectors: int
    first: int
    last: int

    def is_real(self, diameter: int) -> bool:
        """Whether neighbouring sectors move alike or against each other."""
        return diameter == 0 or 2 * diameter == self.sectors

    def rows(self, n_modes: int) -> int:
        """Eigenvalues of each nodal diameter with which the lowest modes are whole.

        An even number: of an odd one ccx 2.20 gives the last a wrong shape.
        """
        real = any(self.is_real(n) for n in range(self.first, self.last + 1))
        return 2 * n_modes + BEYOND if real else n_modes + n_modes % 2


def read_cyclic_symmetry(structure: CalculixStructure) -> CyclicSymmetry | None:
    """The cyclic symmetry of a deck, None where it has none. Raises ModelError."""
    deck = structure.deck
    cards, selected = deck.named("*CYCLIC SYMMETRY MODEL"), deck.named(SELECT)
    if not cards:
        return None
    counts = {card.option("N") for card in cards}
    where = deck.where(cards[0])
    if len(counts) > 1 or not cards[0].option("N").isdecimal():
        raise ModelError(f"{where}: *CYCLIC SYMMETRY MODEL requires one number N of sectors")
    if not selected:
        raise ModelError(
            f"{where}: a model with cyclic symmetry requires {SELECT}, NMIN=, NMAX= after "
            "*FREQUENCY in its step"
        )
    sectors = int(cards[0].option("N"))
    given = [selected[0].option(name) or "0" for name in ("NMIN", "NMAX")]
    first, last = (int(text) if text.isdecimal() else -1 for text in given)
    if not 0 <= first <= last <= sectors // 2:
        raise ModelError(
            f"{deck.where(selected[0])}: nodal diameters of {sectors} sectors go from 0 to "
            f"{sectors // 2}, NMIN first; found {given[0]} to {given[1]}"
        )
    return CyclicSymmetry(sectors, first, last)


def standing_modes(
    parts: Sequence[tuple[int, ModalResult, ModalResult]], symmetry: CyclicSymmetry, n_modes: int
) -> ModalResult:
    """The lowest modes of the whole structure, mass-normalised.

    parts: of each nodal diameter its number and the real and imaginary parts of the sector's
    shapes, as ccx gives them. Raises ValueError where those that come in pairs do not.
    """
    found: list[tuple[float, Floats, Floats]] = []  # eigenvalues, shapes, energies
    for diameter, real, imaginary in parts:
        table, shapes = real.eigenvalues, np.real(real.modes.mode_shapes)
        energies = np.vstack([real.total_strain_energy, real.strain_energies])
        energies += np.vstack([imaginary.total_strain_energy, imaginary.strain_energies])
        if not symmetry.is_real(diameter):
            scaled = np.sqrt(2.0 / symmetry.sectors) * shapes
            found += [
                (float(table[row]), scaled[:, row], energies[:, row]) for row in range(table.size)
            ]
            continue
        # The last eigenvalue may be cut off its equals.
        for rows in _equal(table)[:-1]:
            if rows.size % 2:
                raise ValueError(f"eigenvalues of nodal diameter {diameter} do not come in pairs")
            mean = energies[:, rows].mean(axis=1)
            own = _real_modes(shapes[:, rows]) / np.sqrt(symmetry.sectors)
            found += [(float(table[rows].mean()), shape, mean) for shape in own.T]
    if len(found) < n_modes:
        raise ValueError(f"{len(found)} modes of {n_modes}")
    found = sorted(found, key=lambda item: item[0])[:n_modes]
    values = np.array([value for value, _, _ in found])
    sums = np.stack([energies for _, _, energies in found], axis=1)
    first = parts[0][1]
    modes = replace(
        first.modes,
        frequencies_hz=np.sqrt(np.maximum(values, 0.0)) / (2.0 * np.pi),
        mode_shapes=np.stack([shape for _, shape, _ in found], axis=1),
    )
    return replace(
        first,
        eigenvalues=values,
        modes=modes,
        strain_energies=sums[1:],
        total_strain_energy=sums[0],
        mass=symmetry.sectors * first.mass,
    )


def _equal(table: Floats) -> list[Integers]:
    """Rows of a table of ascending eigenvalues, those together that are equal."""
    apart = np.diff(table) > ALIKE * np.abs(table[1:])
    return np.split(np.arange(table.size), np.flatnonzero(apart) + 1)


def _real_modes(shapes: Floats) -> Floats:
    """Real shapes (n_dof, m) of which these (n_dof, 2 m) are the real parts in all phases."""
    left, sizes, _ = np.linalg.svd(shapes, full_matrices=False)
    count = shapes.shape[1] // 2
    modes = np.zeros((shapes.shape[0], count))
    kept = min(count, sizes.size)
    modes[:, :kept] = left[:, :kept] * sizes[:kept]
    return modes
