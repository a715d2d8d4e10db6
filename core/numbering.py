"""Numbers of modes where a campaign has several configurations, each with a test of its own.

Mode n of the test of the k-th configuration (from 1) has the number 1000 k + n, so that numbers
stay unique wherever modes of several tests stand side by side. With one configuration numbers are
the test's own.
"""

from __future__ import annotations

from collections.abc import Sequence

#: What the k-th configuration's place is multiplied with; a test's own numbers are smaller.
CONFIGURATION = 1000


def numbered(place: int, number: int) -> int:
    """The number of a mode of the configuration at a place (from 1) by its own test's number."""
    return CONFIGURATION * place + number


def configuration_of(configurations: Sequence[str], number: int) -> str | None:
    """The configuration whose test a mode is of, None where there is one only."""
    place = number // CONFIGURATION - 1
    return configurations[place] if 0 <= place < len(configurations) else None


def mode_name(configurations: Sequence[str], number: int) -> str:
    """A measured mode as people call it."""
    name = configuration_of(configurations, number)
    return f"mode {number}" if name is None else f"mode {number % CONFIGURATION} of {name}"
