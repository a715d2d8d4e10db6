"""Differences between two jobs: why a job has to run although a similar result is stored.

Differences are described in terms of the campaign if both jobs have a note (`job.py`), otherwise by
the parts of the content keys. Decks are compared line by line: the text of each nominal deck is in

    STORE/models/DIGEST.gz

It serves only these descriptions: without it they are shorter. Very large decks are not stored.
"""

from __future__ import annotations

import gzip
import json
import logging
import tempfile
import zlib
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from difflib import SequenceMatcher
from pathlib import Path

from modetune.adapters.cross_checks import without_mark
from modetune.adapters.solver import Rendered
from modetune.core.errors import ModetuneError
from modetune.core.storage.files import writing
from modetune.core.storage.keys import Json
from modetune.core.storage.store import Holding, Store
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
DECK = "the deck's text differs"

Text = list[str]
#: Returns a deck's lines by the digest of its model, None if they are not stored.
Texts = Callable[[str], Text | None]


@dataclass(frozen=True, slots=True)
class JobDescription:
    """What is known about a job; asked has the parts of its key as (name, JSON)."""

    key: str
    solver: str
    solver_version: str
    kind: str
    asked: tuple[tuple[str, str], ...]
    note: JobNote | None


@dataclass(frozen=True, slots=True)
class Nearest:
    """The stored result nearest to a job, and the differences between the two."""

    key: str
    differences: tuple[str, ...]


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


def differences_with_places(
    job: JobDescription, other: JobDescription, texts: Texts
) -> tuple[str, ...]:
    """Return the differences between two jobs, with the lines in which their decks differ."""
    found = differences(job, other)
    if job.note is None or other.note is None:
        return found
    ours, theirs = texts(job.note.model_digest), texts(other.note.model_digest)
    places = deck_difference(ours, theirs) if ours is not None and theirs is not None else ""
    if not places:
        return found
    return tuple(f"{text}: {places}" if text.startswith(DECK) else text for text in found)


def differences(job: JobDescription, other: JobDescription) -> tuple[str, ...]:
    """Return a phrase for each difference between two jobs, the first job's side first."""
    found = list_differences(job, other)
    if not found and job.key != other.key:
        return ("parameters of the same names and values act on other parts of the deck",)
    return tuple(found)


def list_differences(job: JobDescription, other: JobDescription) -> list[str]:
    """Return the differences between the known parts of two jobs."""
    texts = []
    if job.solver != other.solver:
        texts.append(f"solver {job.solver}, there {other.solver}")
    elif job.solver_version != other.solver_version:
        texts.append(f"{job.solver} {job.solver_version}, there {other.solver_version}")
    if job.kind != other.kind:
        texts.append(f"{job.kind} analysis, there {other.kind}")
    known = job.note is not None and other.note is not None
    if job.note is not None and other.note is not None:
        texts += _by_notes(job.note, other.note)
    ours, theirs = dict(job.asked), dict(other.asked)
    if ours and theirs:
        for name in sorted(ours.keys() | theirs.keys()):
            covered = name in IN_NOTES if known else name in ("solver", "version")
            covered = covered or (name == "groups" and job.kind != other.kind)
            if ours.get(name) != theirs.get(name) and not covered:
                texts.append(_part(name, ours.get(name), theirs.get(name)))
    return texts


def _by_notes(note: JobNote, other: JobNote) -> list[str]:
    texts = []
    if note.model_digest != other.model_digest:
        names = f" ({note.model}, there {other.model})" if note.model != other.model else ""
        texts.append(f"{DECK}{names}")
    ours, theirs = dict(note.values), dict(other.values)
    for name in sorted(ours.keys() | theirs.keys()):
        here, there = ours.get(name, 1.0), theirs.get(name, 1.0)  # 1 is the deck's own value
        if here != there:
            texts.append(f"{name} {_number(here, there)}, there {_number(there, here)}")
    if note.analysis != other.analysis:
        return texts
    if note.n_modes != other.n_modes:
        texts.append(f"{note.n_modes} modes, there {other.n_modes}")
    if note.n_nodes != other.n_nodes:
        texts.append(f"shapes at {note.n_nodes} nodes, there at {other.n_nodes}")
    elif note.nodes_digest != other.nodes_digest:
        texts.append(f"shapes at {note.n_nodes} nodes, there at as many others")
    if note.columns != other.columns:
        texts.append(
            f"derivatives by {', '.join(note.columns)}, there by {', '.join(other.columns)}"
        )
    return texts


