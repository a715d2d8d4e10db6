"""The embedded solver's program: it solves the job in the folder that it is started in.

    job.json        what is asked: analysis, number of modes, rows of the shapes, group names
    stiffness.npz   the assembled matrices at the job's parameter values
    mass.npz
    groups.npz      the stiffness of each group with strain energies, one below another
    result.npz      the answer, written aside and renamed

The last line the program prints is its closing mark; what the matrices do not allow is a line
that starts with `*ERROR`. `job.py` writes the input and reads the answer: a file apart, because
each job imports this one, and the adapter's modules take longer than a small model.
"""

from __future__ import annotations

import json
import shutil
import sys
import tempfile
from functools import partial
from pathlib import Path
from typing import TextIO

import numpy as np
from scipy import sparse

from modetune.core.algebra.eigen import available_modes
from modetune.core.algebra.factor_room import FactorRoom, factor_room, machine_memory
from modetune.core.algebra.matrices import CSR, upper_triangle
from modetune.core.algebra.mumps import FactorFiles
from modetune.core.algebra.repeated_modes import canonical_rotation
from modetune.core.algebra.rigid_modes import GIVEN, matrix_energies
from modetune.core.errors import ModelError, SolverExhausted
from modetune.core.modes import Floats

JOB, RESULT = "job.json", "result.npz"
FAULT, EXHAUSTED = "*ERROR", "*EXHAUSTED"
CLOSING_MARK = "modetune matrices: job finished"
MODAL = ("eigenvalues", "mode_shapes", "strain_energies", "total_strain_energy")
MATRICES = tuple(f"{name}_{part}" for name in ("stiffness", "mass") for part in CSR)
#: An eigenvalue below this share of the largest one found, with its sign changed, is not rounding.
NEGATIVE = 1e-6


def run_job(folder: Path, log: TextIO) -> int:
    """Solve the job in a folder: the embedded solver's program. Returns its exit code."""
    job = json.loads((folder / JOB).read_text())
    stiffness = _load(folder, "stiffness")
    mass = _load(folder, "mass")
    _say(log, f"{stiffness.shape[0]} unknowns, {stiffness.nnz} entries of stiffness")
    try:
        if job["n_modes"]:
            with factor_room(FactorRoom(machine_memory(), sys.maxsize, lambda: _files(folder))):
                arrays = _solved(stiffness, mass, folder, **job)
            found = arrays["eigenvalues"]
            _say(log, f"{found.size} modes, eigenvalues {found[0]:.6e} to {found[-1]:.6e}")
        else:
            given = {"stiffness": stiffness, "mass": mass}
            names = [name.split("_") for name in MATRICES]
            arrays = {f"{name}_{part}": getattr(given[name], part) for name, part in names}
    except (ModelError, SolverExhausted) as error:
        _say(log, f"{EXHAUSTED if isinstance(error, SolverExhausted) else FAULT} {error}")
        return 1
    part = folder / f"{RESULT}.part"
    with part.open("wb") as out:
        np.savez(out, allow_pickle=False, **arrays)
    part.replace(folder / RESULT)
    _say(log, CLOSING_MARK)
    return 0


def _solved(
    stiffness: sparse.csr_array,
    mass: sparse.csr_array,
    folder: Path,
    n_modes: int,
    rows: list[int],
    order: list[int],
    n_groups: int,
) -> dict[str, Floats]:
    # A small system has no more modes than its masses allow, and a campaign requests spare ones.
    eigenvalues, shapes = available_modes(stiffness, mass, n_modes)
    shapes = shapes @ canonical_rotation(eigenvalues, shapes[order])
    energies = matrix_energies(upper_triangle(stiffness), shapes, GIVEN)
    if (2.0 * energies < -NEGATIVE * np.abs(eigenvalues).max()).any():
        raise ModelError(
            f"the stiffness matrix has a negative eigenvalue ({eigenvalues[0]:.3e}): no structure "
            "is like that; look at the parts' matrices and the parameters' bounds"
        )
    of_groups = list[Floats]()
    if n_groups:
        groups = _load(folder, "groups")
        for first in range(0, groups.shape[0], shapes.shape[0]):
            forces = groups[first : first + shapes.shape[0]] @ shapes
            of_groups.append(0.5 * np.sum(shapes * forces, axis=0))
    return {
        "eigenvalues": eigenvalues,
        "mode_shapes": shapes[rows],
        "strain_energies": np.array(of_groups).reshape(n_groups, eigenvalues.size),
        "total_strain_energy": energies,
    }


def _files(folder: Path) -> FactorFiles:
    """Return a folder for factors within the job's own, which goes with it."""
    own = Path(tempfile.mkdtemp(dir=folder))
    return FactorFiles(own, partial(shutil.rmtree, own, ignore_errors=True))


def _load(folder: Path, name: str) -> sparse.csr_array:
    return sparse.csr_array(sparse.load_npz(folder / f"{name}.npz"))


def _say(log: TextIO, line: str) -> None:
    log.write(f"{line}\n")
    log.flush()
