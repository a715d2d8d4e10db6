"""Checks that a result agrees with itself, and the mark by which it names its job.

The eigenvalue of a mass-normalised mode is twice its strain energy. Solvers may leave energy out
(hourglass modes, springs, matrices from elsewhere), so less proves nothing; more does, where no
preload takes stiffness away. Modes of unknowns that a job adds to a small model are not the
model's.
"""

from __future__ import annotations

import hashlib
import re
from dataclasses import replace

import numpy as np

from modetune.core.modes import Floats
from modetune.core.updating.job_results import ModalResult

#: Largest ratio of twice the energy to the eigenvalue: element energies come from stresses, with
#: their own rounding and sampling.
MORE_ENERGY = 2.0
#: Of the largest eigenvalue: below it rounding of the eigensolution may hide a mode's energy.
ROUNDING = 1e-4
#: Eigenvalue of spare unknowns, which small models get so that a solver finds all their modes:
#: 160 MHz in seconds.
SPARE_EIGENVALUE = 1e18
#: Where a job's text has its mark, and what a result repeats of it.
MARK = re.compile(r"_JOB([0-9A-F]{16})")


def check_energies(eigenvalues: Floats, total_strain_energy: Floats) -> None:
    """Raise ValueError where a mode has far more strain energy than its eigenvalue says.

    eigenvalues, total_strain_energy: (n_modes,), energies NaN where unknown.
    """
    most = MORE_ENERGY * np.abs(eigenvalues) + ROUNDING * np.abs(eigenvalues).max(initial=0.0)
    wrong = np.flatnonzero(2.0 * total_strain_energy > most)
    if wrong.size:
        mode = int(wrong[0])
        raise ValueError(
            f"eigenvalue {mode + 1} is {eigenvalues[mode]:g}, but twice the strain energy of its "
            f"mode is {2.0 * total_strain_energy[mode]:g}"
        )


def without_spare(result: ModalResult) -> ModalResult:
    """Return the modes of the model itself."""
    own = int(np.sum(result.eigenvalues < 0.5 * SPARE_EIGENVALUE))
    return result if own == result.eigenvalues.size else replace(
        result,
        eigenvalues=result.eigenvalues[:own],
        modes=result.modes.select(np.arange(own)),
        strain_energies=result.strain_energies[:, :own],
        total_strain_energy=result.total_strain_energy[:own],
    )  # fmt: skip


def mark_of(text: bytes) -> str:
    """Return the mark of a job with this text: sixteen digits of its SHA-256."""
    return f"_JOB{hashlib.sha256(text).hexdigest()[:16].upper()}"


def check_mark(asked: str, found: str) -> None:
    """Raise ValueError where a result repeats the mark of another job.

    asked: a text with the job's mark; found: what the result has in its place.
    """
    wanted, text = MARK.search(asked), MARK.search(found)
    if wanted and text and wanted.group() != text.group():
        raise ValueError(
            f"the result names job {text.group(1).lower()}, and {wanted.group(1).lower()} was run: "
            "it is another job's"
        )
