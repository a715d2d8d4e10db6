"""Matrices behind the solver seam: SciPy's eigensolvers as a separate program."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import scipy

from modetune.adapters.matrices.deck import EditedMatrices, read_deck
from modetune.adapters.matrices.job import read_result, write_job
from modetune.adapters.solver import (
    Analysis,
    Capabilities,
    Command,
    ModalAnalysis,
    Rendered,
    Solver,
)
from modetune.core.parameters import Parameter
from modetune.core.storage.keys import Json
from modetune.core.updating.job_results import Result


@dataclass(frozen=True)
class MatricesProgram:
    """The embedded program, which solves what is written of a model of matrices."""

    name = "matrices"
    #: Raised by hand when the same job gives other numbers.
    reader_version = 2
    capabilities = Capabilities(strain_energies=True, matrices=True, tell_rigid=True)

    def version(self) -> str:
        """Return the version of SciPy, whose solvers give the numbers."""
        return scipy.__version__

    def render(self, deck: EditedMatrices, analysis: Analysis) -> Rendered:
        modal = analysis if isinstance(analysis, ModalAnalysis) else ModalAnalysis(0, ())
        content: Json = {
            "solver": self.name,
            "version": self.version(),
            "reader": self.reader_version,
            "model": deck.model.digest,
            "factors": {
                name: value
                for name, value in deck.factors.items()
                if value != 1.0 and not deck.model.parts[name].damps_only
            },
            "n_modes": modal.n_modes,
            "nodes": list(modal.nodes),
            "groups": [[name, list(parts)] for name, parts in modal.groups],
        }
        return Rendered(content, partial(write_job, deck.model, deck.factors, analysis))

    def command(self, threads: int) -> Command:
        count = str(threads)
        names = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS")
        # -P: what lies in the job's folder is data, never a module to import.
        arguments = (sys.executable, "-P", "-m", "modetune.adapters.matrices")
        return Command(arguments, tuple((name, count) for name in names))

    def read(
        self, deck: EditedMatrices, analysis: Analysis, folder: Path, return_code: int
    ) -> Result:
        return read_result(deck.model, deck.factors, analysis, folder, return_code)


def matrices_solver(deck: Path, parameters: tuple[Parameter, ...]) -> Solver:
    """Return the embedded solver for a model file.

    Raises ModelError where it cannot be understood.
    """
    return Solver(read_deck(deck, parameters), MatricesProgram())
