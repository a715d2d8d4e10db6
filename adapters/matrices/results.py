"""Reading what the embedded solver left in a job's folder."""

from __future__ import annotations

import zipfile
from pathlib import Path

import numpy as np
from scipy import sparse

from modetune.adapters.matrices.job import CLOSING_MARK, FAULT, RESULT
from modetune.adapters.matrices.model import Factors, MatrixModel
from modetune.adapters.process import LOG, log_tail
from modetune.adapters.solver import Analysis, ModalAnalysis
from modetune.core.errors import ModesError, NoResult, SolverCrashed, SolverRejected
from modetune.core.modes import Floats, mode_set
from modetune.core.results import MatrixResult, ModalResult, Result

MODAL = ("eigenvalues", "mode_shapes", "strain_energies", "total_strain_energy")
MATRICES = tuple(
    f"{name}_{part}" for name in ("stiffness", "mass") for part in ("data", "indices", "indptr")
)


def read_result(
    model: MatrixModel, factors: Factors, analysis: Analysis, folder: Path, return_code: int
) -> Result:
    """The result of a finished job. Raises SolverRejected or SolverCrashed where there is none."""
    lines = (folder / LOG).read_text(errors="replace").splitlines()
    faults = [line.removeprefix(FAULT).strip() for line in lines if line.startswith(FAULT)]
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
        raise NoResult(f"{folder / RESULT} is no result of this job: {error}") from error


def _read_arrays(path: Path, names: tuple[str, ...]) -> dict[str, Floats]:
    """All arrays whole; an entry's checksum stands in the file."""
    try:
        with path.open("rb") as stream, np.load(stream, allow_pickle=False) as file:
            return {name: file[name] for name in names}
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile) as error:
        raise NoResult(f"the result {path} is missing, cut or damaged: {error}") from error


def _modal(
    model: MatrixModel, factors: Factors, analysis: ModalAnalysis, arrays: dict[str, Floats]
) -> ModalResult:
    eigenvalues = arrays["eigenvalues"]
    seen = np.isin(model.nodes, analysis.nodes)
    return ModalResult(
        eigenvalues=eigenvalues,
        modes=mode_set(
            np.sqrt(np.maximum(eigenvalues, 0.0)) / (2.0 * np.pi), arrays["mode_shapes"],
            model.nodes[seen], model.components[seen], normalisation="mass",
        ),
        groups=tuple(name for name, _ in analysis.groups),
        strain_energies=arrays["strain_energies"],
        total_strain_energy=arrays["total_strain_energy"],
        mass=model.total_mass(model.assembled(factors)[1]),
    )  # fmt: skip


def _matrices(model: MatrixModel, arrays: dict[str, Floats]) -> MatrixResult:
    stiffness, mass = (
        sparse.csr_array(
            tuple(arrays[f"{name}_{part}"] for part in ("data", "indices", "indptr")),
            shape=model.stiffness.shape,
        )
        for name in ("stiffness", "mass")
    )
    return MatrixResult.of_full(stiffness, mass, model.nodes, model.components)
