"""A job: one analysis of the model at some parameter values; its key, its deck, its note.

Its deck is edited once: what is rendered for the key is what is run, and a key that was worked out
in this process is remembered (`Plans`).

A content key tells that two jobs differ, not in what: the deck goes into it as a digest. The note
beside a result says it for people, in words of the campaign. It is not part of the key, so it never
decides what is run.
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

#: What identifies a job of one model: its values by name, and its analysis.
Identity = tuple[tuple[tuple[str, float], ...], Analysis]

#: Edited decks of jobs that wait to be run are kept up to this size in all, bytes; of larger ones
#: the key alone is remembered.
KEPT_BYTES = 128 << 20
#: The note's file in the folder of a job.
NOTE_FILE = "note.json"
#: What content keys hold besides the model; a model keeps its digest when these change.
NOT_THE_MODEL = frozenset({"version", "reader"})


@dataclass(frozen=True, slots=True)
class Job:
    """One analysis of the model at some parameter values (relative to the deck)."""

    values: Values
    analysis: Analysis

    @property
    def identity(self) -> Identity:
        """What it has in common with all jobs that are the same."""
        return tuple(sorted((name, float(value)) for name, value in self.values.items())), (
            self.analysis
        )


#: The deck's own values, with nothing asked of the model: what tells models apart.
NOMINAL = Job({}, ModalAnalysis(1, ()))


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
        return json.dumps({item.name: getattr(self, item.name) for item in fields(self)})


@dataclass(frozen=True, slots=True)
class JobPlan:
    """A job before it is run. asked: the canonical JSON behind the key; rendered: its deck."""

    key: str
    asked: str
    rendered: Rendered


class Plans:
    """What is known of one model's jobs in this process; safe from many threads.

    A job's deck is rendered and its key worked out once. The deck is kept until the job is run or
    found in the store, so that it is not rendered again then.
    """

    def __init__(self, solver: Solver) -> None:
        self.solver = solver
        self._keys: dict[Identity, str] = {}
        self._waiting: dict[Identity, JobPlan] = {}
        self._size = 0
        self._digest: str | None = None
        self._lock = threading.Lock()

    def key(self, job: Job) -> str:
        """The content key of a job. Raises ModelError, SolverMissing."""
        known = self._keys.get(job.identity)
        return self.plan(job).key if known is None else known

    def plan(self, job: Job) -> JobPlan:
        """A job's deck with its key, kept for the run. Raises ModelError, SolverMissing."""
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
        """Forget the deck of a job that the store has."""
        with self._lock:
            plan = self._waiting.pop(job.identity, None)
            self._size -= plan.rendered.size if plan else 0

    def model_digest(self) -> str:
        """Digest of the model at the deck's own values. Raises ModelError, SolverMissing."""
        if self._digest is None:
            self._digest = _digest(_model_part(self.plan(NOMINAL).rendered.content))
        return self._digest

    def note(self, job: Job, threads: int) -> JobNote:
        """What is told of a job beside its result. Raises ModelError, SolverMissing."""
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


def _model_part(content: Json) -> Json:
    if not isinstance(content, dict):
        return content
    return {
        name: _model_part(value) for name, value in content.items() if name not in NOT_THE_MODEL
    }


def _digest(content: Json) -> str:
    return hashlib.sha256(canonical_json(content).encode("ascii")).hexdigest()[:16]
