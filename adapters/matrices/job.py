"""One job of the embedded solver: writing its input files, and reading what its program left."""

from __future__ import annotations

import json
import threading
from pathlib import Path

import numpy as np
from scipy import sparse

from modetune.adapters.matrices.matrix_files import NO_ARRAYS, check_archive
from modetune.adapters.matrices.model import Factors, MatrixModel
from modetune.adapters.matrices.program import (
    CLOSING_MARK,
    EXHAUSTED,
    FAULT,
    JOB,
    MATRICES,
    MODAL,
    RESULT,
)
from modetune.adapters.process import log_tail, read_log
from modetune.adapters.regular_file import open_regular
from modetune.adapters.solver import Analysis, ModalAnalysis
from modetune.core.algebra.matrices import CSR, MatrixResult
from modetune.core.errors import (
    ModesError,
    NoResult,
    SolverCrashed,
    SolverExhausted,
    SolverRejected,
)
from modetune.core.modes import Floats, mode_set
from modetune.core.updating.job_results import ModalResult, Result

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
