"""A job: one analysis of a model at some parameter values, with its key, deck and note.

The deck is edited once: the deck rendered for the key is the one that runs, and `Plans` caches the
keys of this process.

Content keys show that two jobs differ but not how, because the deck enters the key as a digest.
The note stored with a result describes the job in terms of the campaign. It is not part of the key
and never affects what runs.
"""

from __future__ import annotations

import hashlib
import json
import threading
from dataclasses import dataclass, fields

from modetune.adapters.solver import (
    Analysis,
    MatrixAnalysis,
    ModalAnalysis,
    Rendered,
    SensitivityAnalysis,
    Solver,
)
from modetune.core.parameters import Values
from modetune.core.storage.keys import Json, canonical_json, content_key

#: Identifies a job of one model: its values by name, and its analysis.
Identity = tuple[tuple[tuple[str, float], ...], Analysis]

#: Edited decks of waiting jobs are kept up to this total size in bytes; beyond it only the keys.
KEPT_BYTES = 128 << 20
#: The note's file in the folder of a job.
NOTE_FILE = "note.json"
#: Parts of a content key that do not belong to the model and do not enter its digest.
NOT_THE_MODEL = frozenset({"version", "reader"})


@dataclass(frozen=True, slots=True)
class Job:
    """One analysis of the model at some parameter values (relative to the deck)."""

    values: Values
    analysis: Analysis

    @property
    def identity(self) -> Identity:
        """A hashable value that equal jobs share."""
        return tuple(sorted((name, float(value)) for name, value in self.values.items())), (
            self.analysis
        )


#: The nominal deck with the smallest analysis: its content identifies the model.
NOMINAL = Job({}, ModalAnalysis(1, ()))


@dataclass(frozen=True, slots=True)
class JobNote:
    """A readable description of a job.

    model_digest is that of the nominal deck, independent of the analysis; values are relative to
    the deck; nodes_digest is that of the output nodes; columns names the parameters for which the
    solver computes derivatives.
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
        """Return the note as JSON."""
        return json.dumps({item.name: getattr(self, item.name) for item in fields(self)})


@dataclass(frozen=True, slots=True)
class JobPlan:
    """A job before it runs: key, the canonical JSON behind the key, and the rendered deck."""

    key: str
    asked: str
    rendered: Rendered


class Plans:
    """The keys and waiting decks of one model's jobs in this process; thread-safe.

    A deck is rendered once and kept until its job has run or was found in the store.
    """

    def __init__(self, solver: Solver) -> None:
        self.solver = solver
        self._keys: dict[Identity, str] = {}
        self._waiting: dict[Identity, JobPlan] = {}
        self._size = 0
        self._digest: str | None = None
        self._lock = threading.Lock()

    def key(self, job: Job) -> str:
        """Return a job's content key. Raises ModelError, SolverMissing."""
        known = self._keys.get(job.identity)
        return self.plan(job).key if known is None else known

    def plan(self, job: Job) -> JobPlan:
        """Return a job's deck and key, kept for the run. Raises ModelError, SolverMissing."""
        with self._lock:
            waiting = self._waiting.get(job.identity)
            if waiting is not None:
                return waiting
            rendered = self.solver.render(job.values, job.analysis)
            asked = canonical_json(rendered.content)
            key = self._keys.get(job.identity) or content_key(asked)
            self._keys[job.identity] = key
            plan = JobPlan(key, asked, rendered)
            if self._size + rendered.size <= KEPT_BYTES:
                self._waiting[job.identity] = plan
                self._size += rendered.size
            return plan

    def done(self, job: Job) -> None:
        """Drop the deck of a job that has ended."""
        with self._lock:
            plan = self._waiting.pop(job.identity, None)
            self._size -= plan.rendered.size if plan else 0

    def model_digest(self) -> str:
        """Return the digest of the nominal deck. Raises ModelError, SolverMissing."""
        if self._digest is None:
            self._digest = _digest(_model_part(self.plan(NOMINAL).rendered.content))
            self.done(NOMINAL)
        return self._digest

    def note(self, job: Job, threads: int) -> JobNote:
        """Return the description stored with a job's result. Raises ModelError, SolverMissing."""
        analysis = job.analysis
        n_modes, nodes = (
            (0, ()) if isinstance(analysis, MatrixAnalysis) else (analysis.n_modes, analysis.nodes)
        )
        return JobNote(
            solver=self.solver.program.name,
            solver_version=self.solver.program.version(),
            model=self.solver.deck.summary.name,
            model_digest=self.model_digest(),
            analysis=analysis_kind(analysis),
            values=job.identity[0],
            n_modes=n_modes,
            n_nodes=len(nodes),
            nodes_digest=_digest(list(nodes)),
            columns=analysis.parameters if isinstance(analysis, SensitivityAnalysis) else (),
            threads=threads,
        )


def read_note(text: str) -> JobNote | None:
    """Read a note from JSON; None if it is missing or has other fields."""
    try:
        data = json.loads(text)
        return JobNote(
            solver=str(data["solver"]),
            solver_version=str(data["solver_version"]),
            model=str(data["model"]),
            model_digest=str(data["model_digest"]),
            analysis=str(data["analysis"]),
            values=tuple((str(name), float(value)) for name, value in data["values"]),
            n_modes=int(data["n_modes"]),
            n_nodes=int(data["n_nodes"]),
            nodes_digest=str(data["nodes_digest"]),
            columns=tuple(map(str, data["columns"])),
            threads=int(data["threads"]),
        )
    except (ValueError, KeyError, TypeError):
        return None


def analysis_kind(analysis: Analysis) -> str:
    """Return modal, matrices or sensitivity."""
    if isinstance(analysis, ModalAnalysis):
        return "modal"
    return "sensitivity" if isinstance(analysis, SensitivityAnalysis) else "matrices"


def _model_part(content: Json) -> Json:
    if not isinstance(content, dict):
        return content
    return {
        name: _model_part(value) for name, value in content.items() if name not in NOT_THE_MODEL
    }


def _digest(content: Json) -> str:
    return hashlib.sha256(canonical_json(content).encode("ascii")).hexdigest()[:16]
