"""One job of the embedded solver: its input files, and the program that solves them.

    job.json        what is asked: analysis, number of modes, rows of the shapes, group names
    stiffness.npz   the assembled matrices at the job's parameter values
    mass.npz
    groups.npz      the stiffness of each group with strain energies, one below another
    result.npz      the answer, written aside and renamed

The last line the program prints is its closing mark; what the matrices do not allow is a line
that starts with `*ERROR`.
"""

from __future__ import annotations

import json
import shutil
import sys
import tempfile
import threading
from functools import partial
from pathlib import Path
from typing import TextIO

import numpy as np
from scipy import sparse

from modetune.adapters.hdf5_reader import CSR
from modetune.adapters.matrices.matrix_files import NO_ARRAYS, check_archive
from modetune.adapters.matrices.model import Factors, MatrixModel
from modetune.adapters.process import log_tail, read_log
from modetune.adapters.regular_file import open_regular
from modetune.adapters.solver import Analysis, ModalAnalysis
from modetune.core.algebra.eigen import solve_modes
from modetune.core.algebra.factor_room import FactorRoom, factor_room, machine_memory
from modetune.core.algebra.matrices import MatrixResult, upper_triangle
from modetune.core.algebra.mumps import FactorFiles
from modetune.core.algebra.repeated_modes import canonical_rotation
from modetune.core.algebra.rigid_modes import GIVEN, matrix_energies
from modetune.core.errors import (
    ModelError,
    ModesError,
    NoResult,
    SolverCrashed,
    SolverExhausted,
    SolverRejected,
)
from modetune.core.modes import Floats, mode_set
from modetune.core.updating.job_results import ModalResult, Result

JOB, RESULT = "job.json", "result.npz"
FAULT, EXHAUSTED = "*ERROR", "*EXHAUSTED"
CLOSING_MARK = "modetune matrices: job finished"
MODAL = ("eigenvalues", "mode_shapes", "strain_energies", "total_strain_energy")
MATRICES = tuple(f"{name}_{part}" for name in ("stiffness", "mass") for part in CSR)
#: An eigenvalue below this share of the largest one found, with its sign changed, is not rounding.
NEGATIVE = 1e-6
#: One thread at a time: NumPy has Python parse the heads of arrays, and Python 3.11 failed at that
#: ("AST constructor recursion depth mismatch") where jobs side by side were read at once.
_HEADERS = threading.Lock()


def write_job(model: MatrixModel, factors: Factors, analysis: Analysis, folder: Path) -> None:
    """Write a job's input files into an empty folder; 0 modes request the matrices themselves."""
    scaled = model.assembled(factors)
    sparse.save_npz(folder / "stiffness.npz", scaled.stiffness, compressed=False)
    sparse.save_npz(folder / "mass.npz", scaled.mass, compressed=False)
    n_modes, rows, n_groups, order = 0, list[int](), 0, list[int]()
    if isinstance(analysis, ModalAnalysis):
        seen = np.flatnonzero(np.isin(model.nodes, analysis.nodes))
        rows = seen.tolist()
        order = seen[np.lexsort((model.components[seen], model.nodes[seen]))].tolist()
        n_modes, n_groups = analysis.n_modes, len(analysis.groups)
        if n_groups:
            groups = [model.group_stiffness(names, factors) for _, names in analysis.groups]
            stacked = sparse.vstack(groups, format="csr")
            sparse.save_npz(folder / "groups.npz", stacked, compressed=False)
    job = {"n_modes": n_modes, "rows": rows, "order": order, "n_groups": n_groups}
    (folder / JOB).write_text(json.dumps(job))


def read_result(
    model: MatrixModel, factors: Factors, analysis: Analysis, folder: Path, return_code: int
) -> Result:
    """Return the result of a finished job.

    Raises SolverRejected, SolverExhausted or SolverCrashed where
    there is none."""
    lines = read_log(folder).splitlines()
    faults = [line.removeprefix(FAULT).strip() for line in lines if line.startswith(FAULT)]
    full = [line.removeprefix(EXHAUSTED).strip() for line in lines if line.startswith(EXHAUSTED)]
    if full:
        raise SolverExhausted(f"the model {model.name} (job in {folder}): {full[0]}")
    if faults:
        raise SolverRejected(f"the model {model.name} has no modes (job in {folder}): {faults[0]}")
    if return_code != 0 or not lines or lines[-1] != CLOSING_MARK:
        raise SolverCrashed(
            f"the matrices solver ended in {folder} with code {return_code} and without its "
            f"closing line\n{log_tail(folder)}"
        )
    modal = isinstance(analysis, ModalAnalysis)
    arrays = _read_arrays(folder / RESULT, MODAL if modal else MATRICES)
    try:
        if isinstance(analysis, ModalAnalysis):
            return _modal(model, factors, analysis, arrays)
        return _matrices(model, arrays)
    except (ModesError, ValueError) as error:
        raise NoResult(f"{folder / RESULT} is not a result of this job: {error}") from error


def _read_arrays(path: Path, names: tuple[str, ...]) -> dict[str, Floats]:
    """Read all arrays; the file has a checksum of each entry."""
    try:
        with open_regular(path) as stream:
            check_archive(path)
            with _HEADERS, np.load(stream, allow_pickle=False) as file:
                return {name: file[name] for name in names}
    except (OSError, *NO_ARRAYS) as error:
        raise NoResult(f"the result {path} is missing, cut or damaged: {error}") from error


def _modal(
    model: MatrixModel, factors: Factors, analysis: ModalAnalysis, arrays: dict[str, Floats]
) -> ModalResult:
    eigenvalues = arrays["eigenvalues"]
    seen = np.isin(model.nodes, analysis.nodes)
    return ModalResult(
        eigenvalues=eigenvalues,
        modes=mode_set(
            np.sqrt(np.maximum(eigenvalues, 0.0)) / (2.0 * np.pi),
            arrays["mode_shapes"],
            model.nodes[seen],
            model.components[seen],
            normalisation="mass",
        ),
        groups=tuple(name for name, _ in analysis.groups),
        strain_energies=arrays["strain_energies"],
        total_strain_energy=arrays["total_strain_energy"],
        mass=model.total_mass(model.assembled(factors).mass),
    )


def _matrices(model: MatrixModel, arrays: dict[str, Floats]) -> MatrixResult:
    stiffness, mass = (
        sparse.csr_array(
            tuple(arrays[f"{name}_{part}"] for part in CSR), shape=model.stiffness.shape
        )
        for name in ("stiffness", "mass")
    )
    return MatrixResult.of_full(stiffness, mass, model.nodes, model.components)


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
    # A small system has no more modes than unknowns, and a campaign requests spare ones.
    n_modes = min(n_modes, stiffness.shape[0])
    eigenvalues, shapes = solve_modes(stiffness, mass, n_modes)
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
        "strain_energies": np.array(of_groups).reshape(n_groups, n_modes),
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
