"""What a name that is not known may have been meant for."""

from __future__ import annotations

from collections.abc import Iterable
from difflib import get_close_matches
from typing import TypeVar

from modetune.core.errors import CampaignError

T = TypeVar("T")

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
    return f" (there are {listed(names.values(), LISTED) or 'none'})"


def listed(names: Iterable[object], most: int = 6) -> str:
    """Names with commas, the first few where there are many."""
    texts = [str(name) for name in names]
    more = f" and {len(texts) - most} more" if len(texts) > most else ""
    return ", ".join(texts[:most]) + more


def named(option: str, given: str, known: tuple[T, ...]) -> T:
    """What an option names of those that are known. Raises CampaignError."""
    for item in known:
        if item == given:
            return item
    raise CampaignError(f"{option} {given!r}: expected one of {', '.join(map(str, known))}")


def _plain(name: str) -> str:
    return name.lower().replace("-", "_")
