"""What is said behind a name that is not known."""

from __future__ import annotations

import pytest

from modetune.core.near_names import LISTED, suggestion


@pytest.mark.parametrize(
    ("name", "known", "said"),
    [
        ("stifness", ["stiffness", "mass"], "; did you mean stiffness?"),
        ("SIX_MASS", ["garteur", "six-mass"], "; did you mean six-mass?"),
        ("qqq", ["b", "a"], " (there are b, a)"),
        ("qqq", [], " (there are none)"),
        ("", map(str, range(LISTED)), f" (there are {', '.join(map(str, range(LISTED)))})"),
        ("", map(str, range(20)), f" (there are {', '.join(map(str, range(LISTED)))} and 8 more)"),
    ],
)
def test_the_nearest_name_or_what_there_is(name: str, known: list[str], said: str) -> None:
    assert suggestion(name, known) == said