def _number(value: float, beside: float) -> str:
    """Six digits, or all if the other value has the same six."""
    text = f"{value:.6g}"
    return text if text != f"{beside:.6g}" else repr(value)


def _part(name: str, here: str | None, there: str | None) -> str:
    word = WORDS.get(name, f"`{name}`")
    if here is None or there is None:
        return f"{word}: {'only here' if there is None else 'only there'}"
    if max(len(here), len(there)) > LONGEST:
        return f"{word} differs" if name != "groups" else f"{word} differ"
    return f"{word} {here}, there {there}"


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


logger = logging.getLogger(__name__)

#: Larger decks are not kept, bytes.
LARGEST = 32 << 20
#: If first and last difference are further apart, their lines are counted, not compared.
COMPARED_LINES = 2000
#: Differences shown, and characters of each line.
SHOWN_CHANGES, WIDTH = 3, 50


def save_text(store: Store, digest: str, nominal: Rendered) -> None:
    """Store a nominal deck's text under the digest of its model; failures are only logged."""
    path = _path(store, digest)
    try:
        text = None if path.exists() else deck_text(nominal)
        if text is not None:
            with writing(path) as part:
                part.write_bytes(gzip.compress("\n".join(text).encode("utf-8", "surrogateescape")))
    except (ModetuneError, OSError) as error:
        logger.info("the deck's text was not stored: %s", error)


def deck_text(nominal: Rendered) -> Text | None:
    """Return the lines of a solver's input; None if it is binary or too large.

    Raises ModelError, and OSError if the temporary folder is full.
    """
    with tempfile.TemporaryDirectory(prefix="modetune-") as name:
        nominal.write(Path(name))
        files = sorted(path for path in Path(name).rglob("*") if path.is_file())
        if sum(path.stat().st_size for path in files) > LARGEST:
            return None
        data = without_mark(b"\n".join(path.read_bytes() for path in files))
    return None if b"\0" in data else data.decode("utf-8", "surrogateescape").splitlines()


def load_text(store: Store, digest: str) -> Text | None:
    """Return the stored lines of the deck with this digest, None if there are none."""
    try:
        data = gzip.decompress(_path(store, digest).read_bytes())
    except (OSError, EOFError, zlib.error):
        return None
    return data.decode("utf-8", "surrogateescape").splitlines() or None


def deck_difference(ours: Text, theirs: Text) -> str:
    """Return the first few differing groups of lines, ours first; "" if the decks are equal."""
    start = 0
    while start < min(len(ours), len(theirs)) and ours[start] == theirs[start]:
        start += 1
    end = 0
    while end < min(len(ours), len(theirs)) - start and ours[-1 - end] == theirs[-1 - end]:
        end += 1
    here, there = ours[start : len(ours) - end], theirs[start : len(theirs) - end]
    if not here and not there:
        return ""
    if max(len(here), len(there)) > COMPARED_LINES:
        return f"{len(here)} lines in place of {len(there)}{_below(ours, start)}"
    changes = [
        change
        for change in SequenceMatcher(None, here, there, autojunk=False).get_opcodes()
        if change[0] != "equal"
    ]
    shown = [
        f"{_quoted(here[i:j])}{_below(ours, start + i)}, there {_quoted(there[k:m])}"
        for _, i, j, k, m in changes[:SHOWN_CHANGES]
    ]
    more = len(changes) - SHOWN_CHANGES
    return ", ".join(shown) + (f", and in {more} more places" if more > 0 else "")


def _quoted(lines: Text) -> str:
    if not lines:
        return "nothing"
    first = lines[0].strip()
    text = f"`{first[:WIDTH]}{'...' if len(first) > WIDTH else ''}`"
    return text if len(lines) == 1 else f"{text} and {len(lines) - 1} more lines"


def _below(lines: Text, place: int) -> str:
    """The keyword line above a line, in decks that have keyword lines."""
    for line in reversed(lines[:place]):
        if line.startswith("*"):
            return f" (below {line.strip()[:WIDTH]})"
    return ""


def _path(store: Store, digest: str) -> Path:
    return store.folder / "models" / f"{digest}.gz"
