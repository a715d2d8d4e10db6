"""What a name that is not known may have been meant for."""

from __future__ import annotations

from collections.abc import Iterable
from difflib import get_close_matches

#: Names that are listed where none is near.
LISTED = 12


def suggestion(name: str, known: Iterable[str]) -> str:
    """Said behind a name that is not among those known: the one nearest to it, or what there is.

    Upper and lower case are alike, as are `-` and `_`.
    """
    names = {_plain(item): item for item in known}
    near = get_close_matches(_plain(name), names, n=1)
    if near:
        return f"; did you mean {names[near[0]]}?"
    more = ", ..." if len(names) > LISTED else ""
    return f" (there are {', '.join(list(names.values())[:LISTED]) or 'none'}{more})"


def _plain(name: str) -> str:
    return name.lower().replace("-", "_")
