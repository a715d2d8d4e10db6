"""What says that a program got no licence: sentences of the licence managers, and a site's own.

The sentences are data: no program has its own way to read them, and a campaign adds what another
licence manager says (`run: licence_messages`).
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

from modetune.adapters.process import LOG
from modetune.adapters.regular_file import open_regular

#: Sentences of the licence managers themselves. "License" alone is in every banner and manual.
LICENCE = re.compile(
    r"FLEX(?:lm|net)\b.*(?:error|denied|fail|cannot|could not)|Licensed number of users already"
    r"|(?:could not|unable to|cannot|can't|failed to)\s+(?:check ?out|obtain|acquire|get|find"
    r"|connect to)\b.{0,60}licen[cs]e"
    r"|could not check ?out|licen[cs]e (?:server|file|manager|key).{0,60}(?:down|not respond"
    r"|not found|cannot|could not|denied|expired|invalid|unavailable|fail|no such|does not)"
    r"|licen[cs]e.{0,40}(?:denied|expired|unavailable|check-?out failed)"
    r"|no (?:such feature|licen[cs]es? (?:available|found|for))|Feature\b.{0,80}(?:not available|"
    r"expired|denied|does not (?:exist|support)|no licen)"
    r"|SPLM.{0,80}(?:error|fail|denied|cannot|could not|not )|invalid \(inconsistent\) license key"
    r"|MSC Licensing.{0,80}(?:error|fail|denied|not )"
    r"|(?:SYSTEM|USER) FATAL MESSAGE.{0,40}(?:LICEN[CS]E|AUTHORI[SZ]ATION)",
    re.IGNORECASE,
)
#: Comments of decks.
COMMENT = re.compile(r"\s*(\$|\*\*(?!\*))")
#: A licence is refused before anything is computed: within this many bytes of each file.
HEAD_BYTES = 1 << 20
#: Names of files in which programs say it, besides the log of what they print.
SPOKEN = ("*.log", "*.LOG", "*.f04", "*.F04", "*.f06", "*.F06", "*.out", "*.err", "*.ERR", "*.msg")


def licence_denied(text: str, messages: Sequence[str] = ()) -> str:
    """Return the first line of a text that says a licence was refused; empty if none does.

    messages: parts of lines that say so too, in upper or lower case.
    """
    own = [message.lower() for message in messages]
    for line in text.splitlines():
        # A card or comment of the user's deck may speak of licences too.
        if not COMMENT.match(line) and (
            LICENCE.search(line) or any(message in line.lower() for message in own)
        ):
            return line.strip(" *\t")
    return ""


def licence_refusal(folder: Path, messages: Sequence[str] = ()) -> str:
    """Return the line of a job's files that reports a refused licence, empty if none does."""
    files = dict.fromkeys(path for name in (LOG, *SPOKEN) for path in sorted(folder.glob(name)))
    for path in files:
        try:
            with open_regular(path) as file:
                text = licence_denied(file.read(HEAD_BYTES).decode("latin-1"), messages)
        except OSError:  # gone, or no file
            continue
        if text:
            return text
    return ""
