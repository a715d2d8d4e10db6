"""What differs between two jobs, for why a job is run, or what a stored result is.

Differences are told in the campaign's words where both jobs carry a note (`job.py`), else in those
of the content keys. The nearest stored result is found by `store_index`.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass

from modetune.core.storage.keys import Json
from modetune.core.storage.store import Holding
from modetune.flows.jobs.deck_texts import Text, deck_difference
from modetune.flows.jobs.job import JobNote, read_note

#: What content keys call the deck with the values in it; a note says it better.
SAID_BY_NOTES = frozenset({
    "deck", "model", "factors", "values", "parameters", "columns", "n_modes", "modes", "nodes",
    "frames", "analysis", "kind", "solver", "version",
})  # fmt: skip
#: Words for what content keys call otherwise.
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
SHOWN = 40
DECK = "the deck's text differs"

#: A deck's lines by the digest of its model, None where they are not known.
Texts = Callable[[str], Text | None]


@dataclass(frozen=True, slots=True)
class AskedJob:
    """A job as far as it is known. asked: what went into the key by name, as JSON each."""

    key: str
    solver: str
    solver_version: str
    kind: str
    asked: tuple[tuple[str, str], ...]
    note: JobNote | None


@dataclass(frozen=True, slots=True)
class Nearest:
    """The stored result nearest to a job, and what differs, the job first."""

    key: str
    differences: tuple[str, ...]


def asked_of(holding: Holding) -> AskedJob:
    """A stored result as a job."""
    note = read_note(holding.note)
    return AskedJob(
        key=holding.key,
        solver=holding.solver,
        solver_version=holding.solver_version,
        kind=note.analysis if note else holding.kind,
        asked=named_parts(holding.asked),
        note=note,
    )


def asked_by_note(key: str, note: JobNote, asked: str = "{}") -> AskedJob:
    """A job that has no result, by its note and, where known, the canonical JSON of its key."""
    return AskedJob(key, note.solver, note.solver_version, note.analysis, named_parts(asked), note)


def named_parts(asked: str) -> tuple[tuple[str, str], ...]:
    """What went into a key: the name and JSON of every part, parts of parts taken apart."""
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


def differences_with_places(job: AskedJob, other: AskedJob, texts: Texts) -> tuple[str, ...]:
    """What differs between two jobs, with the places where their decks do.

    texts: the deck's lines by the digest of a model, where they are known.
    """
    told = differences(job, other)
    if job.note is None or other.note is None:
        return told
    ours, theirs = texts(job.note.model_digest), texts(other.note.model_digest)
    places = deck_difference(ours, theirs) if ours is not None and theirs is not None else ""
    if not places:
        return told
    return tuple(f"{text}: {places}" if text.startswith(DECK) else text for text in told)


def differences(job: AskedJob, other: AskedJob) -> tuple[str, ...]:
    """What differs between two jobs, a phrase each; the first one's side is told first."""
    told = told_differences(job, other)
    if not told and job.key != other.key:
        return ("what the parameters change in the deck, at the same names and values",)
    return tuple(told)


def told_differences(job: AskedJob, other: AskedJob) -> list[str]:
    """The differences between two jobs that can be told from what is known of them."""
    told = []
    if job.solver != other.solver:
        told.append(f"solver {job.solver}, there {other.solver}")
    elif job.solver_version != other.solver_version:
        told.append(f"{job.solver} {job.solver_version}, there {other.solver_version}")
    if job.kind != other.kind:
        told.append(f"{job.kind} analysis, there {other.kind}")
    known = job.note is not None and other.note is not None
    if job.note is not None and other.note is not None:
        told += _by_notes(job.note, other.note)
    ours, theirs = dict(job.asked), dict(other.asked)
    if ours and theirs:
        for name in sorted(ours.keys() | theirs.keys()):
            covered = name in SAID_BY_NOTES if known else name in ("solver", "version")
            covered = covered or (name == "groups" and job.kind != other.kind)
            if ours.get(name) != theirs.get(name) and not covered:
                told.append(_part(name, ours.get(name), theirs.get(name)))
    return told


def _by_notes(note: JobNote, other: JobNote) -> list[str]:
    told = []
    if note.model_digest != other.model_digest:
        names = f" ({note.model}, there {other.model})" if note.model != other.model else ""
        told.append(f"{DECK}{names}")
    ours, theirs = dict(note.values), dict(other.values)
    for name in sorted(ours.keys() | theirs.keys()):
        here, there = ours.get(name, 1.0), theirs.get(name, 1.0)  # 1 is the deck's own value
        if here != there:
            told.append(f"{name} {_number(here, there)}, there {_number(there, here)}")
    if note.analysis != other.analysis:
        return told
    if note.n_modes != other.n_modes:
        told.append(f"{note.n_modes} modes, there {other.n_modes}")
    if note.n_nodes != other.n_nodes:
        told.append(f"shapes at {note.n_nodes} nodes, there at {other.n_nodes}")
    elif note.nodes_digest != other.nodes_digest:
        told.append(f"shapes at {note.n_nodes} nodes, there at as many others")
    if note.columns != other.columns:
        told.append(
            f"derivatives by {', '.join(note.columns)}, there by {', '.join(other.columns)}"
        )
    return told


def _number(value: float, beside: float) -> str:
    """Six digits, or as many as tell it from the other one."""
    text = f"{value:.6g}"
    return text if text != f"{beside:.6g}" else repr(value)


def _part(name: str, here: str | None, there: str | None) -> str:
    word = WORDS.get(name, f"`{name}`")
    if here is None or there is None:
        return f"{word}: {'only here' if there is None else 'only there'}"
    if max(len(here), len(there)) > SHOWN:
        return f"{word} differs" if name != "groups" else f"{word} differ"
    return f"{word} {here}, there {there}"


def describe(job: AskedJob) -> list[tuple[str, str]]:
    """A job in headings and words."""
    told = [("solver", f"{job.solver} {job.solver_version}".strip())]
    note = job.note
    if note is None:
        what = (
            "computed by modetune from stored results"
            if job.solver == "modetune"
            else ("no note is with it (it was stored by an earlier modetune)")
        )
        parts = [
            f"{WORDS.get(name, name)} {value}" for name, value in job.asked if len(value) <= SHOWN
        ]
        return [("what", f"{job.kind}, {what}"), *told, ("asked", "; ".join(parts) or "not known")]
    what = f"{note.analysis} analysis of {note.model}"
    if note.n_modes:
        what += f", {note.n_modes} modes"
    if note.n_nodes:
        what += f", shapes at {note.n_nodes} nodes"
    if note.columns:
        what += f", derivatives by {', '.join(note.columns)}"
    values = ", ".join(f"{name} {value:.6g}" for name, value in note.values)
    return [("what", what), *told, ("at", f"{values or 'no parameters'} (relative to the deck)")]
