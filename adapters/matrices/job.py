"""One job of the embedded solver: its input files, and the program that solves them.

    job.json        what is asked: analysis, number of modes, rows of the shapes, group names
    stiffness.npz   the assembled matrices at the job's parameter values
    mass.npz
    group0.npz ...  the stiffness of each group whose strain energies are asked for
    result.npz      the answer, written aside and renamed

The last line the program prints is its closing mark; what the matrices do not allow is a line
that starts with `*ERROR`.
"""

from __future__ import annotations

import json
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy import sparse

from modetune.adapters.matrices.model import Factors, MatrixModel
from modetune.adapters.solver import Analysis, ModalAnalysis
from modetune.core.eigen import solve_modes
from modetune.core.errors import ModelError
from modetune.core.modes import Floats, count_rigid_modes

JOB, RESULT = "job.json", "result.npz"
FAULT = "*ERROR"
CLOSING_MARK = "modetune matrices: job finished"
#: An eigenvalue below this share of the largest one found, with its sign changed, is no rounding.
NEGATIVE = 1e-6


@dataclass(frozen=True, slots=True)
class MatrixJob:
    """What a job's folder asks for; n_modes 0 asks for the matrices themselves."""

    n_modes: int
    rows: tuple[int, ...]
    n_groups: int


def write_job(model: MatrixModel, factors: Factors, analysis: Analysis, folder: Path) -> None:
    """Write a job's input files into an empty folder."""
    stiffness, mass = model.assembled(factors)
    sparse.save_npz(folder / "stiffness.npz", stiffness, compressed=False)
    sparse.save_npz(folder / "mass.npz", mass, compressed=False)
    job = MatrixJob(0, (), 0)
    if isinstance(analysis, ModalAnalysis):
        rows = np.flatnonzero(np.isin(model.nodes, analysis.nodes))
        job = MatrixJob(analysis.n_modes, tuple(rows.tolist()), len(analysis.groups))
        for number, (_, names) in enumerate(analysis.groups):
            group = model.group_stiffness(names, factors)
            sparse.save_npz(folder / f"group{number}.npz", group, compressed=False)
    told = {"n_modes": job.n_modes, "rows": job.rows, "n_groups": job.n_groups}
    (folder / JOB).write_text(json.dumps(told))


def run_job(folder: Path) -> int:
    """Solve the job in a folder: the embedded solver's program. Returns its exit code."""
    told = json.loads((folder / JOB).read_text())
    job = MatrixJob(int(told["n_modes"]), tuple(told["rows"]), int(told["n_groups"]))
    stiffness = _load(folder, "stiffness")
    mass = _load(folder, "mass")
    _say(f"{stiffness.shape[0]} unknowns, {stiffness.nnz} entries of stiffness")
    try:
        arrays = _modes(job, stiffness, mass, folder) if job.n_modes else _matrices(stiffness, mass)
    except ModelError as error:
        _say(f"{FAULT} {error}")
        return 1
    part = folder / f"{RESULT}.part"
    with part.open("wb") as out:
        np.savez(out, allow_pickle=False, **arrays)
    part.replace(folder / RESULT)
    _say(CLOSING_MARK)
    return 0


def _modes(
    job: MatrixJob, stiffness: sparse.csr_array, mass: sparse.csr_array, folder: Path
) -> dict[str, Floats]:
    # A small system has no more modes than unknowns, and a campaign asks for some to spare.
    n_modes = min(job.n_modes, stiffness.shape[0])
    eigenvalues, shapes = solve_modes(stiffness, mass, n_modes)
    elastic = eigenvalues[count_rigid_modes(eigenvalues) :]
    if (elastic < -NEGATIVE * np.abs(eigenvalues).max()).any():
        raise ModelError(
            f"the stiffness matrix has a negative eigenvalue ({elastic.min():.3e}): no structure "
            "is like that; look at the parts' matrices and the parameters' bounds"
        )
    _say(f"{n_modes} modes, eigenvalues {eigenvalues[0]:.6e} to {eigenvalues[-1]:.6e}")
    groups = [_load(folder, f"group{number}") for number in range(job.n_groups)]
    energies = [0.5 * np.sum(shapes * (group @ shapes), axis=0) for group in groups]
    return {
        "eigenvalues": eigenvalues,
        "mode_shapes": shapes[list(job.rows)],
        "strain_energies": np.array(energies).reshape(job.n_groups, n_modes),
        "total_strain_energy": 0.5 * np.sum(shapes * (stiffness @ shapes), axis=0),
    }


def _matrices(stiffness: sparse.csr_array, mass: sparse.csr_array) -> dict[str, Floats]:
    return {
        f"{name}_{part}": getattr(matrix, part)
        for name, matrix in (("stiffness", stiffness), ("mass", mass))
        for part in ("data", "indices", "indptr")
    }


def _load(folder: Path, name: str) -> sparse.csr_array:
    return sparse.csr_array(sparse.load_npz(folder / f"{name}.npz"))


def _say(line: str) -> None:
    sys.stdout.write(f"{line}\n")
    sys.stdout.flush()
