"""Texts of decks kept beside the results, so that it can be told where two of them differ.

    STORE/models/DIGEST.gz    what the solver was given, at the deck's own values

They are for people: nothing is computed from them, and one that is missing or damaged only makes
an explanation shorter. Decks beyond a size are not kept.
"""

from __future__ import annotations

import gzip
import logging
import tempfile
import zlib
from difflib import SequenceMatcher
from pathlib import Path

from modetune.adapters.cross_checks import without_mark
from modetune.adapters.solver import Rendered
from modetune.core.errors import ModetuneError
from modetune.core.storage.files import writing
from modetune.core.storage.store import Store

logger = logging.getLogger(__name__)

#: Larger decks are not kept, bytes.
LARGEST = 32 << 20
#: Longer stretches between the first and the last difference are counted, not compared.
COMPARED_LINES = 2000
#: Differences shown, and characters of each line.
SHOWN, WIDTH = 3, 50

Text = list[str]


def keep_text(store: Store, digest: str, nominal: Rendered) -> None:
    """Keep a deck's text by the digest of its model. What prevents it is logged and harms nothing.

    nominal: a job at the deck's own values.
    """
    path = _path(store, digest)
    try:
        text = None if path.exists() else deck_text(nominal)
        if text is not None:
            with writing(path) as part:
                part.write_bytes(gzip.compress("\n".join(text).encode("utf-8", "surrogateescape")))
    except (ModetuneError, OSError) as error:
        logger.info("the deck's text is not kept: %s", error)


def deck_text(nominal: Rendered) -> Text | None:
    """The lines of what a solver is given; nothing where it is not a text.

    Raises ModelError; OSError where the temporary folder has no room.
    """
    with tempfile.TemporaryDirectory(prefix="modetune-") as name:
        nominal.write(Path(name))
        files = sorted(path for path in Path(name).rglob("*") if path.is_file())
        if sum(path.stat().st_size for path in files) > LARGEST:
            return None
        data = without_mark(b"\n".join(path.read_bytes() for path in files))
    return None if b"\0" in data else data.decode("utf-8", "surrogateescape").splitlines()


def kept_text(store: Store, digest: str) -> Text | None:
    """The lines of a kept deck, by the digest of its model, or nothing."""
    try:
        data = gzip.decompress(_path(store, digest).read_bytes())
    except (OSError, EOFError, zlib.error):
        return None
    return data.decode("utf-8", "surrogateescape").splitlines() or None


def deck_difference(ours: Text, theirs: Text) -> str:
    """Where two decks differ: the first few stretches of lines, ours first; empty where nowhere."""
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
    told = [
        f"{_quoted(here[i:j])}{_below(ours, start + i)}, there {_quoted(there[k:m])}"
        for _, i, j, k, m in changes[:SHOWN]
    ]
    more = len(changes) - SHOWN
    return ", ".join(told) + (f", and in {more} more places" if more > 0 else "")


def _quoted(lines: Text) -> str:
    if not lines:
        return "nothing"
    first = lines[0].strip()
    text = f"`{first[:WIDTH]}{'...' if len(first) > WIDTH else ''}`"
    return text if len(lines) == 1 else f"{text} and {len(lines) - 1} more lines"


def _below(lines: Text, place: int) -> str:
    """The keyword line above a place, in decks that have such lines."""
    for line in reversed(lines[:place]):
        if line.startswith("*"):
            return f" (below {line.strip()[:WIDTH]})"
    return ""


def _path(store: Store, digest: str) -> Path:
    return store.folder / "models" / f"{digest}.gz"
