"""What is noted beside a result for people: the model's name and state, and the parameter values.

A content key tells that two jobs differ, not in what: the deck goes into it as a digest. A note
says it in words of the campaign. It is no part of the key, so it never decides what is run.
"""

from __future__ import annotations

import hashlib
import json
from dataclasses import asdict, dataclass

from modetune.adapters.solver import (
    Analysis,
    MatrixAnalysis,
    ModalAnalysis,
    SensitivityAnalysis,
    Solver,
)
from modetune.core.keys import Json, canonical_json
from modetune.core.parameters import Values

#: The note's file in the folder of a job.
NOTE_FILE = "note.json"
#: What content keys hold besides the model; a model keeps its digest when these change.
NOT_THE_MODEL = frozenset({"version", "reader"})


@dataclass(frozen=True, slots=True)
class JobNote:
    """A job for people.

    model_digest: of the deck at its own values, whatever is asked of it; values: of the
    parameters, relative to the deck; nodes_digest: of the nodes whose shapes were wanted;
    columns: names of the parameters whose derivatives were wanted of the solver itself.
    """

    solver: str
    solver_version: str
    model: str
    model_digest: str
    analysis: str
    values: tuple[tuple[str, float], ...]
    n_modes: int
    n_nodes: int
    nodes_digest: str
    columns: tuple[str, ...]
    threads: int

    def text(self) -> str:
        """The note as JSON."""
        return json.dumps(asdict(self))


def job_note(solver: Solver, values: Values, analysis: Analysis, threads: int) -> JobNote:
    """The note of a job. Raises ModelError."""
    n_modes, nodes = (
        (0, ()) if isinstance(analysis, MatrixAnalysis) else (analysis.n_modes, analysis.nodes)
    )
    return JobNote(
        solver=solver.name,
        solver_version=solver.version(),
        model=solver.model.name,
        model_digest=model_digest(solver),
        analysis=analysis_kind(analysis),
        values=tuple(sorted((name, float(value)) for name, value in values.items())),
        n_modes=n_modes,
        n_nodes=len(nodes),
        nodes_digest=_digest(list(nodes)),
        columns=analysis.parameters if isinstance(analysis, SensitivityAnalysis) else (),
        threads=threads,
    )


def read_note(text: str) -> JobNote | None:
    """The note of this text; nothing where there is none, or one of another shape."""
    try:
        told = json.loads(text)
        return JobNote(
            solver=str(told["solver"]),
            solver_version=str(told["solver_version"]),
            model=str(told["model"]),
            model_digest=str(told["model_digest"]),
            analysis=str(told["analysis"]),
            values=tuple((str(name), float(value)) for name, value in told["values"]),
            n_modes=int(told["n_modes"]),
            n_nodes=int(told["n_nodes"]),
            nodes_digest=str(told["nodes_digest"]),
            columns=tuple(map(str, told["columns"])),
            threads=int(told["threads"]),
        )
    except (ValueError, KeyError, TypeError):
        return None


def analysis_kind(analysis: Analysis) -> str:
    """modal, matrices or sensitivity."""
    if isinstance(analysis, ModalAnalysis):
        return "modal"
    return "sensitivity" if isinstance(analysis, SensitivityAnalysis) else "matrices"


def model_digest(solver: Solver) -> str:
    """Digest of the model at the deck's own values. Raises ModelError."""
    return _digest(_model_part(solver.content({}, ModalAnalysis(1, ()))))


def _model_part(content: Json) -> Json:
    if not isinstance(content, dict):
        return content
    return {
        name: _model_part(value) for name, value in content.items() if name not in NOT_THE_MODEL
    }


def _digest(content: Json) -> str:
    return hashlib.sha256(canonical_json(content).encode("ascii")).hexdigest()[:16]
