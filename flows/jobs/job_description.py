"""Descriptions of jobs: the inputs that make a content key, in the words of the campaign."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass

from modetune.core.storage.keys import Json
from modetune.core.storage.store import Holding
from modetune.flows.jobs.job import JobNote, read_note

#: Parts of content keys that a note describes better.
IN_NOTES = frozenset({
    "deck", "model", "factors", "values", "parameters", "columns", "n_modes", "modes", "nodes",
    "frames", "analysis", "kind", "solver", "version",
})  # fmt: skip
#: Readable names of other parts.
WORDS = {
    "deck": "the deck's text with the parameter values in it",
    "model": "the model",
    "factors": "parameter values",
    "values": "parameter values",
    "groups": "groups whose strain energies are wanted",
    "n_modes": "number of modes",
    "version": "solver version",
    "reader": "modetune's reader of the output",
    "jobs": "the stored results it follows from",
}
#: Longer values are not shown.
LONGEST = 40


@dataclass(frozen=True, slots=True)
class JobDescription:
    """What is known about a job; asked has the parts of its key as (name, JSON)."""

    key: str
    solver: str
    solver_version: str
    kind: str
    asked: tuple[tuple[str, str], ...]
    note: JobNote | None


def job_of_holding(holding: Holding) -> JobDescription:
    """Return the description of a stored result's job."""
    note = read_note(holding.note)
    return JobDescription(
        key=holding.key,
        solver=holding.solver,
        solver_version=holding.solver_version,
        kind=note.analysis if note else holding.kind,
        asked=named_parts(holding.asked),
        note=note,
    )


def job_of_note(key: str, note: JobNote, asked: str = "{}") -> JobDescription:
    """Return the description of a job without a result; asked is the key's JSON, if known."""
    return JobDescription(
        key, note.solver, note.solver_version, note.analysis, named_parts(asked), note
    )


def named_parts(asked: str) -> tuple[tuple[str, str], ...]:
    """Return the parts of a key's JSON as sorted (name, JSON), nested parts separately."""
    try:
        content: Json = json.loads(asked)
    except ValueError:
        return ()
    return tuple(sorted(_parts(content)))


def _parts(content: Json) -> Iterator[tuple[str, str]]:
    if not isinstance(content, Mapping):
        return
    for name, value in content.items():
        if isinstance(value, Mapping) and name not in ("values", "factors", "frames"):
            yield from _parts(value)
        else:
            yield name, json.dumps(value)


def describe(job: JobDescription) -> list[tuple[str, str]]:
    """Return a job's description as rows of (heading, text)."""
    texts = [("solver", f"{job.solver} {job.solver_version}".strip())]
    note = job.note
    if note is None:
        what = (
            "computed by modetune from stored results"
            if job.solver == "modetune"
            else "stored without a note by an earlier modetune"
        )
        parts = [
            f"{WORDS.get(name, name)} {value}" for name, value in job.asked if len(value) <= LONGEST
        ]
        return [("what", f"{job.kind}, {what}"), *texts, ("asked", "; ".join(parts) or "not known")]
    what = f"{note.analysis} analysis of {note.model}"
    if note.n_modes:
        what += f", {note.n_modes} modes"
    if note.n_nodes:
        what += f", shapes at {note.n_nodes} nodes"
    if note.columns:
        what += f", derivatives by {', '.join(note.columns)}"
    values = ", ".join(f"{name} {value:.6g}" for name, value in note.values)
    return [("what", what), *texts, ("at", f"{values or 'no parameters'} (relative to the deck)")]
