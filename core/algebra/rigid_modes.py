"""Which modes are rigid: rigid-body motion, and the mechanisms of parts that move freely.

The eigenvalue of a mass-normalised mode is twice its strain energy, lambda = phi^T K phi = 2 U. A
rigid mode has none, so what a solver gives for its eigenvalue is rounding of the eigensolution, up
to some eps * lambda_max of the model's largest eigenvalue. Energies summed over elements as stress
times strain do not have that rounding: strains are differences of displacements, wrong by eps, and
the energy is wrong by their square. In CalculiX runs of free solids and shells 2 U was 1e-15 to
1e-7 of the eigenvalue for rigid modes; for elastic ones, those of a body on soft springs (0.8 Hz
below elastic modes of 4.6 kHz) among them, it was the eigenvalue to seven digits. So a mode is
rigid where

    2 U < lambda / 2     its eigenvalue is not strain energy. The two cannot be distinguished only
                         if the true eigenvalue is below the rounding.

Energies that come from a product with K have the rounding of K, which is known where K is: what is
below it is none (`matrix_energies`). If a solver does not print all of a mode's energy (hourglass
modes of reduced elements, preload, springs along a line) or none at all, its eigenvalue decides:

    |lambda| <= ROUNDING eps lambda_max     it is no larger than rounding makes it.

Neither the shape of a mode nor a gap in the spectrum says anything: a body on soft mounts moves
like a rigid one, far below its elastic modes, and has energy; a mechanism does not, and has none.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy import sparse

from modetune.core.algebra.matrices import upper_product
from modetune.core.errors import CampaignError
from modetune.core.modes import Floats

EPS = float(np.finfo(np.float64).eps)
#: Eigenvalues of rigid modes in multiples of eps times the largest eigenvalue of a bar as long as
#: the least dimension of an element: 0.04 to 0.2 in CalculiX for solids and shells.
ROUNDING = 30.0
#: A mode of which this share of its eigenvalue is strain energy has been strained.
STRAINED = 0.5
#: Energies this near to the eigenvalue, relative, are complete.
COMPLETE = 1e-3
#: Rounding of an entry of a matrix that CalculiX printed with 14 digits (twice the mean of 5e-14
#: over the mantissa): errors of elements that are alike all have one sign.
PRINTED = 2e-14
#: The same of matrices from elsewhere, which have been reduced, turned or written with some digits:
#: 4e-12 in those of a free aircraft of printed matrices on 24 modes, where elastic modes have 2e-6.
GIVEN = 1e-11


def count_rigid_modes(
    eigenvalues: Floats, strain_energies: Floats, largest: Callable[[], float]
) -> int:
    """How many of the lowest modes are rigid.

    eigenvalues: (n_modes,), ascending, (rad/s)^2, as the solver gave them, of either sign where
    they are rounding. strain_energies: (n_modes,), of the mass-normalised modes, NaN where they are
    not all known. largest: estimates the model's largest eigenvalue, called only if energies do not
    decide; the largest of the given ones is its lower bound.
    """
    sizes = np.maximum.accumulate(np.abs(eigenvalues))
    elastic = 2.0 * strain_energies > STRAINED * sizes
    unknown = np.isnan(strain_energies)
    if unknown.any():
        rounding = ROUNDING * EPS * max(largest(), float(sizes[-1]))
        elastic |= unknown & (np.abs(eigenvalues) > rounding)
    return int(np.argmax(elastic)) if elastic.any() else eigenvalues.size


def matrix_energies(stiffness: sparse.csr_array, shapes: Floats, rounding: float) -> Floats:
    """Strain energies phi^T K phi / 2, (n_modes,), zero where rounding of K hides them.

    stiffness: (n, n), upper triangle; shapes: (n, n_modes); rounding: of its entries, relative.
    The error of phi^T K phi is at most rounding times |phi|^T |K| |phi|.
    """
    twice = np.sum(shapes * upper_product(stiffness, shapes), axis=0)
    sizes = np.abs(shapes)
    most = rounding * np.sum(sizes * upper_product(abs(stiffness), sizes), axis=0)
    return np.asarray(np.where(np.abs(twice) > most, 0.5 * twice, 0.0))


@dataclass(frozen=True, slots=True)
class RigidByHand:
    """A number of rigid modes that a user gave; where: file, line and key."""

    number: int
    where: str

    def check(self, eigenvalues: Floats, strain_energies: Floats, found: int) -> None:
        """Refuse what the energies contradict. Raises CampaignError.

        found: by the energies. They say nothing where they are not known or not complete.
        """
        complete = np.abs(2.0 * strain_energies - eigenvalues) <= COMPLETE * np.abs(eigenvalues)
        text = ""
        if self.number > eigenvalues.size:
            text = f"only {eigenvalues.size} modes were computed"
        elif complete[found : self.number].any():
            mode = found + int(np.argmax(complete[found : self.number]))
            text = (
                f"the strain energies say {found}: that of mode {mode + 1} at "
                f"{np.sqrt(abs(eigenvalues[mode])) / (2.0 * np.pi):.4g} Hz is all of its "
                "eigenvalue, so it is elastic"
            )
        elif self.number < found and complete[found:].all():
            share = 2.0 * strain_energies[self.number] / abs(eigenvalues[self.number])
            if np.isfinite(share):
                text = (
                    f"the strain energies say {found}: that of mode {self.number + 1} is "
                    f"{share:.1g} of its eigenvalue, which is rounding"
                )
        if text:
            raise CampaignError(
                f"{self.where}: {self.number} rigid modes, but {text}; leave the number out, or "
                "look at the supports"
            )
